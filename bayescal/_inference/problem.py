"""A model bound to readings: expected output, Jacobian and priors, from cached basis columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bayescal._inference.gaussian import Gram, Prior, XDraws, draw_x
from bayescal._inference.record import Record
from bayescal._model.composition import (
    Linearisation,
    ResponseArguments,
    compose,
    compute_input_variance,
    differentiate_output,
    expand_coefficient,
    linearise_output,
)
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import NONLINEAR_KINDS, Layout, Unknown
from bayescal._model.prior import slope
from bayescal._model.terms import PriorDeviations, Term, build_terms

Values = dict[str, float]
Arrays = Mapping[str, Any]
ZERO_SD_COORDINATE = -30.0  # coordinate of a negligible standard deviation (1e-13 of its scale)


class Host:
    """Source of a record's cached basis columns and responses in NumPy, for one or many draws (a `ColumnSource`)."""

    xp = np

    def __init__(self, record: Record) -> None:
        self.record = record
        self.size: int = record.size
        self.slots: tuple[str, ...] = record.slots
        self.codes: Mapping[str, Any] = record.codes

    def columns(self, term: Term, shapes: Sequence[Any], shifts: Arrays, with_grad: bool) -> Any:
        spec, record = term.columns, self.record
        if any(np.ndim(s) for s in shapes) or any(m.ndim > 1 for m in shifts.values()):
            if with_grad:
                return record.differentiate_columns(spec, shapes, shifts)
            return record.columns_of_draws(spec, shapes, shifts), {}
        if not shifts:
            return record.columns(spec, tuple(map(float, shapes))), {}
        values = [np.atleast_1d(float(s)) for s in shapes]
        shifts = {n: m[None] for n, m in shifts.items()}
        columns, derivatives = record.differentiate_columns(spec, values, shifts)
        return columns[0], {n: d[0] for n, d in derivatives.items()}

    def response(self, slots: Arrays, shifts: Arrays) -> np.ndarray:
        return self.record.respond(slots, shifts, with_grad=False)[0]

    def differentiate_output(self, slots: Arrays, shifts: Arrays) -> tuple[np.ndarray, Arrays]:
        return self.record.respond(slots, shifts)


@dataclass(eq=False)
class Problem:
    """A model bound to a record of readings; size_factors: effect → factor of its prior standard deviations."""

    layout: Layout
    record: Record
    size_factors: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        layout = self.layout
        terms = build_terms(layout.blocks, self.record, self.size_factors)
        self.terms: tuple[Term, ...] = terms[0]
        self.corrected_columns: tuple[str, ...] = terms[1]
        self.host: Host = Host(self.record)
        self.hypers: tuple[Unknown, ...] = layout.hypers
        self.size: int = sum(t.size for t in self.terms if t.place == "x")
        self.is_noisy: bool = any(t.place == "input" for t in self.terms)  # has noise on an input
        self.noise: Noise = layout.model.noise
        self.fixed_values: dict[str, float] = dict(layout.model.fixed)
        # A promoted coefficient in units of a learned standard deviation changes with it.
        group_sd_names = {t.group_sd_name for t in self.terms if t.place == "phi"}
        self.kinds: list[str] = [h.kind for h in self.hypers]
        is_nonlinear = (h.kind in NONLINEAR_KINDS or h.name in group_sd_names for h in self.hypers)
        self.nonlinear_phi: list[int] = [i for i, nonlinear in enumerate(is_nonlinear) if nonlinear]
        self.mean_of_x: Float[np.ndarray, "p"] = layout.mean_of_x
        self.weight_of_x: Float[np.ndarray, "p"] = layout.weight_of_x

    def hyper(self, v: Sequence[float] | np.ndarray) -> Values:
        """Return hyper-parameters and fixed unknowns by name, at coordinates v of φ, in reported units."""
        return self.layout.hyper(v)

    def hyper_of_each(self, vs: Float[np.ndarray, "b d"]) -> list[dict[str, float]]:
        """Return hyper-parameters and fixed unknowns by name, one dictionary per row of coordinates of φ (b, d)."""
        columns = {n: np.broadcast_to(v, len(vs)) for n, v in self.hyper(vs.T).items()}
        return [{n: float(c[i]) for n, c in columns.items()} for i in range(len(vs))]

    def log_prior(self, v: np.ndarray) -> float:
        """Return the log prior density of φ at its coordinates v."""
        return float(self.layout.log_prior(v))

    def draw_x(
        self,
        gram: Gram,
        vs: Float[np.ndarray, "b d"],
        flat_scales: Float[np.ndarray, "p"],
        origin: Float[np.ndarray, "p"],
        deviates: Float[np.ndarray, "b p"] | float = 0.0,
    ) -> XDraws:
        """Return draws of x given each of several φ, from normal deviates (0: the mean), and log likelihoods of φ."""
        prior = self.prior(self.hyper(vs.T), flat_scales, (len(vs),))
        deviates = np.broadcast_to(deviates, (len(vs), self.size))
        return draw_x(gram, self.record.size, prior, origin, deviates)

    def log_priors(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b"]:
        """Return the log prior densities of φ at several coordinates v (b, d), one for each (b,)."""
        return self.layout.log_prior(v.T)

    def value_and_sd(self, name: str, v: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
        """Return the value of an entry of φ at v and its standard uncertainty, given the covariance of coordinates."""
        i = self.layout.index_in_phi[name]
        prior = self.hypers[i].prior
        return float(prior.value(v[i])), abs(slope(prior, v[i])) * math.sqrt(covariance[i, i])

    @cached_property
    def in_x(self) -> tuple[Term, ...]:
        return tuple(t for t in self.terms if t.place == "x")

    @cached_property
    def sizes(self) -> PriorDeviations:
        """Return the prior standard deviations of x as a function of φ."""
        return PriorDeviations(self.in_x, self.layout.model.effects, self.size)

    def prior(
        self, hyper: Mapping[str, Any], flat_scales: np.ndarray, count: tuple[int, ...] = ()
    ) -> Prior:
        """Return the prior of x given φ, or each of b φ if `count` is (b,); flat_scales: scales of flat priors."""
        sd = np.where(self.weight_of_x > 0, self.sizes.evaluate(hyper, count), flat_scales)
        return Prior(self.mean_of_x, sd, self.weight_of_x)

    def member_sd(self, term: Term, hyper: Mapping[str, Any], count: int) -> Float[np.ndarray, "b"]:
        """Return the prior standard deviation of one group member's coefficient at each of `count` φ (b,)."""
        if term.place == "x":
            return self.sizes.evaluate(hyper, (count,))[:, term.x_slice.start]
        sd = term.prior_sd if term.group_sd_name is None else hyper[term.group_sd_name]
        return np.broadcast_to(sd, (count,))

    @property
    def start(self) -> Float[np.ndarray, "p"]:
        """Return the starting point of x: prior means, or 0 (the origin) for coefficients with an origin (p,)."""
        return np.where(self.layout.x_origins != 0.0, 0.0, self.mean_of_x)

    def map_x(self, other: Problem, x: Float[np.ndarray, "q"]) -> Float[np.ndarray, "p"]:
        """Return this problem's x (p,) with the coefficients x (q,) of another problem; the others: prior means."""
        mapped_x, slices = self.start, {(t.effect.name, t.index): t.x_slice for t in other.in_x}
        for t in self.in_x:
            if (x_slice := slices.get((t.effect.name, t.index))) is not None:
                mapped_x[t.x_slice] = x[x_slice]
        return mapped_x

    def value(self, t: Term, x: np.ndarray, hyper: Mapping[str, Any]) -> np.ndarray:
        """Return a term's coefficient at each reading (…, n), or one for all (…, 1)."""
        return expand_coefficient(self.host, t, x, hyper)

    def compose(
        self, terms: Sequence[Term], x: Any, hyper: Mapping[str, Any], with_grad: bool = False
    ) -> ResponseArguments:
        """Return the arguments of the response, sums of terms, at x (p,) or at draws of x (b, p)."""
        values = [self.value(t, x, hyper) for t in terms]
        return compose(self.host, terms, values, hyper, with_grad)

    @cached_property
    def is_affine(self) -> bool:
        """Return whether the expected output is affine in x."""
        return not self.corrected_columns and self.record.affine_map is not None

    @cached_property
    def _dynamic_terms(self) -> tuple[Term, ...]:
        """Return the terms to evaluate at each φ: those that depend on φ if the output is affine in x, else all."""
        is_affine = self.is_affine
        return tuple(t for t in self.terms if not is_affine or t.place != "x" or t.columns.names)

    @cached_property
    def priors(self) -> dict[str, Any]:
        """Return the priors of φ's coordinates, by name."""
        return {h.name: h.prior for h in self.hypers}

    def clear_cache(self) -> None:
        """Drop the cached Jacobian."""
        vars(self).pop("_static_jacobian", None)

    @cached_property
    def _static_jacobian(self) -> tuple[Float[np.ndarray, "n p"], Int[np.ndarray, "q"]]:
        """Return the Jacobian of φ-independent terms (other columns zero), and the indices in x of φ-dependent ones."""
        indices = np.arange(self.size)
        dynamic_indices = np.concatenate(
            [indices[:0], *(indices[t.x_slice] for t in self._dynamic_terms if t.place == "x")]
        )
        jacobian = np.zeros((self.record.size, self.size), order="F")
        if self.is_affine:
            terms = [t for t in self.in_x if not t.columns.names]
            point = np.zeros(self.size), self.fixed_values
            static = linearise_output(self.host, terms, self.compose(terms, *point, with_grad=True))
            jacobian[:, np.setdiff1d(indices, dynamic_indices)] = static.jacobian
        return jacobian, dynamic_indices

    def slopes(
        self, x: Float[np.ndarray, "p"], hyper: Values
    ) -> Mapping[str, Float[np.ndarray, "n"]]:
        """Return the derivatives of the expected output with respect to each slot and corrected column, (n,) each."""
        terms = () if self.is_affine else self.terms
        composed = self.compose(terms, x, hyper, with_grad=True)
        return differentiate_output(self.host, terms, composed)[1]

    def linearise(self, x: Float[np.ndarray, "*b p"], hyper: Mapping[str, Any]) -> Linearisation:
        """Return expected output and Jacobian at x, or at draws of x, in the output unit per reported unit."""
        line = self.linearise_dynamic(x, hyper)
        if not self.is_affine:
            return line
        static_jacobian, dynamic_indices = self._static_jacobian
        jacobian = np.tile(static_jacobian, (*line.mean.shape[:-1], 1, 1))
        jacobian[..., dynamic_indices] = line.jacobian
        return Linearisation(line.mean + x @ static_jacobian.T, jacobian, line.inputs)

    def linearise_dynamic(
        self,
        x: Float[np.ndarray, "*b p"],
        hyper: Mapping[str, Any],
        terms: Sequence[Term] | None = None,
    ) -> Linearisation:
        """Return the expected output and Jacobian of φ-dependent terms only (`_dynamic_terms`), or of given terms."""
        terms = self._dynamic_terms if terms is None else terms
        return linearise_output(self.host, terms, self.compose(terms, x, hyper, with_grad=True))

    def extra(self, line: Linearisation) -> Float[np.ndarray, "n"] | float:
        """Return the variance of each reading from noisy inputs, output unit squared (n,), or 0."""
        return compute_input_variance(self.terms, line) if self.is_noisy else 0.0

    def expected(self, x: Any, hyper: Mapping[str, Any]) -> Float[np.ndarray, "b n"]:
        """Return the expected output of joint draws, output unit (b, n)."""
        composed = self.compose(self._dynamic_terms, x, hyper)
        mean = self.host.response(composed.slots, composed.shifts)
        if self.is_affine:
            return mean + x @ self._static_jacobian[0].T
        return np.broadcast_to(mean, (len(x), self.record.size))  # one row if there are no terms

    def expected_with_slopes(
        self, x: Any, hyper: Mapping[str, Any], terms: Sequence[Term]
    ) -> tuple[Float[np.ndarray, "b n"], list[np.ndarray]]:
        """Return the expected output of joint draws, and its derivatives with respect to each term at every reading."""
        with_grad = any(t.slot not in self.host.slots for t in terms)
        composed = self.compose(self.terms, x, hyper, with_grad)
        mean, by_slot = differentiate_output(self.host, self.terms, composed)
        term_ids = {id(t) for t in terms}
        pairs = zip(self.terms, composed.columns, strict=True)
        return mean, [by_slot[t.slot] * column for t, column in pairs if id(t) in term_ids]

    def expected_and_extra(
        self, x: Any, hyper: Mapping[str, Any]
    ) -> tuple[Float[np.ndarray, "b n"], Any]:
        """Return the expected output of joint draws, and the variance from noisy inputs (b, n), or 0."""
        if not self.is_noisy:
            return self.expected(x, hyper), 0.0
        inputs = [t for t in self.terms if t.place == "input"]
        mean, derivatives = self.expected_with_slopes(x, hyper, inputs)
        variances = [(s * t.prior_sd) ** 2 for t, s in zip(inputs, derivatives, strict=True)]
        return mean, np.broadcast_to(sum(variances), mean.shape)


def differentiate(f: Callable[[np.ndarray], Any], point: np.ndarray, step: Any) -> np.ndarray:
    """Return ∂f/∂point (d, …) by central differences; step: one number for all coordinates, or one for each (d,)."""
    shifts = np.diag(np.broadcast_to(step, point.shape))
    return np.array([(f(point + s) - f(point - s)) / (2 * s.sum()) for s in shifts])


def overwrite(values: np.ndarray, indices: list[int], v: np.ndarray) -> np.ndarray:
    """Return a copy of v with the entries at `indices` replaced by `values`, in order."""
    copy = v.copy()
    copy[indices] = values
    return copy
