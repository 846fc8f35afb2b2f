"""The loop: compare with the readings, see where it fails, add what is missing, watch the error fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayescal._calibration import Calibration
from bayescal._check import Check, check
from bayescal._discover import Discovery, discover, laplace_evidence
from bayescal._effect import Effect
from bayescal._fit import fit
from bayescal._folds import LeaveOneGroupOut, leave_one_group_out
from bayescal._frame import Reference
from bayescal._measurements import Measurements
from bayescal._method import Method
from bayescal._model import Model
from bayescal._predict import predict
from bayescal._progress import stage
from bayescal._score import residuals

AUTOCORRELATED = 4.0  # z of the lag-1 autocorrelation above which the noise model is not adequate


@dataclass(frozen=True)
class Step:
    """One model of the sequence, with its errors in the output unit.

    Attributes:
        calibration: the fit.
        added: effect that this step added; None for the first.
        dropped: effects that the addition made superfluous.
        rmse: of the fitted readings, group deviations at zero (what an unseen group would see).
        rmse_fitted: the same with group deviations as fitted.
        holdout_rmse: of readings that were kept apart; None without them.
        left_out: each group predicted from the others.
        noise_floor: from neighbouring readings alone, whatever the model.
        check: where this model fails.
        discovery: what is missing from it; None where probabilities would not be honest.
    """

    calibration: Calibration
    added: str | None
    dropped: tuple[str, ...]
    rmse: float
    rmse_fitted: float
    holdout_rmse: float | None
    left_out: LeaveOneGroupOut | None
    noise_floor: float
    check: Check
    discovery: Discovery | None


@dataclass(frozen=True)
class Gate:
    """Whether probabilities of missing effects may be given at all."""

    ok: bool
    reason: str


@dataclass(frozen=True)
class Trail:
    """The sequence of models from the baseline to the last, and whether to trust the last.

    Attributes:
        steps: in order.
        gate: of the last model.
        holdout: the readings kept apart.
    """

    steps: tuple[Step, ...]
    gate: Gate
    holdout: Measurements | None

    @property
    def final(self) -> Step:
        return self.steps[-1]

    @property
    def ok(self) -> bool:
        return self.gate.ok and self.final.calibration.verdict.ok

    def save(self, folder: Path) -> None:
        """Write result.json, calibration.nc (of the last step) and loop.png to an existing folder."""
        from bayescal._plot import loop, save  # matplotlib only where a picture is written
        from bayescal._result import result, write_json

        write_json(result(self), Path(folder) / "result.json")
        self.final.calibration.save(Path(folder) / "calibration.nc")
        save(loop(self), Path(folder) / "loop.png")

    def __str__(self) -> str:
        from bayescal._text import trail_text  # tables for people stand above this floor

        return trail_text(self)


def calibrate(
    model: Model,
    readings: Measurements,
    *,
    holdout: Measurements | None = None,
    effects: Sequence[Effect] = (),
    method: Method | None = None,
    max_effects: int = 5,
    seed: int = 0,
    reference: Reference | None = None,
) -> Trail:
    """Fit, check, discover, add and fit again, until nothing more is found.

    Args:
        model: to begin with.
        readings: to fit.
        holdout: readings kept apart: read after the last step, and never used to choose an effect.
        effects: further candidates of the user's own.
        method: of every fit; `Marginal()` if not given.
        max_effects: most effects to add.
        seed: of every random number.
        reference: constants of the bases to use in place of the readings' own.

    Raises:
        ModelError: the readings lack what the model needs.
    """
    if holdout is not None:
        model.require(holdout)
    steps = [_step(model, readings, None, (), effects, method, max_effects, seed, reference)]
    start = set(model.names)
    for _ in range(max_effects):
        found = steps[-1].discovery
        if found is None or not found.best or not steps[-1].calibration.verdict.ok:
            break
        added = found.best[0]
        if any(added.name in s.dropped for s in steps):
            break  # it was dropped before: adding it again would go in a circle
        model, dropped = _look_back(model + added, steps[-1].calibration, start, added.name)
        left = max_effects - (len(steps))
        steps.append(
            _step(model, readings, added.name, dropped, effects, method, max(left, 1), seed, reference)
        )
    if holdout is not None:
        steps = [_with_holdout(s, holdout) for s in steps]
    return Trail(tuple(steps), gate(steps[-1]), holdout)


def _step(model, readings, added, dropped, effects, method, max_effects, seed, reference) -> Step:
    calibration = fit(model, readings, method, seed=seed, strict=False, reference=reference)
    with stage("checking"):
        checked = check(calibration)
        left_out = leave_one_group_out(calibration)
    discovery = None
    if calibration.verdict.ok:
        discovery = discover(calibration, effects=effects, max_effects=max_effects)
    return Step(
        calibration,
        added,
        dropped,
        predict(calibration).rmse,
        float(np.sqrt(np.mean(checked.residuals**2))),
        None,
        left_out,
        noise_floor(calibration),
        checked,
        discovery,
    )


def _with_holdout(step: Step, holdout: Measurements) -> Step:
    return Step(**{**step.__dict__, "holdout_rmse": predict(step.calibration, holdout).rmse})


def _look_back(
    model: Model, calibration: Calibration, start: set[str], newest: str
) -> tuple[Model, tuple[str, ...]]:
    """Drop what was added before and is superfluous now: the model is more probable without it."""
    dropped: list[str] = []
    added = [n for n in model.names if n not in start and n != newest]
    if not added:
        return model, ()
    with stage("looking back"):
        best = laplace_evidence(model, calibration)
        for name in added:
            without = laplace_evidence(model - name, calibration)
            if without >= best:
                model, best = model - name, without
                dropped.append(name)
    return model, tuple(dropped)


def gate(step: Step) -> Gate:
    """Whether the last model's noise is as independent as its probabilities assume."""
    verdict = step.calibration.verdict
    if not verdict.ok:
        return Gate(False, "The fit did not converge: " + " ".join(verdict.reasons))
    if step.check.fixed is not None and step.check.fixed.rms > 2 * step.check.fixed.noise:
        return Gate(
            False,
            f"The fixed coefficients leave residuals of {step.check.fixed.rms:.3g} {step.check.unit} rms, "
            f"{step.check.fixed.rms / step.check.fixed.noise:.1f} times the noise of the same model set free.",
        )
    coefficient, z = step.check.autocorrelation
    if z > AUTOCORRELATED and len(step.calibration.readings) >= 30:
        return Gate(
            False,
            f"Noise model inadequate: neighbouring residuals are correlated ({coefficient:.2f}, z = {z:.1f}), "
            "so the probabilities of missing effects are too confident. Either the noise is correlated in "
            "time or something is missing that no candidate describes.",
        )
    return Gate(True, "converged; neighbouring residuals are not correlated")


def noise_floor(calibration: Calibration) -> float:
    """Noise that no model of smooth effects could remove, output unit.

    From each residual against the mean of its two neighbours (in time within a run; in temperature where there
    is no time), as in a von Neumann ratio: what varies slowly cancels.
    """
    residual = residuals(calibration).raw
    frame, readings = calibration.frame, calibration.readings
    if readings.has("time"):
        order, linked = np.asarray(frame.order), np.asarray(frame.step) > 0
    else:
        key = readings["temperature"] if readings.has("temperature") else np.arange(len(readings))
        order, linked = np.argsort(key, kind="stable"), np.ones(len(readings), bool)
        linked[0] = False
    r = residual[order]
    inner = linked[1:-1] & linked[2:]
    bend = (r[1:-1] - 0.5 * (r[:-2] + r[2:]))[inner]
    if bend.size < 3:
        return float(np.sqrt(np.mean(residual**2)))
    return float(np.sqrt(np.mean(bend**2) / 1.5))

