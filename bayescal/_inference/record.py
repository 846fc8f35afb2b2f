"""A record: one set of readings as the engine sees them, with every column that was computed for it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from jaxtyping import Float, Int

from bayescal._core.errors import ModelError
from bayescal._core.lazy_jax import jax
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import Measurements
from bayescal._inference import programs
from bayescal._inference.column_table import ColumnTable
from bayescal._inference.expansion import Expansions
from bayescal._inference.host_columns import HostColumns
from bayescal._inference.noise_nodes import AlongColumn, OneNode, in_frequency
from bayescal._model.channel_at_rest import CHANNEL
from bayescal._model.composition import find_response_columns
from bayescal._model.effect import Basis, Effect
from bayescal._model.frame import PATH, Frame, Reference, build_frame
from bayescal._model.instrument import Instrument
from bayescal._model.noise_law import Noise
from bayescal._model.terms import ColumnSpec

KEPT_BYTES = 256 * 2**20  # of columns at shapes, of which the latest are kept; and of expansions
DIFFERENCE = 1e-4  # of the range of a column, for slopes by it
AFFINE = 1e-9  # change of a slope, relative to the largest, up to which it does not change
DRAWS_A_CALL = 48  # draws in one call of a program, or half of that,
CALL_NUMBERS = 16_384  # and more of a short record: draws times readings, up to which the call itself is what costs

Arrays = Mapping[str, np.ndarray]  # by name of a slot or column: (n,), or (b, n) for b draws


@dataclass(eq=False)
class Record:
    """Readings of one instrument (outputs y are (n,)), with their columns and slopes."""

    instrument: Instrument
    frame: Frame
    y: np.ndarray
    _fixed: dict[Basis, np.ndarray] = field(default_factory=dict)
    _shaped: OrderedDict[Any, np.ndarray] = field(default_factory=OrderedDict)
    _bytes: int = 0
    _expansions: dict[Any, Expansions] = field(default_factory=dict)
    _nodes: dict[Any, OneNode | None] = field(default_factory=dict)
    _last: tuple[Any, Any] | None = None  # slots, and what the instrument responded to them
    _for_laws: dict[Noise, tuple[Noise, Frame]] = field(default_factory=dict)
    of: Any = None  # what it was made of, held

    @cached_property
    def size(self) -> int:
        return self.frame.size

    @cached_property
    def padded(self) -> Frame:
        of = self.of
        if isinstance(of, Record) and of.frame is self.frame:
            return of.padded
        return programs.padded(self.frame)

    @cached_property
    def on_host(self) -> HostColumns:
        return HostColumns(self.frame)

    def for_law(self, law: Noise) -> tuple[Noise, Frame]:
        """Return a noise law and its part of the readings, padded and in its order, for programs.

        Each array that is handed to a program costs as much as small programs compute in.
        """
        if law not in self._for_laws:
            frame = self.frame.only(law.needs)
            frame = programs.padded(frame if law.independent else frame.in_time())
            self._for_laws[law] = law.plain, frame
        return self._for_laws[law]

    def with_frame(self, frame: Frame | None = None) -> Record:
        """Return the same readings as a further record, with shared fixed columns, or another frame."""
        shared = {"_fixed": self._fixed, "of": self}
        record = Record(self.instrument, self.frame if frame is None else frame, self.y, **shared)
        if frame is None:
            same = {"_for_laws": self._for_laws, "_nodes": self._nodes}
            vars(record).update(codes=self.codes, on_host=self.on_host, **same)
        return record

    def require_finite(self, effects: Iterable[Effect]) -> None:
        """Refuse effects of the user's own that divide by zero, or take the root of a negative number, in a reading.

        Raises:
            ModelError: so one does, at the middle of its shapes.
        """
        catalogue, affected = self.instrument.known, self.instrument.shown_by(self.frame, effects)
        for effect in (e for e in affected if not (e.name in catalogue or e.is_placeholder)):
            of = ColumnSpec.from_effect(effect)
            middle = tuple(float(prior.value(0.0)) for prior in of.priors)
            lost = np.flatnonzero(~np.isfinite(self.columns(of, middle)).all(axis=1))
            if not len(lost):
                continue
            columns = [c for c in effect.columns if c in self.frame.columns]
            at = ", ".join(f"{c} {self.frame[c][lost[0]]:.6g}" for c in columns)
            raise ModelError(
                f"Effect {effect.name!r} is not finite in {len(lost)} of {self.size} readings, first in reading "
                f"{lost[0] + 1} ({at}): look where it divides by zero, or takes the root of a negative number"
            )

    def of_noise(self, residual: Float[np.ndarray, "n"]) -> Record:
        """Return residuals as the record of a channel at rest: to fit noise alone."""
        record = Record(CHANNEL, self.frame, residual, _for_laws=self._for_laws, _nodes=self._nodes)
        channel = {slot: np.ones(self.size) for slot in record.slots}
        vars(record)["affine"] = np.zeros(self.size), channel  # nothing to compile
        return record

    @cached_property
    def codes(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(codes, dtype=np.intp) for name, codes in self.frame.codes.items()}

    @cached_property
    def in_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the order of time within runs, and the steps in it, s; −1 at a run's first reading."""
        return np.asarray(self.frame.order), np.asarray(self.frame.step)

    @cached_property
    def ordered(self) -> bool:
        """Return whether readings stand in the order of time already."""
        return bool(np.all(np.diff(self.in_time[0]) == 1))

    @cached_property
    def table(self) -> ColumnTable:
        """Return the columns of an affine output that structures share, with products at nodes of noise laws."""
        return ColumnTable(self.y - self.affine[0])  # pyright: ignore[reportOptionalSubscript]

    def forget(self) -> None:
        """Forget columns at shapes and the shared table; they are made anew on demand."""
        self._shaped, self._bytes, self._expansions = OrderedDict(), 0, {}
        if self.affine is not None:
            self.table.forget()

    def expansions(self, effect: ColumnSpec, fixed: tuple[float | None, ...]) -> Expansions:
        """Return an effect's columns as functions of the coordinates of its free shapes; the others are `fixed`."""
        key = effect.key, fixed
        if sum(e.nbytes for e in self._expansions.values()) > KEPT_BYTES:
            self._expansions.clear()
        if key not in self._expansions:

            def columns(v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s n k"]:
                if not fixed:
                    return self.columns(effect, ())[None]
                along = iter(v.T)
                values = [
                    np.full(len(v), h) if h is not None else prior.value(next(along))
                    for h, prior in zip(fixed, effect.priors, strict=True)
                ]
                return self._computed(effect, values, {})

            self._expansions[key] = Expansions(columns, sum(h is None for h in fixed))
        return self._expansions[key]

    def nodes(self, law: Noise) -> OneNode | None:
        """Return the nodes at which products tell all settings of a noise law; None where none do."""
        place = law.variance_place(self.frame)
        if law.even(self.frame):
            key: Any = "even"
        elif place is not None:
            key = place.tobytes()
        elif UNCERTAINTY in self.frame.columns or not law.stationary:
            return None
        else:
            key = "in frequency"
        if key not in self._nodes:
            if key == "even":
                self._nodes[key] = OneNode(self.size)
            elif place is not None:
                self._nodes[key] = AlongColumn(place)
            else:
                self._nodes[key] = in_frequency(*self.in_time)
        return self._nodes[key]

    @cached_property
    def read(self) -> frozenset[str]:
        """Return the columns that the response reads itself."""
        if isinstance(self.of, Record):
            return self.of.read
        return find_response_columns(self.instrument, self.frame)

    @cached_property
    def slots(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.instrument.slots)

    @property
    def _what(self) -> programs.Responding:
        return programs.Responding(self.instrument.response, self.instrument.vector is not None)

    def columns(self, effect: ColumnSpec, values: tuple[float, ...]) -> Float[np.ndarray, "n k"]:
        """Return an effect's columns at values of its shapes, on the readings as measured; read-only."""
        if not effect.shapes:
            if effect.basis not in self._fixed:
                self._fixed[effect.basis] = self.on_host.at(effect.basis, {}, {})
            return self._fixed[effect.basis]
        key = (effect.key, values)
        columns = self._shaped.pop(key, None)
        if columns is None:
            columns = self._computed(effect, [np.array([v]) for v in values], {})[0]
            self._bytes += columns.nbytes
            while self._bytes > KEPT_BYTES and self._shaped:
                self._bytes -= self._shaped.popitem(last=False)[1].nbytes
        self._shaped[key] = columns
        return columns

    def respond(
        self, slots: Arrays, shifts: Arrays, with_grad: bool = True
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        """Return expected output, and slopes by each slot and moved column, (n,) or of draws (b, n) each."""
        if not shifts and self.affine is not None:
            base, slopes = self.affine
            return sum((slopes[name] * value for name, value in slots.items()), base), slopes
        if self._host_affine is not None:
            return self._moved(slots, shifts) if with_grad else (self._respond(slots, shifts), {})
        if not any(np.ndim(v) > 1 for v in (*slots.values(), *shifts.values())):
            return self._response(slots, shifts)
        if with_grad:
            return self._together(programs.slopes_of_draws, self._what, slots, shifts)
        return self._together(programs.responses, self.instrument.response, slots, shifts), {}

    def _respond(self, slots: Arrays, shifts: Arrays) -> Any:
        """Return the response by NumPy, columns of the readings moved."""
        all_slots = {name: slots.get(name, np.zeros(self.size)) for name in self.slots}
        output = self.instrument.response(all_slots, self.frame.moved(shifts))
        return np.broadcast_to(output, np.broadcast_shapes(np.shape(output), (self.size,)))

    def _moved(
        self, slots: Arrays, shifts: Arrays
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        """Return an affine output and its slopes by NumPy: complex steps by slots, differences by shifts."""
        slopes = {n: self._respond({n: np.full(self.size, 1j)}, shifts).imag for n in self.slots}
        for name, shift in shifts.items():
            h = self._difference(name)
            up, down = (self._respond(slots, {**shifts, name: shift + s}) for s in (h, -h))
            slopes[name] = (up - down) / (2 * h)
        return self._respond(slots, shifts), slopes

    def _difference(self, column: str) -> float:
        """Return a step for slopes by a column."""
        return DIFFERENCE * (float(np.ptp(self.frame[column.removesuffix(PATH)])) or 1.0)

    def _response(self, slots, shifts):
        """Return the response and its slopes at some slots and shifts; the last one is cached."""
        key = [(name, np.asarray(v).tobytes()) for name, v in (*slots.items(), *shifts.items())]
        last = self._last
        if last is None or last[0] != key:
            full = {name: slots.get(name, np.zeros(self.size)) for name in self.slots}
            padded = ({n: self.longer(v) for n, v in arrays.items()} for arrays in (full, shifts))
            outputs = programs.response_slopes(self._what, self.padded, *padded)
            self._last = last = key, jax.tree.map(lambda a: np.asarray(a)[: self.size], outputs)
        return last[1]

    @cached_property
    def affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """Return the response at empty slots and its slopes, where it is affine in the slots; else None.

        Tried at two random sets of slots.
        """
        if isinstance(self.of, Record):
            return self.of.affine
        if (host := self._host_affine) is not None:
            return host
        base, slopes = self._response({}, {})
        for slots in self._random_slots(slopes):
            _, slopes_there = self._response(slots, {})
            for name in self.slots:
                scale = np.max(np.abs(slopes[name]), initial=0.0)
                change = np.abs(slopes_there[name] - slopes[name])
                # not "larger than": outside of an arcsine there is no slope to compare
                if not np.max(change, initial=0.0) <= AFFINE * scale:
                    return None
        return base, slopes

    @cached_property
    def _host_affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """Return `affine` by NumPy; None where the response is JAX's, or not affine."""
        if isinstance(self.of, Record):
            return self.of._host_affine
        try:
            with np.errstate(all="ignore"):
                base, slopes = self._moved({}, {})
                for slots in self._random_slots(slopes):
                    change = sum((slopes[n] * v for n, v in slots.items()), np.zeros(self.size))
                    miss = np.abs(self._respond(slots, {}) - base - change)
                    if not np.max(miss) <= AFFINE * np.max(np.abs(change)):
                        return None
        except Exception:  # of numbers that it cannot take
            return None
        return base, slopes

    def _random_slots(self, slopes: Mapping[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
        """Yield two random sets of slot values, scaled to change the output by its range, to test for affinity."""
        random, reach = np.random.default_rng(0), float(np.ptp(self.y)) or 1.0
        steep = {n: float(np.max(np.abs(slope), initial=0.0)) for n, slope in slopes.items()}
        size = {n: min(1.0, reach / s) if s > 0 else 1.0 for n, s in steep.items()}
        for _ in range(2):
            yield {n: size[n] * random.standard_normal(self.size) for n in self.slots}

    def columns_of_draws(
        self, effect: ColumnSpec, values: Sequence[Any], shifts: Arrays
    ) -> Float[np.ndarray, "*b n k"]:
        """Return an effect's columns for several draws; (n, k) where nothing depends on the draw.

        Values of its shapes are (b,) each, or one number for all; columns of the readings are moved by (b, n) each.
        """
        if not values and not shifts:
            return self.columns(effect, ())
        count = max((len(v) for v in shifts.values()), default=1)
        values = np.broadcast_arrays(*values, np.zeros(count))[:-1]
        return self._computed(effect, values, shifts)

    def _computed(self, effect: ColumnSpec, values: Sequence[np.ndarray], shifts) -> Any:
        count = max(len(v) for v in (*values, *shifts.values()))
        for name, shift in self._corrected(effect, values).items():
            shifts = {**shifts, name: shifts.get(name, 0.0) + shift}
        pairs = zip(effect.basis_shapes, values, strict=False)
        shapes = {n: np.broadcast_to(v, (count,)) for n, v in pairs}
        return self.on_host.along(effect.basis, shapes, shifts)

    def _corrected(
        self, effect: ColumnSpec, values: Sequence[Any]
    ) -> dict[str, Float[np.ndarray, "*b n"]]:
        """Return the shifts of the columns that an effect depends on, at values of its shapes."""
        shifts, at = dict[str, np.ndarray](), len(effect.basis_shapes)
        for c in effect.corrections:
            shapes, at = values[at : at + len(c.spec.shapes)], at + len(c.spec.shapes)
            if any(np.ndim(v) for v in shapes):
                columns = self.columns_of_draws(c.spec, shapes, {})
            else:  # one draw: cached
                columns = self.columns(c.spec, tuple(shapes))
            shift = c.factor * columns[..., c.index]
            shifts[c.column + PATH] = shifts.get(c.column + PATH, 0.0) + shift
        return shifts

    def moved_columns_of_draws(self, effect: ColumnSpec, values: Sequence[Any], shifts: Any) -> Any:
        """Return `columns_of_draws`, and their slopes by the shifts, by differences, (b, n, k) each."""
        slopes = {}
        for name, shift in shifts.items():
            h = self._difference(name)
            ends = ({**shifts, name: shift + s} for s in (h, -h))
            up, down = (self.columns_of_draws(effect, values, end) for end in ends)
            slopes[name] = (up - down) / (2 * h)
        return self.columns_of_draws(effect, values, shifts), slopes

    def _together(self, program, what: Any, slots: Arrays, shifts: Arrays) -> Any:
        """Run a program for several draws, some at once; readings are padded, the last draw repeated."""
        count = max(len(v) for v in (*slots.values(), *shifts.values()) if np.ndim(v) > 1)
        inputs = {name: slots.get(name, 0.0) for name in self.slots}, shifts
        both = [
            {n: np.broadcast_to(v, (count, self.size)) for n, v in arrays.items()}
            for arrays in inputs
        ]
        # Full stretches and half ones: two lengths to compile; and a sixth, where computing is what costs.
        most = max(DRAWS_A_CALL, CALL_NUMBERS // self.padded_size)
        parts = (6, 2, 1) if DRAWS_A_CALL * self.padded_size > 2 * CALL_NUMBERS else (2, 1)
        together = next((most // n for n in parts if count <= most // n), most)
        whole = None
        for start in range(0, count, together):
            stop = min(start + together, count)
            draws = np.minimum(np.arange(start, start + together), count - 1)[:, None]
            some = ({n: v[draws, self._to_length] for n, v in arrays.items()} for arrays in both)
            outputs = program(what, self.padded, *some)
            if whole is None:
                whole = jax.tree.map(lambda a: np.empty((count, self.size, *a.shape[2:])), outputs)
            for into, arrays in zip(*map(jax.tree.leaves, (whole, outputs)), strict=True):
                into[start:stop] = np.asarray(arrays)[: stop - start, : self.size]
        return whole

    def longer(self, values: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "... m"]:
        """Pad values of the readings with the last one to the padded length."""
        return values[..., self._to_length]

    @cached_property
    def padded_size(self) -> int:
        return programs.padded_length(self.size)

    @cached_property
    def _to_length(self) -> Int[np.ndarray, "m"]:
        return np.minimum(np.arange(self.padded_size), self.size - 1)


_LIVE: WeakValueDictionary[Any, Record] = WeakValueDictionary()


def record_of(instrument: Instrument, readings: Measurements, reference: Reference) -> Record:
    """Return readings as the engine sees them; frame and fixed columns are shared by all their records."""
    key = id(readings), instrument, _as_value(reference)
    base = _LIVE.get(key)
    if base is None:
        frame = build_frame(readings, reference)
        base = _LIVE[key] = Record(instrument, frame, np.asarray(frame["output"]))
        base.of = readings  # held: no others take their place in memory while this lives
    return base.with_frame()


def _as_value(of: Any) -> Any:
    if isinstance(of, Mapping):
        return tuple(sorted((name, _as_value(value)) for name, value in of.items()))
    return of
