"""When a sampler is reliable: the one policy, from diagnostics to the reasons of a verdict.

Draws from importance weights are trusted by Pareto k̂ and their effective size, chains by R-hat, their effective size
and divergences, an optimum by its last step and its curvature. Whoever fits asks here: methods, devices of a batch,
programs.
Sources: Vehtari et al., JMLR 25 (2024) 72 (k̂); Vehtari et al., Bayesian Analysis 16 (2021) 667 (R-hat).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from bayescal._core.importance_weights import effective_size
from bayescal._inference.method import Verdict
from bayescal._inference.mode import Mode
from bayescal._inference.nuts_chains import Chains

K_HAT = 0.7  # above it, importance weights are not reliable (Vehtari et al. 2024)
# Where the model is nonlinear, coefficients are proposed with a Gaussian's tails, thinner than those that they may
# have; k̂ then shows too little: at 0.6 to 0.7, standard deviations came out up to a third too small, below 0.5 right.
K_HAT_NONLINEAR = 0.5
NONLINEAR = 0.3  # standard deviation of the log weights by nonlinearity, from which on that counts
ENOUGH = 400  # effective draws, below which more are made,
FEWEST = 100  # and which will do where there is no time for more: a standard deviation is then known to 7 %
R_HAT = 1.02  # of chains that agree
ENOUGH_OF_CHAINS = 200  # effective draws
DIVERGENT = 0.005  # share of the transitions, up to which a corner of the posterior is none
MOVING = 0.05  # standard deviations that the mode's last round moved anything by
NOT_CONVERGED = "Levenberg–Marquardt stopped before its tolerance was met."
SINGULAR = "The curvature is singular: some direction is not determined by readings or priors."


def unevenness(
    weights: Float[np.ndarray, "s"], k_hat: float, *, limit: float = K_HAT, enough: float = ENOUGH
) -> str:
    """Why weighted draws are not reliable, in numbers; empty if they are.

    Args:
        weights: smoothed, summing to one.
        k_hat: theirs.
        limit: largest k̂ that is trusted.
        enough: effective draws, below which they are too few.
    """
    effective = effective_size(weights)
    if k_hat <= limit and effective >= enough:
        return ""
    return f"k̂ = {k_hat:.2f}, {effective:.0f} effective draws"


def largest_k_hat(correction: Float[np.ndarray, "s"], weights: Float[np.ndarray, "s"]) -> float:
    """The largest k̂ that is trusted, given what nonlinearity adds to the log weights of draws of φ."""
    correction = np.clip(correction, -1e3, 1e3)
    mean = weights @ correction
    nonlinear = weights @ (correction - mean) ** 2 > NONLINEAR**2
    return K_HAT_NONLINEAR if nonlinear else K_HAT


def weights_verdict(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    notes: tuple[str, ...],
    mode: Mode | None = None,
    reasons: tuple[str, ...] = (),
) -> Verdict:
    """Of importance weights that are even enough but for `reasons`, by the mode that they were proposed around."""
    if mode is not None and not mode.change <= MOVING:
        reasons = (
            *reasons,
            f"The mode was still moving by {float(mode.change):.2g} standard deviations "
            "when the optimiser stopped.",
        )
    return Verdict(
        ok=not reasons,
        reasons=reasons,
        notes=notes,
        sampler="importance sampling",
        pareto_k=k_hat,
        ess=effective_size(weights),
    )


def chain_verdict(
    ran: Chains, sampler: str, notes: tuple[str, ...], k_hat: float | None = None
) -> Verdict:
    """R-hat, effective size and divergences of chains, in words."""
    from arviz_stats.base.array import array_stats  # half a second that only sampling needs

    draws = np.moveaxis(np.asarray(ran.draws), -1, 0)
    r_hat = max(float(np.asarray(array_stats.rhat(d, chain_axis=0, draw_axis=1))) for d in draws)
    ess = min(float(np.asarray(array_stats.ess(d, chain_axis=0, draw_axis=1))) for d in draws)
    reasons = []
    if not r_hat <= R_HAT:
        reasons.append(f"Chains disagree (R-hat {r_hat:.3f}): run longer, or give tighter priors.")
    if ess < ENOUGH_OF_CHAINS:
        reasons.append(f"Only {ess:.0f} effective draws: run longer.")
    if ran.divergences > DIVERGENT * draws[0].size:
        reasons.append(f"{ran.divergences} divergent transitions: the posterior has a corner.")
    return Verdict(
        ok=not reasons,
        reasons=tuple(reasons),
        notes=notes,
        sampler=sampler,
        pareto_k=k_hat,
        ess=ess,
        r_hat=r_hat,
        divergences=ran.divergences,
    )
