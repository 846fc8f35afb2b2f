"""Many devices of one type, fitted each by itself in this process: mean, covariance and whether they are reliable.

Least squares has a closed form but for one number, the noise, where the expected output is affine in the coefficients,
their priors are fixed and the noise is white: the quick way through a batch. The readings enter through R of the QR
factors of [J_flat, J·s, r] alone (s: prior standard deviations), and through the singular values d of its block of
proper columns. The restricted likelihood of the noise σ is then a sum of p terms,

    −2 log L(σ) = (n − f) log σ² + ρ²/σ² + Σ log(1 + d²/σ²) + c²/(σ² + d²)

with ρ what no column explains, c the readings along the singular vectors and f the number of flat coefficients. Its
maximum is that of `LeastSquares`, and so are the coefficients at it and their covariance.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).

There frames of many devices are stacked, so that one compiled program sees them all. A table without time and without
groups becomes a stack of frames by a few array operations; else frames are built one by one. Devices with other numbers
of readings are padded to a common one; a padded reading repeats the last and counts nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from bayescal import (
    BayescalError,
    Frame,
    InputError,
    LeastSquares,
    Marginal,
    Measurements,
    Model,
    ModelError,
)
from bayescal._annexes.fleet.batch_result import BatchPart, BatchResult
from bayescal._annexes.fleet.devices import DEVICE, DeviceBlock, Devices, joined
from bayescal._annexes.fleet.partial_pooling import pooled
from bayescal._annexes.fleet.population import Named
from bayescal._core import deadline
from bayescal._core.importance_weights import smoothed
from bayescal._core.jax_setup import spare_memory_maps
from bayescal._core.jit import compiled
from bayescal._core.settings import unusual
from bayescal._inference import least_squares, sampled_products, trust
from bayescal._inference.laplace import find_mode
from bayescal._inference.linear_model import sized
from bayescal._inference.method import Method
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record, record_of
from bayescal._inference.sampling import weighted_draws
from bayescal._model import forward
from bayescal._model.frame import (
    GROUPS,
    Reference,
    build_frame,
    reference_name,
    reference_of,
    rounded_means,
)
from bayescal._model.parameters import Layout, Levels, bind
from bayescal.workshop import UNCERTAINTY

GRID = 32  # starts for log σ², among which the best one's neighbours bracket the maximum
NEWTON_STEPS = 10  # safeguarded Newton steps in the bracket, to the last digits
LEAST_NOISE = 1e-24  # share of the readings' variance, below which the noise counts as none
NOISE = "noise.white"
NOT_REACHED = "not reached ({}): give more time"


class ClosedFormFit(NamedTuple):
    """What least squares finds of one device: x̂, its covariance, σ, and whether all of it was determined."""

    x: Float[Array, "p"]
    covariance: Float[Array, "p p"]
    noise: Float[Array, ""]
    determined: Array
    scatter: Array  # whether the readings left any


def has_closed_form(layout: Layout, frame: Frame) -> bool:
    """Whether the model is of this kind for readings like these."""
    noise = layout.model.noise
    only_noise = all(h.kind == "noise" for h in layout.hypers)
    return (
        noise.first
        and only_noise
        and layout.size > 0
        and not any(b.place == "input" for b in layout.blocks)
        and UNCERTAINTY not in frame.columns
        and not sampled_products.is_nonlinear(layout, frame)
    )


@compiled
def solve_in_closed_form(
    layout: Layout, frames: Frame, ys: Float[Array, "b n"], real: Float[Array, "b n"]
) -> ClosedFormFit:
    """All devices of a stack; `real` is 0 where a reading is padding."""
    return jax.vmap(lambda *device: _solve_one(layout, *device))(frames, ys, real)


def _solve_one(
    layout: Layout, frame: Frame, y: Float[Array, "n"], real: Float[Array, "n"]
) -> ClosedFormFit:
    flat = np.concatenate([np.full(b.size, b.coefficient.flat) for b in layout.x_blocks])
    places, f, p = np.argsort(~flat, kind="stable"), int(flat.sum()), layout.size
    centre = forward.prior_mean(layout)
    hyper = forward.hyper_values(layout, jnp.zeros(len(layout.hypers)))
    line = forward.linearise(layout, frame, centre, hyper)
    norm = jnp.sqrt(jnp.sum((line.jacobian * real[:, None]) ** 2, axis=0))
    scale = forward.prior_sd(layout, hyper, 1 / jnp.where(norm > 0, norm, 1.0))
    table = jnp.column_stack([(line.jacobian * scale)[:, places], y - line.mean])
    # R, flat columns first, then the proper ones, then the readings.
    upper = _triangle(table * real[:, None])
    u, d, vt = jnp.linalg.svd(upper[f:p, f:p])
    c, rest, d2 = u.T @ upper[f:p, p], upper[p, p] ** 2, d**2
    if NOISE in dict(layout.model.fixed):
        variance = jnp.asarray(dict(layout.model.fixed)[NOISE]) ** 2
    else:
        variance = jnp.exp(_log_variance(jnp.sum(real) - f, rest, c**2, d2))
    # The proper coefficients z, in parts of their prior standard deviations, given the noise.
    z = vt.T @ (d * c / (variance + d2))
    covariance_z = (vt.T * (variance / (variance + d2))) @ vt
    # The flat ones given these: R11·x = first − R12·z + noise.
    left = upper[:f, :f]
    right = jnp.column_stack([upper[:f, f:p], upper[:f, p], jnp.eye(f)])
    back = solve_triangular(left, right, lower=False)
    slope, free, root = back[:, : p - f], back[:, p - f], back[:, p - f + 1 :]
    cross = -slope @ covariance_z
    inner = variance * root @ root.T - cross @ slope.T
    undo = np.argsort(places)
    value = jnp.concatenate([free - slope @ z, z])[undo]
    covariance = jnp.block([[inner, cross], [cross.T, covariance_z]])[undo][:, undo]
    # Flat columns have length one: a diagonal of R near zero is a direction that nothing determines.
    determined = jnp.all(jnp.abs(jnp.diag(left)) > 1e-10) & jnp.all(jnp.isfinite(value))
    return ClosedFormFit(
        x=centre + scale * value,
        covariance=scale[:, None] * covariance * scale,
        noise=jnp.sqrt(variance),
        determined=determined,
        scatter=rest > LEAST_NOISE * jnp.sum(upper[:, p] ** 2),
    )


def _triangle(table: Float[Array, "n q"]) -> Float[Array, "q q"]:
    """R of the QR factors up to the signs of its rows, square however few rows there are."""
    upper = jnp.linalg.qr(table, mode="r")
    return jnp.pad(upper, ((0, table.shape[1] - upper.shape[0]), (0, 0)))


def _log_variance(count: Array, rest: Array, c2: Float[Array, "m"], d2: Float[Array, "m"]) -> Array:
    """Where the restricted likelihood of t = log σ² is greatest.

    Args:
        count: readings less flat coefficients.
        rest: sum of squares that no column explains, positive.
        c2, d2: squares along the singular vectors, and of the singular values.
    """

    def value(t):
        s = jnp.exp(t)
        return -(count * t + rest / s + jnp.sum(jnp.log1p(d2 / s) + c2 / (s + d2)))

    def slopes(t):
        s = jnp.exp(t)
        share = s / (s + d2)
        pull = c2 * share / (s + d2)
        first = -count + rest / s + jnp.sum(1 - share + pull)
        second = -rest / s + jnp.sum(-share * (1 - share) + pull * (1 - 2 * share))
        return first, second

    # From none of it explained by noise to all of it.
    least = jnp.log(rest / count + 1e-300) - 0.5
    most = jnp.log((rest + jnp.sum(c2)) / count + 1e-300) + 4.0
    grid = least + (most - least) * jnp.linspace(0.0, 1.0, GRID) ** 2
    best = jnp.argmax(jax.vmap(value)(grid))
    low, high = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, GRID - 1)]

    def closer(_, state):
        t, low, high = state
        first, second = slopes(t)
        low, high = jnp.where(first > 0, t, low), jnp.where(first > 0, high, t)
        step = t - first / jnp.where(second < 0, second, -1.0)
        inside = (step >= low) & (step <= high) & (second < 0)
        return jnp.where(inside, step, 0.5 * (low + high)), low, high

    return jax.lax.fori_loop(0, NEWTON_STEPS, closer, (grid[best], low, high))[0]


STEP = 1.25  # from one padded number of readings to the next
NUMBERS = 2_000_000  # readings in one stack at most


class DeviceFrame(NamedTuple):
    """One device as a fit takes it.

    Attributes:
        device: its index in the block.
        layout: where its unknowns stand.
        levels: members of its groups.
        frame: what the effects see.
        y: outputs, (n,).
    """

    device: int
    layout: Layout
    levels: Levels
    frame: Frame
    y: np.ndarray


class DeviceStack(NamedTuple):
    """Devices of one shape, as `DeviceFrame` with a leading axis.

    Attributes:
        devices: their indices in the block, (b,).
        layout: common to all.
        levels: members of the groups of each.
        frame: stacked frames; leaves (b, …).
        y: outputs, (b, n).
        real: 1 where a reading is one, 0 where it is padding, (b, n).
    """

    devices: np.ndarray
    layout: Layout
    levels: Sequence[Levels]
    frame: Frame
    y: np.ndarray
    real: np.ndarray

    def padded(self) -> DeviceStack:
        """A few devices more, the last one repeated, so that few programs are compiled: at most an eighth above 64."""
        few = len(self.devices)
        step = max(64, 1 << max((few - 1).bit_length() - 4, 0))
        many = 1 << (few - 1).bit_length() if few < 64 else -(-few // step) * step
        pick = np.minimum(np.arange(many), few - 1)
        if many == few:
            return self
        frame = jax.tree.map(lambda a: np.asarray(a)[pick], self.frame)
        return self._replace(frame=frame, y=self.y[pick], real=self.real[pick])


Refuse = Callable[[int, BayescalError], Any]  # takes the index of a device that cannot be fitted


def frames(
    model: Model, block: DeviceBlock, reference: Reference, refuse: Refuse
) -> Iterator[DeviceFrame]:
    """The devices of a block one by one; `refuse` is called with those that cannot be fitted, and why."""
    for i in range(len(block.names)):
        readings = block.measurements(i)
        try:
            layout, levels = bind(model, readings)
            frame = build_frame(readings, {**reference_of(readings), **reference})
        except BayescalError as error:
            refuse(i, error)
            continue
        yield DeviceFrame(
            i, layout, levels, jax.tree.map(np.asarray, frame), np.asarray(readings["output"])
        )


def stacks(
    model: Model, block: DeviceBlock, reference: Reference, refuse: Refuse, most: int
) -> Iterator[DeviceStack]:
    """The devices of a block by shape, at most so many at once; arguments as of `frames`."""
    labels = {name for name, unit in block.units.items() if unit is None}
    if labels <= {DEVICE} and not {"time", "temperature_point"} & block.values.keys():
        yield from _stacks_of_numbers(model, block, reference, refuse, most)
        return
    waiting: dict[tuple, list[DeviceFrame]] = {}
    for one in frames(model, block, reference, refuse):
        kind = (str(jax.tree.map(jnp.shape, one.frame)), one.layout.counts)
        waiting.setdefault(kind, []).append(one)
        if len(waiting[kind]) >= min(most, NUMBERS // max(1, len(one.y))):
            yield _stacked(waiting.pop(kind))
    for rest in waiting.values():
        yield _stacked(rest)


def _stacked(made: Sequence[DeviceFrame]) -> DeviceStack:
    devices, layouts, levels, each, ys = zip(*made, strict=True)
    y = np.stack(ys)
    frame = jax.tree.map(lambda *a: np.stack(a), *each)
    return DeviceStack(np.array(devices), layouts[0], levels, frame, y, np.ones_like(y))


def _stacks_of_numbers(
    model: Model, block: DeviceBlock, reference: Reference, refuse: Refuse, most: int
) -> Iterator[DeviceStack]:
    """Devices whose frames need nothing but their numbers: no time, no groups, no labels."""
    rungs = np.array([_rung(int(n)) for n in range(int(block.counts.max()) + 1)])[block.counts]
    constants = {name: v for name, v in reference.items() if not isinstance(v, dict)}
    levels = {g: () if g == "cell" else ("1",) for g in GROUPS}
    for rung in np.unique(rungs).tolist():
        counts = ((group, len(names)) for group, names in levels.items())
        layout = Layout(model, tuple(counts))
        few = block.counts <= layout.size  # readings, perhaps not enough for the model
        for one in np.flatnonzero(few & (rungs == rung)).tolist():
            try:
                bind(model, block.measurements(one))
            except BayescalError as error:
                refuse(one, error)
                rungs[one] = 0
        members = np.flatnonzero(rungs == rung)
        at_once = max(1, min(most, NUMBERS // rung))
        for begin in range(0, len(members), at_once):
            some = members[begin : begin + at_once]
            columns, real, scalars = _matrices(block, some, rung)
            shape = real.shape
            frame = Frame(  # NumPy arrays, until they are fitted
                columns=columns,
                labels={},
                rates={},
                codes={g: np.full(shape, len(names) - 1) for g, names in levels.items()},
                reference={**scalars, **{n: np.full(len(some), v) for n, v in constants.items()}},
                order=np.broadcast_to(np.arange(rung), shape),
                step=-np.ones(shape),
                record=dict(columns),
                silence=np.full(len(some), np.inf),
            )
            own = [levels] * len(some)
            if DEVICE in block.values:
                own = [{**levels, DEVICE: (block.names[i],)} for i in some]
            yield DeviceStack(some, layout, own, frame, columns["output"], real)


def _rung(count: int) -> int:
    """The least of a ladder of numbers of readings that is no smaller."""
    rung = 8
    while rung < count:
        rung = int(np.ceil(rung * STEP))
    return rung


def _matrices(
    block: DeviceBlock, some: np.ndarray, rung: int
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, np.ndarray]]:
    """Columns (b, rung), which readings are real, and the reference constants of each device."""
    counts = block.counts[some]
    within = np.arange(rung)
    rows = block.starts[some][:, None] + np.minimum(within, counts[:, None] - 1)
    real = (within < counts[:, None]).astype(float)
    numbers = [name for name, unit in block.units.items() if unit is not None]
    columns = {name: block.values[name][rows] for name in numbers}
    scalars = {}
    for name in numbers:
        low, high = columns[name].min(axis=1), columns[name].max(axis=1)
        if block.units[name] == "degC":
            mean = np.sum(columns[name] * real, axis=1) / counts
            sd = np.sqrt(np.sum((columns[name] - mean[:, None]) ** 2 * real, axis=1) / counts)
            scalars[reference_name(name)] = rounded_means(mean, sd, low, high)
        if name not in ("output", UNCERTAINTY):
            scalars |= {f"{name}_low": low, f"{name}_high": high}
    return columns, real, scalars


CHUNK = 4096  # devices in one compiled program at most
NUDGE = 1e-5  # of a coordinate, for the slope of its value
NO_SCATTER = (
    "The readings leave no scatter about the model, so that the noise is not determined: too few readings for the "
    "coefficients, or made without noise."
)
HELD = (
    "Shapes have the standard uncertainty of their coordinate times its slope; noise and between-group standard "
    "deviations are held at their restricted-likelihood estimates."
)


@dataclass(frozen=True)
class FitOptions:
    """How every device is fitted.

    Attributes:
        method: of every fit.
        seed: of every random number.
        chunk: devices fitted at once at most.
        reference: constants of the bases, in place of each device's own.
    """

    method: LeastSquares | Marginal
    seed: int = 0
    chunk: int = CHUNK
    reference: Reference = field(default_factory=dict)

    @classmethod
    def of(
        cls, model: Model, method: Method | None, seed: int, chunk: int, reference: Reference | None
    ) -> FitOptions:
        """As a user gives them.

        Raises:
            InputError: `chunk` is none.
            ModelError: the method cannot be mapped over devices.
        """
        if chunk < 1:
            raise InputError(f"chunk is {chunk}: give at least 1")
        return cls(mappable(model, method or LeastSquares()), seed, chunk, dict(reference or {}))

    def with_common(self, reference: Reference) -> FitOptions:
        """With further constants, where none were given."""
        return replace(self, reference={**reference, **self.reference})

    def data(self, model: Model) -> dict[str, Any]:
        """What was fitted, as a result says it."""
        return {
            "instrument": model.instrument.name,
            "effects": list(model.names),
            "noise": model.noise.law,
            "method": self.method.name,
            "seed": self.seed,
            "reference": {k: v for k, v in self.reference.items() if not isinstance(v, dict)},
            **({"settings": own} if (own := unusual()) else {}),
        }


def fit_devices(
    model: Model, devices: Devices, options: FitOptions, named: Named | None = None
) -> BatchResult:
    """Fit every device by itself in a few compiled programs, or under a population of named coefficients.

    Raises:
        InputError: no device at all, or none that can be used.
    """
    if not len(devices):
        raise InputError("there is no device to fit: give at least one")
    if named:
        options = options.with_common(common_reference(temperature_sums(devices)))
    groups = [(model, devices)]
    result = fit_together(devices.names, devices.refused, groups, options, each=False)
    return pooled(result, named, options.seed) if named else result


def fit_together(
    names: tuple[str, ...],
    refused: Mapping[str, str],
    groups: Sequence[tuple[Model, Devices]],
    options: FitOptions,
    each: bool = True,
) -> BatchResult:
    """Fit groups of devices, each with a model of its own; one result in the order of the names.

    Args:
        names: of all devices.
        refused: those of them that are in no group, and why.
        groups: models, and the devices that each is fitted to; the result is named after the first.
        options: of every fit.
        each: whether a reason that all devices share refuses each of them, and not the whole.

    Raises:
        InputError: none can be used, and not `each`.
    """
    spare_memory_maps()
    fits = _Fits(options)
    fits.refused |= refused
    fitted = [fits.fit(model, devices, each) for model, devices in groups]
    late = NOT_REACHED.format(deadline.current().why)
    fits.refused |= {n: late for n in names if n not in fits.facts and n not in fits.refused}
    parts, reasons = fits.parts(names), fits.reasons | fits.refused
    if not parts and names and not each:
        name, why = next(iter(fits.refused.items()))
        raise InputError(f"none of the {len(names)} devices can be used; {name}: {why}")
    return BatchResult(
        devices=names,
        ok=np.array([not reasons.get(name) for name in names], dtype=bool),
        reasons=tuple(reasons.get(name, "") for name in names),
        parts=tuple(parts),
        population=None,
        about={**options.data(fitted[0]), "notes": list(fits.notes)},
        facts=pd.DataFrame.from_dict(
            fits.facts, "index", dtype=float, columns=["readings", "T0"]
        ).reindex(names),
    )


def mappable(model: Model, method: Method) -> LeastSquares | Marginal:
    """The method, if it can be mapped over devices.

    Raises:
        ModelError: it cannot.
    """
    if not isinstance(method, LeastSquares | Marginal):
        raise ModelError(
            f"fit_batch maps LeastSquares() and Marginal() over devices, not {type(method).__name__}: fit them one by "
            "one with it"
        )
    if isinstance(method, Marginal) and (
        not model.noise.gaussian or method.sampler != "importance"
    ):
        raise ModelError(
            "fit_batch maps Marginal() over devices by importance sampling, which needs Gaussian noise: use "
            "LeastSquares(), or fit them one by one"
        )
    return method


def temperature_sums(devices: Devices) -> list[tuple[str, float, int]]:
    """Sum and number of the readings of each column of temperatures."""
    return [
        (name, float(np.sum(block.values[name])), len(block.values[name]))
        for block in devices.blocks
        for name in block.temperatures
    ]


def common_reference(sums: Sequence[tuple[str, float, int]]) -> Reference:
    """T0 and its like over all devices, so that offsets mean the same for each."""
    total: dict[str, np.ndarray] = {}
    for name, *own in sums:
        total[name] = total.get(name, 0.0) + np.array(own)
    return {reference_name(name): float(np.round(s / n)) for name, (s, n) in total.items()}


def tailored(model: Model, readings: Measurements) -> Model:
    """The model with its instrument tailored to one device's readings; the same where nothing has to be.

    What it has of the instrument's own (effects, the noise law) is that of the tailored one; what was changed stays. A
    size that was changed is one in parts of what a record shows, as all of the general instrument's are.
    """
    general = model.instrument
    own = general.for_readings(readings)
    if own is general:
        return model
    stated = {e.name: e for e in (*general.effects, *general.candidates)}
    sized = {e.name: e for e in (*own.effects, *own.candidates)}
    parts = {
        e.name: e.coefficients[0].size / stated[e.name].coefficients[0].size
        for e in model.effects
        if e.name in stated and e == replace(stated[e.name], coefficients=e.coefficients)
    }
    effects = tuple(sized.get(e.name, e) if e.name in parts else e for e in model.effects)
    noise = own.noise if model.noise == general.noise else model.noise
    made = Model(own, effects, noise, model.fixed)
    for name, part in parts.items():
        if part != 1:
            made = made.resize(name, part * made.effect(name).coefficients[0].size)
    return made


def tailored_to_first(
    model: Model, devices: Iterable[Measurements]
) -> tuple[Model, Measurements | None]:
    """The model tailored to the first device that it can be tailored to, and that device; None where there is none.

    Raises:
        InputError: no device has what the instrument takes from readings: why, of the first.
    """
    refusals: list[InputError] = []
    for readings in devices:
        try:
            return tailored(model, readings), readings
        except InputError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]
    return model, None


def sized_for(model: Model, readings: Measurements, reference: Reference) -> Model:
    """Plausible amplitudes of what no named effect describes, where they are open: one device's, for all."""
    if not any(e.open for e in model.effects):
        return model
    own = {**reference_of(readings), **reference}
    return sized(model, readings, record_of(model.instrument, readings, own))


class _Solved(NamedTuple):
    """Devices of one layout, every unknown in its reported unit; covariances of what is held are NaN."""

    layout: Layout
    mean: np.ndarray  # (b, q)
    covariance: np.ndarray  # (b, q, q)
    reasons: Sequence[str]  # what stands against each device; empty if nothing
    notes: tuple[str, ...] = ()  # how it was done


class _Fits:
    """Fits as they come in: devices that are refused, what stands against others, how it was done."""

    def __init__(self, options: FitOptions) -> None:
        self.options, self.method = options, options.method
        self.refused: dict[str, str] = {}
        self.reasons: dict[str, str] = {}
        self.notes: dict[str, None] = {}
        self.facts: dict[str, tuple[float, float]] = {}  # by device: how many readings, T0
        self._promoted: dict[Layout, tuple[Layout, tuple[str, ...]]] = {}
        self._found: dict[tuple[tuple[str, str], ...], list[tuple]] = {}

    def fit(self, model: Model, devices: Devices, each: bool) -> Model:
        """Fit every device that can be fitted; the model, with open sizes taken from the first.

        Raises:
            BayescalError: no block can be used, and not `each`; what is said of the first.
        """
        wrong: list[BayescalError] = []
        blocks = joined(devices.blocks)
        for block in blocks:
            try:
                first = block.measurements(0)
                model.require(first)
                model = sized_for(model, first, self.options.reference)
                self._fit(model, block)
            except deadline.TimeIsUp:
                break
            except BayescalError as error:  # a column is missing, of all its devices
                wrong.append(error)
                self.refused = dict.fromkeys(block.names, str(error)) | self.refused
        if wrong and len(wrong) == len(blocks) and not each:
            raise wrong[0]
        return model

    def _fit(self, model: Model, block: DeviceBlock) -> None:
        def refuse(device: int, error: BayescalError) -> None:
            self.refused[block.names[device]] = str(error)

        # Least squares of all has a closed form if that of the first device has that can be fitted.
        given = model, block, self.options.reference
        first = next(frames(*given, lambda *_: None), None)
        if (
            first is not None
            and isinstance(self.method, LeastSquares)
            and has_closed_form(first.layout, jax.tree.map(jnp.asarray, first.frame))
        ):
            for stack in stacks(*given, refuse, self.options.chunk):
                names = [block.names[i] for i in stack.devices]
                t0 = np.broadcast_to(stack.frame.reference.get("T0", np.nan), len(names))
                self.facts |= zip(names, zip(stack.real.sum(axis=1), t0, strict=True), strict=True)
                self._keep(names, stack.levels, _in_closed_form(stack))
                deadline.current().ask()
            return
        for one in frames(*given, refuse):
            name, solved = block.names[one.device], self._solved(one)
            self.facts[name] = len(one.y), float(one.frame.reference.get("T0", np.nan))
            self._keep([name], [one.levels], solved)
            deadline.current().ask()

    def _solved(self, one: DeviceFrame) -> _Solved:
        if isinstance(self.method, LeastSquares):
            return _by_least_squares(one, self.method)
        if one.layout not in self._promoted:  # decided on the first device of its kind, for all
            record = Record(one.layout.model.instrument, one.frame, one.y)
            found = sampled_products.choose(Problem(one.layout, record), self.method.promote)
            self._promoted[one.layout] = found[0].layout, found[1]
        layout, notes = self._promoted[one.layout]
        return _by_sampling(one._replace(layout=layout), self.method, self.options.seed, notes)

    def _keep(self, names: Sequence[str], levels: Sequence[Levels], made: _Solved) -> None:
        deadline.current().defer_interrupt()
        self.notes |= dict.fromkeys(made.notes)
        self.reasons |= dict(zip(names, made.reasons, strict=True))
        alike: dict[tuple, list[int]] = {(): list(range(len(names)))}
        if any(b.coefficient.per for b in made.layout.blocks if b.place != "input"):
            alike = {}  # unknowns are called after the members of groups, each device's own
            for i, own in enumerate(levels):
                alike.setdefault(tuple(own.items()), []).append(i)
        for members in alike.values():
            own = tuple(_unknowns(made.layout, levels[members[0]]))
            some = [names[i] for i in members], made.mean[members], made.covariance[members]
            self._found.setdefault(own, []).append(some)

    def parts(self, devices: Sequence[str]) -> list[BatchPart]:
        """All unknowns with their moments, in the order of the devices."""
        places = {name: i for i, name in enumerate(devices)}
        parts = []
        for own, pieces in self._found.items():
            names, means, covariances = zip(*pieces, strict=True)
            at = np.array([places[name] for some in names for name in some], dtype=int)
            order = np.argsort(at)
            mean, covariance = np.concatenate(means)[order], np.concatenate(covariances)[order]
            called, units = zip(*own, strict=True) if own else ((), ())
            parts.append(BatchPart(at[order], called, units, mean, covariance))
        return parts


def _unknowns(layout: Layout, levels: Levels) -> list[tuple[str, str]]:
    """(name, unit) of every unknown, in the order of `_Solved.mean`."""
    unknowns = []
    for b in layout.blocks:
        if b.place in ("x", "phi"):
            unknowns += [(name, b.coefficient.unit) for name in b.member_names(levels)]
    return unknowns + [(h.name, h.unit) for h in layout.hypers if h.kind != "promoted"]


def _in_closed_form(stack: DeviceStack) -> _Solved:
    padded, few = stack.padded(), len(stack.devices)
    y, real = jnp.asarray(padded.y), jnp.asarray(padded.real)
    solved = solve_in_closed_form(stack.layout, padded.frame, y, real)
    line = jax.tree.map(lambda a: np.asarray(a)[:few], solved)
    known = NOISE in dict(stack.layout.model.fixed)
    mean, covariance = line.x, line.covariance
    if not known:
        mean = np.column_stack([line.x, line.noise])
        covariance = _held(covariance, range(line.x.shape[1]), mean.shape[1])
    reasons = np.where(line.scatter | known, "", NO_SCATTER)
    reasons = np.where(line.determined, reasons, trust.SINGULAR).tolist()
    return _Solved(stack.layout, mean, covariance, reasons)


def _held(covariance: np.ndarray, free: Sequence[int], size: int) -> np.ndarray:
    """Covariances (b, q, q) of all unknowns from those of the free ones; NaN for what is held at its estimate."""
    whole = np.full((len(covariance), size, size), np.nan)
    whole[:, np.array(free)[:, None], free] = covariance
    return whole


def _by_least_squares(one: DeviceFrame, method: LeastSquares) -> _Solved:
    """`LeastSquares` itself."""
    layout, places = one.layout, one.layout.positions("shape", "promoted")
    problem = Problem(layout, Record(layout.model.instrument, one.frame, one.y))
    solution = least_squares.solution_on(problem, method.curvature == "hessian")
    v, priors = solution.mode.v, [h.prior for h in layout.hypers]
    ends = [[float(priors[i].value(v[i] + d)) for d in (-NUDGE, NUDGE)] for i in places]
    slopes = np.append(np.ones(layout.size), [(b - a) / (2 * NUDGE) for a, b in ends])
    values = [float(prior.value(own)) for prior, own in zip(priors, v, strict=True)]
    mean = np.append(solution.mode.x, values)
    covariance = slopes[:, None] * np.asarray(solution.covariance) * slopes
    free = [*range(layout.size), *(layout.size + i for i in places)]
    reason = "" if solution.converged else trust.NOT_CONVERGED
    if not (np.all(np.isfinite(covariance)) and np.all(np.isfinite(mean))):
        reason = trust.SINGULAR
    whole = _held(covariance[None], free, len(mean))
    return _Solved(layout, mean[None], whole, [reason], (HELD,) if places else ())


def _by_sampling(one: DeviceFrame, method: Marginal, seed: int, notes: tuple[str, ...]) -> _Solved:
    """`Marginal` by importance sampling; where its weights fail, the verdict says so."""
    problem = Problem(one.layout, Record(one.layout.model.instrument, one.frame, one.y))
    own = int(np.random.SeedSequence([seed, one.device]).generate_state(1)[0])
    draws = weighted_draws(problem, find_mode(problem), own, method.proposals, method.rounds)
    weights, k_hat = _weights(draws.log_weight)
    values = _values(one.layout, draws.x, draws.v)
    mean = weights @ values
    apart = values - mean
    covariance = (weights[:, None] * apart).T @ apart
    reason = "" if np.all(np.isfinite(mean)) else trust.SINGULAR
    if not reason and (why := trust.unevenness(weights, k_hat)):
        reason = f"Importance weights were uneven ({why}): fit this device by bc.fit, which goes over to NUTS."
    return _Solved(one.layout, mean[None], covariance[None], [reason], notes)


def _weights(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    if not np.any(np.isfinite(log_weight)):
        return np.full(log_weight.size, np.nan), np.inf
    return smoothed(np.where(np.isfinite(log_weight), log_weight, -1e300))


def _values(layout: Layout, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """All unknowns of draws (s, q), in the order of `_unknowns`."""
    hyper = {h.name: np.asarray(h.prior.value(v[:, i])) for i, h in enumerate(layout.hypers)}
    parts = []
    for b in layout.blocks:
        if b.place == "x":
            parts.append(x[:, b.start : b.start + b.size])
        elif b.place == "phi":
            value = np.stack([hyper[name] for name in b.member_names()], axis=1)
            if b.coefficient.group_sd is not None:
                value = b.coefficient.mean + hyper[b.group_sd_name][:, None] * value
            parts.append(value)
    parts += [hyper[h.name][:, None] for h in layout.hypers if h.kind != "promoted"]
    return np.concatenate(parts, axis=1)
