"""The log density of φ with the coefficients integrated out, about a point.

From a table of products where one tells them (`Tabulated`), else from the readings at each φ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._inference.gaussian import Conditional, Gram, condition, factors, solve
from bayescal._inference.newton import NOWHERE, ByValues, Nearby
from bayescal._inference.noise_on_record import (
    Independent,
    Whitening,
    density_terms,
    products_of_several,
    total_log_density,
    whitening,
)
from bayescal._inference.problem import Problem, Values
from bayescal._inference.tabulated import Evaluation, Tabulated
from bayescal._model.composition import Linearisation

NEWTON_STEPS = 50  # to the mode of x at most
NEWTON_NATS = 1e-6  # that the last of them gains: one more would gain the square of that
NUMBERS = 4_000_000  # in linearisations that are kept, and in what is computed at once
WIDEST = 128  # columns that a filter passes over together


@dataclass(eq=False)
class Density(ByValues):
    """log p(y, φ) as a function of φ's coordinates, x integrated out of the structure linearised at a point.

    A nonlinear structure is linearised in its shapes at `expansion_point`. What noise on inputs adds to each
    variance is held at `input_variance`, if given. One of another point, or of a structure nearby, bends alike.
    """

    problem: Problem
    x: Float[np.ndarray, "p"]
    flat: Float[np.ndarray, "p"]
    expansion_point: Float[np.ndarray, "d"] | None = None
    input_variance: Float[np.ndarray, "n"] | None = None
    like: Nearby | None = None

    scale = 1.0  # of φ's coordinates, in which priors are about standard normal

    def __post_init__(self) -> None:
        self._lines: dict[tuple[float, ...], Linearisation] = {}
        self._mode = self.x  # of x, where it was sought
        self._evaluated: tuple[np.ndarray, Evaluation | None] | None = None
        self._begin(self.like)

    @cached_property
    def tabulated(self) -> Tabulated | None:
        """Return the structure on the record's table of products; None where no table serves it."""
        problem = self.problem
        nodes = None
        if not (problem.corrected or problem.noisy or any(t.place == "phi" for t in problem.terms)):
            nodes = problem.record.nodes(problem.noise)
        v = np.zeros(len(problem.hypers)) if self.expansion_point is None else self.expansion_point
        return None if nodes is None else Tabulated(problem, nodes, self.x, v)

    @property
    def origin(self) -> Float[np.ndarray, "p"]:
        """Return the point that x is counted from in `grams`."""
        return self.x if self.tabulated is None else self.tabulated.at

    def _line(self, v: np.ndarray, hyper: Values) -> Linearisation:
        key = self._key(v)
        if key not in self._lines:
            if len(self._lines) >= self._together:
                self._lines.clear()
            self._lines[key] = self.problem.linearise(self.x, hyper)
        return self._lines[key]

    def _key(self, v: np.ndarray) -> tuple[float, ...]:
        """Return the coordinates of φ that change J: shapes and promoted coefficients."""
        return tuple(float(v[i]) for i in self.problem.moving)

    def _linearised(self, vs: Float[np.ndarray, "b d"]) -> Iterator[Linearisation]:
        """Yield the structure linearised at each of several φ; of an affine output as many at once as are kept."""
        problem = self.problem
        for some in np.array_split(vs, -(-len(vs) // self._together)):
            keys = [self._key(v) for v in some]
            self._lines = {key: self._lines[key] for key in keys if key in self._lines}
            new = {k: v for k, v in zip(keys, some, strict=True) if k not in self._lines}
            if problem.affine and not problem.noisy and len(new) > 1:
                at = np.tile(self.x, (len(new), 1))
                lines = problem.linearise(at, problem.hyper(np.array([*new.values()]).T))
                for i, key in enumerate(new):
                    self._lines[key] = Linearisation(lines.mean[i], lines.jacobian[i], lines.inputs)
            for key, v in zip(keys, some, strict=True):
                yield self._lines.get(key) or self._line(v, problem.hyper(v))

    @property
    def _together(self) -> int:
        return max(2, NUMBERS // (self.problem.record.size * (self.problem.size + 1)))

    def _extra(self, line: Linearisation) -> Float[np.ndarray, "n"] | float:
        """Return the variance that noise on inputs adds to each reading."""
        return self.problem.extra(line) if self.input_variance is None else self.input_variance

    def _white(self, line: Linearisation, hyper: Values) -> Whitening | Independent:
        return whitening(self.problem.noise, hyper, self.problem.record, self._extra(line))

    def whitened(
        self, v: np.ndarray, x: Float[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n q"], float]:
        """Return the residuals, the whitened [Jacobian, residuals] and log|Σ| at φ and x, output unit."""
        hyper = self.problem.hyper(v)
        line = self._line(v, hyper)
        residual = self.problem.record.y - line.mean - line.jacobian @ (x - self.x)
        return residual, *self._white(line, hyper).both(np.column_stack([line.jacobian, residual]))

    def gram(self, v: np.ndarray, hyper: Values) -> Gram:
        """Return the weighted products of the readings at φ."""
        if not self.problem.noise.gaussian:
            return Gram(*(part[0] for part in self._about_modes(v[None])))
        line = self._line(v, hyper)
        white, logdet = self._white(line, hyper).both(self._table(line))
        return Gram.of(white.T @ white, logdet)

    def _table(self, line: Linearisation) -> Float[np.ndarray, "n q"]:
        return np.column_stack([line.jacobian, self.problem.record.y - line.mean])

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return the weighted products at several φ, x counted from `origin`."""
        problem = self.problem
        if self.tabulated is not None:
            return self.tabulated.grams(vs)
        if not problem.noise.gaussian:
            parts = range(0, len(vs), self._together)
            grams = [self._about_modes(vs[i : i + self._together]) for i in parts]
            return Gram(*map(np.concatenate, zip(*grams, strict=True)))
        # Spreads are the prior's alone: φ that differ by these have the same products.
        acts = [k != "group_sd" or i in problem.moving for i, k in enumerate(problem.kinds)]
        _, first, which = np.unique(vs[:, acts], axis=0, return_index=True, return_inverse=True)
        grams = self._whitened_together(vs[first])
        return Gram(*(np.stack([np.asarray(g[i]) for g in grams])[which.ravel()] for i in range(4)))

    def _whitened_together(self, vs: Float[np.ndarray, "b d"]) -> list[Gram]:
        """Return the products at several φ; of one noise a filter passes over each column once."""
        noise, by_noise = np.array([kind == "noise" for kind in self.problem.kinds]), {}
        for i, v in enumerate(vs):
            by_noise.setdefault(i if self.problem.noisy else tuple(v[noise]), []).append(i)
        most, groups = max(1, WIDEST // (self.problem.size + 1)), list[list[int]]()
        for members in sorted(by_noise.values(), key=len):
            groups += [members[k : k + most] for k in range(0, len(members), most)]
        places = list[list[list[int]]]()

        def tables() -> Iterator[tuple[Whitening | Independent, np.ndarray]]:
            lines = self._linearised(vs[[i for group in groups for i in group]])
            line, first = None, np.empty(0)
            for group in groups:
                before, line = line, next(lines)
                first = first if line is before else self._table(line)
                columns, places_in_group = [*first.T], [[*range(first.shape[1])]]
                for _ in group[1:]:
                    places_in_group.append([*places_in_group[0]])
                    table = self._table(next(lines))
                    for j in np.flatnonzero(np.any(table != first, axis=0)):
                        places_in_group[-1][j] = len(columns)
                        columns.append(table[:, j])
                places.append(places_in_group)
                white = self._white(line, self.problem.hyper(vs[group[0]]))
                yield white, first if len(group) == 1 else np.column_stack(columns)

        grams: dict[int, Gram] = {}
        for k, (products, logdet) in enumerate(products_of_several(tables())):
            for i, members in zip(groups[k], places[k], strict=True):
                grams[i] = Gram.of(products[np.ix_(members, members)], logdet)
        return [grams[i] for i in range(len(vs))]

    def _about_modes(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return the products that stand for a non-Gaussian law: a quadratic about the mode of x given φ.

        Newton's steps with the law's own curvature; where one leads down, the step of a Gaussian scale mixture, which
        never does. With the mode's distance m from here, products there become JᵀWJ, JᵀWr + JᵀWJ·m, and so on.
        Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
        """
        problem, noise, record, x = self.problem, self.problem.noise, self.problem.record, self.x
        hyper = problem.hyper(vs.T)
        prior = problem.prior(hyper, self.flat, (len(vs),))
        lines = [self._line(v, problem.hyper(v)) for v in vs]
        jacobian = np.stack([line.jacobian for line in lines])
        residual = record.y - np.stack([line.mean for line in lines])
        further = (np.broadcast_to(self._extra(line), (record.size,)) for line in lines)
        extra: Any = np.stack([*further]) if problem.noisy else 0.0
        width = np.where(prior.sd > 0, prior.sd, 1.0)

        def of(array: np.ndarray, some: np.ndarray) -> np.ndarray:
            return array if len(some) == len(array) else array[some]

        def look(some: np.ndarray, move: np.ndarray) -> list[np.ndarray]:
            """Return objective, slope and curvature by residual, mixture weights, z and log|Σ| at some φ."""
            remaining = of(residual, some) - (of(jacobian, some) @ move[:, :, None])[:, :, 0]
            phi = {name: np.broadcast_to(v, (len(vs),))[some] for name, v in hyper.items()}
            variance = extra[some] if np.ndim(extra) else extra
            terms = density_terms(noise, phi, record, remaining, variance)
            z = prior.weight * (x + move - prior.mean) / width[some]
            least = terms.squares + np.sum(z**2, axis=1)
            weight = terms.weight(remaining)
            each_of = terms.slope, terms.curvature, weight, z, terms.logdet
            return [least, *map(np.array, each_of)]

        def products(some: np.ndarray, weight: np.ndarray) -> np.ndarray:
            columns = of(jacobian, some)
            return (columns * weight[:, :, None]).transpose(0, 2, 1) @ columns

        move = np.tile(self._mode - x, (len(vs), 1))
        value, *state = look(np.arange(len(vs)), move)
        left_over = np.arange(len(vs)) if problem.size else np.zeros(0, dtype=int)
        for _ in range(NEWTON_STEPS):
            if not len(left_over):
                break
            slope, curvature, weight, z, _ = (a[left_over] for a in state)
            sd = prior.sd[left_over]
            pull = (
                sd * (of(jacobian, left_over).transpose(0, 2, 1) @ slope[:, :, None])[:, :, 0] - z
            )
            trying, before = np.arange(len(left_over)), value[left_over]
            for weights in (curvature, weight):
                tried = left_over[trying]
                inner = products(tried, weights[trying]) * sd[trying, :, None] * sd[trying, None, :]
                # No factor, and no step, where the curvature bends up: Newton's would end on a saddle.
                chol = factors(inner + np.diag(prior.weight))
                step = solve(chol, solve(chol, pull[trying]), upper=True)
                trial = look(tried, move[tried] + sd[trying] * step)
                better = trial[0] <= value[tried]
                put = tried[better]
                move[put] += (sd[trying] * step)[better]
                for whole, new in zip((value, *state), trial, strict=True):
                    whole[put] = new[better]
                trying = trying[~better]
                if not len(trying):
                    break
            left_over = left_over[before - value[left_over] > NEWTON_NATS]
        self._mode = x + move[0]
        slope, curvature, _, z, logdet = state
        jtj = products(np.arange(len(vs)), curvature)
        jtr = (jacobian.transpose(0, 2, 1) @ slope[:, :, None])[:, :, 0]
        # The quadratic about the mode, rtr − 2·jtrᵀ(δ − m) + (δ − m)ᵀ·jtj·(δ − m), with its powers of δ collected:
        # these are the products at the point itself, where δ = x − x̂ is zero.
        across = (jtj @ move[:, :, None])[:, :, 0]
        squares = value - np.sum(z**2, axis=1) + np.sum(move * (2 * jtr + across), axis=1)
        return Gram(jtj, jtr + across, squares, logdet)

    def squares(self, hyper: Values, gram: Gram) -> float:
        """Return the sum of squares of the whitened residuals, or what stands for it under heavy tails."""
        noise, record = self.problem.noise, self.problem.record
        if noise.gaussian:
            return gram.rtr
        # For a law with outliers: −2·log of the density against that of no residual at all.
        line = self.problem.linearise(self.x, hyper)
        residual = record.y - line.mean
        return density_terms(noise, hyper, record, residual, self._extra(line)).squares

    def evaluate(self, v: np.ndarray, exact: bool = False) -> Any:
        """Return log density, gradient and curvature, an `exact` one or about right; None where there is none."""
        if self.tabulated is None:
            return super().evaluate(v, exact)
        if self._evaluated is None or not np.array_equal(self._evaluated[0], v):
            self._evaluated = v.copy(), self.tabulated.evaluate(v, self.flat, True)
        return self._evaluated[1]

    def value(self, v: np.ndarray) -> float:
        """Return the log density at a coordinate that a climb may go on from."""
        if self.tabulated is None:
            return super().value(v)
        evaluated = self.evaluate(v)
        return NOWHERE if evaluated is None else evaluated.log_density

    def at(self, v: np.ndarray) -> tuple[float, Conditional | None]:
        """Return the log density at a coordinate, and x given φ there; None where there is no density."""
        problem = self.problem
        if self.tabulated is not None:
            at_v = self.tabulated.evaluate(v, self.flat, False)
            return (NOWHERE, None) if at_v is None else (at_v.log_density, at_v.conditional)
        hyper = problem.hyper(v)
        prior, gram = problem.prior(hyper, self.flat), self.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet) or not np.all(np.isfinite(prior.sd)):
            return NOWHERE, None
        conditional = condition(gram, problem.record.size, prior, self.x)
        value = math.nan if conditional is None else conditional.log_marginal + problem.log_prior(v)
        return (value, conditional) if math.isfinite(value) else (NOWHERE, None)

    def values(self, vs: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k"]:
        """Return the log density at several coordinates."""
        problem, vs = self.problem, np.asarray(vs)
        if not len(vs):
            return np.zeros(0)
        if self.tabulated is not None or problem.terms:
            log_density = problem.drawn(self.grams(vs), vs, self.flat, self.origin).log_marginal
        else:  # of a noise law alone: one column
            law, record = problem.noise, problem.record
            log_density = total_log_density(law, record, record.y[None], problem.hyper(vs.T))
        return np.nan_to_num(log_density + problem.log_priors(vs), nan=NOWHERE, neginf=NOWHERE)
