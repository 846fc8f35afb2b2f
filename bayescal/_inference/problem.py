"""A model bound to readings: its expected output, Jacobian and priors, put together from columns and slopes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bayescal._inference.gaussian import Drawn, Gram, Prior, draw
from bayescal._inference.record import Record
from bayescal._model.composition import (
    Composed,
    Linearised,
    compose,
    linearised,
    slopes,
    value,
    variance_of_inputs,
)
from bayescal._model.composition import expected as expected_of
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import MOVING, Layout, Unknown
from bayescal._model.prior import slope
from bayescal._model.terms import Sizes, Term, terms_of

Values = dict[str, float]
Moves = Mapping[str, Any]
ABSENT = -30.0  # coordinate of a standard deviation that is not there (1e-13 of its scale)


class Host:
    """A record as the source of a composition: it keeps columns and responses. Of one draw, or of several."""

    xp = np

    def __init__(self, record: Record) -> None:
        self.record = record
        self.size: int = record.size
        self.slots: tuple[str, ...] = record.slots
        self.codes: Mapping[str, Any] = record.codes

    def columns(self, term: Term, shapes: Sequence[Any], moves: Moves, sloped: bool) -> Any:
        of, record = term.columns, self.record
        if any(np.ndim(s) for s in shapes) or any(m.ndim > 1 for m in moves.values()):
            if sloped:
                return record.moved_columns_of_draws(of, shapes, moves)
            return record.columns_of_draws(of, shapes, moves), {}
        if not moves:
            return record.columns(of, tuple(map(float, shapes))), {}
        values = [np.atleast_1d(float(s)) for s in shapes]
        moves = {n: m[None] for n, m in moves.items()}
        columns, slopes = record.moved_columns_of_draws(of, values, moves)
        return columns[0], {n: slope[0] for n, slope in slopes.items()}

    def response(self, slots: Moves, moves: Moves) -> np.ndarray:
        return self.record.respond(slots, moves, sloped=False)[0]

    def slopes(self, slots: Moves, moves: Moves) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        return self.record.respond(slots, moves)


@dataclass(eq=False)
class Problem:
    """A structure bound to a record; plausible sizes of coefficients are multiplied by `size_factors`, by effect."""

    layout: Layout
    record: Record
    size_factors: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        layout = self.layout
        terms = terms_of(layout.blocks, self.record, self.size_factors)
        self.terms: tuple[Term, ...] = terms[0]
        self.corrected: tuple[str, ...] = terms[1]
        self.host: Host = Host(self.record)
        self.hypers: tuple[Unknown, ...] = layout.hypers
        self.size: int = sum(t.size for t in self.terms if t.place == "x")
        self.noisy: bool = any(t.place == "input" for t in self.terms)  # an input
        self.noise: Noise = layout.model.noise
        self.fixed_values: dict[str, float] = dict(layout.model.fixed)
        # A promoted coefficient in units of a learned spread moves with that spread too.
        scaled = {t.group_sd_name for t in self.terms if t.place == "phi"}
        self.kinds: list[str] = [h.kind for h in self.hypers]
        moving = (h.kind in MOVING or h.name in scaled for h in self.hypers)
        self.moving: list[int] = [i for i, moves in enumerate(moving) if moves]
        self._coordinates = [(h.name, h.prior.value, h.prior.log_density) for h in self.hypers]

    def hyper(self, v: Sequence[float] | np.ndarray) -> Values:
        """Return the entries of φ at coordinate v, by name; fixed ones included."""
        pairs = zip(self._coordinates, v, strict=True)
        free = {name: value(coordinate) for (name, value, _), coordinate in pairs}
        return {**self.fixed_values, **free}  # pyright: ignore[reportReturnType]

    def log_prior(self, v: np.ndarray) -> float:
        """Return the log prior density of φ in its coordinates."""
        pairs = zip(self._coordinates, v, strict=True)
        return float(sum(density(coordinate) for (*_, density), coordinate in pairs))

    def drawn(
        self,
        gram: Gram,
        vs: Float[np.ndarray, "b d"],
        flat: Float[np.ndarray, "p"],
        origin: Float[np.ndarray, "p"],
        normal: Float[np.ndarray, "b p"] | float = 0.0,
    ) -> Drawn:
        """Return x given each of several φ, by standard normal numbers or its mean, with log marginals."""
        prior = self.prior(self.hyper(vs.T), flat, (len(vs),))
        normal = np.broadcast_to(normal, (len(vs), self.size))
        return draw(gram, self.record.size, prior, origin, normal)

    def log_priors(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b"]:
        """Return log prior densities of several φ."""
        parts = [density(v[:, i]) for i, (*_, density) in enumerate(self._coordinates)]
        return np.sum(parts, axis=0) if parts else np.zeros(len(v))

    def value_and_sd(self, name: str, v: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
        """Return one entry of φ and its standard uncertainty, by those of its coordinates."""
        i = self.layout.index_in_phi[name]
        prior = self.hypers[i].prior
        return float(prior.value(v[i])), abs(slope(prior, v[i])) * math.sqrt(covariance[i, i])

    @cached_property
    def in_x(self) -> tuple[Term, ...]:
        return tuple(t for t in self.terms if t.place == "x")

    @cached_property
    def sizes(self) -> Sizes:
        """Return the prior standard deviations of x given φ."""
        return Sizes(self.in_x, self.layout.model.effects, self.size)

    @cached_property
    def mean_of_x(self) -> Float[np.ndarray, "p"]:
        mean = np.zeros(self.size)
        for t in self.in_x:
            mean[t.at] = t.mean
        return mean

    @cached_property
    def weight_of_x(self) -> Float[np.ndarray, "p"]:
        weight = np.ones(self.size)
        for t in self.in_x:
            if t.flat:
                weight[t.at] = 0.0
        return weight

    def prior(
        self, hyper: Mapping[str, Any], flat: np.ndarray, count: tuple[int, ...] = ()
    ) -> Prior:
        """Return the prior of x given φ, or given each of `count`; `flat` are the scales where it is flat."""
        sd = np.where(self.weight_of_x > 0, self.sizes.at(hyper, count), flat)
        return Prior(self.mean_of_x, sd, self.weight_of_x)

    def member_sd(self, term: Term, hyper: Mapping[str, Any], count: int) -> Float[np.ndarray, "b"]:
        """Return the prior standard deviation of one member's coefficient at each of `count` φ."""
        if term.place == "x":
            return self.sizes.at(hyper, (count,))[:, term.at.start]
        sd = term.prior_sd if term.group_sd_name is None else hyper[term.group_sd_name]
        return np.broadcast_to(sd, (count,))

    @property
    def start(self) -> Float[np.ndarray, "p"]:
        """Return x at its prior means; a constant that outputs are counted from at its origin."""
        x = self.mean_of_x.copy()
        for b in self.layout.x_blocks:
            if b.origin:
                x[b.at] = 0.0
        return x

    def x_of(self, other: Problem, x: Float[np.ndarray, "q"]) -> Float[np.ndarray, "p"]:
        """Return another structure's x in this one's terms, missing ones at their prior mean."""
        x_here, theirs = self.start, {(t.effect.name, t.index): t.at for t in other.in_x}
        for t in self.in_x:
            if (at := theirs.get((t.effect.name, t.index))) is not None:
                x_here[t.at] = x[at]
        return x_here

    def value(self, t: Term, x: np.ndarray, hyper: Mapping[str, Any]) -> np.ndarray:
        """Return a term's coefficient at each reading (…, n), or one for all (…, 1)."""
        return value(self.host, t, x, hyper)

    def composed(
        self, terms: Sequence[Term], x: Any, hyper: Mapping[str, Any], sloped: bool = False
    ) -> Composed:
        """Compose some terms at an x, or at those of several draws."""
        values = [self.value(t, x, hyper) for t in terms]
        return compose(self.host, terms, values, hyper, sloped)

    @cached_property
    def affine(self) -> bool:
        """Return whether the expected output is affine in x."""
        return not self.corrected and self.record.affine is not None

    @cached_property
    def _dynamic_terms(self) -> tuple[Term, ...]:
        """Return the terms to be composed: of an affine output, those that φ moves."""
        affine = self.affine
        return tuple(t for t in self.terms if not affine or t.place != "x" or t.shape_names)

    @cached_property
    def _static_jacobian(self) -> tuple[Float[np.ndarray, "n p"], Int[np.ndarray, "q"]]:
        """Return the Jacobian by terms that φ does not move, cached, and the places of the others in x."""
        places = np.arange(self.size)
        dynamic = np.concatenate(
            [places[:0], *(places[t.at] for t in self._dynamic_terms if t.place == "x")]
        )
        jacobian = np.zeros((self.record.size, self.size), order="F")
        if self.affine:
            terms = [t for t in self.in_x if not t.shape_names]
            none = np.zeros(self.size), self.fixed_values
            static = linearised(self.host, terms, self.composed(terms, *none, sloped=True))
            jacobian[:, np.setdiff1d(places, dynamic)] = static.jacobian
        return jacobian, dynamic

    def slopes(
        self, x: Float[np.ndarray, "p"], hyper: Values
    ) -> Mapping[str, Float[np.ndarray, "n"]]:
        """Return the slopes of the expected output by each slot and corrected column, reading by reading."""
        terms = () if self.affine else self.terms
        return slopes(self.host, terms, self.composed(terms, x, hyper, sloped=True))[1]

    def linearise(self, x: Float[np.ndarray, "*b p"], hyper: Mapping[str, Any]) -> Linearised:
        """Return expected output and Jacobian at an x, or at those of several draws, output unit per unit."""
        line = self.linearise_dynamic(x, hyper)
        if not self.affine:
            return line
        static, dynamic = self._static_jacobian
        if line.mean.ndim > 1:
            static = np.tile(static, (len(line.mean), 1, 1))
        jacobian = static.copy(order="A")
        jacobian[..., dynamic] = line.jacobian
        return Linearised(line.mean + (static @ x[..., None])[..., 0], jacobian, line.inputs)

    def linearise_dynamic(
        self,
        x: Float[np.ndarray, "*b p"],
        hyper: Mapping[str, Any],
        terms: Sequence[Term] | None = None,
    ) -> Linearised:
        """Return the same by the terms that φ moves alone, where the output is affine."""
        terms = self._dynamic_terms if terms is None else terms
        return linearised(self.host, terms, self.composed(terms, x, hyper, sloped=True))

    def extra(self, line: Linearised) -> Float[np.ndarray, "n"] | float:
        """Return the variance that noise on inputs adds to each reading, output unit squared."""
        return variance_of_inputs(self.terms, line) if self.noisy else 0.0

    # joint draws: x (b, p), φ by name, one value a draw or one for all -----------------------------

    def expected(self, x: Any, hyper: Mapping[str, Any]) -> Float[np.ndarray, "b n"]:
        """Return the expected output of joint draws, output unit."""
        mean = expected_of(self.host, self.composed(self._dynamic_terms, x, hyper))
        if self.affine:
            return mean + x @ self._static_jacobian[0].T
        return np.broadcast_to(mean, (len(x), self.record.size))  # of no term it is one for all

    def expected_with_slopes(
        self, x: Any, hyper: Mapping[str, Any], terms: Sequence[Term]
    ) -> tuple[Float[np.ndarray, "b n"], list[np.ndarray]]:
        """Return expected output of joint draws, and slopes by terms as if all readings were of one member."""
        sloped = any(t.slot not in self.host.slots for t in terms)  # of a column that is corrected
        composed = self.composed(self.terms, x, hyper, sloped)
        mean, by_slot = slopes(self.host, self.terms, composed)
        chosen = {id(t) for t in terms}
        pairs = zip(self.terms, composed.columns, strict=True)
        return mean, [by_slot[t.slot] * column for t, column in pairs if id(t) in chosen]

    def expected_and_extra(
        self, x: Any, hyper: Mapping[str, Any]
    ) -> tuple[Float[np.ndarray, "b n"], Any]:
        """Return expected output of joint draws, and the variance of noise on inputs, (b, n) or 0."""
        if not self.noisy:
            return self.expected(x, hyper), 0.0
        inputs = [t for t in self.terms if t.place == "input"]
        mean, slopes = self.expected_with_slopes(x, hyper, inputs)
        added = [(s * t.prior_sd) ** 2 for t, s in zip(inputs, slopes, strict=True)]
        return mean, np.broadcast_to(sum(added), mean.shape)


def differences(f: Callable[[np.ndarray], Any], at: np.ndarray, step: Any) -> np.ndarray:
    """Return central differences of a function by each coordinate; one step, or one each."""
    shifts = np.diag(np.broadcast_to(step, at.shape))
    return np.array([(f(at + s) - f(at - s)) / (2 * s.sum()) for s in shifts])


def put(values: np.ndarray, places: list[int], v: np.ndarray) -> np.ndarray:
    """Return v with other values in some places."""
    changed = v.copy()
    changed[places] = values
    return changed
