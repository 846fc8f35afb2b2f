"""Many devices of one type, each by itself: what `fit` gives of it, one by one or all at once.

A device is fitted by `fit`: its result is the mean and covariance of that posterior, and what stands against it. Least
squares of plain devices, against which nothing can stand, has a closed form but for one number, the noise, that gives
the same: the expected output is affine in the coefficients, their priors are fixed, the noise is white. The readings
enter through R of the QR factors of [J_flat, J·s, r] alone (s: prior standard deviations), and through the singular
values d of its block of proper columns. The restricted likelihood of the noise σ is then a sum of p terms,

    −2 log L(σ) = (n − f) log σ² + ρ²/σ² + Σ log(1 + d²/σ²) + c²/(σ² + d²)

with ρ what no column explains, c the readings along the singular vectors and f the number of flat coefficients. Its
maximum is that of `LeastSquares`, and so are the coefficients at it and their covariance. A device is no plain one
where it has several maxima or a coefficient stands far from its prior's mean (the noise may take up what a prior
forbids), where outputs are so far from the model's mean that digits are lost, and where a unit may be wrong.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).

There frames of many devices are stacked, so that one compiled program sees them all. A table without time and without
groups becomes a stack of frames by a few array operations; else frames are built one by one. Devices with other numbers
of readings are padded to a common one; a padded reading repeats the last and counts nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
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
    Calibration,
    Frame,
    InputError,
    LeastSquares,
    Marginal,
    Measurements,
    Model,
    fit,
)
from bayescal._annexes.fleet.batch_result import BatchPart, BatchResult
from bayescal._annexes.fleet.devices import DEVICE, DeviceBlock, Devices, joined
from bayescal._calibration.claim import Claim
from bayescal._calibration.judgement import noiseless
from bayescal._core import deadline
from bayescal._core.jit import compiled
from bayescal._core.settings import unusual
from bayescal._inference import sampled_products
from bayescal._inference.method import Method
from bayescal._model import forward
from bayescal._model.frame import (
    GROUPS,
    build_frame,
    reference_name,
    reference_of,
    rounded_means,
)
from bayescal._model.parameters import Layout, bind
from bayescal._model.unknowns import Unknowns
from bayescal.workshop import UNCERTAINTY

Reference = dict[str, Any]  # constants of bases

PLAIN_SD = 3.0  # prior standard deviations that a coefficient stands from its prior's mean, at most
PLAIN_SHARE = 1e-5  # of two sizes, above which neither is in a wrong unit
PLAIN_DIGITS = 1e6  # times the noise, up to which an output keeps enough of its digits
GRID = 32  # starts for log σ², among which the best one's neighbours bracket the maximum
NEWTON_STEPS = 10  # safeguarded Newton steps in the bracket, to the last digits
LEAST_NOISE = 1e-24  # share of the readings' variance, below which the noise counts as none
NOISE = "noise.white"
NOT_REACHED = "not reached ({}): give more time"


class ClosedFormFit(NamedTuple):
    """What least squares finds of one device: x̂, its covariance, σ, and whether it is a plain one."""

    x: Float[Array, "p"]
    covariance: Float[Array, "p p"]
    noise: Float[Array, ""]
    plain: Array


def has_closed_form(layout: Layout, frame: Frame) -> bool:
    """Return whether the model is of this kind for readings like these."""
    noise = layout.model.noise
    return (
        noise.first
        and all(h.kind == "noise" for h in layout.hypers)
        and layout.size > 0
        and all(b.place != "input" and b.coefficient.per is None for b in layout.blocks)
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
    count, fixed = jnp.sum(real), dict(layout.model.fixed)
    if NOISE in fixed:
        variance, maxima = jnp.asarray(fixed[NOISE]) ** 2, 1
    else:
        log_variance, maxima = _log_variance(count - f, rest, c**2, d2)
        variance = jnp.exp(log_variance)
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
    noise = jnp.sqrt(variance)
    reach = jnp.max(jnp.abs(line.jacobian * scale), axis=0)[places][f:]  # at plausible sizes
    largest, range_ = jnp.max(jnp.abs(y)), jnp.max(y) - jnp.min(y)
    plain = [
        count > p,
        maxima == 1,
        jnp.max(jnp.abs(z), initial=0.0) < PLAIN_SD,
        # Flat columns have length one: a diagonal of R near zero is a direction that nothing determines.
        jnp.all(jnp.abs(jnp.diag(left)) > PLAIN_SHARE) & jnp.all(norm > 0),
        (rest > LEAST_NOISE * jnp.sum(upper[:, p] ** 2)) & (noise < range_),
        jnp.all((PLAIN_SHARE * reach < noise) & (PLAIN_SHARE * noise < reach)),
        PLAIN_DIGITS * jnp.minimum(noise, range_)
        > jnp.maximum(largest, jnp.max(jnp.abs(y - line.mean))),
    ]
    return ClosedFormFit(
        x=centre + scale * value,
        covariance=scale[:, None] * covariance * scale,
        noise=noise,
        plain=jnp.all(jnp.array(plain)) & jnp.all(jnp.isfinite(value)),
    )


def _triangle(table: Float[Array, "n q"]) -> Float[Array, "q q"]:
    """R of the QR factors up to the signs of its rows, square however few rows there are."""
    upper = jnp.linalg.qr(table, mode="r")
    return jnp.pad(upper, ((0, table.shape[1] - upper.shape[0]), (0, 0)))


def _log_variance(
    count: Array, rest: Array, c2: Float[Array, "m"], d2: Float[Array, "m"]
) -> tuple[Array, Array]:
    """Return where the restricted likelihood of t = log σ² is greatest, and how many maxima it has.

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
    values = jax.vmap(value)(grid)
    rises = jnp.diff(values) > 0
    maxima = jnp.sum(rises[:-1] & ~rises[1:]) + ~rises[0] + rises[-1]
    best = jnp.argmax(values)
    low, high = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, GRID - 1)]

    def closer(_, state):
        t, low, high = state
        first, second = slopes(t)
        low, high = jnp.where(first > 0, t, low), jnp.where(first > 0, high, t)
        step = t - first / jnp.where(second < 0, second, -1.0)
        inside = (step >= low) & (step <= high) & (second < 0)
        return jnp.where(inside, step, 0.5 * (low + high)), low, high

    return jax.lax.fori_loop(0, NEWTON_STEPS, closer, (grid[best], low, high))[0], maxima


STEP = 1.25  # from one padded number of readings to the next
NUMBERS = 2_000_000  # readings in one stack at most


class DeviceStack(NamedTuple):
    """Devices of one shape, as the closed form takes them.

    Attributes:
        devices: their indices in the block, (b,).
        layout: where the unknowns of each stand.
        frame: what the effects see; leaves (b, …).
        y: outputs, (b, n).
        real: 1 where a reading is one, 0 where it is padding, (b, n).
    """

    devices: np.ndarray
    layout: Layout
    frame: Frame
    y: np.ndarray
    real: np.ndarray

    def solved(self) -> ClosedFormFit:
        """Solve all devices: arrays of NumPy, (b, …).

        The last device is repeated so that few programs are compiled: at most an eighth above 64.
        """
        few = len(self.devices)
        step = max(64, 1 << max((few - 1).bit_length() - 4, 0))
        many = 1 << (few - 1).bit_length() if few < 64 else -(-few // step) * step
        pick = np.minimum(np.arange(many), few - 1)
        frame = jax.tree.map(lambda a: np.asarray(a)[pick], self.frame)
        padded = jnp.asarray(self.y[pick]), jnp.asarray(self.real[pick])
        found = solve_in_closed_form(self.layout, frame, *padded)
        return jax.tree.map(lambda a: np.asarray(a)[:few], found)


def devices_alone(model: Model, block: DeviceBlock, reference: Reference) -> Iterator[DeviceStack]:
    """Yield the devices of a block that the model can be bound to, one by one."""
    for i in range(len(block.names)):
        readings = block.measurements(i)
        with suppress(BayescalError):  # whoever fits it says why
            model.require(readings)
            layout = bind(model, readings)[0]
            frame = build_frame(readings, {**reference_of(readings), **reference})
            frame = jax.tree.map(lambda a: np.asarray(a)[None], frame)
            y = np.asarray(readings["output"])[None]
            yield DeviceStack(np.array([i]), layout, frame, y, np.ones_like(y))


def stacks(
    model: Model, block: DeviceBlock, reference: Reference, most: int
) -> Iterator[DeviceStack]:
    """Yield the devices of a block by shape, at most so many at once."""
    labels = {name for name, unit in block.units.items() if unit is None}
    if labels <= {DEVICE} and not {"time", "temperature_point"} & block.values.keys():
        yield from _stacks_of_numbers(model, block, reference, most)
        return
    waiting: dict[tuple, list[DeviceStack]] = {}
    for one in devices_alone(model, block, reference):
        kind = (str(jax.tree.map(jnp.shape, one.frame)), one.layout.counts)
        waiting.setdefault(kind, []).append(one)
        if len(waiting[kind]) >= min(most, NUMBERS // max(1, one.y.size)):
            yield _joined(waiting.pop(kind))
    yield from map(_joined, waiting.values())


def _joined(some: Sequence[DeviceStack]) -> DeviceStack:
    devices, layouts, each, ys, real = zip(*some, strict=True)
    frame = jax.tree.map(lambda *a: np.concatenate(a), *each)
    at, y, real = map(np.concatenate, (devices, ys, real))
    return DeviceStack(at, layouts[0], frame, y, real)


def _stacks_of_numbers(
    model: Model, block: DeviceBlock, reference: Reference, most: int
) -> Iterator[DeviceStack]:
    """Yield devices whose frames need nothing but their numbers: no time, no groups, no labels."""
    rungs = np.array([_rung(int(n)) for n in range(int(block.counts.max()) + 1)])[block.counts]
    constants = {name: v for name, v in reference.items() if not isinstance(v, dict)}
    members = {g: 0 if g == "cell" else 1 for g in GROUPS}
    layout = Layout(model, tuple(members.items()))
    rungs[block.counts <= layout.size] = 0  # no plain ones
    for rung in np.unique(rungs[rungs > 0]).tolist():
        alike = np.flatnonzero(rungs == rung)
        at_once = max(1, min(most, NUMBERS // rung))
        for begin in range(0, len(alike), at_once):
            some = alike[begin : begin + at_once]
            columns, real, scalars = _matrices(block, some, rung)
            shape = real.shape
            frame = Frame(  # NumPy arrays, until they are fitted
                columns=columns,
                labels={},
                rates={},
                codes={g: np.full(shape, count - 1) for g, count in members.items()},
                reference={**scalars, **{n: np.full(len(some), v) for n, v in constants.items()}},
                order=np.broadcast_to(np.arange(rung), shape),
                step=-np.ones(shape),
                record=dict(columns),
                silence=np.full(len(some), np.inf),
            )
            yield DeviceStack(some, layout, frame, columns["output"], real)


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


@dataclass(frozen=True)
class FitOptions:
    """How every device is fitted.

    Attributes:
        method: of every fit.
        seed: of every random number.
        chunk: devices fitted at once at most.
        reference: constants of the bases, in place of each device's own.
    """

    method: Method
    seed: int = 0
    chunk: int = CHUNK
    reference: Reference = field(default_factory=dict)

    @classmethod
    def of(
        cls, method: Method | None, seed: int, chunk: int, reference: Reference | None
    ) -> FitOptions:
        """As a user gives them; chains of single devices, minutes each, are left to `fit`.

        Raises:
            InputError: `chunk` is none.
        """
        if chunk < 1:
            raise InputError(f"chunk is {chunk}: give at least 1")
        method = method or LeastSquares()
        method = replace(method, chains=False) if isinstance(method, Marginal) else method
        return cls(method, seed, chunk, dict(reference or {}))

    def with_common(self, reference: Reference) -> FitOptions:
        """With further constants, where none were given."""
        return replace(self, reference={**reference, **self.reference})

    def compared_at(self, facts: pd.DataFrame) -> FitOptions | None:
        """Return how devices are fitted to be compared, at one temperature; None where they are so already."""
        known = facts.loc[:, "T0"].dropna()
        if "T0" in self.reference or known.nunique() < 2:
            return None
        return replace(
            self.with_common({"T0": float(known.median().round())}), method=LeastSquares()
        )

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


def tailored_to_first(model: Model, devices: Iterable[Measurements]) -> Model:
    """Return the model tailored to the first device that it can be tailored to; as it is where there is none.

    Raises:
        InputError: no device has what the instrument takes from readings: why, of the first.
    """
    refusals: list[InputError] = []
    for readings in devices:
        try:
            return tailored(model, readings)
        except InputError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]
    return model


@dataclass
class Fits:
    """Fits of devices as they come in.

    Attributes:
        options: of every fit.
        names: of all devices, in their order.
        reasons: name → what stands against a device; refused ones too.
        facts: name → how many readings were fitted, and T0, °C.
        moments: names and units of unknowns → devices that have them, their means and covariances.
        places: devices by the file that they stand in.
        missing: file → why its devices have no results.
        structures: of the devices that were searched.
    """

    options: FitOptions
    names: list[str] = field(default_factory=list)
    reasons: dict[str, str] = field(default_factory=dict)
    facts: dict[str, tuple[float, float]] = field(default_factory=dict)
    moments: dict[tuple[tuple[str, ...], tuple[str, ...]], list[tuple]] = field(
        default_factory=dict
    )
    places: dict[str, tuple[str, ...]] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    structures: dict[str, Any] = field(default_factory=dict)

    def fit_groups(self, groups: Sequence[tuple[Model, Devices]]) -> None:
        """Fit groups of devices, each with a model of its own; those that the deadline leaves out are refused."""
        with suppress(deadline.TimeIsUp):
            for model, devices in groups:
                for block in joined(devices.blocks):
                    self.fit(model, block)
        late = NOT_REACHED.format(deadline.current().why)
        missing = [n for n in self.names if n not in self.facts and n not in self.reasons]
        self.reasons |= dict.fromkeys(missing, late)

    def extend(self, other: Fits) -> None:
        """Append the fits of other devices."""
        self.names += other.names
        for name in ("reasons", "facts", "places", "missing", "structures"):
            getattr(self, name).update(getattr(other, name))
        for kind, moments in other.moments.items():
            self.moments.setdefault(kind, []).extend(moments)

    def refuse(self, reasons: Mapping[str, str]) -> None:
        """Refuse devices that were fitted."""
        self.names = [*dict.fromkeys(self.names)]
        self.reasons |= reasons
        self.facts = {name: own for name, own in self.facts.items() if name not in reasons}
        for kind, moments in self.moments.items():
            keep = [
                np.array([n not in reasons for n in names], dtype=bool) for names, *_ in moments
            ]
            self.moments[kind] = [
                ([n for n, k in zip(names, own, strict=True) if k], mean[own], covariance[own])
                for own, (names, mean, covariance) in zip(keep, moments, strict=True)
            ]

    def result(self, model: Model) -> BatchResult:
        """Return all devices in their order."""
        names, reasons = tuple(self.names), self.reasons
        return BatchResult(
            devices=names,
            ok=np.array([not reasons.get(name) for name in names], dtype=bool),
            reasons=tuple(reasons.get(name, "") for name in names),
            parts=self._parts(names),
            population=None,
            about=self.options.data(model),
            facts=pd.DataFrame.from_dict(
                self.facts, "index", dtype=float, columns=["readings", "T0"]
            ).reindex(names),
        )

    def fit(self, model: Model, block: DeviceBlock) -> None:
        """Fit every device of a block that can be fitted: plain ones all at once, the others one by one."""
        alone = np.ones(len(block.names), dtype=bool)
        given = model, block, self.options.reference
        if isinstance(self.options.method, LeastSquares) and self._may_be_plain(*given):
            for stack in stacks(*given, self.options.chunk):
                found = stack.solved()
                alone[stack.devices[found.plain]] = False
                self._keep_plain(model, block, stack, found)
                deadline.current().ask()
        for i in np.flatnonzero(alone).tolist():
            self._fit_alone(model, block.names[i], block.measurements(i))
            deadline.current().ask()

    @staticmethod
    def _may_be_plain(model: Model, block: DeviceBlock, reference: Reference) -> bool:
        """Return whether nothing but the model's own effects may have acted on the outputs, and these linearly."""
        first = next(devices_alone(model, block, reference), None)
        known = {c.name for c in model.instrument.columns} | model.columns
        numbers = {name for name, unit in block.units.items() if unit is not None}
        if first is None or not numbers <= known:
            return False
        shown = model.with_nuisances(block.measurements(int(first.devices[0])))
        frame = jax.tree.map(lambda a: jnp.asarray(a[0]), first.frame)
        return shown is model and has_closed_form(first.layout, frame)

    def _keep_plain(
        self, model: Model, block: DeviceBlock, stack: DeviceStack, found: ClosedFormFit
    ) -> None:
        plain, layout = found.plain, stack.layout
        names = [block.names[i] for i in stack.devices[plain]]
        t0 = np.broadcast_to(stack.frame.reference.get("T0", np.nan), plain.shape)[plain]
        self.facts |= zip(names, zip(stack.real.sum(axis=1)[plain], t0, strict=True), strict=True)
        unknowns = Unknowns.of(layout)
        mean, covariance = (np.asarray(a)[plain] for a in (found.x, found.covariance))
        if NOISE not in dict(model.fixed):
            mean = np.column_stack([mean, found.noise[plain]])
            covariance = np.pad(covariance, ((0, 0), (0, 1), (0, 1)), constant_values=np.nan)
        self._keep(names, unknowns, mean, covariance)

    def _fit_alone(self, model: Model, name: str, readings: Measurements) -> None:
        """Fit one device by `fit`: the moments of its posterior, and what stands against it."""
        options = self.options
        known = reference_of(readings)
        reference = {n: value for n, value in options.reference.items() if n in known}
        how: dict[str, Any] = {"seed": options.seed, "reference": reference}
        try:
            found = fit(model, readings, options.method, strict=False, **how)
        except BayescalError as error:
            self.reasons[name] = str(error)
            return
        self.facts[name] = len(readings), float(found.reference.get("T0", np.nan))  # pyright: ignore
        table = found.values.reshape(-1, len(found.unknowns))
        covariance = np.atleast_2d(np.cov(table.T))
        held = np.ptp(table, axis=0) == 0
        covariance[held], covariance[:, held] = np.nan, np.nan
        self._keep([name], found.unknowns, table.mean(axis=0)[None], covariance[None])
        if why := " ".join(self._against(found)):
            self.reasons[name] = why

    @staticmethod
    def _against(found: Calibration) -> Sequence[Any]:
        """Return what stands against a device that was fitted by itself."""
        if not found.verdict.ok:
            return found.verdict.reasons
        free = found.layout.size
        if NOISE not in dict(found.model.fixed) and len(found.readings) <= free:
            return [Claim("readings.too_few", count=len(found.readings), free=free)]
        return [said] if (said := noiseless(found)) else found.conflicts

    def _keep(
        self,
        devices: Sequence[str],
        unknowns: Unknowns,
        mean: np.ndarray,
        covariance: np.ndarray,
    ) -> None:
        deadline.current().defer_interrupt()
        key = unknowns.names, unknowns.units
        self.moments.setdefault(key, []).append((devices, mean, covariance))

    def _parts(self, devices: Sequence[str]) -> tuple[BatchPart, ...]:
        """Return all unknowns with their moments, in the order of the devices."""
        places = {name: i for i, name in enumerate(devices)}
        parts = []
        for (called, units), pieces in self.moments.items():
            names, means, covariances = zip(*pieces, strict=True)
            at = np.array([places[name] for some in names for name in some], dtype=int)
            order = np.argsort(at)
            mean, covariance = np.concatenate(means)[order], np.concatenate(covariances)[order]
            if len(at):
                parts.append(BatchPart(at[order], called, units, mean, covariance))
        return tuple(parts)
