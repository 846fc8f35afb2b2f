"""Marginal log density of the hyper-parameters φ: coefficients x integrated out of a linearised model.

Computed from cached inner products if possible (`Tabulated`), otherwise from the readings at each φ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._inference.gaussian import Conditional, Gram, cholesky, condition, solve_tri
from bayescal._inference.newton import NOWHERE, ByValues, Nearby
from bayescal._inference.noise_on_record import (
    Independent,
    Whitening,
    density_terms,
    total_log_density,
    whitened_grams,
    whitening,
)
from bayescal._inference.problem import Problem, Values
from bayescal._inference.tabulated import Evaluation, Tabulated
from bayescal._model.composition import Linearisation

NEWTON_STEPS = 50  # of an iteration for the mode of x, at most
NEWTON_NATS = 1e-6  # convergence: smallest increase of the log density by a Newton step
MAX_NUMBERS = 4_000_000  # array elements in cached linearisations, and in one batch
MAX_FILTER_COLUMNS = 128  # columns of one pass of a Kalman filter


@dataclass(eq=False)
class Density(ByValues):
    """log p(y, φ) as a function of φ's coordinates, with x integrated out of the model linearised at `x`.

    A nonlinear model is linearised in its shapes at `expansion_point`. `input_variance` fixes the variance from noisy
    inputs. `like` gives the curvature of a similar density as a first estimate of this one's Hessian.
    """

    problem: Problem
    x: Float[np.ndarray, "p"]
    flat: Float[np.ndarray, "p"]
    expansion_point: Float[np.ndarray, "d"] | None = None
    input_variance: Float[np.ndarray, "n"] | None = None
    like: Nearby | None = None

    scale = 1.0  # of φ's coordinates: priors are about standard normal

    def __post_init__(self) -> None:
        self._lines: dict[tuple[float, ...], Linearisation] = {}
        self._mode = self.x  # of x given φ, from the latest Newton iteration
        self._evaluated: tuple[np.ndarray, Evaluation | None] | None = None
        self._begin(self.like)

    @cached_property
    def tabulated(self) -> Tabulated | None:
        """Return the model on the record's cached products; None if its products depend on φ in another way."""
        problem = self.problem
        nodes = None
        if not (problem.corrected or problem.noisy or any(t.place == "phi" for t in problem.terms)):
            nodes = problem.record.nodes(problem.noise)
        v = np.zeros(len(problem.hypers)) if self.expansion_point is None else self.expansion_point
        return None if nodes is None else Tabulated(problem, nodes, self.x, v)

    @property
    def origin(self) -> Float[np.ndarray, "p"]:
        """Return the origin of x in `grams` (p,)."""
        return self.x if self.tabulated is None else self.tabulated.origin

    def _linearise_at(self, v: np.ndarray, hyper: Values) -> Linearisation:
        key = self._jacobian_key(v)
        if key not in self._lines:
            if len(self._lines) >= self._batch_size:
                self._lines.clear()
            self._lines[key] = self.problem.linearise(self.x, hyper)
        return self._lines[key]

    def _jacobian_key(self, v: np.ndarray) -> tuple[float, ...]:
        """Return the coordinates of φ that the Jacobian depends on: shapes and promoted coefficients."""
        return tuple(float(v[i]) for i in self.problem.moving)

    def _linearise_many(self, vs: Float[np.ndarray, "b d"]) -> Iterator[Linearisation]:
        """Yield the linearisation at each φ of `vs` (b, d); in batches if the output is affine in x."""
        problem = self.problem
        for batch in np.array_split(vs, -(-len(vs) // self._batch_size)):
            keys = [self._jacobian_key(v) for v in batch]
            self._lines = {key: self._lines[key] for key in keys if key in self._lines}
            missing = {k: v for k, v in zip(keys, batch, strict=True) if k not in self._lines}
            if problem.affine and not problem.noisy and len(missing) > 1:
                points = np.tile(self.x, (len(missing), 1))
                lines = problem.linearise(points, problem.hyper(np.array([*missing.values()]).T))
                for i, key in enumerate(missing):
                    self._lines[key] = Linearisation(lines.mean[i], lines.jacobian[i], lines.inputs)
            for key, v in zip(keys, batch, strict=True):
                yield self._lines.get(key) or self._linearise_at(v, problem.hyper(v))

    @property
    def _batch_size(self) -> int:
        return max(2, MAX_NUMBERS // (self.problem.record.size * (self.problem.size + 1)))

    def _input_variance(self, line: Linearisation) -> Float[np.ndarray, "n"] | float:
        """Return the variance of each reading from noisy inputs, output unit squared (n,), or 0."""
        return self.problem.extra(line) if self.input_variance is None else self.input_variance

    def _whitening(self, line: Linearisation, hyper: Values) -> Whitening | Independent:
        return whitening(self.problem.noise, hyper, self.problem.record, self._input_variance(line))

    def whiten_at(
        self, v: np.ndarray, x: Float[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n q"], float]:
        """Return the residuals, the whitened [Jacobian, residuals] and log|Σ| at φ and x, output unit."""
        hyper = self.problem.hyper(v)
        line = self._linearise_at(v, hyper)
        residual = self.problem.record.y - line.mean - line.jacobian @ (x - self.x)
        table = np.column_stack([line.jacobian, residual])
        return residual, *self._whitening(line, hyper).whiten(table)

    def gram(self, v: np.ndarray, hyper: Values) -> Gram:
        """Return the Gram matrix of [J r] at φ, weighted by Σ⁻¹."""
        if not self.problem.noise.gaussian:
            return Gram(*(part[0] for part in self._laplace_grams(v[None])))
        line = self._linearise_at(v, hyper)
        white, logdet = self._whitening(line, hyper).whiten(self._residual_table(line))
        return Gram.of(white.T @ white, logdet)

    def _residual_table(self, line: Linearisation) -> Float[np.ndarray, "n q"]:
        return np.column_stack([line.jacobian, self.problem.record.y - line.mean])

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return the Gram matrices of [J r] at several φ, weighted by Σ⁻¹, r at x = `origin`."""
        problem = self.problem
        if self.tabulated is not None:
            return self.tabulated.grams(vs)
        if not problem.noise.gaussian:
            parts = range(0, len(vs), self._batch_size)
            grams = [self._laplace_grams(vs[i : i + self._batch_size]) for i in parts]
            return Gram(*map(np.concatenate, zip(*grams, strict=True)))
        # Standard deviations between group members enter the prior alone, not the Gram matrix.
        used = [k != "group_sd" or i in problem.moving for i, k in enumerate(problem.kinds)]
        _, first, index = np.unique(vs[:, used], axis=0, return_index=True, return_inverse=True)
        grams = self._whitened_grams(vs[first])
        return Gram(*(np.stack([np.asarray(g[i]) for g in grams])[index.ravel()] for i in range(4)))

    def _whitened_grams(self, vs: Float[np.ndarray, "b d"]) -> list[Gram]:
        """Return the Gram matrices at several φ; each distinct column is whitened once per setting of the noise."""
        noise, by_noise = np.array([kind == "noise" for kind in self.problem.kinds]), {}
        for i, v in enumerate(vs):
            by_noise.setdefault(i if self.problem.noisy else tuple(v[noise]), []).append(i)
        batch_size = max(1, MAX_FILTER_COLUMNS // (self.problem.size + 1))
        groups = list[list[int]]()
        for members in sorted(by_noise.values(), key=len):
            groups += [members[k : k + batch_size] for k in range(0, len(members), batch_size)]
        hypers, column_sets = self.problem.hyper_of_each(vs), list[list[list[int]]]()

        def tables() -> Iterator[tuple[Whitening | Independent, np.ndarray]]:
            lines = self._linearise_many(vs[[i for group in groups for i in group]])
            line, first_table = None, np.empty(0)
            for group in groups:
                previous, line = line, next(lines)
                first_table = first_table if line is previous else self._residual_table(line)
                columns, group_columns = [*first_table.T], [[*range(first_table.shape[1])]]
                for _ in group[1:]:
                    group_columns.append([*group_columns[0]])
                    table = self._residual_table(next(lines))
                    for j in np.flatnonzero(np.any(table != first_table, axis=0)):
                        group_columns[-1][j] = len(columns)
                        columns.append(table[:, j])
                column_sets.append(group_columns)
                white = self._whitening(line, hypers[group[0]])
                yield white, first_table if len(group) == 1 else np.column_stack(columns)

        grams: dict[int, Gram] = {}
        for k, (products, logdet) in enumerate(whitened_grams(tables())):
            for i, members in zip(groups[k], column_sets[k], strict=True):
                grams[i] = Gram.of(products[np.ix_(members, members)], logdet)
        return [grams[i] for i in range(len(vs))]

    def _laplace_grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return Gram matrices of the Laplace approximation of a non-Gaussian likelihood about the mode of x given φ.

        The mode is found by Newton steps; a step that fails to increase the density is replaced by one of a Gaussian
        scale mixture (EM), which never decreases it. The quadratic is then shifted from the mode back to x.
        Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
        """
        problem, noise, record, x = self.problem, self.problem.noise, self.problem.record, self.x
        hyper = problem.hyper(vs.T)
        prior = problem.prior(hyper, self.flat, (len(vs),))
        lines = [*map(self._linearise_at, vs, problem.hyper_of_each(vs))]
        jacobian = np.stack([line.jacobian for line in lines])
        residual = record.y - np.stack([line.mean for line in lines])
        extras = (np.broadcast_to(self._input_variance(line), (record.size,)) for line in lines)
        extra: Any = np.stack([*extras]) if problem.noisy else 0.0
        safe_sd = np.where(prior.sd > 0, prior.sd, 1.0)

        def select(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return array if len(rows) == len(array) else array[rows]

        def evaluate(rows: np.ndarray, shift: np.ndarray) -> list[np.ndarray]:
            """Return −2·log density, derivatives in the residual, mixture weights, z and log|Σ| at rows of φ."""
            r = select(residual, rows) - (select(jacobian, rows) @ shift[:, :, None])[:, :, 0]
            phi = {name: np.broadcast_to(v, (len(vs),))[rows] for name, v in hyper.items()}
            variance = extra[rows] if np.ndim(extra) else extra
            terms = density_terms(noise, phi, record, r, variance)
            z = prior.weight * (x + shift - prior.mean) / safe_sd[rows]
            objective = terms.squares + np.sum(z**2, axis=1)
            weight = terms.weight(r)
            parts = terms.slope, terms.curvature, weight, z, terms.logdet
            return [objective, *map(np.array, parts)]

        def products(rows: np.ndarray, weight: np.ndarray) -> np.ndarray:
            columns = select(jacobian, rows)
            return (columns * weight[:, :, None]).transpose(0, 2, 1) @ columns

        shift = np.tile(self._mode - x, (len(vs), 1))
        value, *state = evaluate(np.arange(len(vs)), shift)
        active = np.arange(len(vs)) if problem.size else np.zeros(0, dtype=int)
        for _ in range(NEWTON_STEPS):
            if not len(active):
                break
            slope, curvature, weight, z, _ = (a[active] for a in state)
            sd = prior.sd[active]
            gradient = (
                sd * (select(jacobian, active).transpose(0, 2, 1) @ slope[:, :, None])[:, :, 0] - z
            )
            retry, previous = np.arange(len(active)), value[active]
            for weights in (curvature, weight):
                tried = active[retry]
                hessian = products(tried, weights[retry]) * sd[retry, :, None] * sd[retry, None, :]
                # An indefinite Hessian has no Cholesky factor: NaN, so that the step is rejected.
                chol = cholesky(hessian + np.diag(prior.weight))
                step = solve_tri(chol, solve_tri(chol, gradient[retry]), upper=True)
                trial = evaluate(tried, shift[tried] + sd[retry] * step)
                is_better = trial[0] <= value[tried]
                accepted = tried[is_better]
                shift[accepted] += (sd[retry] * step)[is_better]
                for whole, values in zip((value, *state), trial, strict=True):
                    whole[accepted] = values[is_better]
                retry = retry[~is_better]
                if not len(retry):
                    break
            active = active[previous - value[active] > NEWTON_NATS]
        self._mode = x + shift[0]
        slope, curvature, _, z, logdet = state
        jtj = products(np.arange(len(vs)), curvature)
        jtr = (jacobian.transpose(0, 2, 1) @ slope[:, :, None])[:, :, 0]
        # Expand rtr − 2·jtrᵀ(δ − m) + (δ − m)ᵀ·jtj·(δ − m) in powers of δ = x − x̂: the Gram matrix at δ = 0.
        jtj_shift = (jtj @ shift[:, :, None])[:, :, 0]
        squares = value - np.sum(z**2, axis=1) + np.sum(shift * (2 * jtr + jtj_shift), axis=1)
        return Gram(jtj, jtr + jtj_shift, squares, logdet)

    def rss(self, hyper: Values, gram: Gram) -> float:
        """Return the whitened residual sum of squares, or the deviance of a non-Gaussian law."""
        noise, record = self.problem.noise, self.problem.record
        if noise.gaussian:
            return gram.rtr
        # Deviance: −2·log density relative to that of zero residuals.
        line = self.problem.linearise(self.x, hyper)
        residual = record.y - line.mean
        return density_terms(noise, hyper, record, residual, self._input_variance(line)).squares

    def evaluate(self, v: np.ndarray, exact: bool = False) -> Any:
        """Return log density, gradient and negative Hessian (approximate unless `exact`); None if undefined."""
        if self.tabulated is None:
            return super().evaluate(v, exact)
        if self._evaluated is None or not np.array_equal(self._evaluated[0], v):
            self._evaluated = v.copy(), self.tabulated.evaluate(v, self.flat, True)
        return self._evaluated[1]

    def value(self, v: np.ndarray) -> float:
        """Return the log density at v; `NOWHERE` if undefined."""
        if self.tabulated is None:
            return super().value(v)
        evaluated = self.evaluate(v)
        return NOWHERE if evaluated is None else evaluated.log_density

    def condition_at(self, v: np.ndarray) -> tuple[float, Conditional | None]:
        """Return the log density at v, and the conditional posterior of x given φ; None if undefined."""
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
        """Return the log density at several coordinates (k,)."""
        problem, vs = self.problem, np.asarray(vs)
        if not len(vs):
            return np.zeros(0)
        if self.tabulated is not None or problem.terms:
            log_density = problem.drawn(self.grams(vs), vs, self.flat, self.origin).log_marginal
        else:  # no coefficients: the noise law alone
            law, record = problem.noise, problem.record
            log_density = total_log_density(law, record, record.y[None], problem.hyper(vs.T))
        return np.nan_to_num(log_density + problem.log_priors(vs), nan=NOWHERE, neginf=NOWHERE)
