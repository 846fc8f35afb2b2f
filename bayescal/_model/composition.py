"""Composition of effects: the expected output of an instrument, and its derivatives with respect to coefficients.

    output = response(Σ columns · coefficients of each slot; the readings with their columns corrected)

All users of a model evaluate it by `compose`. Basis columns and responses come from a `ColumnSource`: `TracedColumns`
evaluates them in a JAX program, `Host` (`_inference/problem.py`) caches them. Leading array axes are posterior draws.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayescal._core.lazy_jax import jax, jnp
from bayescal._model.effect import Basis
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument
from bayescal._model.terms import ColumnSpec, Term

Hyper = Mapping[str, Any]  # hyper-parameters φ by name: a number, or one value per draw


class ColumnSource(Protocol):
    """Interface that evaluates basis columns and the instrument's response on one set of readings."""

    xp: Any  # NumPy, or JAX's
    size: int  # number of readings, n
    slots: tuple[str, ...]  # names of the instrument's slots: quantities that effects add to
    codes: Mapping[str, Any]  # group → index of each reading's member (n,), −1 for none

    def columns(self, term: Term, shapes: Sequence[Any], shifts: dict, with_grad: bool) -> tuple:
        """Return the basis columns (…, n, k) of a term's effect at `shapes`; with_grad: also derivatives by column."""
        ...

    def response(self, slots: dict, shifts: dict) -> Any:
        """Return the expected output (…, n) at values of the slots and shifts of the columns."""
        ...

    def differentiate_output(self, slots: dict, shifts: dict) -> tuple[Any, Mapping[str, Any]]:
        """Return the expected output, and its derivatives with respect to each slot and corrected column, (…, n)."""
        ...


class ResponseArguments(NamedTuple):
    """Arguments of the instrument's response: slot values and column corrections, and the terms that they sum."""

    slots: dict[str, Any]  # slot → sum of its terms (…, n), slot unit; absent if it has none
    shifts: dict[str, Any]  # column of the readings → correction added to it (…, n)
    values: list[Any]  # each term's coefficient at each reading, (…, n), or one for all, (…, 1)
    columns: list[Any]  # each term's basis column (…, n), slot unit per reported unit
    column_grads: list[Mapping[str, Any]]  # ∂(basis column)/∂(shifted column), for each pair


class Linearisation(NamedTuple):
    """First-order expansion of the expected output about one point.

    mean: expected output (…, n). jacobian, inputs: derivatives with respect to x (…, n, p), to noisy inputs (…, n, k).
    """

    mean: Any
    jacobian: Any
    inputs: Any


def expand_coefficient(source: ColumnSource, term: Term, x: Any, hyper: Hyper) -> Any:
    """Return a term's coefficient at each reading (…, n), or one for all (…, 1), from x (…, p) in reported units."""
    xp = source.xp
    coefficients = evaluate_members(xp, term, x, hyper)
    if term.per is None:
        return coefficients
    zero = xp.zeros((*coefficients.shape[:-1], 1))  # the code of no member is −1
    return xp.concatenate([coefficients, zero], axis=-1)[..., source.codes[term.per]]


def evaluate_members(xp: Any, term: Term, x: Any, hyper: Hyper) -> Any:
    """Return a term's coefficient, one number for each member of its group (…, size)."""
    if term.place == "x":
        return x[..., term.x_slice]
    draws = x.shape[:-1]
    if term.place in ("fixed", "input"):
        return xp.full((*draws, term.size), term.value)
    entries = [xp.broadcast_to(xp.asarray(hyper[name]), draws) for name in term.member_names()]
    coefficients = xp.stack(entries, axis=-1)
    if term.group_sd_name is not None:
        # In units of the learned standard deviation (non-centred), so that a small one makes no funnel (O.
        # Papaspiliopoulos, G. Roberts and M. Sköld, Stat. Sci. 22 (2007) 59).
        group_sd = xp.broadcast_to(xp.asarray(hyper[term.group_sd_name]), draws)
        coefficients = term.mean + group_sd[..., None] * coefficients
    return coefficients


def compose(
    source: ColumnSource,
    terms: Sequence[Term],
    values: list[Any],
    hyper: Hyper,
    with_grad: bool = False,
) -> ResponseArguments:
    """Sum the terms of each slot, of coefficients `values`; with_grad: differentiate bases by corrected columns too.

    Bases of effects that correct a column are evaluated on the recorded columns, all others on corrected ones.
    """
    columns: list[Any] = [None] * len(terms)
    grads: list[Mapping[str, Any]] = [{}] * len(terms)
    shifts: dict[str, Any] = {}
    slots: dict[str, Any] = {}
    correction_indices = [i for i, t in enumerate(terms) if t.slot not in source.slots]
    slot_indices = [i for i, t in enumerate(terms) if t.slot in source.slots]
    for indices, sums in ((correction_indices, shifts), (slot_indices, slots)):
        column_shifts = {} if sums is shifts else shifts
        for _, group in groupby(indices, lambda i: terms[i].effect.name):
            term_indices = list(group)
            first_term = terms[term_indices[0]]
            shapes = [hyper[name] for name in first_term.columns.names]
            basis, basis_grads = source.columns(first_term, shapes, column_shifts, with_grad)
            for i in term_indices:
                t = terms[i]
                columns[i] = basis[..., t.index] * t.factor
                grads[i] = {name: g[..., t.index] * t.factor for name, g in basis_grads.items()}
            _add_terms(source.xp, sums, [(terms[i], columns[i], values[i]) for i in term_indices])
    return ResponseArguments(slots, shifts, values, columns, grads)


def _add_terms(xp: Any, totals: dict[str, Any], triples: list[tuple[Term, Any, Any]]) -> None:
    """Add the terms of one effect, triples (term, basis column, coefficient), to the totals of their slots."""
    for slot, group in groupby(triples, lambda triple: triple[0].slot):
        parts = list(group)
        if len(parts) > 2 and all(v.shape[-1] == 1 and c.ndim == 1 for _, c, v in parts):
            # Columns without a draw axis: one matrix product instead of a sum of terms.
            columns = xp.stack([c for _, c, _ in parts])
            sum_of_terms = xp.concatenate([v for *_, v in parts], axis=-1) @ columns
            totals[slot] = totals[slot] + sum_of_terms if slot in totals else sum_of_terms
            continue
        for _, column, v in parts:
            totals[slot] = totals[slot] + column * v if slot in totals else column * v


def differentiate_output(
    source: ColumnSource, terms: Sequence[Term], composed: ResponseArguments
) -> tuple[Any, dict[str, Any]]:
    """Return the expected output (…, n), and its derivatives (…, n) with respect to each slot and corrected column."""
    mean, partials = source.differentiate_output(composed.slots, composed.shifts)
    derivatives = dict(partials)
    # Chain rule: dμ/dcolumn = ∂μ/∂column + Σ ∂μ/∂slot·∂slot/∂column.
    for t, grads, v in zip(terms, composed.column_grads, composed.values, strict=True):
        for name, grad in grads.items():
            derivatives[name] = derivatives[name] + derivatives[t.slot] * grad * v
    return mean, derivatives


def linearise_output(
    source: ColumnSource, terms: Sequence[Term], arguments: ResponseArguments
) -> Linearisation:
    """Return the expected output and its Jacobians; `arguments`: the result of `compose` with `with_grad=True`."""
    mean, derivatives = differentiate_output(source, terms, arguments)
    assemble = _assemble_jacobian if source.xp is np else _trace_jacobian
    triples = [(t, c, derivatives[t.slot]) for t, c in zip(terms, arguments.columns, strict=True)]
    triples_by_place = ([t for t in triples if t[0].place == place] for place in ("x", "input"))
    return Linearisation(mean, *(assemble(source, mean, group) for group in triples_by_place))


def compute_input_variance(terms: Sequence[Term], linearisation: Linearisation) -> Any:
    """Return each reading's variance due to noise on inputs (…, n), output unit², to first order (JCGM 100, 5.1.2)."""
    sd = np.array([t.prior_sd for t in terms if t.place == "input"])
    return ((linearisation.inputs * sd) ** 2).sum(axis=-1)


def _assemble_jacobian(source: ColumnSource, mean: np.ndarray, triples: list[tuple]) -> np.ndarray:
    """Assemble the Jacobian (…, n, q) with NumPy, one term after the other, each column contiguous in memory."""
    column_count = sum(1 if _get_member_codes(source, t) is None else t.size for t, *_ in triples)
    jacobian, start = np.zeros((*mean.shape[:-1], column_count, mean.shape[-1])), 0
    for term, column, derivative in triples:
        entries, codes = derivative * column, _get_member_codes(source, term)
        if codes is None:
            jacobian[..., start, :] = entries
            start += 1
            continue
        rows = np.flatnonzero(codes >= 0)
        jacobian[..., start + codes[rows], rows] = np.broadcast_to(entries, mean.shape)[..., rows]
        start += term.size
    return np.swapaxes(jacobian, -1, -2)


def _trace_jacobian(source: ColumnSource, mean: Any, triples: list[tuple]) -> Any:
    """Assemble the Jacobian (n, q) in a JAX program, as one product: one product per column compiles slowly."""
    columns = [jnp.zeros((*mean.shape, 0))]
    derivatives = list(columns)
    for term, column, derivative in triples:
        column, derivative = (jnp.broadcast_to(a, mean.shape) for a in (column, derivative))
        columns.append(expand_members(column, _get_member_codes(source, term), term.size))
        derivatives.append(jnp.broadcast_to(derivative[..., None], columns[-1].shape))
    return jnp.concatenate(columns, axis=-1) * jnp.concatenate(derivatives, axis=-1)


def _get_member_codes(source: ColumnSource, t: Term) -> Any:
    return None if t.per is None else source.codes[t.per]


def expand_members(column: Any, codes: Any, size: int) -> Any:
    """Expand a basis column (…, n) to one column per group member (…, n, size); codes: None if there is no group."""
    if codes is None:
        return column[..., None]
    return column[..., None] * (codes[:, None] == np.arange(size))


class TracedColumns:
    """Source of basis columns and responses in a JAX program, for one draw: a differentiable `ColumnSource`."""

    xp = jnp

    def __init__(self, instrument: Instrument, frame: Frame) -> None:
        self.instrument, self.frame = instrument, frame
        self.size, self.codes = frame.size, frame.codes
        self.slots = tuple(s.name for s in instrument.slots)

    @property
    def response_columns(self) -> frozenset[str]:
        """Return the columns of the readings that the instrument's response uses directly."""
        return find_response_columns(self.instrument, self.frame)

    def evaluate_basis(self, basis: Basis, frame: Frame, shapes: Mapping[str, Any]) -> Any:
        """Evaluate an effect's basis function as a matrix of columns (n, k)."""
        return basis.evaluate(frame, shapes)

    def columns(self, term: Term, shapes: Sequence[Any], shifts: dict, with_grad: bool) -> tuple:
        spec = term.columns
        basis_shapes = dict(zip(spec.basis_shapes, shapes, strict=False))

        def evaluate_correction(spec: ColumnSpec, values: Sequence[Any]) -> Any:
            named_values = dict(zip(spec.shapes, values, strict=True))
            return self.evaluate_basis(spec.basis, self.frame, named_values)

        path_shifts = spec.shift_paths(shapes, evaluate_correction)

        def evaluate(shifts: dict) -> Any:
            totals = {n: path_shifts.get(n, 0.0) + shifts.get(n, 0.0) for n in path_shifts | shifts}
            return self.evaluate_basis(spec.basis, self.frame.shift_columns(totals), basis_shapes)

        if not (shifts and with_grad):
            return evaluate(shifts), {}
        shifts = self._broadcast(shifts, shifts)
        columns, jvp = jax.linearize(evaluate, shifts)
        return columns, {name: jvp(_make_tangent(shifts, name)) for name in shifts}

    def _broadcast(self, values: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
        return {name: jnp.broadcast_to(values.get(name, 0.0), (self.size,)) for name in names}

    def response(self, slots: dict, shifts: dict) -> Any:
        slots = self._broadcast(slots, self.slots)
        output = self.instrument.response(slots, self.frame.shift_columns(shifts))
        return jnp.broadcast_to(output, (self.size,))

    def differentiate_output(self, slots: dict, shifts: dict) -> tuple[Any, dict[str, Any]]:
        slots, shifts = self._broadcast(slots, self.slots), self._broadcast(shifts, shifts)
        is_vector = self.instrument.vector is not None
        return differentiate_response(self.response, slots, shifts, is_vector)


def differentiate_response(
    response: Any, slots: dict[str, Any], shifts: dict[str, Any], reverse_mode: bool
) -> tuple[Any, dict[str, Any]]:
    """Return a response (n,) and its derivatives by slot and column; `reverse_mode` is faster for many slots."""
    if reverse_mode and not shifts:
        mean, vjp = jax.vjp(lambda values: response(values, {}), slots)
        return mean, vjp(jnp.ones_like(mean))[0]
    # Each reading's output depends on its own slot values alone: a tangent of ones gives all derivatives at once.
    # Where a slot and a corrected column share a name the correction's derivative replaces the slot's.
    mean, jvp = jax.linearize(response, slots, shifts)
    zeros = [jax.tree.map(jnp.zeros_like, arguments) for arguments in (slots, shifts)]
    by_slot = {name: jvp(_make_tangent(slots, name), zeros[1]) for name in slots}
    return mean, by_slot | {name: jvp(zeros[0], _make_tangent(shifts, name)) for name in shifts}


def _make_tangent(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the tangent vector that is one for `name` and zero for all other names."""
    return {n: jnp.ones_like(v) if n == name else jnp.zeros_like(v) for n, v in values.items()}


def find_response_columns(instrument: Instrument, frame: Frame) -> frozenset[str]:
    """Evaluate the response once and return the names of the columns of the readings that it uses."""
    used_names = set[str]()

    class RecordingDict(dict[str, Any]):
        def __getitem__(self, name: str) -> Any:
            used_names.add(name)
            return super().__getitem__(name)

    slots = {s.name: np.zeros(frame.size) for s in instrument.slots}
    instrument.response(slots, replace(frame, columns=RecordingDict(frame.columns)))
    return frozenset(used_names)
