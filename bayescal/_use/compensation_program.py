"""Compensation program for firmware: inputs, equation, covariance and provenance of an executable correction.

The graph of the equation in use (`expression_graph.py`) and its derivatives are evaluated at the posterior mean of θ:

    expected(s), slope = ∂expected/∂s, gradient = ∂expected/∂θ,   at θ = the posterior mean.

The stimulus s solves expected(s) = reading, by one Newton step from 0 if the equation is affine in s, otherwise by up
to `MAX_NEWTON_STEPS`. Its standard uncertainty is √(gᵀCg), g = −gradient/slope, C = LLᵀ the posterior covariance of θ;
with the noise of one reading √(gᵀCg + v/slope²), v its variance by the noise law at s and the inputs (JCGM 100, 5.2.2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim
from bayescal._calibration.storage import list_sources
from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import number
from bayescal._core.inverse import solve_newton
from bayescal._core.json_data import as_json
from bayescal._core.renamed import renamed
from bayescal._core.version import __version__
from bayescal._data.measurements import Measurements
from bayescal._data.records import RATE_WINDOW_S, rate_window
from bayescal._data.unit_conversion import unit_label
from bayescal._model.frame import Frame, build_frame, name_hold_flag
from bayescal._tables.cells import format_date
from bayescal._use.expression_graph import Graph, Node
from bayescal._use.operating_equation import (
    STIMULUS,
    OperatingEquation,
    PosteriorMoments,
    compute_lag_and_slope,
    input_name,
    is_new_member,
)


class CorrectionInUse(Protocol):
    """Interface of corrections from readings to the stimulus, exported as files (`correction_files.py`)."""

    @property
    def instrument(self) -> str: ...  # its name

    @property
    def why_not(self) -> str: ...  # the reason why the result must not be used; empty if it may

    def to_json_data(self) -> dict[str, Any]: ...  # content of the JSON file


NOT_RELIABLE = "RESULT NOT RELIABLE: "
HISTORY_KINDS = ("rate", "lag", "lag slope")  # kinds of input computed from a temperature's history
# Largest change of a settled value over its standard uncertainty: it adds 0.5 % in the root sum of squares.
MAX_SETTLED_CHANGE = 0.1
RANGE_MARGIN = 0.01  # fraction of the stimulus range, tolerated beyond its ends for noise


class OutsideCalibration(UserWarning):
    """A reading was compensated outside the range in which the instrument was calibrated."""


@dataclass(frozen=True)
class Input:
    """A covariate that a compensation needs, with its range in the calibration."""

    name: str  # name, unit, meaning: as printed and in firmware
    unit: str
    meaning: str
    # "column"; or computed from a record: "rate", "lag", "lag slope" (∂lag/∂τ; 0 omits it), "elapsed"
    kind: str
    column: str  # column that has its values, or from which they are computed
    low: float  # low, high: limits of the calibrated range, in `unit`
    high: float
    tau: float | None = None  # time constant of a lag, s; window of a rate, s
    # for a lag, the longest gap over which the column is interpolated, s; None: any gap
    silence: float | None = None
    settled: bool = False  # for an elapsed time, whether its effects have decayed at `high`
    held: bool = False  # for a lag, whether the column is assumed constant between readings

    @property
    def end(self) -> float:
        """Return the value above which an input is flagged as outside its calibrated range."""
        return np.inf if self.settled else self.high

    @property
    def middle(self) -> float:
        """Return the value at the default operating point: mid-range, the last time, or zero for rates and lags."""
        if self.name == "time":
            return self.high
        return 0.5 * (self.low + self.high) if self.kind in ("column", "elapsed") else 0.0


def list_needed_inputs(equation: OperatingEquation) -> list[Input]:
    """List the inputs on which the equation depends, with units, meanings and calibrated ranges."""
    inputs, calibration, values = list[Input](), equation.calibration, equation.at_fit
    frame = calibration.frame

    def add_input(name: str, unit: str, meaning: str, kind: str, column: str, **past: Any) -> None:
        if name in equation.inputs and name in values:
            limits = float(values[name].min()), float(values[name].max())
            inputs.append(Input(name, unit, meaning, kind, column, *limits, **past))

    meanings = {c.name: c.meaning for c in calibration.model.instrument.columns}
    for name in (n for n in equation.columns if n != "elapsed"):
        meaning = describe_time_origin(calibration) if name == "time" else meanings.get(name, "")
        add_input(name, calibration.readings.unit(name) or "1", meaning, "column", name)
    add_input("elapsed", "s", "time since the start of the run or of power", "elapsed", "time")
    for name, column in equation.rates:
        meaning = (
            f"rate of {column}: least-squares slope over the last {RATE_WINDOW_S:g} s (or the last two readings, if "
            "these are further apart), 0 at the start"
        )
        add_input(name, "degC/s", meaning, "rate", column, tau=rate_window(np.asarray(frame.step)))
    for lag in equation.nodes.lags:  # exports compute lags and ∂lag/∂τ from a record
        is_held = bool(calibration.reference.get(name_hold_flag(lag.column), 0.0))
        silence = None if is_held else float(frame.max_gap)
        lag_fields = {"tau": lag.tau, "silence": silence, "held": is_held}
        meaning = f"{lag.column}, low-pass filtered (time constant {lag.tau!r} s), minus {lag.column}; 0 at the start"
        add_input(lag.name, "delta_degC", meaning, "lag", lag.column, **lag_fields)
        meaning = (
            f"derivative of {lag.name} with respect to its time constant, to propagate the uncertainty of that "
            "constant; 0 at the start; give 0 throughout to omit this uncertainty"
        )
        add_input(lag.slope or "", "delta_degC/s", meaning, "lag slope", lag.column, **lag_fields)
    return sorted(inputs, key=lambda i: i.name)


def gather_inputs(
    inputs: Sequence[Input],
    readings: Measurements | None,
    columns: Mapping[str, ArrayLike],
    epoch: float | None,
) -> tuple[dict[str, np.ndarray], Frame | None]:
    """Return output, inputs and stated uncertainties by name, (n,) each, and a frame if an input depends on history.

    Times in `readings` are on the calibration's clock; `epoch` (its zero, s since 1970) converts dates in `columns`.

    Raises:
        InputError: a needed column is missing, or there are dates without an epoch.
    """
    arrays = {n: np.atleast_1d(np.asarray(v)) for n, v in columns.items()}
    for name in (n for n, array in arrays.items() if array.dtype.kind == "M"):
        if epoch is None:
            raise InputError("times are dates, but the calibration's times are not: give seconds")
        seconds = arrays[name].astype("datetime64[us]").astype(np.int64) * 1e-6
        arrays[name] = seconds - epoch
    if readings is not None:
        arrays = {n: readings[n] for n in readings.columns if readings.unit(n)} | arrays
    if "output" not in arrays:
        raise InputError("the column 'output' is missing: give the readings to compensate")
    arrays = {n: array.astype(float) for n, array in arrays.items()}
    values = dict(zip(arrays, np.broadcast_arrays(*arrays.values()), strict=True))
    lags = {(i.column, i.tau): i.name for i in inputs if i.kind == "lag"}
    for i in inputs:  # a lag given without its slope is taken as exact
        if i.kind == "lag slope" and lags.get((i.column, i.tau)) in values:
            values.setdefault(i.name, np.zeros_like(values["output"]))
    history_inputs = (i for i in inputs if i.kind != "column" and i.name not in values)
    record, computed = None, [i for i in history_inputs if values.keys() >= {"time", i.column}]
    if computed:
        record = _build_record(computed, readings, values)
        for i in computed:
            if i.kind in ("rate", "elapsed"):
                values[i.name] = record.rates[i.column] if i.kind == "rate" else record.elapsed
            else:
                lag_values = compute_lag_and_slope(record, float(i.tau or 0.0), i.column)
                values[i.name] = lag_values[i.kind == "lag slope"]
    for i in inputs:
        if i.name not in values:
            alternative = f" (or {i.column!r} and 'time')" * (i.kind != "column")
            raise InputError(
                f"the column {i.name!r} [{i.unit}]{alternative}, which this calibration needs, is missing (given: "
                f"{', '.join(sorted(arrays))}). Record it, or fit a model without the effects that need it"
            )
    return values, record


def _build_record(
    needed_inputs: Sequence[Input], readings: Measurements | None, values: Mapping[str, np.ndarray]
) -> Frame:
    """Build the frame from which the inputs `needed_inputs` are computed."""
    if readings is None:
        units = {i.column: "degC" for i in needed_inputs if i.kind in HISTORY_KINDS} | {"time": "s"}
        readings = Measurements({n: np.array(values[n]) for n in units}, units)
    return build_frame(readings, {name_hold_flag(i.column): float(i.held) for i in needed_inputs})


def add_margin(span: tuple[float, float]) -> tuple[float, float]:
    """Return a stimulus range with a margin (`RANGE_MARGIN`), outside which a compensated value is flagged."""
    low, high = span
    return low - RANGE_MARGIN * (high - low), high + RANGE_MARGIN * (high - low)


@dataclass(frozen=True)
class Provenance:
    """Provenance of an export, and notes on its use."""

    instrument: str  # name of the instrument
    title: str  # description of the instrument, one line
    stimulus: str  # name of the stimulus
    unit: str  # unit of the stimulus; output_unit: unit of the readings
    output_unit: str
    effects: tuple[tuple[str, str], ...]  # (name, equation) of each effect
    reference: dict[str, float]  # constants of the bases, such as T0
    sources: tuple[tuple[str, str], ...]  # (file, sha256) of the readings
    raw: tuple[str, float, float] | None  # unit, gain, offset of raw output; None: not raw
    notes: tuple[str, ...]  # warnings, one sentence each
    made_by: str  # name and version of this program
    calibration: str = ""  # SHA-256 of the calibration; empty before the export
    why_not: str = ""  # why the result must not be used, also among the notes; empty if it may
    epoch: float | None = None  # date of time zero, s since 1970; None for times without dates


def build_provenance(equation: OperatingEquation) -> Provenance:
    """Build an export's provenance, without notes and failed checks."""
    calibration = equation.calibration
    instrument, use = calibration.model.instrument, equation.use
    effects, note = dict.fromkeys(b.effect for b in equation.blocks), calibration.model.form_note
    scale = calibration.readings.scale or instrument.nominal_scale
    numbers = {k: v for k, v in calibration.reference.items() if not isinstance(v, dict)}
    values = {k: float(v) for k, v in numbers.items() if not k.endswith(("_low", "_high", "_held"))}
    return Provenance(
        instrument=instrument.name,
        title=instrument.title,
        stimulus=use.stimulus,
        unit=use.unit,
        output_unit=calibration.unit,
        effects=tuple((f"{e.name}{note(e.name)}", e.equation) for e in effects),
        reference=values | calibration.hold_at,
        sources=tuple((s.file, s.sha256) for s in list_sources(calibration.readings)),
        raw=(scale.unit, scale.gain, scale.offset) if scale else None,
        notes=(),
        made_by=f"bayescal {__version__}",
        epoch=calibration.readings.since,
    )


def describe_time_origin(calibration: Calibration) -> str:
    """Describe the origin of the calibration's time in words."""
    if (since := calibration.readings.since) is None:
        return "from the zero of the calibration's column 'time', which has no date"
    return f"from {format_date(since)} UTC (dates without a time zone are read as UTC)"


def list_clock_claims(equation: OperatingEquation) -> list[Claim]:
    """Return a claim on effects that depend on the date and on the origin of time; [] if time is not an input."""
    if "time" not in equation.inputs:
        return []
    calibration = equation.calibration
    last_time, since = float(calibration.readings["time"].max()), calibration.readings.since
    end = f"{number(last_time, 6)} s" if since is None else format_date(since + last_time)
    dated_effects = calibration.dated_effects or ("the noise",)
    return [Claim("use.dated", *dated_effects, clock=describe_time_origin(calibration), end=end)]


def list_average_claims(calibration: Calibration) -> list[Claim]:
    """Return a claim with the inclusion probabilities of a calibration averaged over structures; [] for others."""
    effects = {name: p for name, p in calibration.inclusion.items() if p < 1}
    texts = (f"{n}{calibration.model.form_note(n)} {p:.2f}" for n, p in effects.items())
    return [Claim("use.averaged", *effects, named=tuple(texts))] if effects else []


def list_use_claims(equation: OperatingEquation, has_range: bool) -> tuple[Claim, ...]:
    """Return claims on uncertainty, dates, new members, held inputs, lags; unless `has_range`, on stimulus range."""
    calibration = equation.calibration
    deviations = calibration.unfound_spreads or ("nothing else",)
    notes = [Claim("use.uncertainty", *deviations, factor=calibration.form_factor)]
    notes += [*list_average_claims(calibration), *list_clock_claims(equation)]
    if new_members := [u.name for u in equation.unknowns if is_new_member(u)]:
        notes.append(Claim("use.new_members", *new_members))
    if constants := equation.held_inputs:
        values = tuple(f"{n} = {v:.6g} {unit_label(unit)}".rstrip() for n, v, unit in constants)
        numbers = {"places": values, "rms": equation.compute_held_rms(), "unit": calibration.unit}
        notes.append(Claim("use.held_inputs", *(name for name, *_ in constants), **numbers))
    lags = [lag for lag in equation.nodes.lags if lag.shape and lag.name in equation.inputs]
    if lags:
        multiples = (lag.tau / equation.shapes[lag.shape][0] for lag in lags)
        lag_factors = zip(lags, ("" if m == 1.0 else f"{m:.3g} · " for m in multiples), strict=True)
        times = tuple(f"{lag.name} ({m}{lag.shape} = {lag.tau:.4g} s)" for lag, m in lag_factors)
        notes.append(Claim("use.lags", *(lag.name for lag in lags), times=times))
    if not equation.is_slope_calibrated:
        notes.append(Claim("use.bias_only", equation.use.stimulus))
    elif not has_range:
        notes.append(Claim("use.no_range", equation.use.stimulus))
    return tuple(notes)


SCHEMA, SCHEMA_VERSION = "bayescal.compensator", 3
INPUT_KINDS = ("column", "elapsed", *HISTORY_KINDS)


@dataclass(frozen=True)
class ProgramUnknown:
    """A coefficient or shape: name, unit, posterior mean."""

    name: str
    unit: str
    mean: float
    given: tuple[float, float] | None = None  # u of a shape given its effect; P(effect)


@dataclass(frozen=True)
class TracedEquation:
    """The operating equation as a list of operations, and the nodes (indices in the list) of its results."""

    operations: list[Node]
    expected: int  # node of the expected output
    slope: int  # node of its derivative with respect to the stimulus
    gradient: tuple[int, ...]  # nodes of its derivatives with respect to the unknowns
    noise: int  # node of a reading's noise variance


@renamed(data="to_json_data")
@dataclass(frozen=True, eq=False)
class CompensationProgram:
    """Compensation to first order, from the posterior mean and covariance of the unknowns."""

    about: Provenance
    inputs: tuple[Input, ...]  # needed covariates
    stimulus_range: tuple[float, float] | None  # None if not recorded, or constant
    unknowns: tuple[ProgramUnknown, ...]
    covariance: list[list[float]]  # of the unknowns, in reported units
    affine: bool  # whether the expected output is affine in the stimulus
    equation: TracedEquation

    @property
    def instrument(self) -> str:
        return self.about.instrument

    @property
    def why_not(self) -> str:
        return self.about.why_not

    @property
    def stimulus_limits(self) -> tuple[float, float] | None:
        return None if self.stimulus_range is None else add_margin(self.stimulus_range)

    @cached_property
    def graph(self) -> Graph:
        return Graph(self.equation.operations)

    @cached_property
    def cholesky_factor(self) -> np.ndarray:
        """Return the lower triangular L of C = LLᵀ, by QR of Λ^½Vᵀ (correlation matrix VΛVᵀ); C may be singular."""
        covariance = np.array(self.covariance, float).reshape(2 * (len(self.unknowns),))
        sd = np.sqrt(np.diag(covariance))
        scale = np.where(sd > 0, sd, 1.0)
        eigenvalues, eigenvectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        root = (eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))).T
        r = np.linalg.qr(root, mode="r") if len(sd) else root
        return scale[:, None] * (np.where(np.diag(r) < 0, -1.0, 1.0)[:, None] * r).T + 0.0

    def run(
        self, output: np.ndarray, inputs: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the stimulus, its standard uncertainty without noise, and |∂stimulus/∂output|, (n,) each."""
        nodes, evaluate = (self.equation.expected, self.equation.slope), self.graph.evaluate
        s, slope = solve_newton(
            lambda s: evaluate(nodes, {**inputs, STIMULUS: s}), np.asarray(output), self.affine
        )
        *_, uncertainty = self._expand_at({**inputs, STIMULUS: s})
        return s, uncertainty / np.abs(slope), np.broadcast_to(1 / np.abs(slope), s.shape)

    def _expand_at(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Return expected output, its slope ∂output/∂stimulus, and its standard uncertainty without noise, (n,)."""
        outputs = self.equation.expected, self.equation.slope, *self.equation.gradient
        nodes = self.graph.evaluate(outputs, values)
        expected, slope, *gradient = (np.broadcast_to(v, values[STIMULUS].shape) for v in nodes)
        contributions = self.cholesky_factor.T @ np.reshape(gradient, (-1, expected.size))
        return expected, slope, np.sqrt(np.sum(contributions**2, axis=0))

    def noise_variance(self, stimulus: np.ndarray, inputs: Mapping[str, Any]) -> np.ndarray:
        """Return the variance of one reading's noise, output unit squared, (n,)."""
        (variance,) = self.graph.evaluate([self.equation.noise], {**inputs, STIMULUS: stimulus})
        return np.broadcast_to(variance, stimulus.shape)

    def is_settled(self, time: Input) -> bool:
        """Return whether output and uncertainty are constant in elapsed time from the last quarter of its range on.

        Tested at the limits and midpoints of all other inputs, to `MAX_SETTLED_CHANGE` standard uncertainties.
        """
        times = time.high + (time.high - time.low) * np.r_[0.0, -0.25, 2.0 ** np.arange(-4, 31)]
        low, high = self.stimulus_range or (0.0, 0.0)
        for ratio in (0.0, 0.5, 1.0):
            values = {i.name: i.low + ratio * (i.high - i.low) + 0.0 * times for i in self.inputs}
            values |= {time.name: times, STIMULUS: low + ratio * (high - low) + 0.0 * times}
            expected, _, uncertainty = self._expand_at(values)
            changes = np.abs(np.array([expected - expected[0], uncertainty - uncertainty[0]]))
            noise_sd = np.sqrt(self.noise_variance(values[STIMULUS], values))
            u, sd = MAX_SETTLED_CHANGE * uncertainty[0], MAX_SETTLED_CHANGE * noise_sd[0]
            if np.any(changes > u) or np.ptp(noise_sd) > sd:
                return False
        return True

    def require_exportable(self) -> CompensationProgram:
        """Return this program; raise ModelError if an operation of an effect or the noise law cannot be exported."""
        for op, *args in self.equation.operations:
            if op == "call":
                raise ModelError(
                    f"the model cannot be exported: {args[0].why_not}. Write bases with arithmetic, powers, exp, sin "
                    "and jnp.where; or remove the effect concerned (model - name) and fit again; or compensate in "
                    "Python: bayescal compensate"
                )
        return self

    def to_json_data(self) -> dict[str, Any]:
        """Return the program as JSON data, with schema and version."""
        content = {"schema": SCHEMA, "version": SCHEMA_VERSION, **as_json(self)}
        content["equation"]["operations"] = self.graph.to_json_data()
        return content


def build_program(equation: OperatingEquation, moments: PosteriorMoments) -> CompensationProgram:
    """Build the compensation program of an operating equation at the posterior mean of its unknowns."""
    unknowns, readings, use = equation.unknowns, equation.calibration.readings, equation.use
    noise, noise_level = equation.noise_in_use()
    means = {input_name(u.key): float(m) for u, m in zip(unknowns, moments.mean, strict=True)}
    noise = {input_name(name): value for name, value in noise.items()}
    traced, constants = equation.nodes, noise | means
    nodes = [traced.expected, traced.noise, *traced.gradient.values()]
    graph, (expected, variance, slope, *gradient) = equation.graph.subgraph(nodes, constants)
    variance = graph.apply("mul", graph.constant(noise_level), variance)
    nonzero_indices = [i for i, node in enumerate(gradient) if graph.constant_value(node) != 0]
    shapes = {name: m[1:] for name, m in equation.shapes.items() if m[2] < 1}
    pairs = ((unknowns[i], float(moments.mean[i])) for i in nonzero_indices)
    outputs = [expected, slope, variance, *(gradient[i] for i in nonzero_indices)]
    subgraph, (expected, slope, variance, *gradient) = graph.subgraph(outputs, {})
    stimulus_range = None
    if use.equation is None and readings.has(use.stimulus) and np.ptp(readings[use.stimulus]) > 0:
        stimulus_range = float(readings[use.stimulus].min()), float(readings[use.stimulus].max())
    inputs = list_needed_inputs(equation)
    program = CompensationProgram(
        about=build_provenance(equation),
        inputs=tuple(inputs),
        stimulus_range=stimulus_range,
        unknowns=tuple(ProgramUnknown(u.name, u.unit, m, shapes.get(u.key)) for u, m in pairs),
        covariance=moments.covariance[np.ix_(nonzero_indices, nonzero_indices)].tolist(),
        affine=STIMULUS not in subgraph.inputs([slope]),
        equation=TracedEquation(subgraph.nodes, expected, slope, tuple(gradient), variance),
    )
    settled = (replace(i, settled=i.kind == "elapsed" and program.is_settled(i)) for i in inputs)
    return replace(program, inputs=tuple(settled))
