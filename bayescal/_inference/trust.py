"""Convergence diagnostics of samplers and optima, and the reasons of a verdict.

Importance weights: Pareto k̂ and effective sample size; chains: R-hat, effective sample size and divergences; an
optimum: its last step and its Hessian.
Sources: Vehtari et al., JMLR 25 (2024) 72 (k̂); Vehtari et al., Bayesian Analysis 16 (2021) 667 (R-hat).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.importance_weights import effective_size
from bayescal._core.settings import settings
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Verdict
from bayescal._inference.nuts_chains import Chains

K_HAT = 0.7  # largest k̂ of reliable importance weights (Vehtari et al. 2024)
# The same for a nonlinear model, whose coefficients are proposed from a Gaussian with tails that may be too thin, which
# k̂ underestimates: at 0.6 to 0.7 standard deviations were up to a third too small, below 0.5 right.
K_HAT_NONLINEAR = 0.5
# Standard deviation of the nonlinear corrections of log weights, above which a model counts as nonlinear.
NONLINEAR_SD = 0.3
# Effective draws that are accepted at a deadline: a standard deviation is then known to 7 %.
FEWEST_DRAWS = 100
R_HAT = 1.02  # largest R-hat of converged chains; Vehtari et al. 2021 ask for 1.01 of long ones
CHAIN_DRAWS = 200  # smallest effective sample size: a standard deviation is then known to 5 %
DIVERGENT_SHARE = 0.005  # largest fraction of divergent transitions
# Largest change in the last round of a converged mode, standard deviations.
MOVING_SD = 0.05

NOT_CONVERGED = "Levenberg–Marquardt stopped before its tolerance was met."
SINGULAR = "The curvature is singular: some direction is not determined by readings or priors."


def check_weights(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    *,
    limit: float | None = None,
    min_ess: float | None = None,
) -> str:
    """Return k̂ and effective sample size as text if weighted draws are unreliable; empty if they are reliable.

    `limit`: largest k̂; `min_ess`: smallest effective sample size; defaults from the settings.
    """
    effective = effective_size(weights)
    limit, min_ess = K_HAT if limit is None else limit, min_ess or settings().effective_draws
    if k_hat <= limit and effective >= min_ess:
        return ""
    return f"k̂ = {k_hat:.2f}, {effective:.0f} effective draws"


def largest_k_hat(correction: Float[np.ndarray, "s"], weights: Float[np.ndarray, "s"]) -> float:
    """Return the largest k̂ of reliable weights, given the corrections of log weights by nonlinearity."""
    # A nonlinear model has heavier tails than the Gaussian proposals, which k̂ does not see: a tighter bound.
    correction = np.clip(correction, -1e3, 1e3)
    mean = weights @ correction
    nonlinear = weights @ (correction - mean) ** 2 > NONLINEAR_SD**2
    return K_HAT_NONLINEAR if nonlinear else K_HAT


def weights_verdict(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    notes: tuple[str, ...],
    mode: Mode | None = None,
    reasons: tuple[str, ...] = (),
) -> Verdict:
    """Return the verdict on importance weights, given reasons against them, and on their mode."""
    if mode is not None and not mode.change <= MOVING_SD:
        message = f"The mode was still moving by {float(mode.change):.2g} standard deviations"
        reasons = (*reasons, f"{message} when the optimiser stopped.")
    size = effective_size(weights)
    return Verdict(not reasons, reasons, notes, "importance sampling", pareto_k=k_hat, ess=size)


def chain_verdict(chains: Chains, sampler: str, notes: tuple[str, ...]) -> Verdict:
    """Return the verdict on chains by R-hat, effective size and divergences."""
    from arviz_stats.base.array import array_stats  # half a second that only sampling needs

    draws = np.moveaxis(np.asarray(chains.draws), -1, 0)
    # The worst coordinate decides.
    r_hat = max(float(np.asarray(array_stats.rhat(d, chain_axis=0, draw_axis=1))) for d in draws)
    ess = min(float(np.asarray(array_stats.ess(d, chain_axis=0, draw_axis=1))) for d in draws)
    reasons = []
    if not r_hat <= R_HAT:
        reasons.append(f"Chains disagree (R-hat {r_hat:.3f}): run longer, or give tighter priors.")
    if ess < CHAIN_DRAWS:
        reasons.append(f"Only {ess:.0f} effective draws: run longer.")
    if chains.divergences > DIVERGENT_SHARE * draws[0].size:
        reasons.append(f"{chains.divergences} divergent transitions: the posterior has a corner.")
    numbers: dict[str, Any] = {"ess": ess, "r_hat": r_hat, "divergences": chains.divergences}
    return Verdict(not reasons, tuple(reasons), notes, sampler, **numbers)
