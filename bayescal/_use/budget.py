"""The uncertainty budget of a compensated value, after JCGM 100 (GUM), at a chosen operating point.

Two tables split the same variance, including its covariance terms:

- *by coefficient*: sensitivity coefficient c = ∂value/∂θ, contribution |c|·u(θ), and the share c_i·Σ_j C_ij·c_j/u²;
  shares add up to one, and may be negative where correlation reduces the variance (JCGM 100, 5.2.2);
- *by source*: origins of the posterior variance, linearised at the fit: noise of the calibration's readings and
  between-run deviations (Type A), priors (Type B), including those of nuisance angles. A separate row has the
  remainder, due to sampled between-group standard deviations and nonlinear parameters.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim
from bayescal._calibration.prior_influence import find_prior_dominance, variance_by_origin
from bayescal._core.errors import InputError
from bayescal._core.formatting import format_value, number, wrap
from bayescal._core.json_data import as_json
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.unit_conversion import (
    coefficient_factor,
    convert,
    format_unit,
    needs_gravity,
    quotient,
    same_dimension,
    unit_label,
)
from bayescal._use.compensation_program import HISTORY_KINDS, list_clock_claims
from bayescal._use.compensator import Compensator, compensator
from bayescal._use.operating_equation import ALL_DRAWS, OperatingEquation, is_new_member

REMAINDER = "between-run sd, time constants, second-order terms"
STRUCTURES_LABEL = "averaging over structures (rows above: the most probable one alone)"
INADEQUACY_LABEL = "model inadequacy: u × f, f = {:.2f}, except new runs' deviations"
SHARES_NOTE = "Shares of the variance add up to 100 %; a negative share cancels part of others, by correlation."
MIN_PRINTED_SHARE = 5e-4  # smallest share of the variance that is printed
READINGS_LABEL = "noise of the calibration's readings"
Point = Mapping[str, float]  # operating point: stimulus and inputs by name, fixed units


@dataclass(frozen=True)
class Contribution:
    """Contribution of one coefficient to the variance of the compensated value."""

    name: str  # name of the coefficient
    unit: str  # reported unit
    value: float  # posterior mean, reported unit
    uncertainty: float  # standard uncertainty, reported unit
    sensitivity: float  # ∂value/∂coefficient, stimulus unit per reported unit
    contribution: float  # |sensitivity|·uncertainty, stimulus unit
    share: float  # fraction of the variance, including half of the coefficient's covariances


@dataclass(frozen=True)
class SourceShare:
    """One source of uncertainty: u, share of the variance, kind "A" (readings, runs), "B" (a prior) or "" (both)."""

    name: str
    kind: str
    contribution: float
    share: float


def format_inputs(values: Mapping[str, str], units: Mapping[str, str]) -> str:
    """Format input quantities and their values as one text; equal lags T̃ − T of a column are named once."""
    lags = {n: re.sub(r"_lag(_\d+)?$", "_lag (lagged − measured)", n) for n in values}
    names = {n: lag if units[n] == "delta_degC" else n for n, lag in lags.items()}
    return ", ".join(dict.fromkeys(f"{names[n]} = {v}".strip() for n, v in values.items()))


@renamed(shown="in_output_unit")
@dataclass(frozen=True, repr=False)
class Budget(Printed):
    """Uncertainty budget of a compensated value; the result of `budget`.

    Attributes:
        stimulus, unit: name of the stimulus, and unit of its compensated value.
        at, at_units: operating point, the value of the stimulus and of every covariate, and the unit of each value.
        reading: expected reading at the operating point, in `output_unit`.
        output_unit: unit of the instrument's readings.
        uncertainty: combined standard uncertainty of the compensated value, without the noise of the reading.
        noise: standard uncertainty of the compensated value due to the noise of one reading.
        k: coverage factor.
        k_95: coverage factor for a coverage probability of 95 %, from the posterior draws (JCGM 101:2008, 7.7).
        coefficients, sources: rows of the two tables.
        covariance: covariance matrix of `coefficients`, in their order and their reported units.
        notes: warnings, one sentence each.
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
    k_95: float
    coefficients: tuple[Contribution, ...]
    sources: tuple[SourceShare, ...]
    covariance: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty, k times `uncertainty`: without the noise of the reading."""
        return self.k * self.uncertainty

    @property
    def expanded_reading(self) -> float:
        """Return the expanded uncertainty including the noise of one reading."""
        return self.k * float(np.hypot(self.uncertainty, self.noise))

    def in_output_unit(self) -> Budget:
        """Return the budget in the readings' unit, if it has the stimulus' dimension, and with angles in degrees."""
        unit = self.output_unit
        if not same_dimension(self.unit, unit) or needs_gravity(self.unit, unit):
            unit = self.unit
        factor = coefficient_factor(self.unit, unit)
        coefficients = tuple(
            replace(c, sensitivity=factor * c.sensitivity, contribution=factor * c.contribution)
            for c in self.coefficients
        )
        degrees = {n: "deg" if unit == "rad" else unit for n, unit in self.at_units.items()}
        return replace(
            self,
            unit=unit,
            at={n: float(convert(v, self.at_units[n], degrees[n])) for n, v in self.at.items()},
            at_units=degrees,
            uncertainty=factor * self.uncertainty,
            noise=factor * self.noise,
            coefficients=coefficients,
            sources=tuple(replace(s, contribution=factor * s.contribution) for s in self.sources),
        )

    def to_json_data(self) -> dict[str, Any]:
        """Return the budget as JSON data, in fixed units."""
        return as_json(self) | {n: getattr(self, n) for n in ("expanded", "expanded_reading")}

    def _list_parts(self) -> list[str | ResultTable]:
        b = self.in_output_unit()
        unit, (by_coefficient, by_source) = unit_label(b.unit), b.tables()
        omitted_count = len(b.coefficients) - len(by_coefficient.rows)
        note = f" {omitted_count} coefficients below {100 * MIN_PRINTED_SHARE:g} % are not shown."
        u, total = b.uncertainty, b.expanded_reading / b.k
        uncertainties = u, b.noise, total, b.expanded, b.expanded_reading, b.k_95 * u
        texts = (number(s) if s >= 100 else f"{s:#.3g}" for s in uncertainties)
        combined, noise, total, expanded, reading_text, u_95 = (f"{text} {unit}" for text in texts)
        expanded = f"Expanded uncertainty (k = {b.k:g}): {expanded}; with the noise of one reading: {reading_text}."
        coverage = f"For 95 % coverage, from the posterior draws: k = {b.k_95:.2f}, U = {u_95}."
        parts = [
            wrap(f"Uncertainty budget of {b.stimulus} at {b.place}"),
            by_coefficient,
            wrap(f"{SHARES_NOTE}{note * (omitted_count > 0)}", ""),
            by_source,
            f"Combined standard uncertainty {combined}; with the noise of one reading ({noise}): {total}.",
            wrap(f"{expanded} {coverage}", ""),
            wrap(" ".join(b.notes), ""),
        ]
        return [line for part in parts for line in (part, "")][:-1]

    def _format_summary(self) -> str:
        b = self.in_output_unit()
        return f"{self.stimulus} at {b.place}: U = {number(b.expanded)} {unit_label(b.unit)} (k = {self.k:g})"

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return the columns of a table with a row per coefficient, in fixed units."""
        names = [f.name for f in fields(Contribution)]
        return {name: [getattr(c, name) for c in self.coefficients] for name in names}

    @property
    def place(self) -> str:
        """Format the operating point as text; equal lags of a column are named once."""
        labels = {n: unit_label(unit) for n, unit in self.at_units.items()}
        values = {n: f"{number(v, 4)} {labels[n]}" for n, v in self.at.items()}
        return format_inputs(values, self.at_units)

    def tables(self) -> tuple[ResultTable, ResultTable]:
        """Return the tables by coefficient and by source, without rows below `MIN_PRINTED_SHARE`."""
        rows = (self.coefficients, self.sources)
        printed = ([r for r in table if abs(r.share) >= MIN_PRINTED_SHARE] for table in rows)
        title = f"contribution u [{unit_label(self.unit) or 1}]"
        common_columns = (
            TableColumn(title, lambda r: number(r.contribution) if r.contribution > 0 else "–"),
            TableColumn("share", lambda row: f"{100 * row.share:z.1f} %"),
        )

        def format_estimate(c: Contribution) -> str:
            return f"{format_value(c.value, c.uncertainty)} {unit_label(c.unit)}".strip()

        by_coefficient = (
            TableColumn("coefficient", lambda c: c.name),
            TableColumn("estimate ± standard uncertainty", format_estimate),
            TableColumn("sensitivity c", lambda c: number(c.sensitivity)),
            TableColumn("unit of c", lambda c: format_unit(quotient(self.unit, c.unit)), left=True),
            *common_columns,
        )
        by_source = (
            TableColumn("the same uncertainty by source", lambda s: s.name),
            TableColumn("type", lambda s: s.kind or "A, B"),
            *common_columns,
        )
        return ResultTable(by_coefficient, next(printed)), ResultTable(by_source, next(printed))


def budget(
    calibration: Calibration | Compensator, at: Mapping[str, float] | None = None, *, k: float = 2.0
) -> Budget:
    """Compute the uncertainty budget of a compensated value.

    Args:
        calibration: a fit, or its compensator.
        at: operating point: the stimulus and covariates by name, fixed units. Default: the middle of the calibrated
            range; zero for a stimulus of unknown range, for rates and for lags.
        k: coverage factor of the expanded uncertainty.

    Raises:
        InputError: an unknown name, k is not positive, or the output does not depend on the stimulus at the point.
        ModelError: the instrument has no stimulus (`Instrument.use`).
    """
    correction = compensator(calibration) if isinstance(calibration, Calibration) else calibration
    if not (np.isfinite(k) and k > 0):
        raise InputError(f"k = {k}: a coverage factor is a positive number, such as 2")
    point = _validate_point(correction, dict(at or {}))
    expected, slope, gradient = _linearise(correction, point)
    covariance = correction._moments.covariance
    variance = float(gradient @ covariance @ gradient)
    inputs, stimulus = {n: np.array([v]) for n, v in point.items()}, correction.stimulus
    value_draws = correction.equation.moments(ALL_DRAWS).draws @ gradient
    dominant = find_prior_dominance(correction.calibration, value_draws[:, None])
    half_width = float(np.quantile(np.abs(value_draws - value_draws.mean()), 0.95))
    claims = [Claim("budget.prior", *u.names, untold=str(u), told=u.cure) for u in (dominant,) if u]
    sd = np.sqrt(np.diag(covariance))
    shares = gradient * (covariance @ gradient) / (variance or np.inf)
    columns = (correction._moments.mean, sd, gradient, np.abs(gradient) * sd, shares)
    return Budget(
        stimulus=stimulus,
        unit=correction.unit,
        at=point,
        at_units={stimulus: correction.unit} | {i.name: i.unit for i in correction.inputs},
        reading=expected,
        output_unit=correction.about.output_unit,
        uncertainty=variance**0.5,
        noise=float(correction.in_use.noise_variance(inputs[stimulus], inputs)[0]) ** 0.5
        / abs(slope),
        k=float(k),
        k_95=half_width / (variance**0.5 or np.inf),
        coefficients=tuple(
            Contribution(u.name, u.unit, *map(float, values))
            for u, *values in zip(correction.equation.unknowns, *columns, strict=True)
        ),
        sources=_split_by_source(correction, point, gradient, variance),
        covariance=covariance,
        notes=(*claims, *_find_range_claims(correction, point), *list_budget_claims(correction)),
    )


def _validate_point(correction: Compensator, at: dict[str, float]) -> dict[str, float]:
    names = [correction.stimulus, *(i.name for i in correction.inputs if i.kind != "lag slope")]
    for name, value in at.items():
        if name not in names:
            message = f"{name!r} is not an input of this compensation; choose {', '.join(names)}"
            raise InputError(message)
        if not np.isfinite(value):
            raise InputError(f"{name} = {value}: give a finite number")
    return {n: float(at.get(n, v)) for n, v in correction.middle.items() if n in names}


def _linearise(correction: Compensator, point: Point) -> tuple[float, float, np.ndarray]:
    """Return expected output, ∂output/∂stimulus, and ∂(compensated value)/∂θ at a point; missing inputs are zero."""
    values = {name: np.full(1, value) for name, value in point.items()}
    arguments = correction._moments.mean, values[correction.stimulus], values
    expected, slope, gradient = correction.equation.linearise(*arguments)
    if slope[0] == 0:
        point_text = ", ".join(f"{name} = {value:.6g}" for name, value in point.items())
        message = f"at {point_text} the output does not depend on {correction.stimulus}: choose another point"
        raise InputError(message)
    return float(expected[0]), float(slope[0]), 0.0 - np.asarray(gradient[0] / slope[0])


def _split_by_source(
    correction: Compensator, point: Point, gradient: np.ndarray, variance: float
) -> tuple[SourceShare, ...]:
    """Return the variance due to each source: noise, priors, deviations of new group members, and a remainder."""
    calibration, equation = correction.calibration, correction.equation
    unlikely_effects = {e.name for e in calibration.model.effects} - calibration.likeliest_effects
    variances, total = dict[tuple[str, str], float](), variance
    if unlikely_effects:
        calibration = calibration.without(unlikely_effects)
        correction = compensator(calibration, members=dict(equation.members))
        equation, (*_, gradient) = correction.equation, _linearise(correction, point)
        total = float(gradient @ correction._moments.covariance @ gradient)
    unknowns, covariance = equation.unknowns, correction._moments.covariance
    blocks = {b.name: b for b in calibration.layout.blocks}
    sensitivities, estimated_names = dict[str, float](), _list_estimated_group_sds(equation)
    for i, unknown in enumerate(unknowns):
        if is_new_member(unknown):
            label = f"{unknown.key} of a new {unknown.group}"
            kind = "A" if unknown.key in estimated_names else "B"
            variances[label, kind] = gradient[i] ** 2 * covariance[i, i]
        else:
            sensitivities[unknown.name] = float(gradient[i])
    from_readings, by_prior = variance_by_origin(calibration, sensitivities)
    if from_readings or by_prior:
        variances[READINGS_LABEL, "A"] = from_readings
        for name, value in by_prior.items():
            label = f"prior of {name}"
            if (block := blocks.get(name)) and block.effect.is_reference_error:
                label = f"prior of {block.effect.name}"
            elif block and block.per:
                label += f" of each fitted {block.per}"
            variances[label, "B"] = variances.get((label, "B"), 0.0) + value
    index, undetected = calibration.unknowns, list[float]()  # variances not found by the search
    for confounder in calibration.confounders:
        shift = 0.0  # of the value, per standard deviation of the column's effect
        for derivative, u in zip(gradient, unknowns, strict=True):
            if not is_new_member(u) and (shares := confounder.shares.get(u.key)):
                shift += float(derivative) * shares[index.index[u.name] - index.by_key[u.key].start]
        variances[f"{confounder.label}, collinear with the model's", "B"] = shift**2
    for name, (i, sd) in equation.unfound_spreads.items():
        undetected.append(float(gradient[i] * sd) ** 2)
        variances[f"{name} of a new run, not found", ""] = undetected[-1]
    if (excess := 1 - calibration.form_factor**-2) > 0:
        g = gradient * [not is_new_member(u) for u in unknowns]
        model_variance = float(g @ covariance @ g) - sum(undetected)
        variances[INADEQUACY_LABEL.format(calibration.form_factor), "B"] = excess * model_variance
    rows = sorted(variances.items(), key=lambda p: -p[1])
    remainder = total - sum(variances.values())
    rows += [((REMAINDER, ""), remainder * (abs(remainder) > 1e-9 * total))]  # less is rounding
    rows += [((STRUCTURES_LABEL, ""), variance - total)] * bool(unlikely_effects)
    sources = ((label, value, float(np.sign(value) * abs(value) ** 0.5)) for label, value in rows)
    return tuple(SourceShare(*label, u, v / (variance or np.inf)) for label, v, u in sources)


def _list_estimated_group_sds(equation: OperatingEquation) -> set[str]:
    """Return the names of unseen members' coefficients whose between-group standard deviation is estimated."""
    members, fixed_names = dict(equation.members), {None, *dict(equation.layout.model.fixed)}
    estimated_blocks = (b for b in equation.blocks if b.group_sd_name not in fixed_names)
    return {b.name for b in estimated_blocks if b.coefficient.per not in members}


def _find_range_claims(correction: Compensator, point: Point) -> list[Claim]:
    """Return a claim for each input of an operating point (fixed units) that is outside its calibrated range."""
    history = {i.name for i in correction.inputs if i.kind in HISTORY_KINDS}
    fixed = {i.name for i in correction.inputs if i.settled}
    return [
        Claim("budget.beyond_range", name, value=point[name], low=low, high=high, unit=unit)
        for name, (low, high, unit) in correction.calibrated.items()
        if name not in history and (point[name] < low or (point[name] > high and name not in fixed))
    ]


def list_budget_claims(correction: Compensator, is_correction: bool = True) -> tuple[Claim, ...]:
    """Return the claims about what a budget includes and omits; `is_correction` is False for the budget of a slot."""
    calibration, equation = correction.calibration, correction.equation
    sources = [f"{name} of a new run" for name in equation.unfound_spreads]
    sources += ["model inadequacy"] * (calibration.form_factor > 1)
    notes = list_clock_claims(equation) + [Claim("budget.beyond_fit", *sources)] * bool(sources)
    for name, (i, sd) in equation.unfound_spreads.items():
        u, p = equation.unknowns[i], calibration.inclusion.get(name, 0.0)
        numbers = {"coefficient": u.name, "unit": u.unit, "p": p, "tau": sd / (1 - p) ** 0.5}
        if prior := calibration.model.instrument.known[name].coefficients[0].group_sd:
            plausible_sd = float(prior.value(0.0)) * sd / calibration.unfound_spreads[name]
            notes.append(Claim("budget.new_run", name, plausible=plausible_sd, **numbers))
    if is_correction and not correction.equation.is_slope_calibrated:
        notes.append(Claim("use.bias_only", correction.stimulus))
    return (*dict.fromkeys(notes), Claim("budget.shared_errors"))
