"""A trail: the sequence of models from the baseline to the last, with the error of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayescal._calibration.calibration import Calibration
from bayescal._core.formatting import number, probability, table
from bayescal._diagnostics.check_result import Check
from bayescal._diagnostics.leave_group_out import LeaveOneGroupOut
from bayescal._discovery.discovery import Discovery
from bayescal._readings.measurements import Measurements
from bayescal._readings.unit_conversion import unit_label

AUTOCORRELATED = 4.0  # z of the lag-1 autocorrelation above which the noise model is not adequate,
NOTICEABLE = 0.1  # if the coefficient itself is above this


@dataclass(frozen=True)
class Step:
    """One model of the sequence, with its errors in the output unit.

    Attributes:
        calibration: the fit.
        added: effect that this step added; None for the first and where only the noise law changed.
        noise_changed: what was done to the noise law, in words; empty if nothing.
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
    noise_changed: str = ""

    @property
    def title(self) -> str:
        """The step in a few words."""
        if self.added is None:
            return self.noise_changed or "baseline"
        dropped = f" (drops {', '.join(self.dropped)})" if self.dropped else ""
        return f"+ {self.added}{dropped}"

    def errors(self) -> dict[str, Any]:
        """Title and errors as plain data, output unit: what result.json says of them, and what pictures show."""
        left_out = self.left_out
        return {
            "title": self.title,
            "rmse": self.rmse,
            "rmse_fitted": self.rmse_fitted,
            "unit": self.calibration.unit,
            "holdout_rmse": self.holdout_rmse,
            "leave_one_group_out": None
            if left_out is None
            else {"group": left_out.group, "n": left_out.count, "rmse": left_out.rmse},
            "noise_floor": self.noise_floor,
        }


@dataclass(frozen=True)
class Gate:
    """Whether probabilities of missing effects may be given at all."""

    ok: bool
    reason: str


@dataclass(frozen=True)
class OtherPath:
    """Where the search ends under the other noise law, if these readings do not tell the two ends apart.

    Attributes:
        noise: that law.
        added: what was added under it.
        log_bayes_factor: of that end against the trail's own, natural logarithm; negative.
    """

    noise: str
    added: tuple[str, ...]
    log_bayes_factor: float

    def __str__(self) -> str:
        law = "white" if self.noise == "white" else "wandering"
        what = " and ".join(self.added) if self.added else "nothing"
        return (
            f"These readings cannot tell this end from {law} noise with {what} added (log Bayes factor "
            f"{self.log_bayes_factor:.1f}): a dependence on time can look like wandering noise, and wandering noise "
            "like an effect. A repeat of the campaign tells: noise will wander otherwise, an effect will not."
        )


@dataclass(frozen=True)
class Trail:
    """The sequence of models from the baseline to the last, and whether to trust the last.

    Attributes:
        steps: in order.
        gate: of the last model.
        holdout: the readings kept apart.
        other_path: an end under another noise law that is nearly as probable; None where there is none.
    """

    steps: tuple[Step, ...]
    gate: Gate
    holdout: Measurements | None
    other_path: OtherPath | None = None

    @property
    def final(self) -> Step:
        return self.steps[-1]

    @property
    def ok(self) -> bool:
        return self.gate.ok and self.final.calibration.verdict.ok

    if TYPE_CHECKING:

        def save(self, folder: Path) -> None:
            """Write result.json, calibration.nc (of the last step) and loop.png; `save_search` attaches it."""

    def __str__(self) -> str:
        return trail_text(self)


def trail_text(trail: Trail) -> str:
    """The error, step by step."""
    unit = unit_label(trail.final.calibration.unit)
    head = [
        *("step", f"rmse [{unit}]", "left-out", "held-out", "noise", "floor"),
        *("log evidence", "nothing missing"),
    ]
    rows = []
    for i, s in enumerate(trail.steps):
        evidence = s.calibration.log_evidence
        rows.append(
            [
                f"{i} {s.title}",
                number(s.rmse),
                number(s.left_out.rmse if s.left_out else None),
                number(s.holdout_rmse),
                number(s.check.noise),
                number(s.noise_floor),
                "–" if evidence is None else f"{evidence[0]:z.1f}",
                probability(s.discovery.nothing_missing if s.discovery else None),
            ]
        )
    return table(head, rows)


def gate(step: Step) -> Gate:
    """Whether the last model's noise is as independent as its probabilities assume."""
    verdict = step.calibration.verdict
    if not verdict.ok:
        return Gate(False, "The fit did not converge: " + " ".join(verdict.reasons))
    if step.check.fixed is not None and step.check.fixed.wrong:
        return Gate(
            False,
            f"The fixed coefficients leave residuals of {step.check.fixed.rms:.3g} {step.check.unit} rms, "
            f"{step.check.fixed.rms / step.check.fixed.noise:.1f} times the noise of the same model set free.",
        )
    coefficient, z = step.check.autocorrelation
    if abs(z) > AUTOCORRELATED and abs(coefficient) > NOTICEABLE:
        return Gate(
            False,
            f"Noise model inadequate: neighbouring residuals are correlated ({coefficient:.2f}, z = {z:.1f}), "
            "so the probabilities of missing effects are too confident. Either the noise is correlated in "
            "time or something is missing that no candidate describes.",
        )
    return Gate(True, "converged; neighbouring residuals are not correlated")
