"""Promotion of coefficients to φ where products of two unknowns are significant.

The expected output is linear in either factor given the other: with one of them in φ the other is integrated out
exactly. Significance is the second-order Taylor term: the change of the Jacobian over one posterior standard deviation
of a coefficient, times the posterior of the others, in noise standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._inference.density import Density
from bayescal._inference.laplace import NO_START, Mode, find_mode
from bayescal._inference.noise_on_record import variance
from bayescal._inference.problem import Problem

# Smallest second-order term of a significant product of two unknowns, root-sum-square over the readings in noise
# standard deviations: smaller ones change the mean log likelihood by less than ½·0.3² nats.
MIN_PRODUCT_SD = 0.3

MAX_PROMOTED = 6  # number of promoted entries of φ
DIFF_STEP_SD = 0.01  # difference step, posterior standard deviations
MAX_MEMBERS = 12  # number of members of a promoted group coefficient


def promote_products(
    problem: Problem, requested: tuple[str, ...] | None, start: Mapping[str, float] = NO_START
) -> tuple[Problem, tuple[str, ...], Mode | None]:
    """Promote coefficients with significant products, or those `requested`; return problem, notes, mode (or None).

    Raises:
        ModelError: a requested name is not a coefficient of the model.
    """
    layout, record, notes = problem.layout, problem.record, ()
    if requested is not None:
        names = [b.name for b in layout.x_blocks]
        for name in requested:
            if name not in names:
                raise ModelError(
                    f"promote: {name!r} is not a coefficient that can be promoted (available: {', '.join(names)})"
                )
        return Problem(layout.promote(*requested), record), (), None
    while problem.size and not problem.is_affine:
        capacity, threshold = MAX_PROMOTED - len(layout.phi_indices("promoted")), MIN_PRODUCT_SD
        blocks = [b for b in layout.x_blocks if b.coefficient.per is None or b.size <= MAX_MEMBERS]
        blocks = [b for b in blocks if b.size <= capacity]
        if not blocks:
            return problem, notes, None
        mode = find_mode(problem, start=start)
        terms = _compute_second_order(problem, mode)
        strengths = {b.name: float(np.sqrt(np.sum(terms[b.x_slice] ** 2))) for b in blocks}
        # Either factor can be promoted. One with a learned standard deviation would form a funnel with it: last choice.
        candidates = [b for b in blocks if strengths[b.name] >= threshold]
        if not candidates:
            return problem, notes, mode
        preferred_blocks = [b for b in candidates if b.coefficient.group_sd is None]
        strongest = max(preferred_blocks or candidates, key=lambda b: strengths[b.name])
        # Together with the effect's other coefficients in the same slot, if they all fit.
        group = [b for b in blocks if b.effect is strongest.effect and b.slot == strongest.slot]
        group = [b for b in group if b is strongest or strengths[b.name] >= 0.1 * threshold]
        selected_blocks = group if sum(b.size for b in group) <= capacity else [strongest]
        layout = layout.promote(*(b.name for b in selected_blocks))
        names = ", ".join(b.name for b in selected_blocks)
        verb = "are" if len(selected_blocks) > 1 else "is"
        size = f"{strengths[strongest.name]:.2g} noise standard deviations"
        note = f"{names} {verb} sampled, not linearised: the second-order term is {size}."
        notes = (*notes, note)
        problem = Problem(layout, record)
    return problem, notes, None


def _compute_second_order(problem: Problem, mode: Mode) -> Float[np.ndarray, "p"]:
    """Return the second-order Taylor term of each entry of x, root-sum-square over readings, noise deviations (p,)."""
    hyper = problem.hyper(mode.v)
    conditional = Density(problem, mode.x, mode.flat).condition_at(mode.v)[1]
    if conditional is None:
        return np.zeros(problem.size)
    variances = np.diag(conditional.covariance)
    root = np.linalg.cholesky(conditional.covariance + 1e-12 * np.diag(variances))
    noise = np.sqrt(variance(problem.noise, hyper, problem.record))[:, None]
    terms = []
    # ∂J/∂xᵢ·sd(xᵢ) times a square root of the covariance of x, in units of each reading's noise.
    for step in DIFF_STEP_SD * np.diag(np.sqrt(variances)):
        upper, lower = (problem.linearise(mode.x + s, hyper).jacobian for s in (step, -step))
        terms.append(np.linalg.norm((upper - lower) / (2 * DIFF_STEP_SD) @ root / noise))
    return np.array(terms)
