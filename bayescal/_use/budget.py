"""The uncertainty budget of a compensated value, after JCGM 100 (GUM), at a chosen operating point.

Two tables split the same variance, correlations included:

- *by coefficient*: sensitivity c = ∂value/∂θ, contribution |c|·u(θ), and the share c_i·Σ_j C_ij·c_j/u², which adds up
  to one and may be negative where correlation reduces the variance (JCGM 100, 5.2.2);
- *by source*: where the posterior's width comes from, linearised at the fit: noise of the calibration's readings and
  how its runs differ (Type A), priors (Type B), those of nuisance angles among them, which tell how well a bias is
  known. What sampling between-group standard deviations and shapes adds has a row of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim, limit
from bayescal._calibration.prior_influence import not_measured, variance_by_origin
from bayescal._core.as_json import as_json
from bayescal._core.errors import InputError
from bayescal._core.formatting import folded, number, with_error
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.unit_conversion import (
    coefficient_factor,
    convert,
    needs_gravity,
    same_dimension,
    unit_label,
)
from bayescal._use.compensation_program import PAST, clock_note
from bayescal._use.compensator import Compensator, compensator
from bayescal._use.operating_equation import (
    ALL_DRAWS,
    OperatingEquation,
)

REST = "between-group sd, shapes, curvature"
STRUCTURES = "which effects there are (average over structures)"
FORM = "form of the model: formulas that the search does not have"
LEAST_VARIANCE_SHARE = 5e-4  # share of the variance below which a coefficient is not printed
READINGS = "noise of the calibration's readings"


@dataclass(frozen=True)
class Contribution:
    """One coefficient's part."""

    name: str  # name, unit: of the coefficient, as reported
    unit: str
    value: float  # value, uncertainty: posterior mean and standard uncertainty, in that unit
    uncertainty: float
    sensitivity: float  # ∂value/∂coefficient, stimulus unit per reported unit
    contribution: float  # |sensitivity|·uncertainty, stimulus unit
    share: float  # of the variance, correlations included


@dataclass(frozen=True)
class SourceShare:
    """One source's part: kind "A" (readings and their runs), "B" (a prior) or "" (the rest); share of the variance."""

    name: str
    kind: str
    contribution: float
    share: float


@dataclass(frozen=True, repr=False)
class Budget(Printed):
    """An uncertainty budget.

    Attributes:
        stimulus, unit: what the value is of.
        at: operating point: the stimulus and every covariate, in `at_units`.
        at_units: the fixed units.
        reading: expected there, in `output_unit`.
        output_unit: of the instrument's readings.
        uncertainty: combined standard uncertainty of the compensated value, without the noise of the reading.
        noise: standard uncertainty that the noise of one reading adds, stimulus unit.
        k: coverage factor.
        coefficients, sources: the two tables.
        covariance: of the coefficients, in their order, reported units.
        notes: what to know, each a sentence.
    """

    stimulus: str
    unit: str
    at: dict[str, float]
    at_units: dict[str, str]
    reading: float
    output_unit: str
    uncertainty: float
    noise: float
    k: float
    coefficients: tuple[Contribution, ...]
    sources: tuple[SourceShare, ...]
    covariance: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def expanded(self) -> float:
        """k times the combined standard uncertainty, without the noise of the reading."""
        return self.k * self.uncertainty

    @property
    def expanded_reading(self) -> float:
        """The same with the noise of one reading."""
        return self.k * float(np.hypot(self.uncertainty, self.noise))

    @property
    def correlation(self) -> np.ndarray:
        sd = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.where(sd > 0, np.outer(sd, sd), 1.0)

    def shown(self) -> Budget:
        """The same in the readings' unit where the stimulus is of their kind, angles of the point in degrees."""
        to = self.output_unit
        if to == self.unit or not same_dimension(self.unit, to) or needs_gravity(self.unit, to):
            to = self.unit
        factor = coefficient_factor(self.unit, to)
        coefficients = tuple(
            replace(c, sensitivity=factor * c.sensitivity, contribution=factor * c.contribution)
            for c in self.coefficients
        )
        degrees = {n: "deg" if unit == "rad" else unit for n, unit in self.at_units.items()}
        return replace(
            self,
            unit=to,
            at={n: float(convert(v, self.at_units[n], degrees[n])) for n, v in self.at.items()},
            at_units=degrees,
            uncertainty=factor * self.uncertainty,
            noise=factor * self.noise,
            coefficients=coefficients,
            sources=tuple(replace(s, contribution=factor * s.contribution) for s in self.sources),
        )

    def data(self) -> dict[str, Any]:
        """As JSON, in fixed units."""
        more = {"expanded": self.expanded, "expanded_reading": self.expanded_reading}
        return {**as_json(self), **more}

    def _parts(self) -> list[str | ResultTable]:
        shown = self.shown()
        unit, (by_coefficient, by_source) = unit_label(shown.unit), shown.tables()
        seen = [c for c in shown.coefficients if abs(c.share) >= LEAST_VARIANCE_SHARE]
        left = len(shown.coefficients) - len(seen)
        rest = f" {left} coefficients below {LEAST_VARIANCE_SHARE:.2%} are not shown." * (left > 0)
        sizes = shown.uncertainty, shown.noise, shown.expanded_reading / shown.k
        combined, noise, both = (f"{number(size)} {unit}" for size in sizes)
        parts = [
            f"Uncertainty budget of {shown.stimulus} at {shown.place}",
            replace(by_coefficient, rows=seen),
            "Shares count correlations and add up to 100 %; a negative share reduces the variance."
            + rest,
            by_source,
            f"Combined standard uncertainty {combined}; with the noise of one reading ({noise}): {both}.",
            f"Expanded uncertainty (k = {shown.k:g}): {number(shown.expanded)} {unit}; with the noise of one reading: "
            f"{number(shown.expanded_reading)} {unit}.",
            folded(" ".join(shown.notes), ""),
        ]
        return [line for part in parts for line in (part, "")][:-1]

    def _brief(self) -> str:
        shown = self.shown()
        unit = unit_label(shown.unit)
        return f"{self.stimulus} at {shown.place}: U = {number(shown.expanded)} {unit} (k = {self.k:g})"

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each coefficient, in fixed units."""
        names = [f.name for f in fields(Contribution)]
        return {name: [getattr(c, name) for c in self.coefficients] for name in names}

    @property
    def place(self) -> str:
        """The operating point, in words."""
        units = {n: unit_label(unit) for n, unit in self.at_units.items()}
        return ", ".join(f"{n} = {number(v, 4)} {units[n]}".strip() for n, v in self.at.items())

    def tables(self) -> tuple[ResultTable, ResultTable]:
        """By coefficient, and by where it comes from."""
        size = f"contribution {unit_label(self.unit)}".strip()
        tail = (
            TableColumn(size, lambda one: number(one.contribution)),
            TableColumn("share", lambda one: f"{100 * one.share:z.1f} %"),
        )

        def estimate(c: Contribution) -> str:
            return f"{with_error(c.value, c.uncertainty)} {unit_label(c.unit)}".strip()

        by_coefficient = (
            TableColumn("coefficient", lambda c: c.name),
            TableColumn("estimate", estimate),
            TableColumn("sensitivity", lambda c: number(c.sensitivity)),
            *tail,
        )
        by_source = (
            TableColumn("the same by where it comes from", lambda s: s.name),
            TableColumn("type", lambda s: s.kind),
            *tail,
        )
        return ResultTable(by_coefficient, self.coefficients), ResultTable(by_source, self.sources)


def budget(
    calibration: Calibration | Compensator, at: Mapping[str, float] | None = None, *, k: float = 2.0
) -> Budget:
    """The uncertainty budget of a compensated value.

    Args:
        calibration: a fit, or a compensator of one.
        at: operating point: the stimulus and covariates by name, fixed units. Left out are the middle of the
            calibrated range; zero for the stimulus where that is not known, and for rates and lags.
        k: coverage factor of the expanded uncertainty.

    Raises:
        InputError: a name that the calibration does not know, k is not positive, or the output stands still there.
        ModelError: the instrument does not say what it measures.
    """
    chosen = compensator(calibration) if isinstance(calibration, Calibration) else calibration
    if chosen.loaded:
        raise InputError("a loaded compensator has no posterior: give the calibration itself")
    if not (np.isfinite(k) and k > 0):
        raise InputError(f"k = {k}: a coverage factor is a positive number, such as 2")
    point = _operating_point(chosen, dict(at or {}))
    expected, slope, gradient = _slopes(chosen, point)
    covariance = chosen._moments.covariance
    variance = float(gradient @ covariance @ gradient)
    every = chosen.equation.moments(ALL_DRAWS)
    places = {name: np.array([value]) for name, value in point.items()}
    untold = not_measured(chosen.calibration, (every.draws @ gradient)[:, None])
    said = [Claim("budget.prior", *u.names, untold=str(u), told=u.cure) for u in (untold,) if u]
    sd = np.sqrt(np.diag(covariance))
    share = gradient * (covariance @ gradient) / (variance or np.inf)
    numbers = (chosen._moments.mean, sd, gradient, np.abs(gradient) * sd, share)
    unknowns = chosen.equation.unknowns
    return Budget(
        stimulus=chosen.stimulus,
        unit=chosen.unit,
        at=point,
        at_units={chosen.stimulus: chosen.unit, **{i.name: i.unit for i in chosen.inputs}},
        reading=expected,
        output_unit=chosen.about.output_unit,
        uncertainty=variance**0.5,
        noise=float(chosen.noise_variance(places)[0]) ** 0.5 / abs(slope),
        k=float(k),
        coefficients=tuple(
            Contribution(u.name, u.unit, *map(float, own))
            for u, *own in zip(unknowns, *numbers, strict=True)
        ),
        sources=_by_source(chosen, point, gradient, variance),
        covariance=covariance,
        notes=(*said, *_beyond(chosen, point), *notes_on(chosen)),
    )


def _operating_point(chosen: Compensator, at: dict[str, float]) -> dict[str, float]:
    names = [chosen.stimulus, *(i.name for i in chosen.inputs if i.kind != "lag slope")]
    for name, value in at.items():
        if name not in names:
            raise InputError(
                f"{name!r} plays no part in this compensation; what does: {', '.join(names)}"
            )
        if not np.isfinite(value):
            raise InputError(f"{name} = {value}: give a finite number")
    return {n: float(at.get(n, v)) for n, v in chosen.middle.items() if n in names}


def _slopes(chosen: Compensator, point: Mapping[str, float]) -> tuple[float, float, np.ndarray]:
    """Expected output and its slope at a point, and ∂value/∂θ there; inputs that are not in it are zero, as unused."""
    places = {name: np.full(1, value) for name, value in point.items()}
    at = chosen._moments.mean, places[chosen.stimulus], places
    expected, slope, gradient = chosen.equation.linearised(*at)
    if slope[0] == 0:
        where = ", ".join(f"{name} = {value:.6g}" for name, value in point.items())
        raise InputError(
            f"at {where} the output does not follow {chosen.stimulus}: choose another point"
        )
    return float(expected[0]), float(slope[0]), 0.0 - np.asarray(gradient[0] / slope[0])


def _by_source(
    chosen: Compensator, point: Mapping[str, float], gradient: np.ndarray, variance: float
) -> tuple[SourceShare, ...]:
    """The split by what the calibration knew: noise, each prior, each deviation that is new in use."""
    unlikely = {e.name for e in chosen.calibration.model.effects} - chosen.calibration.likeliest
    parts, total = dict[tuple[str, str], float](), variance
    if unlikely:
        members = dict(chosen.equation.members)
        chosen = compensator(chosen.calibration.without(unlikely), members=members)
        *_, gradient = _slopes(chosen, point)
        total = float(gradient @ chosen._moments.covariance @ gradient)
    calibration, unknowns = chosen.calibration, chosen.equation.unknowns
    slopes, learned = dict[str, float](), _learned_group_sds(chosen.equation)
    for i, unknown in enumerate(unknowns):
        if unknown.kind == "new":
            kind = "A" if unknown.key in learned else "B"
            parts[unknown.name, kind] = gradient[i] ** 2 * chosen._moments.covariance[i, i]
        else:
            slopes[unknown.name] = float(gradient[i])
    readings, priors = variance_by_origin(calibration, slopes)
    if readings or priors:
        parts[READINGS, "A"] = readings
        parts |= {(f"prior of {name}", "B"): value for name, value in priors.items()}
    known = calibration.unknowns
    for one in calibration.confounders:
        moved = 0.0  # by a standard deviation of the column's effect
        for slope, u in zip(gradient, unknowns, strict=True):
            if u.kind == "coefficient" and (own := one.shares.get(u.key)):
                moved += float(slope) * own[known.index[u.name] - known.by_key[u.key].start]
        parts[f"{one.of_column}, not told from the model's own", "B"] = moved**2
    beside = 0.0
    for name, (i, size) in chosen.equation.unfound_spreads.items():
        parts[f"{name} (new run), not found", "B"] = own = float(gradient[i] * size) ** 2
        beside += own
    if (lost := 1 - calibration.form_factor**-2) > 0:
        own = gradient * [u.kind != "new" for u in unknowns]
        parts[FORM, "B"] = lost * (float(own @ chosen._moments.covariance @ own) - beside)
    rows = sorted(parts.items(), key=lambda p: -p[1])
    rows += [((REST, ""), total - sum(parts.values()))]
    rows += [((STRUCTURES, ""), variance - total)] * bool(unlikely)
    sizes = ((named, value, float(np.sign(value) * abs(value) ** 0.5)) for named, value in rows)
    return tuple(SourceShare(*named, size, v / (variance or np.inf)) for named, v, size in sizes)


def _learned_group_sds(equation: OperatingEquation) -> set[str]:
    """Coefficients of which a new member is drawn in use, from a spread that the readings told."""
    given, known = dict(equation.members), {None, *dict(equation.layout.model.fixed)}
    learned = (b for b in equation.blocks if b.group_sd_name not in known)
    return {b.name for b in learned if b.coefficient.per not in given}


def _beyond(chosen: Compensator, point: Mapping[str, float]) -> list[Claim]:
    """Where an operating point, fixed units, is outside the calibrated range."""
    past = {i.name for i in chosen.inputs if i.kind in PAST}
    settled = {i.name for i in chosen.inputs if i.settled}
    return [
        Claim("budget.beyond_range", name, value=point[name], low=low, high=high, unit=unit)
        for name, (low, high, unit) in chosen.calibrated.items()
        if name not in past and (point[name] < low or (point[name] > high and name not in settled))
    ]


def notes_on(chosen: Compensator, of_correction: bool = True) -> tuple[Claim, ...]:
    """Which coverage of a budget is short, and what is not counted in it, of a correction or of a slot alone."""
    notes = clock_note(chosen.equation)
    learned = _learned_group_sds(chosen.equation)
    for block in (b for b in chosen.equation.blocks if b.name in learned):
        per = str(block.coefficient.per)
        count = len(chosen.calibration.levels.get(per, ()))
        if count < limit("budget.few_groups", "groups"):
            notes.append(Claim("budget.few_groups", block.name, group=per, count=count))
    if of_correction and not chosen.equation.slope_calibrated:
        notes.append(Claim("use.bias_only", chosen.stimulus))
    return (*dict.fromkeys(notes), Claim("budget.shared_errors"))
