"""Base class of a fit result: model, posterior draws, linearisation, posterior predictive distribution."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from bayescal._calibration import confounding
from bayescal._core.errors import InputError
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.renamed import renamed
from bayescal._data.dataset_checks import MIN_CHANGES, find_grid_step
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.linear_model import LinearModel, linearise_model
from bayescal._inference.method import CHAINS, Draws, Verdict
from bayescal._inference.noise_on_record import Batch, draw_samples, log_densities, variances
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record, record_of
from bayescal._inference.trust import MIN_CHAIN_ESS
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS, Frame, Reference, build_frame, name_reference
from bayescal._model.model import Model
from bayescal._model.parameters import CoefficientBlock, Layout, Unknowns
from bayescal._model.terms import Term

if TYPE_CHECKING:
    import xarray as xr

MAX_THERMOMETER_STEP_DEGC = 1.0  # rounding step of a thermometer; larger steps are set points
MAX_CELLS = 2_000_000  # draws × readings evaluated together, or stored for ArviZ


class FlatDraws(NamedTuple):
    """Joint draws as flat arrays: coefficients x and unconstrained coordinates v of the hyperparameters φ."""

    x: Float[np.ndarray, "b p"]
    v: Float[np.ndarray, "b d"]


@renamed(having="inclusion_masks", likeliest="likeliest_effects", held_at="reference_constants")
@renamed(chi_squared="chi_squared_test", dated="dated_effects", thinned="thin_draws")
@dataclass(frozen=True, eq=False)
class Fitted:
    """The fields and computations of a fit result; `Calibration` documents them and adds printing and saving."""

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
    confounded: tuple[confounding.Confounder, ...] | None = None  # None: computed from the readings
    form_factor: float = 1.0
    unfound_spreads: dict[str, float] = field(default_factory=dict)

    def with_verdict(self, **changes: Any) -> Self:
        """Return a copy with changes of the verdict; cached attributes that do not depend on it are kept."""
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

        Coordinates of group dimensions are the members' names. Unlike `joint`, the variances include confounding.
        """
        return to_xarray(self.unknowns, self.values)

    @cached_property
    def unknowns(self) -> Unknowns:
        return Unknowns.of(self.layout, self.levels)

    @cached_property
    def values(self) -> Float[np.ndarray, "chains draws unknowns"]:
        """Return the draws of `posterior`, in the order of `unknowns`."""
        x = confounding.widen_draws(self.joint.x, self.confounders, self.layout, self.seed)
        return self.unknowns.values(x, self.joint.v)

    @cached_property
    def confounders(self) -> tuple[confounding.Confounder, ...]:
        """Return collinear or rounded columns that increase a coefficient's uncertainty; none if not converged."""
        if self.confounded is not None:
            return self.confounded
        if not self.verdict.ok:
            return ()
        columns = confounding.find_unmodelled_columns(self.model, self.readings)
        steps = self._find_rounding_steps()
        return confounding.find_confounders(self.linear, columns, steps) if columns or steps else ()

    def _find_rounding_steps(self) -> dict[str, tuple[float, np.ndarray]]:
        """Return the rounding step of the output and of each thermometer, and ∂output/∂column (n,), by column."""
        readings, steps = self.readings, dict[str, tuple[float, np.ndarray]]()
        if step := find_grid_step(readings["output"]):
            steps["output"] = step, np.ones(len(readings))
        thermometers = (n for n in readings.columns if readings.unit(n) == "degC")
        for name in (n for n in thermometers if n in self.model.columns):
            values = readings[name]
            if 0 < (step := find_grid_step(values, MIN_CHANGES)) <= MAX_THERMOMETER_STEP_DEGC:
                frame = self.frame_of(readings.with_column(name, values + step))
                hyper = self.problem.hyper(self.mode.v)
                shifted_fit = self.problem_on(frame).linearise(self.mode.x, hyper)
                steps[name] = step, (shifted_fit.mean - self.linear.mean) / step
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

    def clear_cache(self) -> None:
        """Drop the inference problem and its linear model, which are recomputed on demand."""
        for name in ("problem", "linear"):
            vars(self).pop(name, None)

    def problem_on(self, frame: Frame) -> Problem:
        """Return the inference problem of the fitted structure on other readings."""
        fit_record = self.problem.record
        if frame is fit_record.frame:
            return self.problem
        if all(frame.columns[n] is column for n, column in fit_record.frame.columns.items()):
            return Problem(self.layout, fit_record.with_frame(frame))
        record = Record(self.model.instrument, frame, np.asarray(frame["output"]))
        return Problem(self.layout, record)

    @cached_property
    def linear(self) -> LinearModel:
        """Return the fitted structure linearised at its mode."""
        return linearise_model(self.problem, self.mode)

    @property
    def chi_squared_test(self) -> tuple[float, int, float]:
        """Return χ² of the residuals for their modelled variance, its degrees of freedom, and its p-value or NaN.

        The variance is that of the noise model and of uncertain inputs; χ² tests the fit if `noise.white` is fixed.
        """
        squares = float(np.sum(self.linear.residual**2 / self.linear.variance))
        dof = self.linear.size - len(self.linear.owners)
        return squares, dof, float(chdtrc(dof, squares)) if dof > 0 else float("nan")

    @property
    def unit(self) -> str:
        return self.model.instrument.unit

    @property
    def hold_at(self) -> dict[str, float]:
        """Return the reference constants of the columns that effects depend on: name (T0, V0 …) → value."""
        return {name: value for name, (value, _) in self.reference_constants.items()}

    @cached_property
    def reference_constants(self) -> dict[str, tuple[float, str]]:
        """Return the reference constants of the columns that effects depend on: name (T0, V0 …) → value and unit."""
        constants: dict[str, tuple[float, str]] = {}
        for column in self.readings.columns:
            name, unit = name_reference(column), self.readings.unit(column)
            if unit is None or column not in self.model.columns:
                continue
            low, high = (self.reference.get(f"{column}_{end}") for end in ("low", "high"))
            if name in self.reference:
                constants[name] = float(self.reference[name]), unit  # pyright: ignore[reportArgumentType]
            elif column != "time" and isinstance(low, float) and isinstance(high, float):
                # The midpoint of the column's range, if a centred effect is zero there.
                middle = 0.5 * (low + high)
                if middle != 0 and self._active_at(column, high) - self._active_at(column, middle):
                    constants[name] = middle, unit
        return constants

    def _active_at(self, column: str, value: float) -> set[str]:
        """Return the names of a column's effects that are nonzero at a value of it."""
        values: Any = np.full(self._probe_frame.size, value)
        probe = replace(self._probe_frame, columns={**self._probe_frame.columns, column: values})
        effects = (e for e in self.model.effects if column in e.columns and not e.is_placeholder)
        return {e.name for e in effects if np.any(self._basis(e, probe))}

    @cached_property
    def _probe_frame(self) -> Frame:
        """Return a frame of eight evenly spaced readings, to test effects numerically."""
        rows = np.unique(np.linspace(0, len(self.readings) - 1, 8, dtype=int))
        return self.frame.reorder(rows, np.arange(len(rows)), self.frame.step[rows])

    def _basis(self, effect: Effect, frame: Frame) -> Any:
        """Return an effect's basis columns at the posterior mode of its shape parameters."""
        parameters: Any = self.problem.hyper(self.mode.v)
        shapes = {s.name: parameters[effect.shape_name(s)] for s in effect.column_shapes}
        return effect.evaluate(frame, shapes)

    @cached_property
    def dated_effects(self) -> tuple[str, ...]:
        """Return names of the effects that depend on absolute time, not only on time since the start of a run."""
        if not self.readings.has("time"):
            return ()
        frame, span = self._probe_frame, self.reference["time_span"]
        later_frame = frame.shift_columns({"time": 0.3 * float(span)})  # pyright: ignore[reportArgumentType]
        time_effects = (e for e in self.model.effects if "time" in e.columns)
        pairs = ((e.name, self._basis(e, frame), self._basis(e, later_frame)) for e in time_effects)
        return tuple(name for name, a, b in pairs if not np.array_equal(a, b))

    def on_clock(self, readings: Measurements) -> Measurements:
        """Return readings with times counted from this calibration's epoch.

        Raises:
            InputError: one has dates and the other has none, and an effect changes with the date.
        """
        return readings.align_clock(self.readings.since, lambda: ", ".join(self.dated_effects))

    def frame_of(self, readings: Measurements) -> Frame:
        """Build the frame of other readings on this calibration's clock, T0, runs and groups."""
        if readings is self.readings:
            return self.frame
        return build_frame(self.on_clock(readings), self.reference, self.levels, self.readings)

    @cached_property
    def inclusion_masks(self) -> dict[str, Bool[np.ndarray, "draws"]]:
        """Return for each effect a mask of draws whose structure includes it, all draws unless models were averaged."""
        x, blocks = self.draws().x, self.layout.x_blocks
        return {e.name: has_effect(x, blocks, e.name) for e in self.model.effects}

    @property
    def inclusion(self) -> dict[str, float]:
        """Return each effect's inclusion probability; 1 where no structures were averaged."""
        return {name: float(mask.mean()) for name, mask in self.inclusion_masks.items()}

    @property
    def likeliest_effects(self) -> set[str]:
        """Return the names of the effects of the most probable structure."""
        patterns, counts = np.unique([*self.inclusion_masks.values()], axis=1, return_counts=True)
        best = patterns[:, counts.argmax()]
        return {name for name, included in zip(self.inclusion_masks, best, strict=True) if included}

    @property
    def usual_columns(self) -> set[str]:
        """Return the columns of effects with inclusion probability above 0.5, and those of group labels."""
        probable_names = {name for name, p in self.inclusion.items() if p > 0.5}
        return set().union(GROUPS, *(self.model.effect(n).columns for n in probable_names))

    def with_columns(self, columns: Iterable[str]) -> Self:
        """Return the posterior conditional on structures that need no other columns; itself if too few draws remain."""
        missing = [e.name for e in self.model.effects if not {*e.columns} <= {*columns}]
        return self.without(missing) if missing else self

    def without(self, names: Collection[str]) -> Self:
        """Return the posterior conditional on structures without these effects; itself if too few draws remain."""
        draw_rows = np.flatnonzero(~np.any([self.inclusion_masks[name] for name in names], axis=0))
        if len(draw_rows) < MIN_CHAIN_ESS:
            return self
        effects = tuple(e for e in self.model.effects if e.name not in names)
        layout = replace(self.layout, model=replace(self.model, effects=effects))
        x_indices, v_indices = self.layout.shared_indices(layout)
        chosen_draws, mode = draw_rows[: CHAINS * (len(draw_rows) // CHAINS)], self.mode
        draws, covariance = self.draws(), mode.covariance[np.ix_(v_indices, v_indices)]
        x, v = draws.x[chosen_draws][:, x_indices], draws.v[chosen_draws][:, v_indices]
        mode = mode._replace(
            x=x.mean(axis=0), v=mode.v[v_indices], covariance=covariance, flat=mode.flat[x_indices]
        )
        return replace(self, model=layout.model, layout=layout, joint=Draws.of(x, v), mode=mode)

    def draws(self, limit: int | None = None) -> FlatDraws:
        """Return joint draws (x, v) as flat arrays, x relative to its origin, evenly thinned to at most `limit`."""
        x, v = np.concatenate(self.joint.x), np.concatenate(self.joint.v)
        step = 1 if limit is None else max(1, -(-len(x) // limit))
        return FlatDraws(x[::step], v[::step])

    def thin_draws(self, limit: int) -> tuple[FlatDraws, int]:
        """Return draws, thinned so that draws × readings is at most about `limit`, and the number of chains."""
        chains, length = self.joint.x.shape[:2]
        step = -(-length // max(1, min(length, limit // max(1, chains * len(self.readings)))))
        arrays = (np.concatenate(a[:, ::step]) for a in (self.joint.x, self.joint.v))
        return FlatDraws(*arrays), chains

    def samples(self, name: str) -> np.ndarray:
        """Return the draws of an unknown (draws,), or of a group's members (draws, members), in the reported unit.

        Raises:
            InputError: no unknown has this name.
        """
        by_key = self.unknowns.by_key
        if name not in by_key and name not in self.unknowns.index:
            raise InputError(f"no unknown is called {name!r}; the fit has: {', '.join(by_key)}")
        return self.unknowns.select(np.concatenate(self.values), name)

    @run_on_one_thread
    def log_likelihood(self, limit: int = MAX_CELLS) -> xr.Dataset:
        """Return the pointwise log likelihood (chain, draw, reading); draws are thinned to `limit` numbers at most.

        Under correlated noise it is conditional on the earlier readings of the run.
        """
        import xarray as xr  # loading takes half a second, with pandas

        draws, chains = self.thin_draws(limit)
        problem, record = self.problem, self.problem.record
        densities = np.empty((len(draws.x), record.size))
        for chunk, chunk_draws, hyper in _iterate_chunks(problem, draws):
            mean, input_var = problem.expected_and_extra(chunk_draws.x, hyper)
            residuals = record.y - mean
            densities[chunk] = log_densities(problem.noise, record, residuals, hyper, input_var)
        by_chain = densities.reshape(chains, -1, record.size)
        return xr.Dataset({"output": (("chain", "draw", "reading"), by_chain)})


def to_xarray(unknowns: Unknowns, values: Float[np.ndarray, "chains draws unknowns"]) -> xr.Dataset:
    """Return draws as a dataset with one variable per unknown or group of unknowns, in its reported unit."""
    import pandas as pd
    import xarray as xr

    variables, coordinates = dict[str, tuple](), dict[str, pd.Index]()
    for key, rows in unknowns.by_key.items():
        unknown, dims = unknowns.rows[rows.start], ("chain", "draw")
        if unknown.group is not None:
            dims = (*dims, unknown.group)
            # xarray would load Dask to look at a list
            coordinates[unknown.group] = pd.Index([u.member for u in unknowns.rows[rows]])
        attrs = {"effect": unknown.effect} if unknown.block else {"kind": unknown.kind}
        variables[key] = dims, unknowns.select(values, key), {"units": unknown.unit, **attrs}
    return xr.Dataset(variables, coords=coordinates)


def has_effect(
    x: Float[np.ndarray, "b p"], blocks: Sequence[CoefficientBlock], name: str
) -> Bool[np.ndarray, "b"]:
    """Mask the draws whose structure includes an effect: its coefficients are exactly zero in all others."""
    effect_blocks = (b for b in blocks if b.place == "x" and b.effect.name == name)
    is_nonzero = [np.any(x[:, b.x_slice] != 0, axis=1) for b in effect_blocks]
    # An effect that is fixed or sampled with φ is part of every structure.
    return np.any(is_nonzero, axis=0) if is_nonzero else np.ones(len(x), dtype=bool)


class PredictiveMoments(NamedTuple):
    """Posterior predictive moments of readings, (n,) each, output unit or its square."""

    mean: Float[np.ndarray, "n"]  # posterior mean of the expected output
    variance: Float[np.ndarray, "n"]  # posterior variance of the expected output
    noise: Float[np.ndarray, "n"]  # posterior mean of the noise variance
    unknown: Float[np.ndarray, "n"]  # posterior mean of the variance of inputs and unseen members


@run_on_one_thread
def compute_predictive_moments(
    problem: Problem, draws: FlatDraws, noise: Callable[[np.ndarray], tuple[Any, Any]] | None = None
) -> PredictiveMoments:
    """Return predictive moments of readings, including noise on inputs and deviations of unseen members (code −1).

    Draws are evaluated in chunks; moments are sums of differences to the first draw, against cancellation. `noise` maps
    the draws' residuals (b, n) to the conditional mean (b, n) and variance (n,) of correlated noise. That mean differs
    between draws, since readings determine only the sum of a constant coefficient and slow noise.
    """
    count, reading_count = len(draws.x), problem.record.size
    offset_sum, offset_squares, noise_sum, input_variance = np.zeros((4, reading_count))
    offset0: Any = None
    terms = [t for t in problem.terms if t.place == "input" or _is_unseen(problem, t).any()]
    for _, chunk_draws, hyper in _iterate_chunks(problem, draws):
        mean, sds = _compute_mean_and_input_sds(problem, chunk_draws, hyper, terms)
        noise_var = variances(problem.noise, hyper, problem.record)
        if noise is not None:
            noise_mean, conditional_var = noise(problem.record.y - mean)
            slow_var = np.reshape(problem.noise.slow_variance(hyper), (-1, 1))
            mean, noise_var = mean + noise_mean, noise_var - slow_var + conditional_var
        offset0 = mean[0].copy() if offset0 is None else offset0
        offset = mean - offset0
        offset_sum += np.sum(offset, axis=0)
        offset_squares += np.einsum("bn,bn->n", offset, offset)
        noise_sum += len(chunk_draws.x) * np.mean(noise_var, axis=0)
        if sds:
            input_squares = np.broadcast_to(sum(s**2 for s in sds), mean.shape)
            input_variance += len(chunk_draws.x) * np.mean(input_squares, axis=0)
    offset = offset_sum / count
    variance = np.maximum(offset_squares / count - offset**2, 0.0)
    return PredictiveMoments(offset0 + offset, variance, noise_sum / count, input_variance / count)


@run_on_one_thread
def replicate(
    problem: Problem,
    draws: FlatDraws,
    rng: np.random.Generator,
    member_codes: Mapping[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "b n"]:
    """Simulate readings by the measurement equation and the noise model, once from each draw.

    Deviations of unseen group members are drawn from their prior; `member_codes`: (n,), by group.
    """
    outputs, member_codes = np.empty((len(draws.x), problem.record.size)), member_codes or {}
    uncertain_terms = [t for t in problem.terms if t.place == "input" or t.per in member_codes]
    for chunk, chunk_draws, hyper in _iterate_chunks(problem, draws):
        mean, sds = _compute_mean_and_input_sds(problem, chunk_draws, hyper, uncertain_terms)
        for t, sd in zip(uncertain_terms, sds, strict=True):
            codes = np.arange(mean.shape[1]) if t.place == "input" else member_codes[str(t.per)]
            deviates = rng.standard_normal((len(mean), int(codes.max()) + 2))
            mean = mean + sd * deviates[:, codes]  # code −1 indexes the last column
        seed = int(rng.integers(2**31))
        outputs[chunk] = draw_samples(problem.noise, problem.record, mean, hyper, seed)
    return outputs


def _iterate_chunks(problem: Problem, draws: FlatDraws) -> Iterator[tuple[slice, FlatDraws, Batch]]:
    """Yield chunks of draws: their indices, x and v, φ by name."""
    count = max(1, MAX_CELLS // max(1, problem.record.size))
    for start in range(0, len(draws.x), count):
        chunk = slice(start, start + count)
        chunk_draws = FlatDraws(draws.x[chunk], draws.v[chunk])
        values = problem.hyper(chunk_draws.v.T).items()
        yield chunk, chunk_draws, {k: np.broadcast_to(v, len(chunk_draws.x)) for k, v in values}


def _compute_mean_and_input_sds(
    problem: Problem, draws: FlatDraws, hyper: Batch, terms: Sequence[Term]
) -> tuple[Float[np.ndarray, "b n"], list[Any]]:
    """Return the expected outputs (b, n), and the standard deviation of the output due to each of `terms`.

    A term is noise on an input, or the deviation of an unseen member, zero at readings of members seen in the fit.
    """
    if not terms:
        return problem.expected(draws.x, hyper), []
    (mean, gradients), sds = problem.expected_with_slopes(draws.x, hyper, terms), list[Any]()
    for t, gradient in zip(terms, gradients, strict=True):
        prior_sd = t.prior_sd
        if t.place != "input":
            is_present = has_effect(draws.x, problem.terms, t.effect.name)
            member_sd = problem.member_sd(t, hyper, len(draws.x)) * is_present
            prior_sd = np.where(_is_unseen(problem, t), member_sd[:, None], 0.0)
        sds.append(gradient * prior_sd)
    return mean, sds


def _is_unseen(problem: Problem, term: Term) -> np.ndarray:
    """Mask the readings whose member of the term's group was not in the fit."""
    if term.per is None or term.place == "fixed":
        return np.zeros(1, dtype=bool)
    return problem.record.codes[term.per] < 0
