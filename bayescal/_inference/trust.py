"""Convergence diagnostics of samplers and optima, and the verdicts on them.

Importance weights: Pareto k̂ and effective sample size; chains: R-hat, effective sample size and divergences; an
optimum: its last step and its Hessian.
Sources: Vehtari et al., JMLR 25 (2024) 72 (k̂); Vehtari et al., Bayesian Analysis 16 (2021) 667 (R-hat).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.importance_weights import compute_ess
from bayescal._core.settings import settings
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Verdict
from bayescal._inference.nuts_chains import Chains

MAX_K_HAT = 0.7  # largest k̂ of reliable importance weights (Vehtari et al. 2024)
# For a nonlinear model, whose Gaussian proposals of coefficients may have too thin tails, which k̂ underestimates: at
# 0.6 to 0.7 standard deviations were up to a third too small, below 0.5 right.
MAX_K_HAT_NONLINEAR = 0.5
# Smallest standard deviation of the corrections of log weights of a nonlinear model.
MIN_NONLINEAR_SD = 0.3
# Effective sample size accepted at a deadline: a standard deviation is then known to 7 %.
MIN_DEADLINE_ESS = 100
MAX_R_HAT = 1.02  # largest R-hat of converged chains; Vehtari et al. 2021 ask for 1.01 of long ones
MIN_CHAIN_ESS = 200  # smallest effective sample size: a standard deviation is then known to 5 %
MAX_DIVERGENT_FRACTION = 0.005  # largest fraction of divergent transitions
# Largest change in the last round of a converged mode, standard deviations.
MAX_MODE_CHANGE_SD = 0.05

NOT_CONVERGED = "Levenberg–Marquardt did not converge to its tolerance."
SINGULAR_HESSIAN_TEXT = "The Hessian is singular: readings and priors do not identify all unknowns."


def check_weights(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    *,
    limit: float | None = None,
    min_ess: float | None = None,
) -> str:
    """Return Pareto k̂ and effective sample size as text if importance weights are unreliable, otherwise "".

    limit: largest k̂, default 0.7. min_ess: smallest effective sample size; default from the settings.
    """
    ess = compute_ess(weights)
    limit, min_ess = MAX_K_HAT if limit is None else limit, min_ess or settings().effective_draws
    if k_hat <= limit and ess >= min_ess:
        return ""
    return f"k̂ = {k_hat:.2f}, {ess:.0f} effective draws"


def select_k_hat(log_ratio: Float[np.ndarray, "s"], weights: Float[np.ndarray, "s"]) -> float:
    """Return the largest acceptable Pareto k̂: smaller if the nonlinearity corrections of log weights vary."""
    log_ratio = np.clip(log_ratio, -1e3, 1e3)
    is_nonlinear = weights @ (log_ratio - weights @ log_ratio) ** 2 > MIN_NONLINEAR_SD**2
    return MAX_K_HAT_NONLINEAR if is_nonlinear else MAX_K_HAT


def assess_weights(
    weights: Float[np.ndarray, "s"],
    k_hat: float,
    notes: tuple[str, ...],
    mode: Mode | None = None,
    reasons: tuple[str, ...] = (),
) -> Verdict:
    """Return the verdict on weighted draws and their mode; `reasons`: faults found before, each a sentence."""
    if mode is not None and not mode.change <= MAX_MODE_CHANGE_SD:
        step = f"its last step was {float(mode.change):.2g} prior standard deviations"
        reasons = (*reasons, f"The search for the mode did not converge: {step}.")
    ess = compute_ess(weights)
    return Verdict(not reasons, reasons, notes, "importance sampling", pareto_k=k_hat, ess=ess)


def assess_chains(chains: Chains, sampler: str, notes: tuple[str, ...]) -> Verdict:
    """Return the verdict on the convergence of NUTS chains: R-hat, effective sample size and divergences."""
    from arviz_stats.base.array import array_stats  # half a second that only sampling needs

    draws = np.moveaxis(np.asarray(chains.draws), -1, 0)
    # The worst coordinate decides.
    r_hat = max(float(np.asarray(array_stats.rhat(d, chain_axis=0, draw_axis=1))) for d in draws)
    ess = min(float(np.asarray(array_stats.ess(d, chain_axis=0, draw_axis=1))) for d in draws)
    reasons = []
    if not r_hat <= MAX_R_HAT:
        reasons.append(
            f"Chains did not converge (R-hat {r_hat:.3f}): run longer, or tighten priors."
        )
    if ess < MIN_CHAIN_ESS:
        reasons.append(f"The effective sample size is only {ess:.0f}: run longer.")
    if chains.divergences > MAX_DIVERGENT_FRACTION * draws[0].size:
        reasons.append(
            f"{chains.divergences} divergent transitions: the posterior is strongly curved."
        )
    diagnostics: dict[str, Any] = {"ess": ess, "r_hat": r_hat, "divergences": chains.divergences}
    return Verdict(not reasons, tuple(reasons), notes, sampler, **diagnostics)
