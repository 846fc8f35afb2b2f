"""Non-centred reparametrisation of a NumPyro model: unknowns in units of their priors, for one NUTS step size."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any


def non_centred(model: Callable[..., Any], but: Collection[str] = ()) -> Callable[..., Any]:
    """Return a NumPyro model with normal unknowns sampled as standard normal ones; the posterior is unchanged.

    Unknowns of different magnitude need different step sizes; and an unknown with a learned standard deviation forms a
    funnel with it (M. Betancourt and M. Girolami, arXiv 1312.0906).

    Args:
        model: a function with `numpyro.sample` statements.
        but: names of sites to leave centred: unknowns determined by the readings far better than by a prior with
            learned standard deviation.
    """
    from numpyro.distributions import Independent, Normal
    from numpyro.handlers import reparam
    from numpyro.infer.reparam import LocScaleReparam

    def standard(site: dict[str, Any]) -> LocScaleReparam | None:
        law, done = site["fn"], site["name"].endswith("_decentered")
        law = law.base_dist if isinstance(law, Independent) else law
        is_kept = site["is_observed"] or done or site["name"] in but or not isinstance(law, Normal)
        return None if is_kept else LocScaleReparam(0.0)

    return reparam(model, config=standard)
