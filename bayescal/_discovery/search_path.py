"""A trail: the sequence of models from the baseline to the last, with the error of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.guards import conflicts
from bayescal._core.formatting import number, probability, table
from bayescal._diagnostics.check_result import Check
from bayescal._diagnostics.leave_group_out import LeaveOneGroupOut
from bayescal._discovery.discovery import Discovery
from bayescal._discovery.posterior import Posterior
from bayescal._discovery.structures import Structures
from bayescal._readings.measurements import Measurements
from bayescal._readings.unit_conversion import unit_label

AUTOCORRELATED = 4.0  # z of the lag-1 autocorrelation above which the noise model is not adequate,
NOTICEABLE = 0.1  # if the coefficient itself is above this
WORSE = 1.05  # error against that of an earlier step, above which an effect does harm
SHOWN = 20  # structures kept of a search


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
class Shown:
    """A structure as a search leaves it: what it adds, its noise law, how probable it is."""

    effects: tuple[str, ...]
    wanders: bool
    log_evidence: float
    probability: float


@dataclass(frozen=True)
class Search:
    """How a search ended.

    Attributes:
        structures: the most probable ones.
        weighed: how many were.
        complete: whether it came to its end.
        stopped: why it did not, in words.
    """

    structures: tuple[Shown, ...]
    weighed: int
    complete: bool
    stopped: str = ""

    @classmethod
    def of(cls, structures: Structures, *, complete: bool, stopped: str = "") -> Search:
        posterior = Posterior.of(structures)
        shown = tuple(
            Shown(tuple(sorted(s.effects)), s.wanders, posterior.refitted[s].log_evidence, float(p))
            for s, p in zip(posterior.structures, posterior.probability, strict=True)
            if s in posterior.refitted
        )
        return cls(shown[:SHOWN], len(structures.visited), complete, stopped)


@dataclass(frozen=True)
class Trail:
    """The sequence of models from the first to the chosen one, and whether to trust the last.

    Attributes:
        steps: in order.
        gate: of the last model.
        holdout: the readings kept apart.
        other_path: an end under another noise law that is nearly as probable; None where there is none.
        search: the structures weighed; None before the search.
    """

    steps: tuple[Step, ...]
    gate: Gate
    holdout: Measurements | None
    other_path: OtherPath | None = None
    search: Search | None = None

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
    """The error, step by step: as fitted, of a new run, held out, and the floor."""
    unit = unit_label(trail.final.calibration.unit)
    held_out = trail.holdout is not None
    head = [
        *(
            "step",
            f"as fitted [{unit}]",
            "new run",
            "left-out",
            *(["held-out"] if held_out else []),
        ),
        *("floor", "log evidence", "nothing missing"),
    ]
    rows = []
    for i, s in enumerate(trail.steps):
        evidence = s.calibration.log_evidence
        rows.append(
            [
                f"{i} {s.title}",
                number(s.rmse_fitted),
                number(s.rmse),
                number(s.left_out.rmse if s.left_out else None),
                *([number(s.holdout_rmse)] if held_out else []),
                number(s.noise_floor),
                "–" if evidence is None else f"{evidence[0]:z.1f}",
                probability(s.discovery.nothing_missing if s.discovery else None),
            ]
        )
    return table(head, rows)


def gate(steps: Sequence[Step]) -> Gate:
    """Whether the last model is to be used and its probabilities believed; if not, every reason."""
    reasons = [*_of_noise(steps[-1]), *_against_the_steps_before(steps)]
    reasons += conflicts(steps[-1].calibration)
    if reasons:
        return Gate(False, " ".join(reasons))
    return Gate(True, "converged; neighbouring residuals are not correlated")


def _of_noise(step: Step) -> list[str]:
    verdict = step.calibration.verdict
    if not verdict.ok:
        return ["The fit did not converge: " + " ".join(verdict.reasons)]
    if step.check.fixed is not None and step.check.fixed.wrong:
        return [
            f"The fixed coefficients leave residuals of {step.check.fixed.rms:.3g} {step.check.unit} rms, "
            f"{step.check.fixed.rms / step.check.fixed.noise:.1f} times the noise of the same model set free."
        ]
    coefficient, z = step.check.autocorrelation
    if abs(z) > AUTOCORRELATED and abs(coefficient) > NOTICEABLE:
        return [
            f"Noise model inadequate: neighbouring residuals are correlated ({coefficient:.2f}, z = {z:.1f}), "
            "so the probabilities of missing effects are too confident. Either the noise is correlated in "
            "time or something is missing that no candidate describes."
        ]
    return []


def _against_the_steps_before(steps: Sequence[Step]) -> list[str]:
    """What an added effect made worse: the error as fitted, left-out groups, readings kept apart."""
    reasons, unit = [], unit_label(steps[-1].calibration.unit)
    for before, after in pairwise(steps):
        if after.rmse_fitted > WORSE * before.rmse_fitted:
            reasons.append(
                f"Step {after.title!r} raises the error as fitted, {before.rmse_fitted:.3g} → "
                f"{after.rmse_fitted:.3g} {unit}: do not use it."
            )
    first, last = steps[0], steps[-1]
    pairs = {
        "left-out groups": (
            first.left_out and first.left_out.rmse,
            last.left_out and last.left_out.rmse,
        ),
        "the readings kept apart": (first.holdout_rmse, last.holdout_rmse),
    }
    for what, (early, late) in pairs.items():
        if early is not None and late is not None and late > WORSE * early:
            reasons.append(
                f"The last model predicts {what} worse than the first, {early:.3g} → {late:.3g} {unit}: "
                "what was added holds for these readings alone."
            )
    return reasons
