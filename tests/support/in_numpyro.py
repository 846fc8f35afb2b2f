"""NUTS on the models that are written out in NumPyro (`as_numpyro.py` of an instrument)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import jax
import numpy as np
from numpyro.distributions import Independent, Normal
from numpyro.handlers import reparam
from numpyro.infer import MCMC, NUTS, init_to_median
from numpyro.infer.reparam import LocScaleReparam, Reparam


def draws(
    model: Callable[..., None],
    data: Mapping[str, Any],
    *,
    centred: Collection[str] = (),
    seed: int = 0,
    warmup: int = 1000,
    samples: int = 2000,
) -> dict[str, np.ndarray]:
    """Draws of every site, by its name, of one chain.

    Sizes of unknowns are orders of magnitude apart, and so a step in one is none in another: every normal one is
    sampled in units of its prior standard deviation, which changes no posterior. Those named in `centred` are sampled
    as they stand: what the readings tell far better than the prior whose spread is learned.
    """

    def in_its_size(site: dict[str, Any]) -> Reparam | None:
        law, done = site["fn"], site["name"].endswith("_decentered")
        law = law.base_dist if isinstance(law, Independent) else law
        if site["is_observed"] or done or site["name"] in centred or not isinstance(law, Normal):
            return None
        return LocScaleReparam(0.0)

    kernel = NUTS(
        reparam(model, config=in_its_size),
        dense_mass=True,
        target_accept_prob=0.95,
        init_strategy=init_to_median,
    )
    with jax.enable_x64(True):
        chain = MCMC(kernel, num_warmup=warmup, num_samples=samples, progress_bar=False)
        chain.run(jax.random.key(seed), **data)
    return {name: np.asarray(values) for name, values in chain.get_samples().items()}
