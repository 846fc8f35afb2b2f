"""Products of unknowns: which coefficients to sample with φ.

Where the product of two unknowns matters against the noise, the expected output is linear in either one given the
other: one of them then belongs to φ. It is chosen by the second-order term: the change of the Jacobian over one
posterior standard deviation of a coefficient, carried by the posterior of the others, in units of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._inference.density import Density
from bayescal._inference.laplace import NOTHING_KNOWN, Mode, find_mode
from bayescal._inference.noise_on_record import variance
from bayescal._inference.problem import Problem

# Root-sum-square over the readings, in noise standard deviations, of the second-order term of a product of two
# unknowns, from which one of them is sampled: below it the mean log likelihood changes by less than ½·0.3² nats.
PRODUCT_SD = 0.3

MOST_PROMOTED = 6  # entries of φ that promotion may add
STEP = 0.01  # standard deviations, for the change of the Jacobian
MOST_MEMBERS = 12  # a group coefficient with more members than this is not promoted


def choose(
    problem: Problem, requested: tuple[str, ...] | None, start: Mapping[str, float] = NOTHING_KNOWN
) -> tuple[Problem, tuple[str, ...], Mode | None]:
    """Return the model with promoted coefficients (or those `requested`), notes, and its mode if sought.

    Raises:
        ModelError: a name that was asked for is no coefficient of the model.
    """
    layout, record, notes = problem.layout, problem.record, ()
    if requested is not None:
        names = [b.name for b in layout.x_blocks]
        for name in requested:
            if name not in names:
                raise ModelError(
                    f"promote: nothing that could be promoted is called {name!r}; there is: {', '.join(names)}"
                )
        return Problem(layout.promote(*requested), record), (), None
    while problem.size and not problem.affine:
        free, least = MOST_PROMOTED - len(layout.phi_indices("promoted")), PRODUCT_SD
        few = [b for b in layout.x_blocks if b.coefficient.per is None or b.size <= MOST_MEMBERS]
        few = [b for b in few if b.size <= free]
        if not few:
            return problem, notes, None
        mode = find_mode(problem, start=start)
        sizes = _second_order(problem, mode)
        strength = {b.name: float(np.sqrt(np.sum(sizes[b.x_slice] ** 2))) for b in few}
        # Either factor of a product will do. In units of a spread that is learned itself, a coefficient would make a
        # funnel with it, so such a one is only taken where no other matters.
        matter = [b for b in few if strength[b.name] >= least]
        if not matter:
            return problem, notes, mode
        plain = [b for b in matter if b.coefficient.group_sd is None]
        best = max(plain or matter, key=lambda b: strength[b.name])
        # With the other parts of its effect in the same slot, nonlinear with it, where all fit in φ.
        parts = [b for b in few if b.effect is best.effect and b.slot == best.slot]
        parts = [b for b in parts if b is best or strength[b.name] >= 0.1 * least]
        chosen = parts if sum(b.size for b in parts) <= free else [best]
        layout = layout.promote(*(b.name for b in chosen))
        verb, whose = ("are", "the") if len(chosen) > 1 else ("is", "its")
        note = (
            f"{', '.join(b.name for b in chosen)} {verb} sampled with the hyper-parameters: {whose} product with other "
            f"unknowns amounts to {strength[best.name]:.2g} noise standard deviations."
        )
        notes = (*notes, note)
        problem = Problem(layout, record)
    return problem, notes, None


def _second_order(problem: Problem, mode: Mode) -> Float[np.ndarray, "p"]:
    """Return, for each entry of x, the size of its products with the others, in noise sds."""
    hyper = problem.hyper(mode.v)
    conditional = Density(problem, mode.x, mode.flat).at(mode.v)[1]
    if conditional is None:
        return np.zeros(problem.size)
    variances = np.diag(conditional.covariance)
    root = np.linalg.cholesky(conditional.covariance + 1e-12 * np.diag(variances))
    noise = np.sqrt(variance(problem.noise, hyper, problem.record))[:, None]
    sizes = []
    # What one posterior standard deviation of xᵢ changes in J, times a root of the covariance of the others: the
    # second-order term that the linearised model leaves out of each reading, in units of its noise.
    for step in STEP * np.diag(np.sqrt(variances)):
        up, down = (problem.linearise(mode.x + s, hyper).jacobian for s in (step, -step))
        sizes.append(np.linalg.norm((up - down) / (2 * STEP) @ root / noise))
    return np.array(sizes)
