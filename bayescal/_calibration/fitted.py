"""Record of a fit: the model, its named draws, the verdict."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from bayescal._calibration.confounding import Confounder, confounders, unexplained, widen_draws
from bayescal._core.errors import InputError
from bayescal._core.parallel import on_one_thread
from bayescal._data.dataset_checks import MIN_CHANGES, resolution
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.linear_model import LinearModel, linear_model
from bayescal._inference.method import CHAINS, Draws, Verdict
from bayescal._inference.noise_on_record import Batch, draw_samples, log_densities, variances
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record, record_of
from bayescal._inference.trust import CHAIN_DRAWS
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS, Frame, Reference, build_frame, reference_name
from bayescal._model.model import Model
from bayescal._model.parameters import CoefficientBlock, Layout
from bayescal._model.prior import Known
from bayescal._model.terms import Term
from bayescal._model.unknowns import Unknowns

if TYPE_CHECKING:
    import xarray as xr

COARSEST_DEGREES = 1.0  # °C, of a thermometer's steps; larger ones are set points
CELLS = 2_000_000  # draws × readings evaluated together, or kept for ArviZ


class Vectors(NamedTuple):
    """Joint draws: coefficients, coordinates of φ."""

    x: Float[np.ndarray, "b p"]
    v: Float[np.ndarray, "b d"]


@dataclass(frozen=True, eq=False)
class Fitted:
    """The result of a fit, before it is printed, saved or made a tree; `Calibration` offers these.

    Its fields are described there.
    """

    model: Model
    readings: Measurements
    joint: Draws
    verdict: Verdict
    method: str
    seed: int
    reference: Reference
    levels: dict[str, tuple[str, ...]]
    layout: Layout
    mode: Mode
    log_evidence: tuple[float, float | None] | None
    start: dict[str, float] = field(default_factory=dict)
    confounded: tuple[Confounder, ...] | None = None  # None: to be asked of the readings
    form_factor: float = 1.0
    unfound_spreads: dict[str, float] = field(default_factory=dict)

    def with_verdict(self, **changes: Any) -> Self:
        """Return a copy with another verdict; other cached attributes are kept."""
        copy = object.__new__(type(self))
        vars(copy).update(vars(self), verdict=replace(self.verdict, **changes))
        for name in ("tree", "why_not"):
            vars(copy).pop(name, None)
        return copy

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields for pickle; cached attributes are recomputed."""
        return {f.name: getattr(self, f.name) for f in fields(Fitted)}

    @cached_property
    def posterior(self) -> xr.Dataset:
        """Return draws (chain, draw, …) of each unknown under its name, in its reported unit (`units`).

        Group dimensions carry the members' names. Uncertainties include confounding by recorded columns; `joint` is of
        the model alone.
        """
        return named(self.unknowns, self.values)

    @cached_property
    def unknowns(self) -> Unknowns:
        return Unknowns.of(self.layout, self.levels)

    @cached_property
    def values(self) -> Float[np.ndarray, "chains draws unknowns"]:
        """Return the draws of `posterior`, in the order of `unknowns`."""
        x = widen_draws(self.joint.x, self.confounders, self.layout, self.seed)
        return self.unknowns.values(x, self.joint.v)

    @cached_property
    def confounders(self) -> tuple[Confounder, ...]:
        """Return recorded columns that may have acted in place of coefficients."""
        if self.confounded is not None:
            return self.confounded
        if not self.verdict.ok:
            return ()
        columns, steps = unexplained(self.model, self.readings), self._steps()
        return confounders(self.linear, columns, steps) if columns or steps else ()

    def _steps(self) -> dict[str, tuple[float, np.ndarray]]:
        """Return rounding steps of thermometers and output, and the output's slopes by them (n,)."""
        readings, steps = self.readings, dict[str, tuple[float, np.ndarray]]()
        if step := resolution(readings["output"]):
            steps["output"] = step, np.ones(len(readings))
        thermometers = (n for n in readings.columns if readings.unit(n) == "degC")
        for name in (n for n in thermometers if n in self.model.columns):
            values = readings[name]
            if 0 < (step := resolution(values, MIN_CHANGES)) <= COARSEST_DEGREES:
                frame = self.frame_of(readings.with_column(name, values + step))
                hyper = self.problem.hyper(self.mode.v)
                line = self.problem_on(frame).linearise(self.mode.x, hyper)
                steps[name] = step, (line.mean - self.linear.mean) / step
        return steps

    @property
    def frame(self) -> Frame:
        return self.problem.record.frame

    @cached_property
    def problem(self) -> Problem:
        """Return the inference problem of the fitted structure on its readings."""
        record = record_of(self.model.instrument, self.readings, self.reference)
        record.require_finite(self.model.effects)
        return Problem(self.layout, record)

    def problem_on(self, frame: Frame) -> Problem:
        """Return the inference problem of the fitted structure on other readings."""
        fitted = self.problem.record
        if frame is fitted.frame:
            return self.problem
        if all(frame.columns[n] is column for n, column in fitted.frame.columns.items()):
            return Problem(self.layout, fitted.with_frame(frame))
        record = Record(self.model.instrument, frame, np.asarray(frame["output"]))
        return Problem(self.layout, record)

    @cached_property
    def linear(self) -> LinearModel:
        """Return the fitted structure linearised at its mode."""
        return linear_model(self.problem, self.mode)

    @property
    def chi_squared(self) -> tuple[float, int, float]:
        """Return χ² of the residuals against their known variance, its degrees of freedom, its p-value.

        The variance is that of the noise law and of uncertain inputs: of use where `noise.white` is fixed.
        """
        squares = float(np.sum(self.linear.residual**2 / self.linear.variance))
        freedom = self.linear.size - len(self.linear.owners)
        return squares, freedom, float(chdtrc(freedom, squares)) if freedom > 0 else float("nan")

    @property
    def unit(self) -> str:
        return self.model.instrument.unit

    @property
    def hold_at(self) -> dict[str, float]:
        """Return the reference values of the equations, by name: T0, V0 and the like.

        Only of columns that an effect depends on; where none does, constants are means over the readings.
        """
        return {name: value for name, (value, _) in self.held_at.items()}

    @cached_property
    def held_at(self) -> dict[str, tuple[float, str]]:
        """Return `hold_at`, each with its unit."""
        constants: dict[str, tuple[float, str]] = {}
        for column in self.readings.columns:
            name, unit = reference_name(column), self.readings.unit(column)
            if unit is None or column not in self.model.columns:
                continue
            low, high = (self.reference.get(f"{column}_{end}") for end in ("low", "high"))
            if name in self.reference:
                constants[name] = float(self.reference[name]), unit  # pyright: ignore[reportArgumentType]
            elif column != "time" and isinstance(low, float) and isinstance(high, float):
                # The middle of its range, if an effect is centred there and so vanishes.
                middle = 0.5 * (low + high)
                if middle != 0 and self._nonzero(column, high) - self._nonzero(column, middle):
                    constants[name] = middle, unit
        return constants

    def _nonzero(self, column: str, at: float) -> set[str]:
        """Return names of the effects that are not zero where a column has a value."""
        values: Any = np.full(self._probe.size, at)
        probe = replace(self._probe, columns={**self._probe.columns, column: values})
        by = (e for e in self.model.effects if column in e.columns and not e.is_placeholder)
        return {e.name for e in by if np.any(self._basis(e, probe))}

    @cached_property
    def _probe(self) -> Frame:
        """Return eight readings on which effects are evaluated."""
        rows = np.unique(np.linspace(0, len(self.readings) - 1, 8, dtype=int))
        return self.frame.reordered(rows, np.arange(len(rows)), self.frame.step[rows])

    def _basis(self, effect: Effect, frame: Frame) -> Any:
        """Return an effect's columns at the mode of its shapes."""
        at_mode: Any = self.problem.hyper(self.mode.v)
        shapes = {s.name: at_mode[effect.shape_name(s)] for s in effect.column_shapes}
        return effect.evaluate(frame, shapes)

    @cached_property
    def dated(self) -> tuple[str, ...]:
        """Return names of the effects that depend on absolute time, not only on time since a run's start."""
        if not self.readings.has("time"):
            return ()
        probe = self._probe
        delay = 0.3 * float(self.reference["time_span"])  # pyright: ignore[reportArgumentType]
        delayed = probe.moved({"time": delay})
        in_time = (e for e in self.model.effects if "time" in e.columns)
        pairs = ((e.name, self._basis(e, probe), self._basis(e, delayed)) for e in in_time)
        return tuple(name for name, a, b in pairs if not np.array_equal(a, b))

    def on_clock(self, readings: Measurements) -> Measurements:
        """Return readings with times counted from this calibration's epoch.

        Raises:
            InputError: one has dates and the other has none, and an effect changes with the date.
        """
        return readings.on_clock(self.readings.since, lambda: ", ".join(self.dated))

    def frame_of(self, readings: Measurements) -> Frame:
        """Build the frame of other readings on this calibration's clock, T0, runs and groups."""
        if readings is self.readings:
            return self.frame
        return build_frame(self.on_clock(readings), self.reference, self.levels, self.readings)

    @cached_property
    def having(self) -> dict[str, Bool[np.ndarray, "draws"]]:
        """Mask, for each effect, the draws whose structure includes it (in an average, not all)."""
        x, blocks = self.draws().x, self.layout.x_blocks
        return {e.name: has_effect(x, blocks, e.name) for e in self.model.effects}

    @property
    def inclusion(self) -> dict[str, float]:
        """Return each effect's inclusion probability; 1 where no structures were averaged."""
        return {name: float(included.mean()) for name, included in self.having.items()}

    @property
    def likeliest(self) -> set[str]:
        """Return the effects of the most probable structure."""
        patterns, counts = np.unique([*self.having.values()], axis=1, return_counts=True)
        best = patterns[:, counts.argmax()]
        return {name for name, included in zip(self.having, best, strict=True) if included}

    @property
    def usual_columns(self) -> set[str]:
        """Return the columns needed by effects of inclusion above 0.5, without groups: devices in use are new."""
        shares = self.inclusion
        likely = (e for e in self.model.effects if shares[e.name] > 0.5)
        return set().union(GROUPS, *(e.columns for e in likely))

    def with_columns(self, columns: Iterable[str]) -> Self:
        """Return the average over structures that need no other columns, if enough draws remain."""
        available = set(columns)
        lacking = [e.name for e in self.model.effects if not available.issuperset(e.columns)]
        return self.without(lacking) if lacking else self

    def without(self, names: Collection[str]) -> Self:
        """Return the average over structures without these effects; itself if too few draws remain."""
        rows = np.flatnonzero(~np.any([self.having[name] for name in names], axis=0))
        if len(rows) < CHAIN_DRAWS:
            return self
        effects = tuple(e for e in self.model.effects if e.name not in names)
        layout = replace(self.layout, model=replace(self.model, effects=effects))
        in_x, in_v = self.layout.shared_indices(layout)
        chosen, mode = rows[: CHAINS * (len(rows) // CHAINS)], self.mode
        draws, covariance = self.draws(), mode.covariance[np.ix_(in_v, in_v)]
        x, v = draws.x[chosen][:, in_x], draws.v[chosen][:, in_v]
        mode = mode._replace(
            x=x.mean(axis=0), v=mode.v[in_v], covariance=covariance, flat=mode.flat[in_x]
        )
        joint = Draws.of(x, v)
        return replace(self, model=layout.model, layout=layout, joint=joint, mode=mode)

    def draws(self, limit: int | None = None) -> Vectors:
        """Return joint draws (x, v) as flat arrays, x relative to its origin, evenly thinned to `limit`."""
        arrays = [flat(a) for a in (self.joint.x, self.joint.v)]
        step = 1 if limit is None else max(1, -(-len(arrays[0]) // limit))
        return Vectors(*(a[::step] for a in arrays))

    def thinned(self, limit: int) -> tuple[Vectors, int]:
        """Thin each chain so that draws times readings stay within a limit; return draws and chain count."""
        chains, count = self.joint.x.shape[:2]
        step = -(-count // max(1, min(count, limit // max(1, chains * len(self.readings)))))
        arrays = (flat(a[:, ::step]) for a in (self.joint.x, self.joint.v))
        return Vectors(*arrays), chains

    def samples(self, name: str) -> np.ndarray:
        """Return all draws of an unknown or its group's members, reported unit; (draws,) or (draws, members).

        Raises:
            InputError: no unknown has this name.
        """
        by_key = self.unknowns.by_key
        if name not in by_key and name not in self.unknowns.index:
            raise InputError(f"no unknown is called {name!r}; there are: {', '.join(by_key)}")
        return self.unknowns.select(flat(self.values), name)

    def log_likelihood(self, limit: int = CELLS) -> xr.Dataset:
        """Return the pointwise log likelihood, draws thinned to at most `limit` numbers.

        Under correlated noise it is that of each reading given those before it in its run.
        """
        import xarray as xr  # with pandas half a second, which a command does without

        vectors, chains = self.thinned(limit)
        shaped = pointwise(self.problem, vectors).reshape(chains, -1, len(self.readings))
        return xr.Dataset({"output": (("chain", "draw", "reading"), shaped)})


def named(unknowns: Unknowns, values: Float[np.ndarray, "chains draws unknowns"]) -> xr.Dataset:
    """Return draws as one variable for each key, in its reported unit."""
    import pandas as pd
    import xarray as xr

    variables: dict[str, tuple] = {}
    coordinates: dict[str, pd.Index] = {}
    for key, rows in unknowns.by_key.items():
        first, dims = unknowns.rows[rows.start], ("chain", "draw")
        if first.group is not None:
            dims = (*dims, first.group)
            # xarray would load Dask to look at a list
            coordinates[first.group] = pd.Index([u.member for u in unknowns.rows[rows]])
        of = {"effect": first.effect} if first.block else {"kind": first.kind}
        variables[key] = dims, unknowns.select(values, key), {"units": first.unit, **of}
    return xr.Dataset(variables, coords=coordinates)


def has_effect(
    x: Float[np.ndarray, "b p"], blocks: Sequence[CoefficientBlock], name: str
) -> Bool[np.ndarray, "b"]:
    """Mask the draws that include an effect: without it all of its coefficients are exactly zero."""
    named = (b for b in blocks if b.place == "x" and b.effect.name == name)
    nonzero = [np.any(x[:, b.x_slice] != 0, axis=1) for b in named]
    # A fixed effect, or one sampled with φ, is not averaged over.
    return np.any(nonzero, axis=0) if nonzero else np.ones(len(x), dtype=bool)


def flat(values: np.ndarray) -> np.ndarray:
    """Concatenate the chains."""
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])


class PredictiveMoments(NamedTuple):
    """Moments of readings over draws, (n,) each."""

    mean: Float[np.ndarray, "n"]  # of the expected output,
    variance: Float[np.ndarray, "n"]  # and its variance
    noise: Float[np.ndarray, "n"]  # mean variance of the noise,
    unknown: Float[np.ndarray, "n"]  # and of unknown inputs and group members


@on_one_thread
def moments(
    problem: Problem, draws: Vectors, carried: Callable[[np.ndarray], np.ndarray] | None = None
) -> PredictiveMoments:
    """Return predictive moments of readings, with noise on inputs and unknown group members (code −1).

    Draws are evaluated in chunks, sums taken of differences from the first. `carried` returns the conditional mean of
    the correlated noise given earlier readings, by each draw's expected outputs (b, n); its variance is not in `noise`.
    """
    count, size = len(draws.x), problem.record.size
    total, squares, noise, unknown_inputs = np.zeros((4, size))
    first: Any = None
    for part, reduced, sample, hyper in _chunks(problem, draws):
        terms = [t for t in reduced.terms if t.place == "input" or _is_unseen(reduced, t).any()]
        mean, spreads = _mean_and_spreads(reduced, sample, hyper, terms)
        own_noise = variances(problem.noise, hyper, problem.record)
        if carried is not None:
            mean = mean + carried(mean)
            own_noise = own_noise - np.atleast_1d(problem.noise.slow_variance(hyper))[:, None]
        first = mean[0].copy() if first is None else first
        offset = mean - first
        total += np.sum(offset, axis=0)
        squares += np.einsum("bn,bn->n", offset, offset)
        noise += len(part) * np.mean(own_noise, axis=0)
        if spreads:
            squared = np.broadcast_to(sum(s**2 for s in spreads), mean.shape)
            unknown_inputs += len(part) * np.mean(squared, axis=0)
    offset = total / count
    variance = np.maximum(squares / count - offset**2, 0.0)
    return PredictiveMoments(first + offset, variance, noise / count, unknown_inputs / count)


@on_one_thread
def pointwise(problem: Problem, draws: Vectors) -> Float[np.ndarray, "b n"]:
    """Return each reading's log likelihood under each draw; if noise is correlated, given earlier readings."""
    densities = np.empty((len(draws.x), problem.record.size))
    for part, reduced, sample, hyper in _chunks(problem, draws):
        record, (mean, extra) = reduced.record, reduced.expected_and_extra(sample.x, hyper)
        densities[part] = log_densities(reduced.noise, record, record.y - mean, hyper, extra)
    return densities


@on_one_thread
def replicate(
    problem: Problem,
    draws: Vectors,
    random: np.random.Generator,
    members: Mapping[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "b n"]:
    """Simulate readings by the model's equation and noise, once from each draw.

    Deviations of unknown group members are drawn from their prior; `members`: each reading's member code (n,) by group.
    """
    outputs, members = np.empty((len(draws.x), problem.record.size)), members or {}
    for part, reduced, sample, hyper in _chunks(problem, draws):
        uncertain = [t for t in reduced.terms if t.place == "input" or t.per in members]
        mean, spreads = _mean_and_spreads(reduced, sample, hyper, uncertain)
        for t, spread in zip(uncertain, spreads, strict=True):
            codes = np.arange(mean.shape[1]) if t.place == "input" else members[str(t.per)]
            normal = random.standard_normal((len(mean), int(codes.max()) + 2))
            mean = mean + spread * normal[:, codes]  # −1: the last
        seed = int(random.integers(2**31))
        outputs[part] = draw_samples(problem.noise, problem.record, mean, hyper, seed)
    return outputs


def _chunks(
    problem: Problem, draws: Vectors
) -> Iterator[tuple[np.ndarray, Problem, Vectors, Batch]]:
    """Yield draws in chunks: their indices, their structure's problem, the draws in its terms, φ by name."""
    count = max(1, CELLS // max(1, problem.record.size))
    for places, structure, structure_draws in _by_structure(problem, draws):
        for start in range(0, len(places), count):
            part = slice(start, start + count)
            sample = Vectors(*(np.asarray(a)[part] for a in structure_draws))
            values = structure.hyper(sample.v.T)
            parameters = {k: np.broadcast_to(value, len(sample.x)) for k, value in values.items()}
            yield places[part], structure, sample, parameters


def _by_structure(
    problem: Problem, draws: Vectors
) -> Iterator[tuple[np.ndarray, Problem, Vectors]]:
    """Group an average's draws by which effects with known coefficients they include: yield indices, problem, draws."""
    layout = problem.layout
    fixed = [b for b in layout.x_blocks if b.index in b.effect.held]
    if not fixed:
        yield np.arange(len(draws.x)), problem, draws
        return
    present = np.asarray(draws.x)[:, [b.start for b in fixed]] != 0
    patterns, which = np.unique(present, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        absent = {b.effect.name for b, has in zip(fixed, pattern, strict=True) if not has}
        effects = tuple(_with_fixed(e) for e in layout.model.effects if e.name not in absent)
        inner = replace(layout, model=replace(layout.model, effects=effects))
        in_x, in_v = layout.shared_indices(inner)
        places = np.flatnonzero(which.reshape(-1) == k)
        structure_draws = Vectors(draws.x[places][:, in_x], draws.v[places][:, in_v])
        yield places, Problem(inner, problem.record), structure_draws


def _with_fixed(effect: Effect) -> Effect:
    coefficients = (
        replace(c, prior=Known(c.mean)) if isinstance(c.prior, Known) else c
        for c in effect.coefficients
    )
    return replace(effect, coefficients=tuple(coefficients))


def _mean_and_spreads(
    problem: Problem, draws: Vectors, hyper: Batch, terms: Sequence[Term]
) -> tuple[Float[np.ndarray, "b n"], list[Any]]:
    """Return expected outputs, and the standard deviation that each term adds: noise on an input, or an unknown member
    (zero at readings whose member is known)."""
    if not terms:
        return problem.expected(draws.x, hyper), []
    mean, slopes = problem.expected_with_slopes(draws.x, hyper, terms)
    spreads = list[Any]()
    for t, slope in zip(terms, slopes, strict=True):
        sd = t.prior_sd
        if t.place != "input":
            present = has_effect(draws.x, problem.terms, t.effect.name)
            member_sd = problem.member_sd(t, hyper, len(draws.x)) * present
            sd = np.where(_is_unseen(problem, t), member_sd[:, None], 0.0)
        spreads.append(slope * sd)
    return mean, spreads


def _is_unseen(problem: Problem, term: Term) -> np.ndarray:
    """Mask the readings whose member of the term's group was not in the fit."""
    if term.per is None or term.place == "fixed":
        return np.zeros(1, dtype=bool)
    return problem.record.codes[term.per] < 0
