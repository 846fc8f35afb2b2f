"""The composition: what an instrument is expected to put out, and how that follows every coefficient.

    output = response(Σ columns · coefficients of each slot; the readings with their columns corrected)

There is no other: fits, searches, predictions, NumPyro's program, simulations and the equation that is exported all
come from `compose`. Where columns and responses are taken from is said by a `ColumnSource`: `Traced` (here) has the
effects and the instrument themselves, in programs of JAX; a record that keeps them is the other
(`_inference/problem.py`).
Leading axes are draws.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayescal._core.lazy_jax import jax, jnp
from bayescal._model.effect import Basis, matrix
from bayescal._model.frame import PATH, Frame
from bayescal._model.instrument import Instrument
from bayescal._model.terms import Term

Hyper = Mapping[str, Any]  # φ by name: one number, or one a draw


class ColumnSource(Protocol):
    """Where columns and responses come from."""

    xp: Any  # NumPy, or JAX's
    size: int  # of the readings, n
    slots: tuple[str, ...]  # of the instrument
    codes: Mapping[str, Any]  # by group, the member that each reading belongs to (n,), −1 for none

    def columns(self, term: Term, shapes: Sequence[Any], moves: dict, sloped: bool) -> tuple:
        """Columns of a term's effect (…, n, k), with columns of the readings moved; their slopes by each move."""
        ...

    def response(self, slots: dict, moves: dict) -> Any:
        """Expected output (…, n)."""
        ...

    def slopes(self, slots: dict, moves: dict) -> tuple[Any, Mapping[str, Any]]:
        """Expected output, and its slopes by each slot and each moved column, (…, n)."""
        ...


class Composed(NamedTuple):
    """What a response is taken of."""

    # what the coefficients of each slot come to, (…, n); slots that nothing adds to are left out
    slots: dict[str, Any]
    moves: dict[str, Any]  # what each column of the readings is corrected by
    values: list[Any]  # each term's coefficient at each reading, (…, n), or one for all, (…, 1)
    columns: list[Any]  # each term's column, slot units per reported unit (…, n)
    by_move: list[Mapping[str, Any]]  # slopes of these by each move, where asked for


class Linearised(NamedTuple):
    """The expected output and its derivatives, at one point.

    mean (…, n); jacobian by x (…, n, p); inputs: by each input that has noise (…, n, k).
    """

    mean: Any
    jacobian: Any
    inputs: Any


def value(source: ColumnSource, term: Term, x: Any, hyper: Hyper) -> Any:
    """A term's coefficient at each reading (…, n), or one for all (…, 1), x (…, p) being in reported units."""
    xp = source.xp
    found = members(xp, term, x, hyper)
    if term.per is None:
        return found
    none = xp.zeros((*found.shape[:-1], 1))  # the code of no member is −1
    return xp.concatenate([found, none], axis=-1)[..., source.codes[term.per]]


def members(xp: Any, term: Term, x: Any, hyper: Hyper) -> Any:
    """A term's coefficient, one number for each member of its group (…, size)."""
    if term.place == "x":
        return x[..., term.at]
    draws = x.shape[:-1]
    if term.place in ("fixed", "input"):
        return xp.full((*draws, term.size), term.value)
    own = [xp.broadcast_to(xp.asarray(hyper[name]), draws) for name in term.member_names()]
    found = xp.stack(own, axis=-1)
    if term.group_sd_name is not None:
        # Held in units of its learned spread (non-centred), so that a spread near zero makes no funnel (O.
        # Papaspiliopoulos, G. Roberts and M. Sköld, Stat. Sci. 22 (2007) 59).
        spread = xp.broadcast_to(xp.asarray(hyper[term.group_sd_name]), draws)
        found = term.mean + spread[..., None] * found
    return found


def compose(
    source: ColumnSource,
    terms: Sequence[Term],
    values: list[Any],
    hyper: Hyper,
    sloped: bool = False,
) -> Composed:
    """Add up what the terms come to; `sloped`: slopes of columns by corrections are wanted too.

    Effects that correct a column of the readings see these as recorded, the others the corrected ones.
    """
    made: list[Any] = [None] * len(terms)
    by_move: list[Mapping[str, Any]] = [{}] * len(terms)
    moves: dict[str, Any] = {}
    slots: dict[str, Any] = {}
    correcting = [i for i, t in enumerate(terms) if t.slot not in source.slots]
    others = [i for i, t in enumerate(terms) if t.slot in source.slots]
    for places, sums in ((correcting, moves), (others, slots)):
        shifts = {} if sums is moves else moves
        for _, own in groupby(places, lambda i: terms[i].effect.name):
            together = list(own)
            first = terms[together[0]]
            shapes = [hyper[name] for name in first.shape_names]
            found, slopes = source.columns(first, shapes, shifts, sloped)
            for i in together:
                t = terms[i]
                made[i] = found[..., t.index] * t.factor
                by_move[i] = {name: s[..., t.index] * t.factor for name, s in slopes.items()}
            _add(source.xp, sums, [(terms[i], made[i], values[i]) for i in together])
    return Composed(slots, moves, values, made, by_move)


def _add(xp: Any, sums: dict[str, Any], each: list[tuple[Term, Any, Any]]) -> None:
    """Add terms of one effect to the sums of their slots."""
    for slot, own in groupby(each, lambda one: one[0].slot):
        part = list(own)
        if len(part) > 2 and all(v.shape[-1] == 1 and c.ndim == 1 for _, c, v in part):
            # Of an effect of many columns that all draws share: one product.
            columns = xp.stack([c for _, c, _ in part])
            share = xp.concatenate([v for *_, v in part], axis=-1) @ columns
            sums[slot] = sums[slot] + share if slot in sums else share
            continue
        for _, column, v in part:
            sums[slot] = sums[slot] + column * v if slot in sums else column * v


def expected(source: ColumnSource, made: Composed) -> Any:
    """Expected output, output unit (…, n)."""
    return source.response(made.slots, made.moves)


def slopes(
    source: ColumnSource, terms: Sequence[Term], made: Composed
) -> tuple[Any, dict[str, Any]]:
    """Expected output, and its slopes by each slot and each corrected column (…, n); `made` with slopes."""
    mean, direct = source.slopes(made.slots, made.moves)
    found = dict(direct)
    # Back by the chain rule: what corrects a column moves the output by ∂μ/∂column + Σ ∂μ/∂slot·∂slot/∂column.
    for t, by_move, v in zip(terms, made.by_move, made.values, strict=True):
        for name, slope in by_move.items():
            found[name] = found[name] + found[t.slot] * slope * v
    return mean, found


def linearised(source: ColumnSource, terms: Sequence[Term], made: Composed) -> Linearised:
    """The expected output and its Jacobian by the coefficients of these terms; `made` with slopes."""
    mean, by_slot = slopes(source, terms, made)
    tabled = _in_one_table if source.xp is np else _in_one_product
    each = [(t, c, by_slot[t.slot]) for t, c in zip(terms, made.columns, strict=True)]
    return Linearised(
        mean, *(tabled(source, mean, [e for e in each if e[0].place == p]) for p in ("x", "input"))
    )


def variance_of_inputs(terms: Sequence[Term], line: Linearised) -> Any:
    """What noise on inputs adds to the variance of each reading, to first order (…, n).

    Source: JCGM 100:2008, 5.1.2.
    """
    sd = np.array([t.prior_sd for t in terms if t.place == "input"])
    return ((line.inputs * sd) ** 2).sum(axis=-1)


def _in_one_table(source: ColumnSource, mean: np.ndarray, each: list[tuple]) -> np.ndarray:
    """A Jacobian (…, n, q), written term by term into one table, whose columns lie together in memory."""
    width = sum(1 if _codes(source, t) is None else t.size for t, *_ in each)
    found, at = np.zeros((*mean.shape[:-1], width, mean.shape[-1])), 0
    for t, column, slope in each:
        own, codes = slope * column, _codes(source, t)
        if codes is None:
            found[..., at, :] = own
            at += 1
            continue
        known = np.flatnonzero(codes >= 0)
        found[..., at + codes[known], known] = np.broadcast_to(own, mean.shape)[..., known]
        at += t.size
    return np.swapaxes(found, -1, -2)


def _in_one_product(source: ColumnSource, mean: Any, each: list[tuple]) -> Any:
    """A Jacobian (n, q) in a program: slopes multiplied one after the other would be compiled into each column."""
    columns = [jnp.zeros((*mean.shape, 0))]
    slopes = list(columns)
    for t, column, slope in each:
        column, slope = (jnp.broadcast_to(a, mean.shape) for a in (column, slope))
        columns.append(by_member(column, _codes(source, t), t.size))
        slopes.append(jnp.broadcast_to(slope[..., None], columns[-1].shape))
    return jnp.concatenate(columns, axis=-1) * jnp.concatenate(slopes, axis=-1)


def _codes(source: ColumnSource, t: Term) -> Any:
    return None if t.per is None else source.codes[t.per]


def by_member(column: Any, codes: Any, size: int) -> Any:
    """A coefficient's column (…, n), spread over the members of its group (…, n, size); codes None: it has none."""
    if codes is None:
        return column[..., None]
    return column[..., None] * (codes[:, None] == np.arange(size))


class Traced:
    """The effects and the instrument themselves, in a program of JAX: one draw, differentiable by all."""

    xp = jnp

    def __init__(self, instrument: Instrument, frame: Frame) -> None:
        self.instrument, self.frame = instrument, frame
        self.size, self.codes = frame.size, frame.codes
        self.slots = tuple(s.name for s in instrument.slots)

    @property
    def read(self) -> frozenset[str]:
        """Columns that the response takes itself."""
        return columns_read(self.instrument, self.frame)

    def matrix(self, basis: Basis, frame: Frame, shapes: Mapping[str, Any]) -> Any:
        """Columns of a basis."""
        return matrix(*basis, frame, shapes)

    def columns(self, term: Term, shapes: Sequence[Any], moves: dict, sloped: bool) -> tuple:
        of = term.columns
        at, own = len(of.own), dict(zip(of.own, shapes, strict=False))
        known: dict[str, Any] = {}
        for c in of.corrections:
            theirs = dict(zip(c.of.shapes, shapes[at:], strict=False))
            at += len(c.of.shapes)
            shift = c.factor * self.matrix(c.of.basis, self.frame, theirs)[:, c.index]
            known[c.column + PATH] = known.get(c.column + PATH, 0.0) + shift

        def made(moves: dict) -> Any:
            every = {n: known.get(n, 0.0) + moves.get(n, 0.0) for n in {**known, **moves}}
            return self.matrix(of.basis, self.frame.moved(every), own)

        if not (moves and sloped):
            return made(moves), {}
        moves = {name: jnp.broadcast_to(shift, (self.size,)) for name, shift in moves.items()}
        found, push = jax.linearize(made, moves)
        return found, {name: push(_alone(moves, name)) for name in moves}

    def _whole(self, values: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
        return {name: jnp.broadcast_to(values.get(name, 0.0), (self.size,)) for name in names}

    def response(self, slots: dict, moves: dict) -> Any:
        found = self.instrument.response(self._whole(slots, self.slots), self.frame.moved(moves))
        return jnp.broadcast_to(found, (self.size,))

    def slopes(self, slots: dict, moves: dict) -> tuple[Any, dict[str, Any]]:
        slots, moves = self._whole(slots, self.slots), self._whole(moves, moves)
        return slopes_of(self.response, slots, moves, self.instrument.vector is not None)


def slopes_of(
    response: Any, slots: dict[str, Any], moves: dict[str, Any], backward: bool
) -> tuple[Any, dict[str, Any]]:
    """A response (n,) and its slopes by each slot and move; by all slots in one pass back, where there are dozens."""
    if backward and not moves:
        mean, pull = jax.vjp(lambda own: response(own, {}), slots)
        return mean, pull(jnp.ones_like(mean))[0]
    # The output of a reading hangs on its own slots alone: a vector of ones pushed forward holds each one's own slope.
    # Moves go before slots where both have a name.
    mean, push = jax.linearize(response, slots, moves)
    none = [jax.tree.map(jnp.zeros_like, part) for part in (slots, moves)]
    by_slot = {name: push(_alone(slots, name), none[1]) for name in slots}
    return mean, by_slot | {name: push(none[0], _alone(moves, name)) for name in moves}


def _alone(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Ones for one name, zeros for the others."""
    return {n: jnp.ones_like(v) if n == name else jnp.zeros_like(v) for n, v in values.items()}


def columns_read(instrument: Instrument, frame: Frame) -> frozenset[str]:
    """Columns of the readings that an instrument's response takes itself, beside its slots."""
    asked = set[str]()

    class Asked(dict[str, Any]):
        def __getitem__(self, name: str) -> Any:
            asked.add(name)
            return super().__getitem__(name)

    slots = {s.name: np.zeros(frame.size) for s in instrument.slots}
    instrument.response(slots, replace(frame, columns=Asked(frame.columns)))
    return frozenset(asked)
