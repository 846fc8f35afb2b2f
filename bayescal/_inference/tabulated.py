"""Marginal log density of φ from cached inner products of basis columns: value, gradient and exact Hessian.

Columns of all effects form one table Φ, φ-dependent ones as sums of terms (`Expansion`), so that [J·sd | r] = Φ·D(φ),
D with one non-zero element dᵢ(φ) per row, in the column of the coefficient ("owner") to which row i contributes. With
G(θ) = ΦᵀΣ(θ)⁻¹Φ from products at the nodes of the noise law (`noise_nodes`) and W = DᵀGD = [[M, m], [mᵀ, s]],

    log p(y, φ) = −½·(n·log 2π + log|Σ| + log|A| + ρ) + log p(φ),
    A = M + diag(w),   ρ = s + w·f² − pᵀA⁻¹p,   p = m + w·f,

x = origin + sd·t, the prior t ~ N(f, 1/w). d depends on shapes and prior deviations, G on noise parameters. With
C = A⁻¹, t = C·p, P = [[C + t·tᵀ, −t], [−tᵀ, 1]] (indexed by owners of rows), Q = P ∘ G, and k, l entries of φ,

    ∂ₖ = −aₖᵀQd,   −∂ₖₗ = bₖₗᵀQd + aₖᵀQaₗ − ½·tr(C·Mₖ·C·Mₗ) − qₖᵀCqₗ,   a = ∂d,  b = ∂²d,  qₖ = mₖ − Mₖt,

Mₖ, mₖ the derivatives of M and m: the Hessian costs a few matrix products. Derivatives of G are central differences
with respect to the noise parameters. Source: derived here; the gradient is Fisher's identity.
"""

from __future__ import annotations

import math
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._inference.column_table import RESIDUAL, ColumnTable
from bayescal._inference.expansion import (
    TEST_DRAWS,
    Expansion,
    Expansions,
    ListedColumns,
    PolynomialColumns,
)
from bayescal._inference.gaussian import Conditional, Gram, Prior, condition
from bayescal._inference.noise_nodes import Products, SingleNode, Weights
from bayescal._inference.noise_on_record import variances
from bayescal._inference.problem import Problem, Values
from bayescal._model.composition import expand_members
from bayescal._model.terms import Term

DIFF_STEP = 1e-3  # central-difference step of a coordinate of φ
MAX_ORIGIN_SD = 1e3  # distance of the origin of x from the prior mean, prior standard deviations
MAX_ERROR_NATS = 0.02  # of the log density by polynomial columns
MAX_BATCH_ELEMENTS = 2_000_000  # array elements per batch, to bound memory
MAX_PAIRS_PER_READING = 40  # pairs of table columns above which direct evaluation is cheaper
MAX_CACHED_TABLES = 3  # row tables of a structure


class Evaluation(NamedTuple):
    """Marginal log density at one φ and conditional posterior of x; optionally gradient and negative Hessian."""

    log_density: float
    conditional: Conditional
    gradient: Float[np.ndarray, "d"] | None = None
    curvature: Float[np.ndarray, "d d"] | None = None


class EffectBlock(NamedTuple):
    """One effect of a structure; its basis columns are one block of the table."""

    key: int  # identifier of its columns in the table, common to equal effects
    expansions: Expansions  # of its columns
    terms: tuple[Term, ...]  # its coefficients
    shape_indices: list[int]  # indices in φ of the shapes of its columns
    # Index in x of each coefficient and group member; p (the residual) if it has a fixed value.
    owners: Int[np.ndarray, "m"]
    multipliers: Float[np.ndarray, "m"]  # 1, or minus the value of a fixed coefficient

    def expansion_at(self, v: Float[np.ndarray, "d"], with_grad: bool) -> Expansion:
        """Return the expansion of the effect's columns that is valid at φ."""
        return self.expansions.get(v[self.shape_indices], with_grad)


class TabulatedDensity:
    """Marginal density of φ from cached inner products; a nonlinear output is linearised at a given x and φ."""

    def __init__(
        self,
        problem: Problem,
        nodes: SingleNode,
        x: Float[np.ndarray, "p"],
        expansion_point: Float[np.ndarray, "d"],
    ) -> None:
        self.problem, self.nodes = problem, nodes
        self.phi_index = {h.name: i for i, h in enumerate(problem.hypers)}
        self.noise = [i for i, kind in enumerate(problem.kinds) if kind == "noise"]
        self._tables: dict[Any, _StructureRows] = {}
        self.slopes = problem.slopes(x, problem.hyper(expansion_point))
        if problem.is_affine:
            self.table: ColumnTable = problem.record.table
            self.blocks = self._list_blocks(self.table)
            self.table.remove_fit([*self._static_blocks])
        else:
            self.table = self._linearise_table(x, expansion_point)
        self.origin = self._choose_origin()

    def _list_blocks(self, table: ColumnTable) -> list[EffectBlock]:
        problem, terms_by_effect = self.problem, dict[int, list[Term]]()
        for t in problem.terms:
            terms_by_effect.setdefault(id(t.effect), []).append(t)
        blocks = []
        for terms in terms_by_effect.values():
            names, fixed_values = terms[0].columns.names, problem.fixed_values
            fixed_shapes = tuple(fixed_values.get(n) for n in names)
            term_fields = [(t.index, t.slot, t.factor, t.per, t.size) for t in terms]
            owners = [
                np.arange(t.x_slice.start, t.x_slice.stop)
                if t.place == "x"
                else np.full(t.size, problem.size)
                for t in terms
            ]
            multipliers = [np.full(t.size, 1.0 if t.place == "x" else -t.value) for t in terms]
            blocks.append(
                EffectBlock(
                    table.number((terms[0].columns.key, fixed_shapes, *term_fields)),
                    problem.record.expansions(terms[0].columns, fixed_shapes),
                    tuple(terms),
                    [self.phi_index[n] for n in names if n not in fixed_values],
                    np.concatenate(owners),
                    np.concatenate(multipliers),
                )
            )
        return blocks

    def _get_block(self, block: EffectBlock, expansion: Expansion) -> int:
        """Return the table's block number of an effect's columns, `rank` columns per coefficient and group member."""
        return self.table.block(
            (block.key, expansion.number), lambda: self._list_columns(block, expansion)
        )

    def _list_columns(self, block: EffectBlock, expansion: Expansion) -> Float[np.ndarray, "n w"]:
        columns = []
        for t in block.terms:
            column = (self.slopes[t.slot] * t.factor)[:, None] * expansion.columns[:, t.index]
            codes = None if t.per is None else self.problem.record.codes[t.per]
            member_columns = expand_members(column.T, codes, t.size)  # (r, n, members)
            columns.append(member_columns.transpose(1, 2, 0).reshape(len(column), -1))
        return np.concatenate(columns, axis=1)

    @cached_property
    def _static_blocks(self) -> dict[int, EffectBlock]:
        """Return the φ-independent effects by block number, without Gaussian processes (nearly collinear)."""
        medians = np.zeros(len(self.problem.hypers))
        return {
            self._get_block(block, block.expansion_at(medians, False)): block
            for block in self.blocks
            if not block.shape_indices and block.terms[0].effect.weights is None
        }

    def _linearise_table(self, x: Float[np.ndarray, "p"], v: Float[np.ndarray, "d"]) -> ColumnTable:
        """Build the column table of a nonlinear output linearised at x and v; static coefficients are relative to x."""
        problem = self.problem
        residual = problem.record.y - problem.linearise(x, problem.hyper(v)).mean
        self.table = ColumnTable(residual)
        self.blocks = self._list_blocks(self.table)
        subtracted_fits = dict.fromkeys(self._static_blocks)
        for block in self.blocks:
            expansion = block.expansion_at(v, False)
            is_in_x = block.owners < problem.size
            coefficients = np.where(is_in_x, np.append(x, 0.0)[block.owners], -block.multipliers)
            if (number := self._get_block(block, expansion)) in subtracted_fits:
                subtracted_fits[number] = coefficients
            else:
                factors = expansion.factors(v[block.shape_indices]).value
                residual += self._list_columns(block, expansion) @ np.kron(coefficients, factors)
        self.table.fitted_coefficients = subtracted_fits
        return self.table

    def _choose_origin(self) -> Float[np.ndarray, "p"]:
        """Return the origin of x (p,): least-squares coefficients subtracted from the residual, or prior means."""
        problem = self.problem
        origin, weight = problem.mean_of_x.copy(), problem.weight_of_x
        sd = problem.sizes.fixed_sd.copy()
        origin[weight == 0] = 0.0
        sd[weight == 0] = np.inf
        for mask in problem.sizes.learned_sd_masks.values():
            sd[mask > 0] = np.inf
        for key, block in self._static_blocks.items():
            if (coefficients := self.table.fitted_coefficients.get(key)) is not None:
                is_in_x = block.owners < problem.size
                indices, coefficients = block.owners[is_in_x], coefficients[is_in_x]
                is_near = np.abs(coefficients - origin[indices]) < MAX_ORIGIN_SD * sd[indices]
                origin[indices] = np.where(is_near, coefficients, origin[indices])
        return origin

    def rows(self, expansions: tuple[Expansion, ...]) -> _StructureRows:
        """Return the structure's rows of the table for a combination of expansions; the latest are cached."""
        if expansions not in self._tables:
            while len(self._tables) >= MAX_CACHED_TABLES:
                del self._tables[next(iter(self._tables))]
            self._tables[expansions] = _StructureRows(self, expansions)
        return self._tables[expansions]

    def weights(self, coordinates: Float[np.ndarray, "s q"]) -> Weights:
        """Return the noise law's node weights at several values of its coordinates in φ (s, q)."""
        problem, values = self.problem, dict[str, Any]()
        for name in problem.noise.parameters():
            values[name] = np.full(len(coordinates), problem.fixed_values.get(name, 0.0))
        for k, i in enumerate(self.noise):
            hyper = problem.hypers[i]
            values[hyper.name] = hyper.prior.value(coordinates[:, k])
        return self.nodes.weights(problem.noise, values)

    def evaluate(
        self, v: Float[np.ndarray, "d"], flat_scales: Float[np.ndarray, "p"], with_grad: bool = True
    ) -> Evaluation | None:
        """Return the log density at one φ, with gradient and negative Hessian if `with_grad`; None if undefined."""
        problem, p, q = self.problem, self.problem.size, len(self.noise)
        hyper = problem.hyper(v)
        prior = problem.prior(hyper, flat_scales)
        if not np.all(np.isfinite(prior.sd)):
            return None
        rows = self.rows(tuple(block.expansion_at(v, with_grad) for block in self.blocks))
        weights = self.weights(v[self.noise] + _make_stencil(q)[: None if with_grad else 1])
        if not np.isfinite(weights.log_det[0]):
            return None
        factors, derivatives = rows.factors(v, with_grad)
        grams = rows.products.gram(weights, slice(0, 1 + 2 * q if with_grad else 1))
        gram = rows.select(grams[0])
        unit_d = factors[:, None] * rows.indicator  # D for unit prior deviations (R, p + 1)
        gram_unit = gram @ unit_d
        gram_x = Gram.split(unit_d.T @ gram_unit, weights.log_det[0])
        conditional = condition(gram_x, problem.record.size, prior, self.origin)
        if conditional is None:
            return None
        log_prior, prior_gradient, prior_curvature = self._compute_log_prior(v)
        value = conditional.log_marginal + log_prior
        if not math.isfinite(value):
            return None
        if not with_grad:
            return Evaluation(value, conditional)
        scale = np.append(prior.sd, 1.0)
        C, P = _compute_posterior_moments(conditional, prior, self.origin)
        d = scale[rows.owner] * factors
        U = gram_unit * scale  # G·D
        P_rows = P[rows.owner[:, None], rows.owner]
        Q = gram * P_rows
        d_log_sd, d2_log_sd = self._differentiate_log_sd(v, hyper)
        a = d_log_sd[:, rows.owner] * d
        for index, ks, gradients, _ in derivatives:
            a[np.ix_(ks, index)] = scale[rows.owner[index]] * gradients
        y = Q @ d
        gradient = prior_gradient - a @ y
        dW = rows.indicator.T @ (a[:, :, None] * U)  # (d, p + 1, p + 1)
        dW = dW + dW.transpose(0, 2, 1)
        B = (a @ Q) @ a.T
        # Second derivatives of d times Q·d: with respect to prior deviations, to shapes, mixed.
        e = d * y
        by_sd = d_log_sd[:, rows.owner]
        B += (by_sd * e) @ by_sd.T
        B.flat[:: len(v) + 1] += d2_log_sd @ (rows.indicator.T @ e)
        for index, ks, gradients, hessians in derivatives:
            mixed = by_sd[:, index] @ (scale[rows.owner[index]] * gradients * y[index]).T
            B[:, ks] += mixed
            B[ks, :] += mixed.T
            B[np.ix_(ks, ks)] += hessians @ (scale[rows.owner[index]] * y[index])
        E = P_rows * np.outer(d, d)
        D = d[:, None] * rows.indicator
        for k, i in enumerate(self.noise):
            dG = rows.select(grams[1 + k] - grams[1 + q + k]) / (2 * DIFF_STEP)
            d_log_det = (weights.log_det[1 + k] - weights.log_det[1 + q + k]) / (2 * DIFF_STEP)
            dW[i] = D.T @ dG @ D
            product = (P_rows * dG) @ d
            gradient[i] -= 0.5 * (float(d @ product) + d_log_det)
            B[i, :] = B[:, i] = a @ product
        if self.noise:
            traces = rows.products.traces(weights, rows.add_by_column(E)) + weights.log_det
            B[np.ix_(self.noise, self.noise)] = 0.5 * _compute_second_differences(traces, q)
        # The prior mean f = (mean − origin)/sd depends on sd, and with it w·f in p and w·f² in ρ.
        t = _standardise_mean(conditional, prior, self.origin)
        prior_offset = prior.weight * (t - conditional.z)
        d_log_sd_x, z = d_log_sd[:, :p], prior.weight * conditional.z
        gradient -= d_log_sd_x @ (z * prior_offset)
        B += (d_log_sd_x * (prior_offset**2 - z * prior_offset)) @ d_log_sd_x.T
        B.flat[:: len(v) + 1] += d2_log_sd[:, :p] @ (z * prior_offset)
        dM = dW[:, :p, :p]
        q_vectors = dW[:, :p, p] - dM @ t - d_log_sd_x * prior_offset
        X = C @ dM
        H = B - 0.5 * np.einsum("kij,lji->kl", X, X) - q_vectors @ C @ q_vectors.T
        H.flat[:: len(H) + 1] -= prior_curvature
        return Evaluation(value, conditional, gradient, 0.5 * (H + H.T))

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return the Gram matrices of [J r] at several φ, with residuals r at x = `origin`."""
        p = self.problem.size
        if self.is_direct:
            return self._compute_grams_from_readings(vs)
        sets = [block.expansions.cover(vs[:, block.shape_indices]) for block in self.blocks]
        products, log_det = np.empty((len(vs), p + 1, p + 1)), np.empty(len(vs))
        boxes = np.array([indices for _, indices in sets]).reshape(len(sets), len(vs)).T
        for box in np.unique(boxes, axis=0):
            members = np.flatnonzero(np.all(boxes == box, axis=1))
            rows = self.rows(tuple(e[i] for (e, _), i in zip(sets, box, strict=True)))
            products[members], log_det[members] = self.compute_grams(rows, vs[members])
        for block, (expansions, _) in zip(self.blocks, sets, strict=True):
            for expansion in (e for e in expansions if isinstance(e, ListedColumns)):
                self.table.discard((block.key, expansion.number))
        return Gram.split(products, log_det)

    @cached_property
    def is_direct(self) -> bool:
        """Return whether evaluation from the readings can be cheaper: independent noise, several shapes per effect."""
        has_many_shapes = any(len(block.shape_indices) > 1 for block in self.blocks)
        return has_many_shapes and self.problem.noise.independent and self.problem.is_affine

    def _compute_grams_from_readings(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        problem, products = self.problem, []
        size = problem.record.size * (problem.size + 1)
        for batch in np.array_split(vs, min(len(vs), -(-len(vs) * size // MAX_BATCH_ELEMENTS))):
            hyper = problem.hyper(batch.T)
            line = problem.linearise(np.tile(self.origin, (len(batch), 1)), hyper)
            residual = (problem.record.y - line.mean)[..., None]
            variance = variances(problem.noise, hyper, problem.record)
            variance = np.broadcast_to(variance, line.mean.shape)
            table = np.concatenate([line.jacobian, residual], axis=2) / np.sqrt(variance)[..., None]
            products.append((table.transpose(0, 2, 1) @ table, np.sum(np.log(variance), axis=1)))
        return Gram.split(*map(np.concatenate, zip(*products, strict=True)))

    def compute_grams(
        self, rows: _StructureRows, vs: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b p1 p1"], Float[np.ndarray, "b"]]:
        """Return the Gram matrices of [J r] and log|Σ| at several φ inside the validity boxes of `rows`' expansions."""
        products = []
        batch_count = min(len(vs), -(-len(vs) * rows.width**2 // MAX_BATCH_ELEMENTS))
        for batch in np.array_split(vs, batch_count):
            weights = self.weights(batch[:, self.noise])
            gram = rows.products.gram(weights)
            if not rows.is_identity:
                gram = gram[:, rows.column[:, None], rows.column]
            columns = rows.values(batch)[:, :, None] * rows.indicator
            products.append((columns.transpose(0, 2, 1) @ (gram @ columns), weights.log_det))
        grams, log_det = zip(*products, strict=True)
        return np.concatenate(grams), np.concatenate(log_det)

    def fit_polynomials(
        self,
        v: Float[np.ndarray, "d"],
        covariance: Float[np.ndarray, "d d"],
        flat_scales: Float[np.ndarray, "p"],
    ) -> PolynomialTable | None:
        """Approximate columns by polynomials in φ near its mode; return None if inaccurate or too expensive."""
        deviates = np.random.default_rng(0).standard_normal((400, len(v)))
        draws, expansions = v + deviates @ np.linalg.cholesky(covariance).T, list[Expansion]()
        for block in self.blocks:
            if not block.shape_indices:
                expansions.append(block.expansion_at(v, False))
                continue
            expansion = block.expansions.fit_polynomials(draws[:, block.shape_indices])
            if expansion is None:
                return None
            expansions.append(expansion)
        polynomial_table = PolynomialTable(self, tuple(expansions))
        max_pairs = MAX_PAIRS_PER_READING * self.problem.record.size
        if self.is_direct and polynomial_table.rows.width**2 > max_pairs:
            return None
        if not any(block.shape_indices for block in self.blocks):
            return polynomial_table
        test_v = draws[:TEST_DRAWS]
        exact, fitted_values = (
            self.problem.draw_x(table.grams(test_v), test_v, flat_scales, self.origin).log_marginal
            for table in (self, polynomial_table)
        )
        error = np.abs(fitted_values - exact)[np.isfinite(exact)]
        return polynomial_table if np.max(error, initial=0.0) < MAX_ERROR_NATS else None

    def _compute_log_prior(self, v: Float[np.ndarray, "d"]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log prior of φ, and its first and second derivatives with respect to each coordinate (d,)."""
        h, log_priors = DIFF_STEP, np.empty((3, len(v)))
        for i, hyper in enumerate(self.problem.hypers):
            log_priors[:, i] = hyper.prior.log_density(v[i] + np.array([-h, 0.0, h]))
        low, middle, high = log_priors
        return float(middle.sum()), (high - low) / (2 * h), (high - 2 * middle + low) / h**2

    def _differentiate_log_sd(
        self, v: Float[np.ndarray, "d"], hyper: Values
    ) -> tuple[Float[np.ndarray, "d p1"], Float[np.ndarray, "d p1"]]:
        """Return ∂/∂v and ∂²/∂v² of the log prior standard deviations of x, (d, p + 1) each; the last column is zero.

        A standard deviation that depends on several shapes is a product of functions of one shape each.
        """
        problem, h = self.problem, DIFF_STEP
        first_derivatives, second_derivatives = np.zeros((2, len(v), problem.size + 1))
        for name, mask in problem.sizes.learned_sd_masks.items():
            if (i := self.phi_index.get(name)) is not None:
                coordinates = v[i] + np.array([-h, 0, h])
                low, middle, high = np.log(problem.hypers[i].prior.value(coordinates))
                first_derivatives[i, :-1] += (high - low) / (2 * h) * mask
                second_derivatives[i, :-1] += (high - 2 * middle + low) / h**2 * mask
        for name in problem.sizes.weights_by_shape:
            if (i := self.phi_index.get(name)) is not None:
                value = problem.hypers[i].prior.value
                low, middle, high = (
                    problem.sizes.log_weights(name, {**hyper, name: value(v[i] + s)})
                    for s in (-h, 0.0, h)
                )
                first_derivatives[i, :-1] += (high - low) / (2 * h)
                second_derivatives[i, :-1] += (high - 2 * middle + low) / h**2
        return first_derivatives, second_derivatives


class PolynomialTable:
    """Column table of a structure as polynomials in φ, valid in the region of the Laplace approximation."""

    def __init__(self, tabulated: TabulatedDensity, expansions: tuple[Expansion, ...]) -> None:
        self.tabulated, self.origin = tabulated, tabulated.origin
        self.rows = _StructureRows(tabulated, expansions)
        for block, expansion in zip(tabulated.blocks, expansions, strict=True):
            if block.shape_indices:  # columns of this table alone
                tabulated.table.discard((block.key, expansion.number))

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return the Gram matrices of [J r] at several φ, with residuals r at x = `origin`."""
        return Gram.split(*self.tabulated.compute_grams(self.rows, vs))

    def contains(self, vs: Float[np.ndarray, "b d"]) -> np.ndarray:
        """Return whether each φ is inside the region of the polynomial fit (b,)."""
        is_inside = np.ones(len(vs), dtype=bool)
        for block, expansion in zip(self.tabulated.blocks, self.rows.expansions, strict=True):
            if isinstance(expansion, PolynomialColumns):
                is_inside &= expansion.contains(vs[:, block.shape_indices])
        return is_inside


class _StructureRows:
    """Rows of D for a combination of expansions: table column, index in x ("owner") and constant factor of each."""

    def __init__(self, tabulated: TabulatedDensity, expansions: tuple[Expansion, ...]) -> None:
        self.expansions, self.blocks = expansions, tabulated.blocks
        p, table, keys = tabulated.problem.size, tabulated.table, list[int]()
        column_parts, owner_parts, factor_parts, self.slices = [], [], [], []
        start = 0
        for block, expansion in zip(tabulated.blocks, expansions, strict=True):
            key = tabulated._get_block(block, expansion)
            keys.append(key)
            r = expansion.rank
            columns = start + np.arange(len(block.owners) * r)
            self.slices.append(slice(start, start + len(columns)))
            column_parts.append(columns)
            owner_parts.append(np.repeat(block.owners, r))
            factor_parts.append(np.repeat(block.multipliers, r))
            # Add back what was subtracted from the residual, relative to the origin of x.
            is_in_x = block.owners < p
            origin = tabulated.origin[np.minimum(block.owners, max(p - 1, 0))] if p else 0.0
            offset = np.where(is_in_x, -origin, 0.0)
            offset += table.fitted_coefficients.get(key, 0.0)
            offset = np.repeat(offset, r)
            nonzero = np.flatnonzero(offset)
            column_parts.append(columns[nonzero])
            owner_parts.append(np.full(len(nonzero), p))
            factor_parts.append(offset[nonzero])
            start += len(columns)
        for key in table.fitted_coefficients.keys() - set(keys):
            width = table.fitted_coefficients[key].size
            keys.append(key)
            column_parts.append(start + np.arange(width))
            owner_parts.append(np.full(width, p))
            factor_parts.append(table.fitted_coefficients[key])
            start += width
        self.column = np.concatenate([*column_parts, [start]]).astype(int)
        self.owner = np.concatenate([*owner_parts, [p]]).astype(int)
        self.multipliers = np.concatenate([*factor_parts, [1.0]])
        self.width = start + 1
        self.indicator = np.zeros((len(self.owner), p + 1))
        self.indicator[np.arange(len(self.owner)), self.owner] = 1.0
        self.is_identity = np.array_equal(self.column, np.arange(self.width))
        self.products: Products = table.products(tabulated.nodes, [*keys, RESIDUAL])

    def select(self, gram: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "R R"]:
        """Return the inner products of rows (R, R), selected from those of table columns (w, w)."""
        return gram if self.is_identity else gram[self.column[:, None], self.column]

    def add_by_column(self, e: Float[np.ndarray, "R R"]) -> Float[np.ndarray, "w w"]:
        """Sum a matrix over rows (R, R) into one over table columns (w, w); adjoint of `select`."""
        if self.is_identity:
            return e
        sums = np.zeros((self.width, self.width))
        np.add.at(sums, (self.column[:, None], self.column), e)
        return sums

    @cached_property
    def _dynamic_rows(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Return for each φ-dependent effect its index, its rows of the table, and each row's Taylor term."""
        entries = []
        for i, (block, columns) in enumerate(zip(self.blocks, self.slices, strict=True)):
            if block.shape_indices:
                rows = np.flatnonzero((self.column >= columns.start) & (self.column < columns.stop))
                terms = (self.column[rows] - columns.start) % self.expansions[i].rank
                entries.append((i, rows, terms))
        return entries

    def values(self, vs: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b R"]:
        """Return the element of D in each row (b, R) at several φ (b, d), for unit prior standard deviations."""
        factors = np.tile(self.multipliers, (len(vs), 1))
        for i, rows, terms in self._dynamic_rows:
            shape_values = vs[:, self.blocks[i].shape_indices]
            factors[:, rows] *= self.expansions[i].values(shape_values)[:, terms]
        return factors

    def factors(self, v: Float[np.ndarray, "d"], with_grad: bool) -> tuple[np.ndarray, list[Any]]:
        """Return the element of D in each row; per φ-dependent effect: rows, indices in φ, gradients, Hessians."""
        factors, slopes = self.multipliers.copy(), []
        for i, rows, terms in self._dynamic_rows:
            shape_indices = self.blocks[i].shape_indices
            values = self.expansions[i].factors(v[shape_indices])
            factors[rows] *= values.value[terms]
            if with_grad:
                gradients, hessians = values.gradient[:, terms], values.hessian[:, :, terms]
                multipliers = self.multipliers[rows]
                derivatives = gradients * multipliers, hessians * multipliers
                slopes.append((rows, shape_indices, *derivatives))
        return factors, slopes


def _standardise_mean(
    conditional: Conditional, prior: Prior, point: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "p"]:
    """Return the conditional mean of x minus a point, in prior standard deviations (p,): t in the module's formulas."""
    shift = prior.weight * (prior.mean - point)
    return conditional.z + np.where(shift == 0, 0.0, shift / np.where(prior.sd > 0, prior.sd, 1.0))


def _compute_posterior_moments(
    conditional: Conditional, prior: Prior, point: Float[np.ndarray, "p"]
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p1 p1"]]:
    """Return C = A⁻¹ and P = [[C + t·tᵀ, −t], [−tᵀ, 1]], as in the module's formulas."""
    root, t, p = conditional.root_of_z, _standardise_mean(conditional, prior, point), len(point)
    C, P = root @ root.T, np.empty((p + 1, p + 1))
    P[:p, :p], P[:p, p], P[p, :p], P[p, p] = C + np.outer(t, t), -t, -t, 1.0
    return C, P


@cache
def _make_stencil(q: int) -> Float[np.ndarray, "s q"]:
    """Return the stencil of first and second central differences in q coordinates (1 + 2q + q(q − 1), q)."""
    unit = np.eye(q)
    pairs = np.array([unit[i] + unit[j] for i in range(q) for j in range(i)]).reshape(
        q * (q - 1) // 2, q
    )
    return DIFF_STEP * np.concatenate([np.zeros((1, q)), unit, -unit, pairs, -pairs])


def _compute_second_differences(f: Float[np.ndarray, "s"], q: int) -> Float[np.ndarray, "q q"]:
    """Return the Hessian (q, q) of a function by central differences of its values on the stencil."""
    middle, up, down = f[0], f[1 : 1 + q], f[1 + q : 1 + 2 * q]
    mixed_sums = f[1 + 2 * q :].reshape(2, q * (q - 1) // 2).sum(axis=0)
    hessian, pairs = np.diag(up - 2 * middle + down), [(i, j) for i in range(q) for j in range(i)]
    for (i, j), pair in zip(pairs, mixed_sums, strict=True):
        hessian[i, j] = hessian[j, i] = 0.5 * (pair - up[i] - down[i] - up[j] - down[j] + 2 * f[0])
    return hessian / DIFF_STEP**2
