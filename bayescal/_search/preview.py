"""What another model would do to the readings of a fitted one: a curve over the residuals, its size, the error left.

The other model is fitted as `fit(model, readings, LeastSquares())` does; columns that both have are computed once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import ModelError
from bayescal._core.formatting import number, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.laplace import Mode, find_mode
from bayescal._inference.least_squares import solution_on
from bayescal._inference.linear_model import learned_size, linear_model, sized
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, testable
from bayescal._model.parameters import bind


@dataclass(frozen=True)
class Preview:
    """What another model would do, compared with a fitted one of the same readings.

    Attributes:
        curve: by how much it changes the expected output of each reading, all coefficients estimated again, output
            unit, (n,). Residuals less this curve are the residuals that would be left.
        rms, rms_before: of the residuals with it and without it, output unit.
        log_bayes_factor: of the other model against the fitted one, natural logarithm, at plausible sizes as they are
            stated; None where a prior is flat.
        output_unit: of curve and errors.
        effect: that the other model adds; empty where it is another change.
        size, size_sd: first coefficient of the effect and its standard uncertainty, in `unit`; for a group effect its
            spread, for an unknown dependence its amplitude. The noise is held at its estimate.
        shape: shape parameters of the effect at their estimates, in their units.
    """

    curve: Float[np.ndarray, "n"]
    rms: float
    rms_before: float
    log_bayes_factor: float | None
    output_unit: str
    effect: str = ""
    size: float | None = None
    size_sd: float | None = None
    unit: str = ""
    shape: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        error = (
            f"{number(self.rms_before)} to {number(self.rms)} {unit_label(self.output_unit)} rms"
        )
        factor = self.log_bayes_factor
        evidence = "" if factor is None else f", log Bayes factor {factor:z.1f}"
        if self.size is None or self.size_sd is None:
            return f"residuals from {error}{evidence}"
        size = f"{with_error(self.size, self.size_sd)} {unit_label(self.unit)}".rstrip()
        return f"{self.effect} would be {size}: residuals from {error}{evidence}"


def preview(before: Calibration, change: Model | Effect | str) -> Preview:
    """Return what another model of the readings of a calibration, or one effect more, would do.

    Under a noise law of which least squares only uses the variance the numbers are as approximate as it is. An unknown
    dependence is taken at its marginal mode, which the last rounds of least squares would move by a small part of its
    uncertainty.

    Raises:
        ModelError: the effect is in the model already, its name is unknown, or the readings cannot test it; the model
            needs a column that they lack.
    """
    readings = before.readings
    effect = before.model.instrument.effect(change) if isinstance(change, str) else change
    if isinstance(effect, Effect):
        if (reason := testable(effect, readings)) is not None:
            raise ModelError(f"effect {effect.name!r} cannot be previewed: it {reason}")
        model = before.model + effect
    else:
        model = effect
    model.require(readings)
    record = before.problem.record.beside()
    record.require_finite(model.effects)
    layout = bind(sized(model, readings, record), readings, reference=before.reference)[0]
    problem = Problem(layout, record)
    if isinstance(effect, Effect) and effect.is_placeholder:
        mode, covariance = find_mode(problem), np.zeros((0, 0))
    else:
        mode, covariance, _ = solution_on(problem)
    evidence, known = None if layout.improper else mode.log_evidence, before.log_evidence
    # Both settled: all coefficients fitted anew, shapes too, so that their difference is what the change would do.
    left, residual = linear_model(problem, mode).settled, before.linear.settled
    return Preview(
        curve=residual - left,
        rms=float(np.sqrt(np.mean(left**2))),
        rms_before=float(np.sqrt(np.mean(residual**2))),
        log_bayes_factor=None if known is None or evidence is None else float(evidence - known[0]),
        output_unit=before.unit,
        **(_sizes(effect, problem, mode, covariance) if isinstance(effect, Effect) else {}),
    )


def _sizes(effect: Effect, problem: Problem, mode: Mode, covariance: np.ndarray) -> dict[str, Any]:
    """What says how large the effect is, with its standard uncertainty, and its shapes."""
    term = next(t for t in problem.terms if t.known.of == effect.name and t.index == 0)
    own, i, hyper = mode.x[term.at], term.at.start, problem.hyper(mode.v)
    if learned := learned_size(effect, problem, mode):
        size, sd = learned
    elif term.place != "x":
        size, sd = effect.coefficients[0].size, 0.0
    elif term.size > 1:  # a value for each member, of known spread
        size, sd = float(np.sqrt(np.mean(own**2))), 0.0
    else:
        size, sd = float(own[0]), math.sqrt(max(float(covariance[i, i]), 0.0))
    shape = {s.name: float(hyper[effect.shape_name(s)]) for s in effect.column_shapes}
    told = {"effect": effect.name, "unit": effect.coefficients[0].unit, "shape": shape}
    return {**told, "size": size, "size_sd": sd}
