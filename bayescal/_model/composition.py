"""The composition: the expected output of an instrument and its derivatives by every coefficient.

    output = response(Σ columns · coefficients of each slot; the readings with their columns corrected)

There is no other: fits, searches, predictions, NumPyro's program, simulations and the equation that is exported all
come from `compose`. Columns and responses come from a `ColumnSource`: `Traced` (here) evaluates the effects and the
instrument in programs of JAX; the other is a record that caches them (`_inference/problem.py`).

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
    """Source of columns and responses."""

    xp: Any  # NumPy, or JAX's
    size: int  # of the readings, n
    slots: tuple[str, ...]  # of the instrument
    codes: Mapping[str, Any]  # by group, the member that each reading belongs to (n,), −1 for none

    def columns(self, term: Term, shapes: Sequence[Any], moves: dict, sloped: bool) -> tuple:
        """Return columns of a term's effect (…, n, k), with columns of the readings corrected; their slopes by each."""
        ...

    def response(self, slots: dict, moves: dict) -> Any:
        """Return the expected output (…, n)."""
        ...

    def slopes(self, slots: dict, moves: dict) -> tuple[Any, Mapping[str, Any]]:
        """Return the expected output, and its slopes by each slot and each corrected column, (…, n)."""
        ...


class Composed(NamedTuple):
    """Inputs of a response: sums of slots, corrections of columns, and the terms that they are made of."""

    # sum of the terms of each slot, (…, n); slots without a term are left out
    slots: dict[str, Any]
    moves: dict[str, Any]  # correction of each column of the readings
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
    """Return a term's coefficient at each reading (…, n), or one for all (…, 1), x (…, p) being in reported units."""
    xp = source.xp
    coefficients = members(xp, term, x, hyper)
    if term.per is None:
        return coefficients
    none = xp.zeros((*coefficients.shape[:-1], 1))  # the code of no member is −1
    return xp.concatenate([coefficients, none], axis=-1)[..., source.codes[term.per]]


def members(xp: Any, term: Term, x: Any, hyper: Hyper) -> Any:
    """Return a term's coefficient, one number for each member of its group (…, size)."""
    if term.place == "x":
        return x[..., term.at]
    draws = x.shape[:-1]
    if term.place in ("fixed", "input"):
        return xp.full((*draws, term.size), term.value)
    entries = [xp.broadcast_to(xp.asarray(hyper[name]), draws) for name in term.member_names()]
    coefficients = xp.stack(entries, axis=-1)
    if term.group_sd_name is not None:
        # Held in units of its learned spread (non-centred), so that a spread near zero makes no funnel (O.
        # Papaspiliopoulos, G. Roberts and M. Sköld, Stat. Sci. 22 (2007) 59).
        spread = xp.broadcast_to(xp.asarray(hyper[term.group_sd_name]), draws)
        coefficients = term.mean + spread[..., None] * coefficients
    return coefficients


def compose(
    source: ColumnSource,
    terms: Sequence[Term],
    values: list[Any],
    hyper: Hyper,
    sloped: bool = False,
) -> Composed:
    """Sum the terms of each slot; with `sloped`, return slopes of columns by corrections too.

    Effects that correct a column of the readings see these as recorded, the others the corrected ones.
    """
    columns: list[Any] = [None] * len(terms)
    by_move: list[Mapping[str, Any]] = [{}] * len(terms)
    moves: dict[str, Any] = {}
    slots: dict[str, Any] = {}
    correcting = [i for i, t in enumerate(terms) if t.slot not in source.slots]
    others = [i for i, t in enumerate(terms) if t.slot in source.slots]
    for places, sums in ((correcting, moves), (others, slots)):
        shifts = {} if sums is moves else moves
        for _, group in groupby(places, lambda i: terms[i].effect.name):
            together = list(group)
            first = terms[together[0]]
            shapes = [hyper[name] for name in first.shape_names]
            basis_columns, slopes = source.columns(first, shapes, shifts, sloped)
            for i in together:
                t = terms[i]
                columns[i] = basis_columns[..., t.index] * t.factor
                by_move[i] = {name: s[..., t.index] * t.factor for name, s in slopes.items()}
            _add(source.xp, sums, [(terms[i], columns[i], values[i]) for i in together])
    return Composed(slots, moves, values, columns, by_move)


def _add(xp: Any, sums: dict[str, Any], triples: list[tuple[Term, Any, Any]]) -> None:
    """Add terms of one effect to the sums of their slots."""
    for slot, group in groupby(triples, lambda triple: triple[0].slot):
        part = list(group)
        if len(part) > 2 and all(v.shape[-1] == 1 and c.ndim == 1 for _, c, v in part):
            # Of an effect of many columns that all draws share: one product.
            columns = xp.stack([c for _, c, _ in part])
            share = xp.concatenate([v for *_, v in part], axis=-1) @ columns
            sums[slot] = sums[slot] + share if slot in sums else share
            continue
        for _, column, v in part:
            sums[slot] = sums[slot] + column * v if slot in sums else column * v


def expected(source: ColumnSource, composed: Composed) -> Any:
    """Return the expected output, output unit (…, n)."""
    return source.response(composed.slots, composed.moves)


def slopes(
    source: ColumnSource, terms: Sequence[Term], composed: Composed
) -> tuple[Any, dict[str, Any]]:
    """Return the expected output, and its slopes by each slot and corrected column (…, n); `composed` with slopes."""
    mean, direct = source.slopes(composed.slots, composed.moves)
    by_name = dict(direct)
    # Chain rule: a correction of a column moves the output by ∂μ/∂column + Σ ∂μ/∂slot·∂slot/∂column.
    for t, by_move, v in zip(terms, composed.by_move, composed.values, strict=True):
        for name, slope in by_move.items():
            by_name[name] = by_name[name] + by_name[t.slot] * slope * v
    return mean, by_name


def linearised(source: ColumnSource, terms: Sequence[Term], composed: Composed) -> Linearised:
    """Return the expected output and its Jacobian by the coefficients of these terms; `composed` with slopes."""
    mean, by_slot = slopes(source, terms, composed)
    tabled = _in_one_table if source.xp is np else _in_one_product
    rows = [(t, c, by_slot[t.slot]) for t, c in zip(terms, composed.columns, strict=True)]
    return Linearised(
        mean, *(tabled(source, mean, [e for e in rows if e[0].place == p]) for p in ("x", "input"))
    )


def variance_of_inputs(terms: Sequence[Term], line: Linearised) -> Any:
    """Return the variance of each reading from noise on inputs, to first order (…, n).

    Source: JCGM 100:2008, 5.1.2.
    """
    sd = np.array([t.prior_sd for t in terms if t.place == "input"])
    return ((line.inputs * sd) ** 2).sum(axis=-1)


def _in_one_table(source: ColumnSource, mean: np.ndarray, triples: list[tuple]) -> np.ndarray:
    """Return a Jacobian (…, n, q), written term by term into one table, whose columns lie together in memory."""
    width = sum(1 if _codes(source, t) is None else t.size for t, *_ in triples)
    jacobian, at = np.zeros((*mean.shape[:-1], width, mean.shape[-1])), 0
    for t, column, slope in triples:
        entries, codes = slope * column, _codes(source, t)
        if codes is None:
            jacobian[..., at, :] = entries
            at += 1
            continue
        rows = np.flatnonzero(codes >= 0)
        jacobian[..., at + codes[rows], rows] = np.broadcast_to(entries, mean.shape)[..., rows]
        at += t.size
    return np.swapaxes(jacobian, -1, -2)


def _in_one_product(source: ColumnSource, mean: Any, triples: list[tuple]) -> Any:
    """Return a Jacobian (n, q) in a program: slopes multiplied one after the other would compile into each column."""
    columns = [jnp.zeros((*mean.shape, 0))]
    slopes = list(columns)
    for t, column, slope in triples:
        column, slope = (jnp.broadcast_to(a, mean.shape) for a in (column, slope))
        columns.append(by_member(column, _codes(source, t), t.size))
        slopes.append(jnp.broadcast_to(slope[..., None], columns[-1].shape))
    return jnp.concatenate(columns, axis=-1) * jnp.concatenate(slopes, axis=-1)


def _codes(source: ColumnSource, t: Term) -> Any:
    return None if t.per is None else source.codes[t.per]


def by_member(column: Any, codes: Any, size: int) -> Any:
    """Spread a coefficient's column (…, n) over the members of its group (…, n, size); codes None for no group."""
    if codes is None:
        return column[..., None]
    return column[..., None] * (codes[:, None] == np.arange(size))


class Traced:
    """Column source that evaluates effects and instrument in a JAX program: one draw, differentiable by all."""

    xp = jnp

    def __init__(self, instrument: Instrument, frame: Frame) -> None:
        self.instrument, self.frame = instrument, frame
        self.size, self.codes = frame.size, frame.codes
        self.slots = tuple(s.name for s in instrument.slots)

    @property
    def read(self) -> frozenset[str]:
        """Return the columns that the response reads itself."""
        return columns_read(self.instrument, self.frame)

    def matrix(self, basis: Basis, frame: Frame, shapes: Mapping[str, Any]) -> Any:
        """Evaluate a basis as a matrix of columns."""
        return matrix(*basis, frame, shapes)

    def columns(self, term: Term, shapes: Sequence[Any], moves: dict, sloped: bool) -> tuple:
        of = term.columns
        at, shape_values = len(of.own), dict(zip(of.own, shapes, strict=False))
        shifts: dict[str, Any] = {}
        for c in of.corrections:
            theirs = dict(zip(c.of.shapes, shapes[at:], strict=False))
            at += len(c.of.shapes)
            shift = c.factor * self.matrix(c.of.basis, self.frame, theirs)[:, c.index]
            shifts[c.column + PATH] = shifts.get(c.column + PATH, 0.0) + shift

        def evaluate(moves: dict) -> Any:
            total = {n: shifts.get(n, 0.0) + moves.get(n, 0.0) for n in {**shifts, **moves}}
            return self.matrix(of.basis, self.frame.moved(total), shape_values)

        if not (moves and sloped):
            return evaluate(moves), {}
        moves = {name: jnp.broadcast_to(shift, (self.size,)) for name, shift in moves.items()}
        columns, push = jax.linearize(evaluate, moves)
        return columns, {name: push(_alone(moves, name)) for name in moves}

    def _whole(self, values: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
        return {name: jnp.broadcast_to(values.get(name, 0.0), (self.size,)) for name in names}

    def response(self, slots: dict, moves: dict) -> Any:
        output = self.instrument.response(self._whole(slots, self.slots), self.frame.moved(moves))
        return jnp.broadcast_to(output, (self.size,))

    def slopes(self, slots: dict, moves: dict) -> tuple[Any, dict[str, Any]]:
        slots, moves = self._whole(slots, self.slots), self._whole(moves, moves)
        return slopes_of(self.response, slots, moves, self.instrument.vector is not None)


def slopes_of(
    response: Any, slots: dict[str, Any], moves: dict[str, Any], backward: bool
) -> tuple[Any, dict[str, Any]]:
    """Return a response (n,) and its slopes by each slot and move; by reverse mode (`backward`) for dozens of slots."""
    if backward and not moves:
        mean, pull = jax.vjp(lambda values: response(values, {}), slots)
        return mean, pull(jnp.ones_like(mean))[0]
    # The output of a reading depends on its own slots alone: a vector of ones pushed forward holds each one's slope.
    # Moves go before slots where both have a name.
    mean, push = jax.linearize(response, slots, moves)
    none = [jax.tree.map(jnp.zeros_like, part) for part in (slots, moves)]
    by_slot = {name: push(_alone(slots, name), none[1]) for name in slots}
    return mean, by_slot | {name: push(none[0], _alone(moves, name)) for name in moves}


def _alone(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return ones for one name, zeros for the others."""
    return {n: jnp.ones_like(v) if n == name else jnp.zeros_like(v) for n, v in values.items()}


def columns_read(instrument: Instrument, frame: Frame) -> frozenset[str]:
    """Return the columns of the readings that an instrument's response reads itself, beside its slots."""
    names_read = set[str]()

    class RecordingDict(dict[str, Any]):
        def __getitem__(self, name: str) -> Any:
            names_read.add(name)
            return super().__getitem__(name)

    slots = {s.name: np.zeros(frame.size) for s in instrument.slots}
    instrument.response(slots, replace(frame, columns=RecordingDict(frame.columns)))
    return frozenset(names_read)
