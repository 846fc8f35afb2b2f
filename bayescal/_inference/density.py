"""Marginal log density of the hyper-parameters φ: coefficients x integrated out of a linearised model.

Computed from cached inner products if possible (`TabulatedDensity`), otherwise from the readings at each φ.
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
from bayescal._inference.newton import LOG_ZERO, HessianGuess, NumericDensity
from bayescal._inference.noise_on_record import (
    SdWhitening,
    Whitening,
    density_terms,
    total_log_density,
    whitening,
)
from bayescal._inference.problem import Problem, Values
from bayescal._inference.tabulated import Evaluation, TabulatedDensity
from bayescal._model.composition import Linearisation

MAX_NEWTON_STEPS = 50  # towards the conditional mode of x
NEWTON_TOLERANCE_NATS = 1e-6  # convergence: smallest increase of the log density by a Newton step
MAX_ARRAY_ELEMENTS = 4_000_000  # of cached linearisations, and of one batch
MAX_FILTER_COLUMNS = 128  # columns of one pass of a Kalman filter


@dataclass(eq=False)
class Density(NumericDensity):
    """log p(y, φ) as a function of φ's coordinates, with x integrated out of the model linearised at `x`.

    flat_scales: scales of flat priors of x. expansion_point: φ at which a nonlinear output is linearised.
    input_variance: fixed variance from noisy inputs. guess: first estimate of the Hessian.
    """

    problem: Problem
    x: Float[np.ndarray, "p"]
    flat_scales: Float[np.ndarray, "p"]
    expansion_point: Float[np.ndarray, "d"] | None = None
    input_variance: Float[np.ndarray, "n"] | None = None
    guess: HessianGuess | None = None

    scale = 1.0  # of φ's coordinates: priors are about standard normal

    def __post_init__(self) -> None:
        self._cache: dict[tuple[float, ...], Linearisation] = {}
        self._mode_of_x = self.x  # of x given φ, from the latest Newton iteration
        self._latest: tuple[np.ndarray, Evaluation | None] | None = None
        self._reset(self.guess)

    @cached_property
    def tabulated(self) -> TabulatedDensity | None:
        """Return the density from cached inner products; None if readings must be processed at each φ."""
        problem = self.problem
        nodes = None
        has_promoted = any(t.place == "phi" for t in problem.terms)
        if not (problem.corrected_columns or problem.is_noisy or has_promoted):
            nodes = problem.record.nodes(problem.noise)
        v = np.zeros(len(problem.hypers)) if self.expansion_point is None else self.expansion_point
        return None if nodes is None else TabulatedDensity(problem, nodes, self.x, v)

    @property
    def origin(self) -> Float[np.ndarray, "p"]:
        """Return the coefficients x (p,) at which the residuals of `grams` are evaluated."""
        return self.x if self.tabulated is None else self.tabulated.origin

    def _linearise_at(self, v: np.ndarray, hyper: Values) -> Linearisation:
        key = self._get_jacobian_key(v)
        if key not in self._cache:
            if len(self._cache) >= self._batch_size:
                self._cache.clear()
            self._cache[key] = self.problem.linearise(self.x, hyper)
        return self._cache[key]

    def _get_jacobian_key(self, v: np.ndarray) -> tuple[float, ...]:
        """Return the coordinates of φ that ∂output/∂x depends on: shapes and promoted coefficients."""
        return tuple(float(v[i]) for i in self.problem.nonlinear_phi)

    def _linearise_many(self, vs: Float[np.ndarray, "b d"]) -> Iterator[Linearisation]:
        """Yield the linearised model at each φ of `vs` (b, d); computed in batches if the output is affine in x."""
        problem = self.problem
        for batch in np.array_split(vs, -(-len(vs) // self._batch_size)):
            keys = [self._get_jacobian_key(v) for v in batch]
            self._cache = {key: self._cache[key] for key in keys if key in self._cache}
            uncached = {k: v for k, v in zip(keys, batch, strict=True) if k not in self._cache}
            if len(uncached) > 1:
                points = np.tile(self.x, (len(uncached), 1))
                lines = problem.linearise(points, problem.hyper(np.array([*uncached.values()]).T))
                for i, key in enumerate(uncached):
                    self._cache[key] = Linearisation(*(part[i] for part in lines))
            for key, v in zip(keys, batch, strict=True):
                yield self._cache.get(key) or self._linearise_at(v, problem.hyper(v))

    @property
    def _batch_size(self) -> int:
        return max(2, MAX_ARRAY_ELEMENTS // (self.problem.record.size * (self.problem.size + 1)))

    def _input_variance(self, line: Linearisation) -> Float[np.ndarray, "n"] | float:
        """Return the variance of each reading from noisy inputs, output unit squared (n,), or 0."""
        return self.problem.extra(line) if self.input_variance is None else self.input_variance

    def _get_whitening(self, line: Linearisation, hyper: Values) -> Whitening | SdWhitening:
        return whitening(self.problem.noise, hyper, self.problem.record, self._input_variance(line))

    def whiten_at(
        self, v: np.ndarray, x: Float[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n q"], float]:
        """Return the residuals in the output unit, the whitened [Jacobian, residuals] and log|Σ| at φ and x."""
        hyper = self.problem.hyper(v)
        line = self._linearise_at(v, hyper)
        residual = self.problem.record.y - line.mean - line.jacobian @ (x - self.x)
        table = np.column_stack([line.jacobian, residual])
        return residual, *self._get_whitening(line, hyper).whiten(table)

    def gram(self, v: np.ndarray, hyper: Values) -> Gram:
        """Return the Gram matrix of [J r], Jacobian and residuals, at φ; weighted by Σ⁻¹ (noise covariance Σ)."""
        if not self.problem.noise.is_gaussian:
            return Gram(*(part[0] for part in self._compute_laplace_grams(v[None])))
        line = self._linearise_at(v, hyper)
        return Gram.split(*self._get_whitening(line, hyper).gram(self._stack_residual_table(line)))

    def _stack_residual_table(self, line: Linearisation) -> Float[np.ndarray, "n q"]:
        return np.column_stack([line.jacobian, self.problem.record.y - line.mean])

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return the Gram matrices of [J r] at several φ, weighted by Σ⁻¹, with residuals r at x = `origin`."""
        problem = self.problem
        if self.tabulated is not None:
            return self.tabulated.grams(vs)
        if not problem.noise.is_gaussian:
            parts = range(0, len(vs), self._batch_size)
            grams = [self._compute_laplace_grams(vs[i : i + self._batch_size]) for i in parts]
            return Gram(*map(np.concatenate, zip(*grams, strict=True)))
        # Standard deviations between group members enter the prior alone, not the Gram matrix.
        mask = [k != "group_sd" or i in problem.nonlinear_phi for i, k in enumerate(problem.kinds)]
        _, rows, index = np.unique(vs[:, mask], axis=0, return_index=True, return_inverse=True)
        grams = self._compute_whitened_grams(vs[rows])
        return Gram(*(np.stack([np.asarray(g[i]) for g in grams])[index.ravel()] for i in range(4)))

    def _compute_whitened_grams(self, vs: Float[np.ndarray, "b d"]) -> list[Gram]:
        """Return the Gram matrices at several φ; each distinct column is whitened once per noise parameter set."""
        is_noise, rows_by_noise = np.array([kind == "noise" for kind in self.problem.kinds]), {}
        for i, v in enumerate(vs):
            key = i if self.problem.is_noisy else tuple(v[is_noise])
            rows_by_noise.setdefault(key, []).append(i)
        batch_size = max(1, MAX_FILTER_COLUMNS // (self.problem.size + 1))
        batches = list[list[int]]()
        for rows in sorted(rows_by_noise.values(), key=len):
            batches += [rows[k : k + batch_size] for k in range(0, len(rows), batch_size)]
        hyper_values, grams = self.problem.hyper_of_each(vs), dict[int, Gram]()
        lines = self._linearise_many(vs[[i for batch in batches for i in batch]])
        line, first_table = None, np.empty(0)
        for batch in batches:
            previous_line, line = line, next(lines)
            first_table = first_table if line is previous_line else self._stack_residual_table(line)
            columns, column_sets = [*first_table.T], [[*range(first_table.shape[1])]]
            for _ in batch[1:]:
                column_sets.append([*column_sets[0]])
                table = self._stack_residual_table(next(lines))
                for j in np.flatnonzero(np.any(table != first_table, axis=0)):
                    column_sets[-1][j] = len(columns)
                    columns.append(table[:, j])
            table = first_table if len(batch) == 1 else np.column_stack(columns)
            products, logdet = self._get_whitening(line, hyper_values[batch[0]]).gram(table)
            for i, rows in zip(batch, column_sets, strict=True):
                grams[i] = Gram.split(products[np.ix_(rows, rows)], logdet)
        return [grams[i] for i in range(len(vs))]

    def _compute_laplace_grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return Gram matrices of the Laplace approximation of a non-Gaussian likelihood about the mode of x given φ.

        A Newton step that decreases the density is replaced by an EM step (Gaussian scale mixture), which never
        decreases it. The quadratic expansion is then shifted from the mode back to x.
        Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
        """
        problem, noise, record, x = self.problem, self.problem.noise, self.problem.record, self.x
        hyper = problem.hyper(vs.T)
        prior = problem.prior(hyper, self.flat_scales, (len(vs),))
        lines = [*map(self._linearise_at, vs, problem.hyper_of_each(vs))]
        jacobian = np.stack([line.jacobian for line in lines])
        residual = record.y - np.stack([line.mean for line in lines])
        variances = (np.broadcast_to(self._input_variance(line), (record.size,)) for line in lines)
        input_variance: Any = np.stack([*variances]) if problem.is_noisy else 0.0
        safe_sd = np.where(prior.sd > 0, prior.sd, 1.0)

        def select(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return array if len(rows) == len(array) else array[rows]

        def evaluate(rows: np.ndarray, shift: np.ndarray) -> list[np.ndarray]:
            """Return deviance + Σz², −∂ and −∂² of log density in each residual, EM weights, z, log|Σ|; φ in `rows`."""
            r = select(residual, rows) - (select(jacobian, rows) @ shift[:, :, None])[:, :, 0]
            phi = {name: np.broadcast_to(v, (len(vs),))[rows] for name, v in hyper.items()}
            variance = input_variance[rows] if np.ndim(input_variance) else input_variance
            terms = density_terms(noise, phi, record, r, variance)
            z = prior.weight * (x + shift - prior.mean) / safe_sd[rows]
            objective = terms.squares + np.sum(z**2, axis=1)
            weight = terms.weight(r)
            parts = terms.slope, terms.curvature, weight, z, terms.logdet
            return [objective, *map(np.array, parts)]

        def multiply(rows: np.ndarray, weight: np.ndarray) -> np.ndarray:
            columns = select(jacobian, rows)
            return (columns * weight[:, :, None]).transpose(0, 2, 1) @ columns

        shift = np.tile(self._mode_of_x - x, (len(vs), 1))
        objective, *likelihood_terms = evaluate(np.arange(len(vs)), shift)
        active = np.arange(len(vs)) if problem.size else np.zeros(0, dtype=int)
        for _ in range(MAX_NEWTON_STEPS):
            if not len(active):
                break
            slope, curvature, weight, z, _ = (a[active] for a in likelihood_terms)
            sd = prior.sd[active]
            gradient = (
                sd * (select(jacobian, active).transpose(0, 2, 1) @ slope[:, :, None])[:, :, 0] - z
            )
            pending, previous_objective = np.arange(len(active)), objective[active]
            for weights in (curvature, weight):
                rows, row_sd = active[pending], sd[pending]
                hessian = multiply(rows, weights[pending]) * row_sd[:, :, None] * row_sd[:, None, :]
                # An indefinite Hessian has no Cholesky factor: NaN, so that the step is rejected.
                chol = cholesky(hessian + np.diag(prior.weight))
                step = solve_tri(chol, solve_tri(chol, gradient[pending]), is_upper=True)
                trial = evaluate(rows, shift[rows] + row_sd * step)
                is_better = trial[0] <= objective[rows]
                accepted_rows = rows[is_better]
                shift[accepted_rows] += (row_sd * step)[is_better]
                for current, new_values in zip((objective, *likelihood_terms), trial, strict=True):
                    current[accepted_rows] = new_values[is_better]
                pending = pending[~is_better]
                if not len(pending):
                    break
            active = active[previous_objective - objective[active] > NEWTON_TOLERANCE_NATS]
        self._mode_of_x = x + shift[0]
        slope, curvature, _, z, logdet = likelihood_terms
        jtj = multiply(np.arange(len(vs)), curvature)
        jtr = (jacobian.transpose(0, 2, 1) @ slope[:, :, None])[:, :, 0]
        # Expand rtr − 2·jtrᵀ(δ − m) + (δ − m)ᵀ·jtj·(δ − m) in powers of δ = x − x̂: the Gram matrix at δ = 0.
        jtj_shift = (jtj @ shift[:, :, None])[:, :, 0]
        squares = objective - np.sum(z**2, axis=1) + np.sum(shift * (2 * jtr + jtj_shift), axis=1)
        return Gram(jtj, jtr + jtj_shift, squares, logdet)

    def rss(self, hyper: Values, gram: Gram) -> float:
        """Return the whitened residual sum of squares, or the deviance of a non-Gaussian law."""
        noise, record = self.problem.noise, self.problem.record
        if noise.is_gaussian:
            return gram.rtr
        line = self.problem.linearise(self.x, hyper)
        residual = record.y - line.mean
        return density_terms(noise, hyper, record, residual, self._input_variance(line)).squares

    def evaluate(self, v: np.ndarray, exact: bool = False) -> Any:
        """Return log density, gradient and negative Hessian (by BFGS unless `exact`); None if undefined."""
        if self.tabulated is None:
            return super().evaluate(v, exact)
        if self._latest is None or not np.array_equal(self._latest[0], v):
            self._latest = v.copy(), self.tabulated.evaluate(v, self.flat_scales, True)
        return self._latest[1]

    def value(self, v: np.ndarray) -> float:
        """Return the log density at the coordinates v of φ; −1e300 (`LOG_ZERO`) if undefined."""
        if self.tabulated is None:
            return super().value(v)
        local_model = self.evaluate(v)
        return LOG_ZERO if local_model is None else local_model.log_density

    def condition_at(self, v: np.ndarray) -> tuple[float, Conditional | None]:
        """Return the log density at φ and the conditional posterior of x given φ; (`LOG_ZERO`, None) if undefined."""
        problem = self.problem
        if self.tabulated is not None:
            result = self.tabulated.evaluate(v, self.flat_scales, False)
            return (LOG_ZERO, None) if result is None else (result.log_density, result.conditional)
        hyper = problem.hyper(v)
        prior, gram = problem.prior(hyper, self.flat_scales), self.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet) or not np.all(np.isfinite(prior.sd)):
            return LOG_ZERO, None
        conditional = condition(gram, problem.record.size, prior, self.x)
        value = math.nan if conditional is None else conditional.log_marginal + problem.log_prior(v)
        return (value, conditional) if math.isfinite(value) else (LOG_ZERO, None)

    def values(self, vs: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k"]:
        """Return the log density at several φ (k,), given by their coordinates (k, d)."""
        problem, vs = self.problem, np.asarray(vs)
        if not len(vs):
            return np.zeros(0)
        if self.tabulated is not None or problem.terms:
            draws = problem.draw_x(self.grams(vs), vs, self.flat_scales, self.origin)
            log_density = draws.log_marginal
        else:  # no coefficients: the noise law alone
            law, record = problem.noise, problem.record
            log_density = total_log_density(law, record, record.y[None], problem.hyper(vs.T))
        return np.nan_to_num(log_density + problem.log_priors(vs), nan=LOG_ZERO, neginf=LOG_ZERO)
