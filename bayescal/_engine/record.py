"""A record: one set of readings as the engine sees them, with every column that was computed for it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from bayescal._engine import pieces
from bayescal._engine.terms import ColumnsOf, coordinates
from bayescal._model.departure import Departure
from bayescal._model.effect import Effect
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument

KEPT = 256 * 2**20  # bytes of columns at shapes, of which the latest are kept
AFFINE = 1e-9  # change of a slope, relative to the largest, up to which it does not change
TOGETHER = 48  # draws in one call of a program, or half of that: as many as a shape has nodes, and those between
REACH = 4.0  # prior standard deviations of a shape, up to which columns are interpolated along it,
NODES = REACH * np.cos((np.arange(40) + 0.5) * np.pi / 40)  # between Chebyshev's points,
INTERPOLATED = 1e-9  # as good as this part of the largest number in a column, tried half way between some of them
ASIDE = 1e-5  # of a coordinate, for slopes of columns that are not interpolated
BETWEEN = REACH * np.cos(np.array([1.0, 7.0, 16.0, 24.0, 33.0, 39.0]) * np.pi / 40)
_WEIGHTS = (-1.0) ** np.arange(40) * np.sin((np.arange(40) + 0.5) * np.pi / 40)


def shares(v: float | Float[np.ndarray, "b"]) -> Float[np.ndarray, "... s"]:
    """Of the nodes in an interpolated column (Lagrange's polynomials in barycentric form)."""
    apart = np.asarray(v)[..., None] - NODES
    if not apart.all():
        apart = np.where(apart == 0, 1e-250, apart)
    share = _WEIGHTS / apart
    return share / share.sum(axis=-1, keepdims=True)


def share_slopes(v: float) -> Float[np.ndarray, "s"]:
    """Of these shares by v."""
    return (shares(v + ASIDE) - shares(v - ASIDE)) / (2 * ASIDE)


@dataclass(eq=False)
class Record:
    """Readings of one instrument, with their columns and slopes.

    Attributes:
        instrument: whose.
        frame: the readings.
        y: the outputs (n,).
        library: effects whose fixed columns are computed together, in one program.
    """

    instrument: Instrument
    frame: Frame
    y: np.ndarray
    library: tuple[Effect, ...] = ()
    _fixed: dict[pieces.Basis, np.ndarray] = field(default_factory=dict)
    _shaped: OrderedDict[Any, np.ndarray] = field(default_factory=OrderedDict)
    _curves: dict[Any, np.ndarray | None] = field(default_factory=dict)
    _positions: dict[str, np.ndarray] = field(default_factory=dict)
    _bytes: int = 0
    plain: dict[Any, Any] = field(default_factory=dict)  # what assemblies know of a coefficient

    @cached_property
    def size(self) -> int:
        return self.frame.size

    @cached_property
    def padded(self) -> pieces.Leaves:
        return pieces.Leaves.of(pieces.padded(self.frame))

    @cached_property
    def codes(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(own, dtype=np.intp) for name, own in self.frame.codes.items()}

    @cached_property
    def in_time(self) -> tuple[np.ndarray, np.ndarray]:
        """The order of time within runs, and the steps in it, s; −1 at a run's first reading."""
        return np.asarray(self.frame.order), np.asarray(self.frame.step)

    @cached_property
    def is_in_time(self) -> bool:
        """Whether the readings stand in that order."""
        return bool(np.all(np.diff(self.in_time[0]) > 0))

    def position(self, column: str) -> Float[np.ndarray, "n"]:
        """Along a column, −1 … 1 over its range at the fit; beyond it at its end."""
        if column not in self._positions:
            found = np.asarray(self.frame.position(column))
            self._positions[column] = np.clip(2 * found - 1, -1.0, 1.0)
        return self._positions[column]

    @cached_property
    def slots(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.instrument.slots)

    def columns(self, effect: ColumnsOf, values: tuple[float, ...]) -> Float[np.ndarray, "n k"]:
        """Columns of an effect at values of its shapes, on the readings as measured; not to be written to.

        Those of one shape are interpolated along it where they run smoothly.
        """
        if not effect.shapes:
            return self._less(effect.less) if effect.less else self._fixed_columns(effect.basis)
        near = len(values) == 1 and abs(v := effect.priors[0].coordinate(values[0])) <= REACH
        if near and (curve := self._curve(effect)) is not None:
            return (shares(v) @ curve).reshape(self.size, -1, order="F")
        key = (effect.basis, values)
        found = self._shaped.get(key)
        if found is None:
            found = self.moved_columns(effect, values, {})[0]
            self._shaped[key] = found
            self._bytes += found.nbytes
            while self._bytes > KEPT:
                self._bytes -= self._shaped.popitem(last=False)[1].nbytes
        else:
            self._shaped.move_to_end(key)
        return found

    def column_slopes(self, effect: ColumnsOf, value: float) -> Float[np.ndarray, "n k"]:
        """Slopes of an effect's columns by the coordinate of its one shape."""
        v = (prior := effect.priors[0]).coordinate(value)
        curve = self._curve(effect) if abs(v) < REACH else None
        if curve is not None:
            return (share_slopes(v) @ curve).reshape(self.size, -1, order="F")
        at = [(prior.value(v + step),) for step in (ASIDE, -ASIDE)]
        up, down = (self.moved_columns(effect, values, {})[0] for values in at)
        return (up - down) / (2 * ASIDE)

    def _curve(self, effect: ColumnsOf) -> Float[np.ndarray, "s m"] | None:
        """Columns at the nodes of a shape's coordinate; None where they run too sharply to be interpolated."""
        key = (effect.basis, effect.priors)
        if key not in self._curves:
            prior = effect.priors[0]
            at = np.concatenate([NODES, BETWEEN])
            found = self._computed(effect, [prior.value(at)], {})
            found = found.transpose(0, 2, 1).reshape(len(at), -1)
            nodes, there = found[: len(NODES)], found[len(NODES) :]
            apart = np.max(np.abs(shares(BETWEEN) @ nodes - there))
            smooth = apart <= INTERPOLATED * np.max(np.abs(nodes), initial=1e-300)
            self._curves[key] = nodes if smooth else None
        return self._curves[key]

    def _less(self, of: Departure) -> Float[np.ndarray, "n k"]:
        """Columns of a departure: curves, less the shares that its effect's own columns have in them."""
        assert of.own is not None and of.curves is not None
        own = ColumnsOf(of.own, tuple(n for n, _ in of.at), ())
        taken = self._shaped.get(key := (of.own, of.at))
        if taken is None:
            at = tuple(v for _, v in of.at)
            taken = self.moved_columns(own, at, {})[0] if at else self._fixed_columns(of.own)
            self._shaped[key], self._bytes = taken, self._bytes + taken.nbytes
        return self._fixed_columns(of.curves) - taken @ np.array(of.shares)

    def _fixed_columns(self, key: pieces.Basis) -> Float[np.ndarray, "n k"]:
        if key not in self._fixed:
            of_library = (ColumnsOf.of(e) for e in self.library)
            wanted = {c.basis: None for c in of_library if not c.shapes}
            bases = tuple(wanted) if key in wanted else (key,)
            made = pieces.columns_or_refusal(bases, self.padded, self.frame)
            for basis, columns in zip(bases, made, strict=True):
                self._fixed[basis] = np.asarray(columns)[: self.size]
        return self._fixed[key]

    def moved_columns(
        self, effect: ColumnsOf, values: tuple[float, ...], moves: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "n k"], dict[str, Float[np.ndarray, "n k"]]]:
        """Columns where columns of the readings are corrected by `moves`, and their slopes by these moves."""
        named = {name: np.float64(one) for name, one in zip(effect.shapes, values, strict=True)}
        made = pieces.shaped_columns(effect.basis, self.padded, named, self._longer(moves))
        return jax.tree.map(lambda a: np.asarray(a)[: self.size], made)

    def response(
        self, slots: Mapping[str, np.ndarray], moves: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "n"], dict[str, Float[np.ndarray, "n"]]]:
        """Expected output and its slopes by each slot and each moved column."""
        if not moves and self.affine is not None:
            base, slopes = self.affine
            mean = base
            for name, value in slots.items():
                mean = mean + slopes[name] * value
            return mean, slopes
        return self._response(slots, moves)

    def _response(self, slots, moves):
        full = {name: slots.get(name, np.zeros(self.size)) for name in self.slots}
        made = pieces.response_slopes(
            self.instrument.response, self.padded, self._longer(full), self._longer(moves)
        )
        return jax.tree.map(lambda a: np.asarray(a)[: self.size], made)

    @cached_property
    def affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """The response at empty slots and its slopes, where it is affine in the slots; else None.

        Tried at two random sets of slots, the size of each by what moves the output as much as it varies.
        """
        base, slopes = self._response({}, {})
        random = np.random.default_rng(0)
        reach = float(np.ptp(self.y)) or 1.0
        for _ in range(2):
            slots = dict[str, np.ndarray]()
            for name in self.slots:
                steep = float(np.max(np.abs(slopes[name]), initial=0.0))
                size = min(1.0, reach / steep) if steep > 0 else 1.0
                slots[name] = size * random.standard_normal(self.size)
            _, there = self._response(slots, {})
            for name in self.slots:
                scale = np.max(np.abs(slopes[name]), initial=0.0)
                change = np.abs(there[name] - slopes[name])
                # not "larger than": outside of an arcsine there is no slope to compare
                if not np.max(change, initial=0.0) <= AFFINE * scale:
                    return None
        return base, slopes

    def columns_of_draws(
        self, effect: ColumnsOf, values: Sequence[np.ndarray], moves: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "b n k"]:
        """Columns of an effect for several draws.

        Args:
            effect: whose.
            values: of its shapes, (b,) each.
            moves: what columns of the readings are corrected by, (b, n) each.
        """
        count = max(len(v) for v in (*values, *moves.values()))
        curve = self._curve(effect) if not moves and len(values) == 1 else None
        if curve is not None:
            at = coordinates(effect.priors[0], values[0])
            near = np.abs(at) <= REACH
            found = np.empty((count, curve.shape[1]))
            found[near] = shares(at[near]) @ curve
            found = found.reshape(count, -1, self.size).transpose(0, 2, 1)
            if not np.all(near):
                found[~near] = self._computed(effect, [values[0][~near]], moves)
            return found
        return self._computed(effect, values, moves)

    def _computed(
        self, effect: ColumnsOf, values: Sequence[np.ndarray], moves, program=pieces.columns_along
    ) -> Any:
        count = max(len(v) for v in (*values, *moves.values()))
        shapes = dict(zip(effect.shapes, values, strict=True))
        return self._together(program, effect.basis, count, shapes, moves)

    def moved_columns_of_draws(self, effect: ColumnsOf, values: Sequence[np.ndarray], moves) -> Any:
        """Columns (b, n, k) as `columns_of_draws`, and their slopes by the moves."""
        return self._computed(effect, values, moves, pieces.moved_columns_along)

    def _together(self, program, what: Any, count: int, *both: Mapping[str, np.ndarray]) -> Any:
        """What a program gives for `count` draws, computed in stretches, without what these were padded with."""
        parts = [program(what, self.padded, *part) for part in self._stretches(count, *both)]
        whole = jax.tree.map(lambda *a: np.concatenate([np.asarray(b) for b in a]), *parts)
        return jax.tree.map(lambda a: a[:count, : self.size], whole)

    def several(
        self, slots: Mapping[str, np.ndarray], moves: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "b n"]:
        """Expected outputs of several sets of slots and corrections of columns, (b, n) each."""
        if not moves and self.affine is not None:
            base, slopes = self.affine
            return base + sum(slopes[name] * value for name, value in slots.items())
        count = len(next(iter(slots.values())))
        return self._together(pieces.responses, self.instrument.response, count, slots, moves)

    def responses(
        self, slots: Mapping[str, np.ndarray], moves: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "b n"], dict[str, Any]]:
        """Expected outputs of several draws, and their slopes by each slot and moved column, (b, n) or (n,)."""
        if self.affine is not None and not moves:
            return self.several(slots, {}), self.affine[1]
        count = len(next(iter(slots.values())))
        return self._together(pieces.slopes_of_draws, self.instrument.response, count, slots, moves)

    def _stretches(
        self, count: int, one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]
    ) -> Iterator[tuple[dict[str, np.ndarray], dict[str, np.ndarray]]]:
        """Values for `count` draws, some at once, readings padded; the last draw stands in for missing ones."""
        together = TOGETHER // (1 if count > TOGETHER // 2 else 2)
        for start in range(0, count, together):
            pick = np.minimum(start + np.arange(together), count - 1)
            yield tuple(  # pyright: ignore[reportReturnType]
                {
                    k: v[pick] if v.ndim == 1 else self._longer({k: v[pick]})[k]
                    for k, v in both.items()
                }
                for both in (one, other)
            )

    def _longer(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: v[..., self._to_length] for name, v in values.items()}

    @cached_property
    def _to_length(self) -> Int[np.ndarray, "m"]:
        """Positions of readings, the last repeated up to the padded length."""
        return np.minimum(np.arange(pieces.padded_length(self.size)), self.size - 1)
