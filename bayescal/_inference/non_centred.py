"""A NumPyro model of one's own in units of its priors, in which NUTS finds one step for all unknowns."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any


def non_centred(model: Callable[..., Any], but: Collection[str] = ()) -> Callable[..., Any]:
    """Return a NumPyro model whose normal unknowns are sampled as standard ones, which changes no posterior.

    Sizes of unknowns are orders of magnitude apart, so that a step in one is none in another; and an unknown whose
    spread is learned makes a funnel with it (M. Betancourt and M. Girolami, arXiv 1312.0906).

    Args:
        model: a function with `numpyro.sample` statements.
        but: names of sites to sample as they stand: what readings tell far better than the prior does whose spread is
            learned.
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
