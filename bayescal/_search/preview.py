"""What an effect would do to a fitted model, before it is added: a curve over the residuals, its size, the error left.

The effect is fitted together with everything else, as `fit(model + effect, readings, LeastSquares())` does. What makes
it quick is that the columns of all effects that may be asked for are computed once, in one program.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import ModelError
from bayescal._core.formatting import number, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.laplace import find_mode
from bayescal._inference.least_squares import solution_on
from bayescal._inference.linear_model import LinearModel, learned_size, linear_model, sized
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, testable
from bayescal._model.parameters import bind
from bayescal._search.discover import placeholders


@dataclass(frozen=True)
class Preview:
    """One effect as the readings would have it, were it added to a fitted model.

    Attributes:
        effect: canonical name; empty where another model was asked about.
        curve: by how much it changes the expected output of each reading, all other coefficients estimated again,
            output unit, (n,). Residuals less this curve are the residuals that would be left.
        size, size_sd: first coefficient and its standard uncertainty, in `unit`; for a group effect its spread, for an
            unknown dependence its amplitude. The noise is held at its estimate. None of another model.
        shape: shape parameters at their estimates, in their units.
        rms, rms_before: of the residuals with it and without it, output unit.
        log_bayes_factor: of the model with it against the model without it, natural logarithm, at the effect's
            plausible size as it is stated; None where a prior is flat.
        output_unit: of curve and errors.
    """

    effect: str
    curve: Float[np.ndarray, "n"]
    rms: float
    rms_before: float
    log_bayes_factor: float | None
    output_unit: str
    size: float | None = None
    size_sd: float | None = None
    unit: str = ""
    shape: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        unit = unit_label(self.output_unit)
        error = f"{number(self.rms_before)} to {number(self.rms)} {unit} rms"
        factor = self.log_bayes_factor
        evidence = "" if factor is None else f", log Bayes factor {factor:z.1f}"
        if self.size is None or self.size_sd is None:
            return f"residuals from {error}{evidence}"
        size = f"{with_error(self.size, self.size_sd)} {unit_label(self.unit)}".rstrip()
        return f"{self.effect} would be {size}: residuals from {error}{evidence}"


class Previews:
    """Previews of several effects over one calibration: columns are computed once, and each preview is kept.

    Of the instrument's effects, an unknown dependence on each column and the user's own, or of those given alone.
    """

    def __init__(
        self,
        calibration: Calibration,
        effects: Sequence[Effect] | None = None,
        own: Sequence[Effect] = (),
    ) -> None:
        model, readings = calibration.model, calibration.readings
        if effects is None:
            instrument = model.instrument
            effects = (*instrument.candidates, *instrument.effects, *placeholders(model, readings))
        every = (*effects, *own)
        self.calibration = calibration
        self.effects = {e.name: e for e in every if testable(e, readings) is None}
        self.record = calibration.problem.record.beside()
        self.record.require_finite((*self.effects.values(), *model.effects))
        self._made: dict[str, tuple[Effect, Preview]] = {}

    def of(self, effect: Effect | str) -> Preview:
        """Return the preview of one effect: the numbers of a fit of `model + effect` by least squares.

        Under a noise law of which least squares only uses the variance they are as approximate as it is. An unknown
        dependence is taken at its marginal mode, which the last rounds of least squares would move by a small part of
        its uncertainty.

        Raises:
            ModelError: it is in the model already, its name is unknown, or the readings cannot test it.
        """
        if isinstance(effect, str):
            effect = self.effects.get(effect) or self.calibration.model.instrument.effect(effect)
        chosen, made = self._made.get(effect.name, (None, None))
        if made is not None and chosen == effect:
            return made
        model = self.calibration.model + effect
        if (reason := testable(effect, self.calibration.readings)) is not None:
            raise ModelError(
                f"effect {effect.name!r} cannot be previewed: these readings cannot test it: it {reason}"
            )
        line, covariance, evidence = self._fitted(model, refined=not effect.is_placeholder)
        size, size_sd = _size(effect, line, covariance)
        hyper = line.problem.hyper(line.mode.v)
        shape = {s.name: float(hyper[effect.shape_name(s)]) for s in effect.column_shapes}
        told = {"size": size, "size_sd": size_sd, "unit": effect.coefficients[0].unit}
        made = replace(self._compared(effect.name, line, evidence), **told, shape=shape)
        self._made[effect.name] = effect, made
        return made

    def of_model(self, model: Model) -> Preview:
        """What another model of the same readings would do.

        Raises:
            ModelError: the readings lack what it needs.
        """
        model.require(self.calibration.readings)
        line, _, evidence = self._fitted(model)
        return self._compared("", line, evidence)

    def _compared(self, name: str, line: LinearModel, evidence: float | None) -> Preview:
        before = self.calibration
        # Both settled: all coefficients fitted anew, shapes too, so that their difference is what the effect would
        # change.
        left, residual, known = line.settled, before.linear.settled, before.log_evidence
        return Preview(
            effect=name,
            curve=residual - left,
            rms=float(np.sqrt(np.mean(left**2))),
            rms_before=float(np.sqrt(np.mean(residual**2))),
            log_bayes_factor=None if known is None or evidence is None else evidence - known[0],
            output_unit=before.unit,
        )

    def _fitted(
        self, model: Model, refined: bool = True
    ) -> tuple[LinearModel, np.ndarray, float | None]:
        """A model fitted by least squares to the calibration's readings: about its mode, covariance, log evidence."""
        before = self.calibration
        model = sized(model, before.readings, self.record)
        problem = Problem(bind(model, before.readings, reference=before.reference)[0], self.record)
        if not refined:
            mode = find_mode(problem)
            return linear_model(problem, mode), np.zeros((0, 0)), mode.log_evidence
        found = solution_on(problem)
        evidence = None if problem.layout.improper else float(found.mode.log_evidence)
        return linear_model(problem, found.mode), np.asarray(found.covariance), evidence


def _size(effect: Effect, line: LinearModel, covariance: np.ndarray) -> tuple[float, float]:
    """What says how large the effect is, with its standard uncertainty, in the unit of its first coefficient."""
    problem, mode = line.problem, line.mode
    if learned := learned_size(effect, problem, mode):
        return learned
    term = next(t for t in problem.terms if t.known.of == effect.name and t.index == 0)
    own, i = mode.x[term.at], term.at.start
    if term.place != "x":
        return effect.coefficients[0].size, 0.0
    if term.size > 1:  # a value for each member, of known spread
        return float(np.sqrt(np.mean(own**2))), 0.0
    return float(own[0]), math.sqrt(max(float(covariance[i, i]), 0.0))
