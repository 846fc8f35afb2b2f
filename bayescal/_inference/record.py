"""A record: one set of readings with cached basis columns, responses and expansions."""

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
from bayescal._inference.noise_nodes import ColumnNodes, SingleNode, dct_nodes
from bayescal._model.channel_at_rest import CHANNEL
from bayescal._model.composition import find_response_columns
from bayescal._model.effect import Basis, Effect
from bayescal._model.frame import PATH, Frame, Reference, build_frame
from bayescal._model.instrument import Instrument
from bayescal._model.noise_law import Noise
from bayescal._model.terms import ColumnSpec

MAX_CACHE_BYTES = 256 * 2**20  # of columns of effects with shapes, and of expansions
DIFF_STEP_RANGES = 1e-4  # difference step of a column over the column's range
AFFINE_TOLERANCE = 1e-9  # largest relative change of the derivatives of an affine response
CALL_DRAWS = 48  # largest number of draws per call of a program, or
CALL_ELEMENTS = 16_384  # draws × readings per call, if that is more: otherwise overhead dominates

Arrays = Mapping[str, np.ndarray]  # by name of a slot or column: (n,), or (b, n) for b draws


@dataclass(eq=False)
class Record:
    """Readings of one instrument (frame, outputs y) with cached basis columns and derivatives of the response."""

    instrument: Instrument
    frame: Frame
    y: np.ndarray
    _basis_columns: dict[Basis, np.ndarray] = field(default_factory=dict)
    _shape_columns: OrderedDict[Any, np.ndarray] = field(default_factory=OrderedDict)
    _cached_bytes: int = 0
    _expansions: dict[Any, Expansions] = field(default_factory=dict)
    _nodes: dict[Any, SingleNode | None] = field(default_factory=dict)
    _latest: tuple[Any, Any] | None = None  # latest slot values, and the response with derivatives
    _frames: dict[Noise, tuple[Noise, Frame]] = field(default_factory=dict)
    source: Any = None  # the record or readings that this record was made from

    @cached_property
    def size(self) -> int:
        return self.frame.size

    @cached_property
    def padded(self) -> Frame:
        source = self.source
        if isinstance(source, Record) and source.frame is self.frame:
            return source.padded
        return programs.pad_frame(self.frame)

    @cached_property
    def host_columns(self) -> HostColumns:
        return HostColumns(self.frame)

    def prepare_for_law(self, law: Noise) -> tuple[Noise, Frame]:
        """Return the noise law without priors and its sorted, padded columns, as arguments of compiled programs."""
        if law not in self._frames:
            frame = self.frame.select_columns(law.needs)
            frame = programs.pad_frame(frame if law.independent else frame.sort_by_time())
            self._frames[law] = law.plain, frame
        return self._frames[law]

    def with_frame(self, frame: Frame | None = None) -> Record:
        """Return a record of the same readings that shares cached columns, with another frame if one is given."""
        fields = {"_basis_columns": self._basis_columns, "source": self}
        record = Record(self.instrument, self.frame if frame is None else frame, self.y, **fields)
        if frame is None:
            caches = {"_frames": self._frames, "_nodes": self._nodes}
            vars(record).update(codes=self.codes, host_columns=self.host_columns, **caches)
        return record

    def require_finite(self, effects: Iterable[Effect]) -> None:
        """Check that user-defined effects have finite columns.

        Raises:
            ModelError: an effect is not finite in a reading, at the prior medians of its shapes.
        """
        catalogue, affected = self.instrument.known, self.instrument.shown_by(self.frame, effects)
        for effect in (e for e in affected if not (e.name in catalogue or e.is_placeholder)):
            spec = ColumnSpec.from_effect(effect)
            medians = tuple(float(prior.value(0.0)) for prior in spec.priors)
            rows = np.flatnonzero(~np.isfinite(self.columns(spec, medians)).all(axis=1))
            if not len(rows):
                continue
            columns = [c for c in effect.columns if c in self.frame.columns]
            place_text = ", ".join(f"{c} {self.frame[c][rows[0]]:.6g}" for c in columns)
            raise ModelError(
                f"Effect {effect.name!r} is not finite in {len(rows)} of {self.size} readings, first in reading "
                f"{rows[0] + 1} ({place_text}): check it for divisions by zero and roots of negative numbers"
            )

    def residual_record(self, residual: Float[np.ndarray, "n"]) -> Record:
        """Return a record of residuals, as the output of a channel at constant input, to fit noise laws to."""
        record = Record(CHANNEL, self.frame, residual, _frames=self._frames, _nodes=self._nodes)
        channel = {slot: np.ones(self.size) for slot in record.slots}
        vars(record)["affine_map"] = np.zeros(self.size), channel  # nothing to compile
        return record

    @cached_property
    def codes(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(codes, dtype=np.intp) for name, codes in self.frame.codes.items()}

    @cached_property
    def time_order(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices that sort readings by time within runs, and the sorted time steps, s (−1 begins a run)."""
        return np.asarray(self.frame.order), np.asarray(self.frame.step)

    @cached_property
    def is_time_ordered(self) -> bool:
        """Return whether the readings are sorted by time within runs."""
        return bool(np.all(np.diff(self.time_order[0]) == 1))

    @cached_property
    def table(self) -> ColumnTable:
        """Return the table of columns and inner products shared by all structures, for an affine response."""
        return ColumnTable(self.y - self.affine_map[0])  # pyright: ignore[reportOptionalSubscript]

    def clear_cache(self) -> None:
        """Clear cached columns of effects with shapes, expansions and the column table."""
        self._shape_columns, self._cached_bytes, self._expansions = OrderedDict(), 0, {}
        if self.affine_map is not None:
            self.table.clear()

    def expansions(self, effect: ColumnSpec, fixed: tuple[float | None, ...]) -> Expansions:
        """Return the expansions of an effect's columns in its free shapes; fixed: each shape's fixed value, or None."""
        key = effect.key, fixed
        if sum(e.nbytes for e in self._expansions.values()) > MAX_CACHE_BYTES:
            self._expansions.clear()
        if key not in self._expansions:

            def columns(v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s n k"]:
                if not fixed:
                    return self.columns(effect, ())[None]
                free_values = iter(v.T)
                values = [
                    np.full(len(v), h) if h is not None else prior.value(next(free_values))
                    for h, prior in zip(fixed, effect.priors, strict=True)
                ]
                return self._compute_columns(effect, values, {})

            self._expansions[key] = Expansions(columns, sum(h is None for h in fixed))
        return self._expansions[key]

    def nodes(self, law: Noise) -> SingleNode | None:
        """Return the nodes of a law for interpolating inner products on this record; None if there are none."""
        coordinate = law.variance_coordinate(self.frame)
        if coordinate is not None:
            key: Any = coordinate.tobytes()
        elif UNCERTAINTY in self.frame.columns or not law.stationary:
            return None
        else:
            key = "in frequency"
        if key not in self._nodes:
            if coordinate is None:
                self._nodes[key] = dct_nodes(*self.time_order)
            elif coordinate.ndim == 0:
                self._nodes[key] = SingleNode(self.size, coordinate)
            else:
                self._nodes[key] = ColumnNodes(coordinate)
        return self._nodes[key]

    @cached_property
    def response_columns(self) -> frozenset[str]:
        """Return the columns of the readings that the instrument's response uses directly."""
        if isinstance(self.source, Record):
            return self.source.response_columns
        return find_response_columns(self.instrument, self.frame)

    @cached_property
    def slots(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.instrument.slots)

    @property
    def _spec(self) -> programs.ResponseSpec:
        return programs.ResponseSpec(self.instrument.response, self.instrument.vector is not None)

    def columns(self, effect: ColumnSpec, values: tuple[float, ...]) -> Float[np.ndarray, "n k"]:
        """Return an effect's columns at values of its shapes, on uncorrected readings, cached (n, k); read-only."""
        if not effect.shapes:
            if effect.basis not in self._basis_columns:
                self._basis_columns[effect.basis] = self.host_columns.evaluate(effect.basis, {}, {})
            return self._basis_columns[effect.basis]
        key = (effect.key, values)
        columns = self._shape_columns.pop(key, None)
        if columns is None:
            columns = self._compute_columns(effect, [np.array([v]) for v in values], {})[0]
            self._cached_bytes += columns.nbytes
            while self._cached_bytes > MAX_CACHE_BYTES and self._shape_columns:
                self._cached_bytes -= self._shape_columns.popitem(last=False)[1].nbytes
        self._shape_columns[key] = columns
        return columns

    def respond(
        self, slots: Arrays, shifts: Arrays, with_grad: bool = True
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        """Return the expected output (n,), or (b, n) for draws, and derivatives by slot or column ({} if not asked)."""
        if not shifts and self.affine_map is not None:
            base, slopes = self.affine_map
            return sum((slopes[name] * value for name, value in slots.items()), base), slopes
        if self._host_affine is not None:
            return self._expand(slots, shifts) if with_grad else (self._respond(slots, shifts), {})
        if not any(np.ndim(v) > 1 for v in (*slots.values(), *shifts.values())):
            return self._get_cached_response(slots, shifts)
        if with_grad:
            return self._run_batches(programs.differentiate_many, self._spec, slots, shifts)
        return self._run_batches(programs.respond_many, self.instrument.response, slots, shifts), {}

    def _respond(self, slots: Arrays, shifts: Arrays) -> Any:
        """Evaluate the response by NumPy at slot values and column shifts."""
        all_slots = {name: slots.get(name, np.zeros(self.size)) for name in self.slots}
        output = self.instrument.response(all_slots, self.frame.shift_columns(shifts))
        return np.broadcast_to(output, np.broadcast_shapes(np.shape(output), (self.size,)))

    def _expand(
        self, slots: Arrays, shifts: Arrays
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        """Evaluate an affine response and its derivatives by NumPy: complex steps in slots, differences in shifts."""
        slopes = {n: self._respond({n: np.full(self.size, 1j)}, shifts).imag for n in self.slots}
        for name, shift in shifts.items():
            h = self._choose_difference_step(name)
            upper, lower = (self._respond(slots, {**shifts, name: shift + s}) for s in (h, -h))
            slopes[name] = (upper - lower) / (2 * h)
        return self._respond(slots, shifts), slopes

    def _choose_difference_step(self, column: str) -> float:
        """Return the difference step for derivatives with respect to a column, in its unit."""
        return DIFF_STEP_RANGES * (float(np.ptp(self.frame[column.removesuffix(PATH)])) or 1.0)

    def _get_cached_response(self, slots, shifts):
        """Return the response and its derivatives at one set of slot values and shifts; the latest result is cached."""
        key = [(name, np.asarray(v).tobytes()) for name, v in (*slots.items(), *shifts.items())]
        latest = self._latest
        if latest is None or latest[0] != key:
            all_slots = {name: slots.get(name, np.zeros(self.size)) for name in self.slots}
            padded_arrays = ({n: self.pad(v) for n, v in a.items()} for a in (all_slots, shifts))
            outputs = programs.differentiate(self._spec, self.padded, *padded_arrays)
            self._latest = latest = key, jax.tree.map(lambda a: np.asarray(a)[: self.size], outputs)
        return latest[1]

    @cached_property
    def affine_map(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """Return the response at zero slot values and its derivatives; None if it is not affine in the slots.

        Affinity is tested at two random sets of slot values.
        """
        if isinstance(self.source, Record):
            return self.source.affine_map
        if (affine_map := self._host_affine) is not None:
            return affine_map
        base, slopes = self._get_cached_response({}, {})
        for slots in self._draw_slots(slopes):
            _, new_slopes = self._get_cached_response(slots, {})
            for name in self.slots:
                scale = np.max(np.abs(slopes[name]), initial=0.0)
                change = np.abs(new_slopes[name] - slopes[name])
                # `not <=`: NaN, as outside the domain of an arcsine, counts as not affine
                if not np.max(change, initial=0.0) <= AFFINE_TOLERANCE * scale:
                    return None
        return base, slopes

    @cached_property
    def _host_affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """Return `affine_map` computed by NumPy; None if the response needs JAX or is not affine."""
        if isinstance(self.source, Record):
            return self.source._host_affine
        try:
            with np.errstate(all="ignore"):
                base, slopes = self._expand({}, {})
                for slots in self._draw_slots(slopes):
                    change = sum((slopes[n] * v for n, v in slots.items()), np.zeros(self.size))
                    error = np.abs(self._respond(slots, {}) - base - change)
                    if not np.max(error) <= AFFINE_TOLERANCE * np.max(np.abs(change)):
                        return None
        except Exception:  # the response does not accept NumPy arrays
            return None
        return base, slopes

    def _draw_slots(self, slopes: Mapping[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
        """Yield two random sets of slot values, which change the output by about its range, to test affinity."""
        rng, span = np.random.default_rng(0), float(np.ptp(self.y)) or 1.0
        max_slopes = {n: float(np.max(np.abs(slope), initial=0.0)) for n, slope in slopes.items()}
        amplitudes = {n: min(1.0, span / s) if s > 0 else 1.0 for n, s in max_slopes.items()}
        for _ in range(2):
            yield {n: amplitudes[n] * rng.standard_normal(self.size) for n in self.slots}

    def columns_of_draws(
        self, effect: ColumnSpec, values: Sequence[Any], shifts: Arrays
    ) -> Float[np.ndarray, "*b n k"]:
        """Return an effect's columns for several draws (b, n, k); (n, k) if they do not depend on the draw.

        Values of shapes are (b,) each, or one number for all; shifts of columns are (b, n) each.
        """
        if not values and not shifts:
            return self.columns(effect, ())
        count = max((len(v) for v in shifts.values()), default=1)
        values = np.broadcast_arrays(*values, np.zeros(count))[:-1]
        return self._compute_columns(effect, values, shifts)

    def _compute_columns(self, effect: ColumnSpec, values: Sequence[np.ndarray], shifts) -> Any:
        count = max(len(v) for v in (*values, *shifts.values()))
        path_shifts = effect.shift_paths(values, self._evaluate_correction)
        for name, shift in path_shifts.items():
            shifts = {**shifts, name: shifts.get(name, 0.0) + shift}
        pairs = zip(effect.basis_shapes, values, strict=False)
        shapes = {n: np.broadcast_to(v, (count,)) for n, v in pairs}
        return self.host_columns.evaluate_many(effect.basis, shapes, shifts)

    def _evaluate_correction(self, spec: ColumnSpec, values: Sequence[Any]) -> np.ndarray:
        if any(np.ndim(v) for v in values):
            return self.columns_of_draws(spec, values, {})
        return self.columns(spec, tuple(values))  # one draw: cached

    def differentiate_columns(self, effect: ColumnSpec, values: Sequence[Any], shifts: Any) -> Any:
        """Return an effect's columns and their derivatives with respect to each shift, for draws, (b, n, k) each."""
        slopes = {}
        for name, shift in shifts.items():
            h = self._choose_difference_step(name)
            shift_pairs = ({**shifts, name: shift + s} for s in (h, -h))
            upper, lower = (self.columns_of_draws(effect, values, pair) for pair in shift_pairs)
            slopes[name] = (upper - lower) / (2 * h)
        return self.columns_of_draws(effect, values, shifts), slopes

    def _run_batches(self, program, argument: Any, slots: Arrays, shifts: Arrays) -> Any:
        """Run a program over draws in batches, on padded readings; the last batch is padded with its last draw."""
        count = max(len(v) for v in (*slots.values(), *shifts.values()) if np.ndim(v) > 1)
        arrays_by_kind = {name: slots.get(name, 0.0) for name in self.slots}, shifts
        inputs = [
            {n: np.broadcast_to(v, (count, self.size)) for n, v in arrays.items()}
            for arrays in arrays_by_kind
        ]
        # Full and half batches, and a sixth for long records: few batch sizes to compile.
        max_size = max(CALL_DRAWS, CALL_ELEMENTS // self.padded_size)
        divisors = (6, 2, 1) if CALL_DRAWS * self.padded_size > 2 * CALL_ELEMENTS else (2, 1)
        size = next((max_size // n for n in divisors if count <= max_size // n), max_size)
        result = None
        for start in range(0, count, size):
            stop = min(start + size, count)
            draws = np.minimum(np.arange(start, start + size), count - 1)[:, None]
            batch = ({n: v[draws, self._pad_index] for n, v in arrays.items()} for arrays in inputs)
            outputs = program(argument, self.padded, *batch)
            if result is None:
                result = jax.tree.map(lambda a: np.empty((count, self.size, *a.shape[2:])), outputs)
            for result_array, arrays in zip(*map(jax.tree.leaves, (result, outputs)), strict=True):
                result_array[start:stop] = np.asarray(arrays)[: stop - start, : self.size]
        return result

    def pad(self, values: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "... m"]:
        """Pad values of the readings to the padded length by repeating the last one."""
        return values[..., self._pad_index]

    @cached_property
    def padded_size(self) -> int:
        return programs.padded_length(self.size)

    @cached_property
    def _pad_index(self) -> Int[np.ndarray, "m"]:
        return np.minimum(np.arange(self.padded_size), self.size - 1)


_RECORDS: WeakValueDictionary[Any, Record] = WeakValueDictionary()


def record_of(instrument: Instrument, readings: Measurements, reference: Reference) -> Record:
    """Return a record of readings; all records of the same readings share frame and shape-independent columns."""
    key = id(readings), instrument, _make_hashable(reference)
    shared_record = _RECORDS.get(key)
    if shared_record is None:
        frame = build_frame(readings, reference)
        shared_record = _RECORDS[key] = Record(instrument, frame, np.asarray(frame["output"]))
        shared_record.source = readings  # a reference, so that their `id` in the key stays unique
    return shared_record.with_frame()


def _make_hashable(value: Any) -> Any:
    if isinstance(value, Mapping):
        return tuple(sorted((name, _make_hashable(value)) for name, value in value.items()))
    return value
