"""The operating equation of a calibrated instrument: the equation of one reading, its posterior moments, its inverse.

In use there is no test rig: slots (terms of the measurement equation) absent from `Use.slots` are omitted, and every
run, cell or (unless named) device is unseen: its deviation is drawn from the between-group standard deviation. The
equation is a function of numbers,

    output = point(θ, stimulus, inputs),

with θ the coefficients and nonlinear parameters ("shapes"), and `inputs` the covariates of the reading; the history of
a record enters as inputs too (`temperature_rate`, `temperature_lag`, `elapsed`). It is traced once to a graph of scalar
operations, with its partial derivatives with respect to stimulus and θ. NumPy evaluates the graph, with draws of θ
along the leading axis; exports write it as code. It is solved for the stimulus of each reading.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError, ModelError
from bayescal._core.inverse import solve_newton
from bayescal._model.composition import TracedColumns, compose
from bayescal._model.effect import Basis
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument, Use, compute_factor
from bayescal._model.parameters import CoefficientBlock, Layout, Unknown, name_member
from bayescal._model.terms import build_terms
from bayescal._use.expression_graph import Graph, NotExportable, Symbol, Symbols

NON_INPUT_COLUMNS = ("output", "output_uncertainty", "temperature_point")
ALL_DRAWS = 10**9  # maximum number of draws that no posterior reaches: uses all
STIMULUS = "(stimulus)"  # name of the stimulus as an input of the graph
MAX_BLOCK_SIZE = 60_000  # draws × readings evaluated together, within the processor's cache
MAX_NOISE_READINGS, MAX_NOISE_DRAWS = 200, 2000  # averaged over for the mean noise variance
MAX_HELD_DRAWS = 200  # draws, and readings, for the rms error of held inputs
IMAGINARY_STEP = 1e-30j  # relative complex step of a derivative
Values = Mapping[str, Any]


class Lag(NamedTuple):
    """The lag T̃ − T of a body's temperature T̃ behind the measured T, as an input of the equation."""

    column: str  # column of the measured temperature
    tau: float  # time constant, s, at the posterior mean
    node: int  # node of the time constant
    shape: str  # unknown of which the time constant is a multiple; empty for a constant
    name: str  # name of the input

    @property
    def slope(self) -> str | None:
        """Return the name of the input ∂(T̃ − T)/∂τ, °C/s; None if τ is a constant."""
        return f"{self.name}_by_tau" if self.shape else None


@dataclass(frozen=True, eq=False)
class OneReading(Frame):
    """Frame of readings without history: lags are inputs, given by `lagged` for a column and a time constant."""

    lagged: Callable[[str, Any], Any] | None = None

    def recorded_lag(self, tau: Any, name: str = "temperature") -> Any:
        return np.zeros(self.size) if self.lagged is None else self.lagged(name, tau)

    def direction(self, width: Any, name: str = "temperature") -> tuple[Any, Any]:
        return np.zeros(self.size), np.ones(self.size)  # as at the first reading of a run


def is_new_member(u: Unknown) -> bool:
    """Return whether an unknown is the deviation of a group member that is not among those of the fit."""
    return u.group is not None and u.member is None


def input_name(unknown: str) -> str:
    """Return the name of an unknown or a noise parameter as an input of the graph."""
    return f"({unknown})"


class TermsInUse(TracedColumns):
    """Evaluation of effects and of the instrument's response on the symbols of a graph."""

    xp = np

    def __init__(self, instrument: Instrument, frame: OneReading, graph: Graph) -> None:
        super().__init__(instrument, frame)
        self.graph = graph

    def evaluate_basis(self, basis: Basis, frame: Frame, shapes: Values) -> Any:
        return self.trace(partial(super().evaluate_basis, basis), frame, shapes)

    def trace(self, function: Callable[[Any, Values], Any], frame: Frame, values: Values) -> Any:
        """Return a function of a frame and named values as symbols: called with NumPy, or else traced by JAX."""
        try:
            return self.graph.symbols(function(frame, values))
        except Exception as error:  # JAX functions do not accept symbols
            if isinstance(error, ModelError) and not isinstance(error, NotExportable):
                raise
        from bayescal._use.jax_equations import trace_jax_function

        return trace_jax_function(self.graph, function, frame, values)


class EquationNodes(NamedTuple):
    """Nodes of the traced equation, and the lags among its inputs."""

    expected: int  # expected output, output unit
    noise: int  # variance of a reading's noise by the noise law, without stated uncertainties
    gradient: dict[str, int]  # derivatives of `expected` by stimulus and unknowns; key: input name
    slots: dict[str, int]  # value of each slot, in its unit
    lags: tuple[Lag, ...]  # one per column and time constant


class PosteriorMoments(NamedTuple):
    """Posterior draws (d, p), mean (p,) and covariance (p, p) of θ, reported units."""

    draws: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class OperatingEquation:
    """The measurement equation of a calibrated model for one reading of the instrument in use."""

    calibration: Calibration  # a fit, or an average over structures
    members: tuple[tuple[str, str], ...] = ()  # (group, member) in use; others are unseen
    # (name, value, unit) of inputs fixed at one value, since only improbable effects need them
    held_inputs: tuple[tuple[str, float, str], ...] = ()

    @cached_property
    def layout(self) -> Layout:
        """Return the model's layout with a single member of every group, the one in use."""
        fit_layout = self.calibration.layout
        counts = tuple((group, 1) for group, _ in fit_layout.counts)
        return replace(fit_layout, counts=counts, origin=())

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Return the numeric columns of the fit's readings that may be inputs."""
        excluded_names = (*NON_INPUT_COLUMNS, self.use.stimulus)
        return tuple(sorted(n for n in self.calibration.frame.columns if n not in excluded_names))

    @cached_property
    def rates(self) -> tuple[tuple[str, str], ...]:
        """Return (name of the rate, temperature column) of each rate."""
        return tuple((f"{n}_rate", n) for n in self.calibration.frame.rates)

    @cached_property
    def shapes(self) -> dict[str, tuple[float, float, float]]:
        """Return, by name, each shape's mean and sd conditional on its effect, and the effect's probability."""
        keys = {u.key for u in self.unknowns if u.block is None}
        rows = summary(self.calibration)[1] if keys else ()
        return {n: (r["mean"], r["sd"], r["probability"]) for r in rows if (n := r["name"]) in keys}

    @property
    def use(self) -> Use:
        use = self.calibration.model.instrument.use
        assert use is not None
        return use

    @property
    def blocks(self) -> tuple[CoefficientBlock, ...]:
        """Return the coefficient blocks of the slots in use and of corrected columns, without reference errors."""
        slots = [s.name for s in self.layout.model.instrument.slots]
        slots_in_use = self.use.slots or tuple(slots)
        blocks = (b for b in self.layout.blocks if b.slot in slots_in_use or b.slot not in slots)
        return tuple(b for b in blocks if not b.effect.is_reference_error)

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Return the unknowns of the equation in the order of effects; deviations of new members have no `member`."""
        members, hypers = dict(self.members), {h.name: h for h in self.layout.hypers}
        unknowns = dict[str, Unknown]()
        for b in self.blocks:
            names = map(b.effect.shape_name, b.effect.shapes)
            unknowns |= {n: hypers[n] for n in names if n in hypers and n not in unknowns}
            per, effect = b.coefficient.per, b.effect.name
            name = b.name if per is None else name_member(b.name, members.get(per, f"new {per}"))
            if b.place != "fixed":
                row = Unknown(name, b.name, b.coefficient.unit, effect, "coefficient", block=b)
                unknowns[b.name] = replace(row, member=members.get(per))
        return tuple(unknowns.values())

    @cached_property
    def graph(self) -> Graph:
        """Return the graph of the traced equation."""
        return Graph()

    def _symbol(self, name: str) -> Symbols:
        return self.graph.symbols([Symbol(self.graph.input(name))])

    @cached_property
    def nodes(self) -> EquationNodes:
        """Trace the equation to nodes; held inputs are constants, corrections of test-rig quantities are omitted."""
        graph, model, lags = self.graph, self.layout.model, dict[tuple[str, float], Lag]()
        inputs = {name: self._symbol(name) for name in (*self.columns, *dict(self.rates))}
        inputs |= {name: graph.symbols([value]) for name, value, _ in self.held_inputs}
        frame = self.build_frame_in_use(self._symbol(STIMULUS), inputs)
        frame = replace(frame, lagged=partial(self._trace_lag, lags))
        terms = TermsInUse(model.instrument, frame, graph)
        fixed = {b.name: b.value for b in self.blocks if b.place == "fixed"} | dict(model.fixed)
        values = {name: graph.symbols([value]) for name, value in fixed.items()}
        values |= {u.key: self._symbol(input_name(u.key)) for u in self.unknowns}
        blocks = [b for b in self.blocks if b.slot in terms.slots or b.slot in frame.columns]
        coefficients = [values[b.name] for b in blocks]
        shapes = {n: v[0] for n, v in values.items()}
        composed = compose(terms, build_terms(blocks)[0], coefficients, shapes)
        slots = {name: composed.slots.get(name, graph.symbols([0.0])) for name in terms.slots}
        equation, response = self.use.equation, model.instrument.response

        def output(frame: Frame, slots: Values) -> Any:
            if equation is None:
                return response(dict(slots), frame)
            return equation(frame[self.use.stimulus], dict(slots), frame)

        expected = graph.node_of(terms.trace(output, frame.shift_columns(composed.shifts), slots))
        parameters = {name: self._symbol(input_name(name)) for name in model.noise.parameters()}
        variance = terms.trace(lambda f, values: model.noise.variance(values, f), frame, parameters)
        names = (STIMULUS, *(input_name(u.key) for u in self.unknowns))
        return EquationNodes(
            expected=expected,
            noise=graph.node_of(variance),
            gradient=dict.fromkeys(names, graph.constant(0.0)) | graph.gradient(expected, names),
            slots={name: graph.node_of(value) for name, value in slots.items()},
            lags=tuple(lags.values()),
        )

    def _trace_lag(self, lags: dict[tuple[str, float], Lag], column: str, tau: Any) -> Symbols:
        """Return a lagged column's symbol: the input at the mean τ, noted in `lags`, plus its linear change with τ."""
        node, means = self.graph.node_of(tau), {input_name(n): m[0] for n, m in self.shapes.items()}
        (mean,) = self.graph.evaluate([node], means)
        if (column, mean) not in lags:
            count = sum(lag.column == column for lag in lags.values())
            name = f"{column}_lag" + (f"_{count + 1}" if count else "")
            inputs = self.graph.inputs([node])
            shape = next((n for n in self.shapes if input_name(n) in inputs), "")
            lags[column, mean] = Lag(column, float(mean), node, shape, name)
        lag = lags[column, mean]
        lag_symbol = self._symbol(lag.name)
        return lag_symbol + self._symbol(lag.slope) * (tau - lag.tau) if lag.slope else lag_symbol

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of all possible inputs."""
        lags = (name for lag in self.nodes.lags for name in (lag.name, lag.slope) if name)
        return (*self.columns, *dict(self.rates), *lags)

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Return the names of the inputs on which the output or its noise depends."""
        needed_names = self.graph.inputs([self.nodes.expected, self.nodes.noise])
        return tuple(n for n in sorted(self.names) if n in needed_names)

    @cached_property
    def affine(self) -> bool:
        """Return whether the expected output is affine in the stimulus."""
        return STIMULUS not in self.graph.inputs([self.nodes.gradient[STIMULUS]])

    @property
    def is_slope_calibrated(self) -> bool:
        """Return whether the derivative of the output with respect to the stimulus depends on an unknown."""
        unknowns = {input_name(u.key) for u in self.unknowns}
        return not unknowns.isdisjoint(self.graph.inputs([self.nodes.gradient[STIMULUS]]))

    def evaluate(
        self, outputs: Sequence[int], theta: np.ndarray, stimulus: Any, inputs: Values
    ) -> list[Any]:
        """Return the values of nodes, at most (d, n) each, at unknowns (p,) or draws (d, p), and inputs (n,) each."""
        values = {name: inputs.get(name, np.zeros(1)) for name in self.names}
        for i, u in enumerate(self.unknowns):
            values[input_name(u.key)] = theta[..., i : i + 1]
        return self.graph.evaluate(outputs, {**values, STIMULUS: stimulus})

    def evaluate_draws(
        self, theta: np.ndarray, stimulus: Any, inputs: Values, slot: str | None = None
    ) -> Float[np.ndarray, "d n"]:
        """Return the expected output (output unit), or the value of a slot, for draws of θ (d, p), inputs (n,) each."""
        node = self.nodes.expected if slot is None else self.nodes.slots[slot]
        (values,) = self.evaluate([node], theta, stimulus, inputs)
        return np.broadcast_to(values, (len(theta), len(stimulus)))

    def linearise(
        self, theta: Float[np.ndarray, "p"], stimulus: Float[np.ndarray, "n"], inputs: Values
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n p"]]:
        """Return the expected output at n points, and its derivatives with respect to the stimulus and to unknowns."""
        nodes = [self.nodes.expected, *self.nodes.gradient.values()]
        values = self.evaluate(nodes, theta, stimulus, inputs)
        expected, slope, *gradient = (np.broadcast_to(value, len(stimulus)) for value in values)
        return expected, slope, np.reshape(gradient, (-1, len(stimulus))).T

    def solve(self, theta: np.ndarray, output: np.ndarray, inputs: Values) -> tuple[Any, Any]:
        """Return the stimulus that gives an output, NaN without solution, and the output's derivative there."""
        nodes = self.nodes.expected, self.nodes.gradient[STIMULUS]
        return solve_newton(lambda s: self.evaluate(nodes, theta, s, inputs), output, self.affine)

    def build_frame_in_use(self, stimulus: Float[Any, "n"], inputs: Values) -> OneReading:
        """Build a frame of n readings without history; stimulus and inputs are (n,) each, in fixed units."""
        size = len(stimulus)
        columns = {n: inputs[n] for n in self.columns if n in inputs}
        columns[self.use.stimulus] = stimulus
        return OneReading(
            columns=columns,
            labels={f"{group}={member}": np.ones(size) for group, member in self.members},
            rates={c: inputs[n] for n, c in self.rates if n in inputs and n not in columns},
            codes={group: np.zeros(size, int) for group, _ in self.layout.counts},
            reference=dict(self.calibration.frame.reference),
            order=np.arange(size),
            step=-np.ones(size),
            record=dict(columns),
            max_gap=np.inf,  # pyright: ignore[reportArgumentType]
        )

    @cached_property
    def at_fit(self) -> dict[str, np.ndarray]:
        """Return all inputs at the fit's readings, (n,) each, by name; lags have their mean time constants."""
        frame = self.calibration.frame
        values = {n: np.asarray(frame.columns[n]) for n in self.columns}
        values |= {name: np.asarray(frame.rates[column]) for name, column in self.rates}
        for lag in self.nodes.lags:
            values[lag.name], slope = compute_lag_and_slope(frame, lag.tau, lag.column)
            if lag.slope:
                values[lag.slope] = slope
        return values

    @property
    def stimulus_at_fit(self) -> Float[np.ndarray, "n"]:
        """Return the stimulus of each of the fit's readings; zeros if it was not recorded."""
        readings, name = self.calibration.readings, self.use.stimulus
        return readings[name] if readings.has(name) else np.zeros(len(readings))

    def moments(self, draws: int) -> PosteriorMoments:
        """Return at most `draws` evenly thinned draws of θ, with mean and covariance of all draws.

        The covariance of unknowns estimated in the calibration is multiplied by `form_factor`². Deviations of new group
        members are uncorrelated with these, also in thinned draws, so that results from draws and from moments agree.
        """
        calibration, unknowns = self.calibration, self.unknowns
        (_, v), problem = calibration.draws(), calibration.problem
        draw_count, rng = len(v), np.random.default_rng(calibration.seed)
        thinning = max(1, -(-draw_count // draws))
        values, mean = np.zeros((draw_count, len(unknowns))), np.zeros(len(unknowns))
        new_members = [i for i, u in enumerate(unknowns) if is_new_member(u)]
        for i, u in ((i, u) for i, u in enumerate(unknowns) if i not in new_members):
            values[:, i] = calibration.samples(u.name)
            if u.block is None:  # where its effect is absent, it is replaced by its mean
                values[~calibration.inclusion_masks[u.effect], i] = self.shapes[u.key][0]
            mean[i] = values[:, i].mean()
        thin = values[::thinning].copy()
        scaled_draws = calibration.form_factor * (values - mean)
        covariance = np.atleast_2d(np.cov(scaled_draws.T)) if len(unknowns) else np.zeros((0, 0))
        for i in new_members:
            term = next(t for t in problem.terms if t.name == unknowns[i].key)
            sd = problem.member_sd(term, problem.hyper(v.T), draw_count)
            sd = sd * calibration.inclusion_masks[term.effect.name]
            mean[i], covariance[i, i] = term.coefficient.mean, float(np.mean(sd**2))
            deviations = _draw_uncorrelated(thin - mean, sd[::thinning], covariance[i, i], rng)
            thin[:, i] = mean[i] + deviations
        for i, size in self.unfound_spreads.values():
            covariance[i, i] += size**2
            thin[:, i] += _draw_uncorrelated(thin - mean, np.full(len(thin), size), size**2, rng)
        # Shapes are not rescaled: they might leave their range.
        linear_indices = [i for i, u in enumerate(unknowns) if u.block is not None]
        if thinning > 1 or calibration.form_factor != 1.0:
            target = mean[linear_indices], covariance[np.ix_(linear_indices, linear_indices)]
            thin[:, linear_indices] = _match_moments(thin[:, linear_indices], *target)
        return PosteriorMoments(thin, mean, covariance)

    @property
    def unfound_spreads(self) -> dict[str, tuple[int, float]]:
        """Return undetected deviations of a new run: effect → (index in θ, standard deviation)."""
        instrument, members = self.calibration.model.instrument, dict(self.members)
        indices, sds = {u.key: i for i, u in enumerate(self.unknowns)}, {}
        for name, sd in self.calibration.unfound_spreads.items():
            effect = instrument.known[name]
            c = effect.coefficients[0]
            for b in self.blocks:
                if b.effect.kind == "constant" and b.slot == effect.slot and c.per not in members:
                    sd *= compute_factor(instrument, effect, c) / b.factor
                    sds[name] = indices[b.name], sd
                    break
        return sds

    def compute_held_rms(self) -> float:
        """Return the rms error of the output due to holding inputs fixed, over draws and readings of the fit."""
        rows = slice(None, None, -(-len(self.calibration.readings) // MAX_HELD_DRAWS))
        inputs = {n: v[rows] for n, v in self.at_fit.items()}
        arguments = self.moments(MAX_HELD_DRAWS).draws, self.stimulus_at_fit[rows], inputs
        y, y_held = (e.evaluate_draws(*arguments) for e in (replace(self, held_inputs=()), self))
        return float(np.sqrt(np.mean((y - y_held) ** 2)))

    def noise_in_use(self) -> tuple[dict[str, float], float]:
        """Return the noise parameters at the mean of their coordinates, and a variance factor.

        The factor is the ratio of the posterior mean variance to that at these parameters, over the fit's readings.
        """
        problem, (_, v) = self.calibration.problem, self.calibration.draws(MAX_NOISE_DRAWS)
        rows = slice(None, None, -(-len(self.calibration.readings) // MAX_NOISE_READINGS))
        inputs = {n: x[rows] for n, x in self.at_fit.items() if n in self.inputs}
        inputs[STIMULUS] = self.stimulus_at_fit[rows]

        def compute_mean(values: Mapping[str, Any]) -> float:
            parameters = {input_name(name): value for name, value in values.items()}
            (variance,) = self.graph.evaluate([self.nodes.noise], {**inputs, **parameters})
            return float(np.mean(variance + np.zeros_like(inputs[STIMULUS])))

        means = {n: float(x) for n, x in problem.hyper(v.mean(axis=0)).items()}
        variance_at_means = compute_mean(means)
        draws = {n: np.reshape(x, (-1, 1)) for n, x in problem.hyper(v.T).items()}
        # Zero variance: the readings have stated uncertainties only.
        return means, compute_mean(draws) / variance_at_means if variance_at_means > 0 else 1.0


def equation_in_use(
    calibration: Calibration, members: Mapping[str, str] | None = None
) -> OperatingEquation:
    """Build the operating equation of a calibrated model.

    Raises:
        ModelError: the instrument has no stimulus (`Instrument.use`).
        InputError: a group member is not in the fit.
    """
    instrument, members = calibration.model.instrument, dict(members or {})
    if instrument.use is None:
        raise ModelError(
            f"instrument {instrument.name!r} does not declare its stimulus, so its readings cannot be compensated: "
            "give it use=bayescal.Use(stimulus, unit)"
        )
    for group, member in members.items():
        levels = calibration.levels.get(group) or (
            calibration.readings.groups(group)[0] if calibration.readings.has(group) else ()
        )
        if member not in levels:
            message = f"{group} {member!r} was not in the calibration; it has: {', '.join(levels) or 'none'}"
            raise InputError(message)
    return OperatingEquation(calibration, tuple(sorted(members.items())))


def compute_lag_and_slope(frame: Frame, tau: float, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the lag T̃ − T of a record, °C, and its derivative with respect to the time constant, °C/s, (n,) each."""
    lag = frame.lag(np.asarray(tau * (1 + IMAGINARY_STEP)), column)
    return lag.real, lag.imag / (tau * IMAGINARY_STEP.imag)


def _draw_uncorrelated(
    regressor_draws: Float[np.ndarray, "d p"],
    sd: Float[np.ndarray, "d"],
    variance: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "d"]:
    """Draw values of mean 0, sds ∝ `sd`, sample variance `variance` and sample correlation 0 with the regressors."""
    regressor_sd = regressor_draws.std(axis=0)
    regressor_draws = regressor_draws[:, regressor_sd > 0] / regressor_sd[regressor_sd > 0]
    regressor_draws = regressor_draws[:, : len(sd) // 2]  # fewer for few draws
    regressors = sd[:, None] * np.column_stack([np.ones(len(sd)), regressor_draws])
    values = rng.standard_normal(len(sd))
    values = sd * (values - regressors @ np.linalg.lstsq(regressors, values, rcond=None)[0])
    sample_variance = float(values @ values) / (len(values) - 1)
    return values * (variance / sample_variance) ** 0.5 if sample_variance > 0 else values


def _match_moments(
    draws: Float[np.ndarray, "d p"],
    mean: Float[np.ndarray, "p"],
    covariance: Float[np.ndarray, "p p"],
) -> Float[np.ndarray, "d p"]:
    """Transform draws linearly to a given mean and covariance; too few draws (2 per unknown or less) are unchanged.

    Results from draws and from propagated moments then agree where the equation is linear.
    """
    sd = np.sqrt(np.diag(covariance))
    indices = np.flatnonzero(sd > 0)
    if len(draws) <= 2 * len(indices):
        return draws
    scores = (draws - draws.mean(axis=0))[:, indices] / sd[indices]
    target_correlation = covariance[np.ix_(indices, indices)] / np.outer(sd[indices], sd[indices])
    square_roots = []
    for matrix in (scores.T @ scores / (len(draws) - 1), target_correlation):
        eigenvalues, eigenvectors = np.linalg.eigh(matrix)
        square_roots.append((eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ eigenvectors.T)
    matched_draws = np.tile(mean, (len(draws), 1))
    white_scores = scores @ np.linalg.pinv(square_roots[0], hermitian=True)
    matched_draws[:, indices] += white_scores @ square_roots[1] * sd[indices]
    return matched_draws


def solve_over_draws(
    equation: OperatingEquation,
    theta: Float[np.ndarray, "d p"],
    output: Float[np.ndarray, "n"],
    inputs: Values,
    record: Frame | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and variance of the stimulus over draws, and the mean of (∂stimulus/∂output)², (n,) each.

    Lags are computed from the record at each draw's time constants; without a record they are inputs.
    """
    draw_count, block_size = len(theta), max(1, MAX_BLOCK_SIZE // len(output))
    origin, sums, input_values = np.zeros(len(output)), np.zeros((3, len(output))), dict(inputs)
    for start in range(0, draw_count, block_size):
        draws = theta[start : start + block_size]
        for lag in equation.nodes.lags if record is not None else ():
            (tau,) = equation.evaluate([lag.node], draws, 0.0, {})
            input_values[lag.name] = record.lag(np.reshape(tau, (-1, 1)), lag.column)
            if lag.slope:
                input_values[lag.slope] = np.zeros(1)  # the lag is at this τ already
        solution = equation.solve(draws, output, input_values)
        s, slope = (np.broadcast_to(array, (len(draws), len(output))) for array in solution)
        if start == 0:  # origin of the sums, to avoid cancellation
            origin = s.mean(axis=0)
        offset = s - origin
        sums += [column.sum(axis=0) for column in (offset, offset**2, slope**-2.0)]
    mean = sums[0] / draw_count
    return origin + mean, (sums[1] - sums[0] * mean) / max(draw_count - 1, 1), sums[2] / draw_count
