"""What a fit has found, as a record: the model, its draws with names, the verdict."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from bayescal._calibration.confounding import Confounder, confounders, unexplained, widened
from bayescal._core.errors import InputError
from bayescal._core.parallel import on_one_thread
from bayescal._data.dataset_checks import MIN_CHANGES, resolution
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.linear_model import LinearModel, linear_model
from bayescal._inference.method import CHAINS, Draws, Verdict
from bayescal._inference.noise_on_record import Each, log_densities, samples, variances
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
CELLS = 2_000_000  # draws × readings worked out together, or kept for ArviZ


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
        """The same with another verdict; what was computed of it is kept."""
        made = object.__new__(type(self))
        vars(made).update(vars(self), verdict=replace(self.verdict, **changes))
        for name in ("tree", "why_not"):
            vars(made).pop(name, None)
        return made

    def __getstate__(self) -> dict[str, Any]:
        """The fields, as pickle writes them; what is computed from them is computed again."""
        return {f.name: getattr(self, f.name) for f in fields(Fitted)}

    @cached_property
    def posterior(self) -> xr.Dataset:
        """Draws (chain, draw, …) of each unknown under its name, in its reported unit, as `units` says.

        Group dimensions carry the members' names. Coefficients are as uncertain as recorded columns that ran with what
        the model holds leave them; `joint` is of the model alone.
        """
        return named(self.unknowns, self.values)

    @cached_property
    def unknowns(self) -> Unknowns:
        return Unknowns.of(self.layout, self.levels)

    @cached_property
    def values(self) -> Float[np.ndarray, "chains draws unknowns"]:
        """Draws of `posterior`, in the order of `unknowns`."""
        x = widened(self.joint.x, self.confounders, self.layout, self.seed)
        return self.unknowns.values(x, self.joint.v)

    @cached_property
    def confounders(self) -> tuple[Confounder, ...]:
        """Recorded columns that may have acted in the place of coefficients."""
        if self.confounded is not None:
            return self.confounded
        if not self.verdict.ok:
            return ()
        columns, steps = unexplained(self.model, self.readings), self._steps()
        return confounders(self.linear, columns, steps) if columns or steps else ()

    def _steps(self) -> dict[str, tuple[float, np.ndarray]]:
        """The steps of rounded thermometers and of the output, and the slopes of the output by them (n,)."""
        readings, found = self.readings, dict[str, tuple[float, np.ndarray]]()
        if step := resolution(readings["output"]):
            found["output"] = step, np.ones(len(readings))
        warm = (n for n in readings.columns if readings.unit(n) == "degC")
        for name in (n for n in warm if n in self.model.columns):
            values = readings[name]
            if 0 < (step := resolution(values, MIN_CHANGES)) <= COARSEST_DEGREES:
                frame = self.frame_of(readings.with_column(name, values + step))
                hyper = self.problem.hyper(self.mode.v)
                line = self.problem_on(frame).linearise(self.mode.x, hyper)
                found[name] = step, (line.mean - self.linear.mean) / step
        return found

    @property
    def frame(self) -> Frame:
        return self.problem.record.frame

    @cached_property
    def problem(self) -> Problem:
        """The fitted structure on its readings, as the engine sees it."""
        record = record_of(self.model.instrument, self.readings, self.reference)
        record.require_finite(self.model.effects)
        return Problem(self.layout, record)

    def problem_on(self, frame: Frame) -> Problem:
        """The fitted structure on other readings."""
        fitted = self.problem.record
        if frame is fitted.frame:
            return self.problem
        if all(frame.columns[n] is column for n, column in fitted.frame.columns.items()):
            return Problem(self.layout, fitted.beside(frame))
        record = Record(self.model.instrument, frame, np.asarray(frame["output"]))
        return Problem(self.layout, record)

    @cached_property
    def linear(self) -> LinearModel:
        """The fitted structure as a linear model about its mode."""
        return linear_model(self.problem, self.mode)

    @property
    def chi_squared(self) -> tuple[float, int, float]:
        """χ² of the residuals against their known variance, its degrees of freedom, the chance of as much or more.

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
        """Where the coefficients hold, by the names of the constants in the equations: T0, V0 and the like.

        Those of columns that an effect depends on; where none does, constants are means over the readings.
        """
        return {name: value for name, (value, _) in self.held_at.items()}

    @cached_property
    def held_at(self) -> dict[str, tuple[float, str]]:
        """`hold_at`, each with its unit."""
        found: dict[str, tuple[float, str]] = {}
        for column in self.readings.columns:
            name, unit = reference_name(column), self.readings.unit(column)
            if unit is None or column not in self.model.columns:
                continue
            low, high = (self.reference.get(f"{column}_{end}") for end in ("low", "high"))
            if name in self.reference:
                found[name] = float(self.reference[name]), unit  # pyright: ignore[reportArgumentType]
            elif column != "time" and isinstance(low, float) and isinstance(high, float):
                # The middle of its range, where an effect counts the column from it: there it vanishes.
                middle = 0.5 * (low + high)
                if middle != 0 and self._acting(column, high) - self._acting(column, middle):
                    found[name] = middle, unit
        return found

    def _acting(self, column: str, at: float) -> set[str]:
        """Names of the effects that are not zero where a column has a value."""
        values: Any = np.full(self._probe.size, at)
        there = replace(self._probe, columns={**self._probe.columns, column: values})
        by = (e for e in self.model.effects if column in e.columns and not e.is_placeholder)
        return {e.name for e in by if np.any(self._basis(e, there))}

    @cached_property
    def _probe(self) -> Frame:
        """Eight of the readings, on which effects are tried."""
        rows = np.unique(np.linspace(0, len(self.readings) - 1, 8, dtype=int))
        return self.frame.reordered(rows, np.arange(len(rows)), self.frame.step[rows])

    def _basis(self, effect: Effect, frame: Frame) -> Any:
        """Return columns of an effect at the mode of its shapes."""
        at_mode: Any = self.problem.hyper(self.mode.v)
        shapes = {s.name: at_mode[effect.shape_name(s)] for s in effect.column_shapes}
        return effect.evaluate(frame, shapes)

    @cached_property
    def dated(self) -> tuple[str, ...]:
        """Names of the effects that change with the date, whatever the time since a run's start."""
        if not self.readings.has("time"):
            return ()
        now = self._probe
        moved = 0.3 * float(self.reference["time_span"])  # pyright: ignore[reportArgumentType]
        later = now.moved({"time": moved})
        in_time = (e for e in self.model.effects if "time" in e.columns)
        both = ((e.name, self._basis(e, now), self._basis(e, later)) for e in in_time)
        return tuple(name for name, here, there in both if not np.array_equal(here, there))

    def on_clock(self, readings: Measurements) -> Measurements:
        """Return readings with times counted from this calibration's epoch.

        Raises:
            InputError: one has dates and the other has none, and an effect changes with the date.
        """
        return readings.on_clock(self.readings.since, lambda: ", ".join(self.dated))

    def frame_of(self, readings: Measurements) -> Frame:
        """Other readings as this calibration sees them: its clock, its T0, its runs, its groups."""
        if readings is self.readings:
            return self.frame
        return build_frame(self.on_clock(readings), self.reference, self.levels, self.readings)

    @cached_property
    def having(self) -> dict[str, Bool[np.ndarray, "draws"]]:
        """Which draws are of a structure that has each effect: of an average over structures, not all are."""
        x, blocks = self.draws().x, self.layout.x_blocks
        return {e.name: has_effect(x, blocks, e.name) for e in self.model.effects}

    @property
    def inclusion(self) -> dict[str, float]:
        """The share of draws that have each effect; one for all, where nothing was averaged."""
        return {name: float(there.mean()) for name, there in self.having.items()}

    @property
    def likeliest(self) -> set[str]:
        """The effects of the most probable structure: those that most draws have together."""
        patterns, counts = np.unique([*self.having.values()], axis=1, return_counts=True)
        best = patterns[:, counts.argmax()]
        return {name for name, there in zip(self.having, best, strict=True) if there}

    @property
    def usual_columns(self) -> set[str]:
        """Columns that effects more probable than not need; a group is none: what is used is a new member of it."""
        shares = self.inclusion
        likely = (e for e in self.model.effects if shares[e.name] > 0.5)
        return set().union(GROUPS, *(e.columns for e in likely))

    def with_columns(self, columns: Iterable[str]) -> Self:
        """The average over those structures that need no other columns, where that leaves enough of them."""
        there = set(columns)
        lacking = [e.name for e in self.model.effects if not there.issuperset(e.columns)]
        return self.without(lacking) if lacking else self

    def without(self, names: Collection[str]) -> Self:
        """The average over the structures that have none of these effects; the same where these have nearly all."""
        kept = np.flatnonzero(~np.any([self.having[name] for name in names], axis=0))
        if len(kept) < CHAIN_DRAWS:
            return self
        effects = tuple(e for e in self.model.effects if e.name not in names)
        layout = replace(self.layout, model=replace(self.model, effects=effects))
        in_x, in_v = self.layout.entries_in(layout)
        pick, mode = kept[: CHAINS * (len(kept) // CHAINS)], self.mode
        draws, inner = self.draws(), mode.covariance[np.ix_(in_v, in_v)]
        x, v = draws.x[pick][:, in_x], draws.v[pick][:, in_v]
        mode = mode._replace(
            x=x.mean(axis=0), v=mode.v[in_v], covariance=inner, flat=mode.flat[in_x]
        )
        joint = Draws.of(x, v)
        return replace(self, model=layout.model, layout=layout, joint=joint, mode=mode)

    def draws(self, limit: int | None = None) -> Vectors:
        """Joint draws (x, v) as flat arrays, x counted from its origin, evenly thinned to `limit`."""
        every = [flat(a) for a in (self.joint.x, self.joint.v)]
        step = 1 if limit is None else max(1, -(-len(every[0]) // limit))
        return Vectors(*(a[::step] for a in every))

    def thinned(self, limit: int) -> tuple[Vectors, int]:
        """Joint draws, each chain thinned so that draws times readings stay within a limit; and how many chains."""
        chains, count = self.joint.x.shape[:2]
        step = -(-count // max(1, min(count, limit // max(1, chains * len(self.readings)))))
        kept = (flat(a[:, ::step]) for a in (self.joint.x, self.joint.v))
        return Vectors(*kept), chains

    def samples(self, name: str) -> np.ndarray:
        """All draws of one unknown, or of all members of its group, in its reported unit; (draws,) or (draws, members).

        Raises:
            InputError: nothing is called so.
        """
        known = self.unknowns.by_key
        if name not in known and name not in self.unknowns.index:
            raise InputError(f"no unknown is called {name!r}; there are: {', '.join(known)}")
        return self.unknowns.select(flat(self.values), name)

    def log_likelihood(self, limit: int = CELLS) -> xr.Dataset:
        """Pointwise log likelihood, draws thinned so that at most `limit` numbers come back.

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

    found: dict[str, tuple] = {}
    coordinates: dict[str, pd.Index] = {}
    for key, own in unknowns.by_key.items():
        first, dims = unknowns.rows[own.start], ("chain", "draw")
        if first.group is not None:
            dims = (*dims, first.group)
            # xarray would load Dask to look at a list
            coordinates[first.group] = pd.Index([u.member for u in unknowns.rows[own]])
        of = {"effect": first.effect} if first.block else {"kind": first.kind}
        found[key] = dims, unknowns.select(values, key), {"units": first.unit, **of}
    return xr.Dataset(found, coords=coordinates)


def has_effect(
    x: Float[np.ndarray, "b p"], blocks: Sequence[CoefficientBlock], name: str
) -> Bool[np.ndarray, "b"]:
    """Return which draws have an effect: of a structure without it all of its coefficients are exactly zero."""
    own = [
        np.any(x[:, b.at] != 0, axis=1) for b in blocks if b.place == "x" and b.effect.name == name
    ]
    # One that is held, or sampled with φ, is not averaged over.
    return np.any(own, axis=0) if own else np.ones(len(x), dtype=bool)


def flat(values: np.ndarray) -> np.ndarray:
    """Chains one after the other."""
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])


# what joint draws say of readings, all on the host ------------------------------------------------------------------


class PredictiveMoments(NamedTuple):
    """Moments of readings over draws, (n,) each."""

    mean: Float[np.ndarray, "n"]  # of the expected output,
    variance: Float[np.ndarray, "n"]  # and its variance
    noise: Float[np.ndarray, "n"]  # mean variance of the noise,
    beside: Float[np.ndarray, "n"]  # and of what is not known of a reading's inputs and groups


@on_one_thread
def moments(
    problem: Problem, draws: Vectors, carried: Callable[[np.ndarray], np.ndarray] | None = None
) -> PredictiveMoments:
    """Return moments of readings, noise on inputs and members of groups that are not known (of code −1) included.

    Draws are taken a stretch at a time and never held together; sums are of differences from the first. What known
    readings say of the correlated noise of all, by what each draw expects of them (b, n), is `carried`: it is added to
    the mean, and its variance is no part of that of the noise.
    """
    count, size = len(draws.x), problem.record.size
    total, squares, noise, beside = np.zeros((4, size))
    first: Any = None
    for part, own, some, hyper in _stretches(problem, draws):
        acting = [t for t in own.terms if t.place == "input" or _unseen(own, t).any()]
        mean, spreads = _mean_and_spreads(own, some, hyper, acting)
        own_noise = variances(problem.noise, hyper, problem.record)
        if carried is not None:
            mean = mean + carried(mean)
            own_noise = own_noise - np.atleast_1d(problem.noise.slow_variance(hyper))[:, None]
        first = mean[0].copy() if first is None else first
        away = mean - first
        total += np.sum(away, axis=0)
        squares += np.einsum("bn,bn->n", away, away)
        noise += len(part) * np.mean(own_noise, axis=0)
        if spreads:
            squared = np.broadcast_to(sum(s**2 for s in spreads), mean.shape)
            beside += len(part) * np.mean(squared, axis=0)
    away = total / count
    variance = np.maximum(squares / count - away**2, 0.0)
    return PredictiveMoments(first + away, variance, noise / count, beside / count)


@on_one_thread
def pointwise(problem: Problem, draws: Vectors) -> Float[np.ndarray, "b n"]:
    """Log likelihood of each reading under each draw: under correlated noise, given those before it in its run."""
    found = np.empty((len(draws.x), problem.record.size))
    for part, own, some, hyper in _stretches(problem, draws):
        record, (mean, extra) = own.record, own.expected_and_extra(some.x, hyper)
        found[part] = log_densities(own.noise, record, record.y - mean, hyper, extra)
    return found


@on_one_thread
def replicate(
    problem: Problem,
    draws: Vectors,
    random: np.random.Generator,
    members: Mapping[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "b n"]:
    """Readings simulated by the model's own equation and noise, from each draw once.

    Of members of groups that the fit does not know deviations are drawn from their prior; `members` has, by group, a
    code of each reading's member (n,).
    """
    found, members = np.empty((len(draws.x), problem.record.size)), members or {}
    for part, own, some, hyper in _stretches(problem, draws):
        acting = [t for t in own.terms if t.place == "input" or t.per in members]
        mean, spreads = _mean_and_spreads(own, some, hyper, acting)
        for t, spread in zip(acting, spreads, strict=True):
            codes = np.arange(mean.shape[1]) if t.place == "input" else members[str(t.per)]
            normal = random.standard_normal((len(mean), int(codes.max()) + 2))
            mean = mean + spread * normal[:, codes]  # −1: the last
        seed = int(random.integers(2**31))
        found[part] = samples(problem.noise, problem.record, mean, hyper, seed)
    return found


def _stretches(
    problem: Problem, draws: Vectors
) -> Iterator[tuple[np.ndarray, Problem, Vectors, Each]]:
    """Which draws, some at a time; the structure that they are of, and they in its terms; their φ by name."""
    many = max(1, CELLS // max(1, problem.record.size))
    for places, own, those in _by_structure(problem, draws):
        for start in range(0, len(places), many):
            part = slice(start, start + many)
            some = Vectors(*(np.asarray(a)[part] for a in those))
            values = own.hyper(some.v.T)
            each = {k: np.broadcast_to(value, len(some.x)) for k, value in values.items()}
            yield places[part], own, some, each


def _by_structure(
    problem: Problem, draws: Vectors
) -> Iterator[tuple[np.ndarray, Problem, Vectors]]:
    """Draws of an average, together those of structures whose columns are the same: of each draw that has them known
    coefficients are what they are by definition, and zero of others."""
    layout = problem.layout
    held = [b for b in layout.x_blocks if b.index in b.effect.held]
    if not held:
        yield np.arange(len(draws.x)), problem, draws
        return
    there = np.asarray(draws.x)[:, [b.start for b in held]] != 0
    patterns, which = np.unique(there, axis=0, return_inverse=True)
    for k, has in enumerate(patterns):
        gone = {b.effect.name for b, one in zip(held, has, strict=True) if not one}
        effects = tuple(_by_definition(e) for e in layout.model.effects if e.name not in gone)
        own = replace(layout, model=replace(layout.model, effects=effects))
        in_x, in_v = layout.entries_in(own)
        places = np.flatnonzero(which.reshape(-1) == k)
        those = Vectors(draws.x[places][:, in_x], draws.v[places][:, in_v])
        yield places, Problem(own, problem.record), those


def _by_definition(effect: Effect) -> Effect:
    own = (
        replace(c, prior=Known(c.mean)) if isinstance(c.prior, Known) else c
        for c in effect.coefficients
    )
    return replace(effect, coefficients=tuple(own))


def _mean_and_spreads(
    problem: Problem, draws: Vectors, hyper: Each, terms: Sequence[Term]
) -> tuple[Float[np.ndarray, "b n"], list[Any]]:
    """Return expected outputs, and the standard deviation that each of some terms adds: noise on an input, or a member
    that is not known (zero at readings whose member is)."""
    if not terms:
        return problem.expected(draws.x, hyper), []
    mean, slopes = problem.expected_with_slopes(draws.x, hyper, terms)
    spreads = list[Any]()
    for t, slope in zip(terms, slopes, strict=True):
        sd = t.prior_sd
        if t.place != "input":
            present = has_effect(draws.x, problem.terms, t.effect.name)
            member_sd = problem.member_sd(t, hyper, len(draws.x)) * present
            sd = np.where(_unseen(problem, t), member_sd[:, None], 0.0)
        spreads.append(slope * sd)
    return mean, spreads


def _unseen(problem: Problem, term: Term) -> np.ndarray:
    """Which readings belong to a member of the term's group that is not known."""
    if term.per is None or term.place == "fixed":
        return np.zeros(1, dtype=bool)
    return problem.record.codes[term.per] < 0
