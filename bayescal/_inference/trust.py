"""When a sampler is reliable: the one policy, from diagnostics to the reasons of a verdict.

Draws from importance weights are trusted by Pareto k̂ and their effective size, chains by R-hat, their effective size
and divergences, an optimum by its last step and its curvature. Whoever fits asks here: methods, devices of a batch,
programs.
Sources: Vehtari et al., JMLR 25 (2024) 72 (k̂); Vehtari et al., Bayesian Analysis 16 (2021) 667 (R-hat).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.importance_weights import effective_size
from bayescal._core.settings_in_force import OutcomeSettings, in_force
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Verdict
from bayescal._inference.nuts_chains import Chains

NOT_CONVERGED = "Levenberg–Marquardt stopped before its tolerance was met."
SINGULAR = "The curvature is singular: some direction is not determined by readings or priors."


@dataclass(frozen=True)
class SamplingSettings(OutcomeSettings):
    """When draws are trusted.

    Attributes:
        k_hat: above it, importance weights are not reliable (Vehtari et al. 2024).
        k_hat_nonlinear: the same where the model is nonlinear: coefficients are proposed with a Gaussian's tails,
            thinner than those that they may have, and k̂ then shows too little: at 0.6 to 0.7, standard deviations came
            out up to a third too small, below 0.5 right.
        nonlinear: standard deviation of the log weights by nonlinearity, from which on that counts.
        enough: effective draws, below which more are made: a standard deviation is then known to 3.5 %.
        fewest: effective draws that will do where there is no time for more: it is then known to 7 %.
        r_hat: of chains that agree; Vehtari et al. 2021 ask for 1.01 of long chains.
        enough_of_chains: effective draws of a coordinate, of which a standard deviation is known to 5 %.
        divergent: share of the transitions, up to which a corner of the posterior is none.
        product: root-sum-square over the readings, in noise standard deviations, of the second-order term of a product
            of two unknowns, from which one of them is sampled: below it the log likelihood changes by
            less than ½·0.3² = 0.045 nats on average.
        moving: standard deviations that the mode's last round moved anything by, beyond which it was no mode.
        higher: log density above the mode's, from which on a draw shows that it was not the highest: more than what
            interpolated products are off by (0.03), less than would matter.
    """

    k_hat: float = 0.7
    k_hat_nonlinear: float = 0.5
    nonlinear: float = 0.3
    enough: int = 400
    fewest: int = 100
    r_hat: float = 1.02
    enough_of_chains: int = 200
    divergent: float = 0.005
    product: float = 0.3
    moving: float = 0.05
    higher: float = 1.0


def sampling() -> SamplingSettings:
    """The settings of sampling that hold here."""
    return in_force(SamplingSettings)


def unevenness(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    *,
    limit: float | None = None,
    enough: float | None = None,
) -> str:
    """Why weighted draws are not reliable, in numbers; empty if they are.

    Args:
        weights: smoothed, summing to one.
        k_hat: theirs.
        limit: largest k̂ that is trusted; that of the settings if None.
        enough: effective draws, below which they are too few; likewise.
    """
    effective = effective_size(weights)
    limit, enough = sampling().k_hat if limit is None else limit, enough or sampling().enough
    if k_hat <= limit and effective >= enough:
        return ""
    return f"k̂ = {k_hat:.2f}, {effective:.0f} effective draws"


def largest_k_hat(correction: Float[np.ndarray, "s"], weights: Float[np.ndarray, "s"]) -> float:
    """The largest k̂ that is trusted, given what nonlinearity adds to the log weights of draws of φ."""
    # Where nonlinearity counts, coefficients were proposed by a Gaussian: its thin tails hide from k̂ what the
    # posterior has farther out, and the bound is tighter.
    correction = np.clip(correction, -1e3, 1e3)
    mean = weights @ correction
    nonlinear = weights @ (correction - mean) ** 2 > sampling().nonlinear ** 2
    return sampling().k_hat_nonlinear if nonlinear else sampling().k_hat


def weights_verdict(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    notes: tuple[str, ...],
    mode: Mode | None = None,
    reasons: tuple[str, ...] = (),
) -> Verdict:
    """Of importance weights that are even enough but for `reasons`, by the mode that they were proposed around."""
    if mode is not None and not mode.change <= sampling().moving:
        still = f"The mode was still moving by {float(mode.change):.2g} standard deviations"
        reasons = (*reasons, f"{still} when the optimiser stopped.")
    size = effective_size(weights)
    return Verdict(not reasons, reasons, notes, "importance sampling", pareto_k=k_hat, ess=size)


def chain_verdict(ran: Chains, sampler: str, notes: tuple[str, ...]) -> Verdict:
    """R-hat, effective size and divergences of chains, in words."""
    from arviz_stats.base.array import array_stats  # half a second that only sampling needs

    draws = np.moveaxis(np.asarray(ran.draws), -1, 0)
    # The worst of all coordinates counts: split chains that agree in most of them have still not met in that one.
    r_hat = max(float(np.asarray(array_stats.rhat(d, chain_axis=0, draw_axis=1))) for d in draws)
    ess = min(float(np.asarray(array_stats.ess(d, chain_axis=0, draw_axis=1))) for d in draws)
    reasons, given = [], sampling()
    if not r_hat <= given.r_hat:
        reasons.append(f"Chains disagree (R-hat {r_hat:.3f}): run longer, or give tighter priors.")
    if ess < given.enough_of_chains:
        reasons.append(f"Only {ess:.0f} effective draws: run longer.")
    if ran.divergences > given.divergent * draws[0].size:
        reasons.append(f"{ran.divergences} divergent transitions: the posterior has a corner.")
    known: dict[str, Any] = {"ess": ess, "r_hat": r_hat, "divergences": ran.divergences}
    return Verdict(not reasons, tuple(reasons), notes, sampler, **known)
