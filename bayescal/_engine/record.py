"""A record: one set of readings as the engine sees them, with every column that was computed for it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from bayescal._engine import pieces
from bayescal._model.effect import Effect
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument

KEPT = 256 * 2**20  # bytes of columns at shapes, of which the latest are kept
AFFINE = 1e-9  # change of a slope, relative to the largest, up to which it does not change


REACH = 4.0  # prior standard deviations of a shape, up to which columns are interpolated along it,
NODES = REACH * np.cos((np.arange(40) + 0.5) * np.pi / 40)  # between Chebyshev's points,
INTERPOLATED = 1e-9  # as good as this part of the largest number in a column, tried half way between some of them
BETWEEN = REACH * np.cos(np.array([1.0, 7.0, 16.0, 24.0, 33.0, 39.0]) * np.pi / 40)
_WEIGHTS = (-1.0) ** np.arange(40) * np.sin((np.arange(40) + 0.5) * np.pi / 40)


def shares(v: float) -> Float[np.ndarray, "s"]:
    """Of the nodes in an interpolated column (Lagrange's polynomials in barycentric form)."""
    apart = v - NODES
    if not apart.all():
        return (apart == 0).astype(float)
    share = _WEIGHTS / apart
    return share / share.sum()


def share_slopes(v: float) -> Float[np.ndarray, "s"]:
    """Of these shares by v."""
    step = 1e-6
    return (shares(v + step) - shares(v - step)) / (2 * step)


class ColumnsOf(NamedTuple):
    """What an effect's columns depend on: its basis, and the shapes that this takes."""

    basis: pieces.Basis
    shapes: tuple[str, ...]
    priors: tuple[Any, ...]  # of the shapes

    @classmethod
    def of(cls, effect: Effect) -> ColumnsOf:
        shapes = effect.column_shapes
        return cls(
            pieces.basis_of(effect), tuple(s.name for s in shapes), tuple(s.prior for s in shapes)
        )


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
    _bytes: int = 0
    plain: dict[Any, Any] = field(
        default_factory=dict
    )  # of assemblies: what they know of a coefficient

    @property
    def size(self) -> int:
        return self.frame.size

    @cached_property
    def padded(self) -> pieces.Leaves:
        return pieces.Leaves.of(pieces.padded(self.frame))

    @cached_property
    def codes(self) -> dict[str, np.ndarray]:
        return {
            group: np.asarray(codes, dtype=np.intp) for group, codes in self.frame.codes.items()
        }

    @cached_property
    def in_time(self) -> tuple[np.ndarray, np.ndarray]:
        """The order of time within runs, and the steps in it, s; −1 at a run's first reading."""
        return np.asarray(self.frame.order), np.asarray(self.frame.step)

    @cached_property
    def slots(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.instrument.slots)

    def columns(self, effect: ColumnsOf, values: tuple[float, ...]) -> Float[np.ndarray, "n k"]:
        """Columns of an effect on the readings as they were measured; not to be written to.

        Those of one shape are interpolated along it where they run smoothly.

        Args:
            effect: whose.
            values: of its shapes.
        """
        if not effect.shapes:
            return self._fixed_columns(effect.basis)
        if len(values) == 1 and abs(v := effect.priors[0].coordinate(values[0])) <= REACH:
            curve = self._curve(effect)
            if curve is not None:
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

    def column_slopes(self, effect: ColumnsOf, value: float) -> Float[np.ndarray, "n k"] | None:
        """Slopes of an effect's columns by the coordinate of its one shape; None where they are not interpolated."""
        v = effect.priors[0].coordinate(value)
        curve = self._curve(effect) if abs(v) < REACH else None
        if curve is None:
            return None
        return (share_slopes(v) @ curve).reshape(self.size, -1, order="F")

    def _curve(self, effect: ColumnsOf) -> Float[np.ndarray, "s m"] | None:
        """Columns at the nodes of a shape's coordinate; None where they run too sharply to be interpolated."""
        key = (effect.basis, effect.priors)
        if key not in self._curves:
            prior = effect.priors[0]
            at = np.concatenate([NODES, BETWEEN])
            found = pieces.columns_along(
                effect.basis, self.padded, {effect.shapes[0]: prior.value(at)}
            )
            found = np.asarray(found)[:, : self.size].transpose(0, 2, 1).reshape(len(at), -1)
            nodes, there = found[: len(NODES)], found[len(NODES) :]
            apart = max(
                np.max(np.abs(shares(v) @ nodes - row))
                for v, row in zip(BETWEEN, there, strict=True)
            )
            smooth = apart <= INTERPOLATED * np.max(np.abs(nodes), initial=1e-300)
            self._curves[key] = nodes if smooth else None
        return self._curves[key]

    def _fixed_columns(self, key: pieces.Basis) -> Float[np.ndarray, "n k"]:
        if key not in self._fixed:
            of_library = (ColumnsOf.of(e) for e in self.library)
            wanted = {c.basis: None for c in of_library if not c.shapes}
            bases = tuple(wanted) if key in wanted else (key,)
            made = pieces.fixed_columns(bases, self.padded)
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
            slots = {}
            for name in self.slots:
                steep = float(np.max(np.abs(slopes[name]), initial=0.0))
                size = min(1.0, reach / steep) if steep > 0 else 1.0
                slots[name] = size * random.standard_normal(self.size)
            _, there = self._response(slots, {})
            for name in self.slots:
                scale = np.max(np.abs(slopes[name]), initial=0.0)
                if np.max(np.abs(there[name] - slopes[name]), initial=0.0) > AFFINE * (
                    scale + 1e-300
                ):
                    return None
        return base, slopes

    def several(self, slots: Mapping[str, np.ndarray]) -> Float[np.ndarray, "b n"]:
        """Expected outputs of several sets of slots, (b, n) each."""
        if self.affine is not None:
            base, slopes = self.affine
            return base + sum(slopes[name] * value for name, value in slots.items())
        made = pieces.responses(self.instrument.response, self.padded, self._longer(slots))
        return np.asarray(made)[:, : self.size]

    def _longer(self, values: Mapping[str, np.ndarray]) -> dict[str, Array]:
        more = pieces.padded_length(self.size) - self.size
        return {
            name: np.pad(v, [(0, 0)] * (np.ndim(v) - 1) + [(0, more)], mode="edge")  # pyright: ignore
            for name, v in values.items()
        }


def library_of(
    instrument: Instrument, frame: Frame, more: Iterable[Effect] = ()
) -> tuple[Effect, ...]:
    """Effects of the instrument that these readings have the columns for, and some more."""
    known = {e.name: e for e in (*instrument.effects, *instrument.candidates, *more)}
    text = {label.split("=")[0] for label in frame.labels}
    return tuple(
        e
        for e in known.values()
        if all(c in frame.columns or c in text or c in frame.codes for c in _measured(e))
    )


def _measured(effect: Effect) -> list[str]:
    return [c for c in effect.columns if c != "temperature_point"]
