"""A structure's log density of φ, x integrated out, from products of columns: value, gradient and exact curvature.

Columns of all effects stand in one table Φ, moving ones as sums of few (`Expansion`), so that [J·sd | r] = Φ·D(φ) with
D a matrix of row weights, one non-zero number dᵢ(φ) in a row, in the column of the row's owner. With
G(θ) = ΦᵀΣ(θ)⁻¹Φ from products at the nodes of the noise law (`noise_nodes`) and W = DᵀGD = [[M, m], [mᵀ, s]],

    log p(y, φ) = −½·(n·log 2π + log|Σ| + log|A| + ρ) + log p(φ),
    A = M + diag(w),   ρ = s + w·f² − pᵀA⁻¹p,   p = m + w·f,

x = at + sd·t, the prior t ~ N(f, 1/w). Shapes, spreads and sizes move d, the noise's parameters G. With C = A⁻¹,
t = C·p, P = [[C + t·tᵀ, −t], [−tᵀ, 1]] (rows and columns of P by the owners of rows), Q = P ∘ G, and k, l entries of φ,

    ∂ₖ = −aₖᵀQd,   −∂ₖₗ = bₖₗᵀQd + aₖᵀQaₗ − ½·tr(C·Mₖ·C·Mₗ) − qₖᵀCqₗ,   a = ∂d,  b = ∂²d,  qₖ = mₖ − Mₖt,

Mₖ, mₖ the slopes of M and m: so that the curvature costs a few products. Slopes of G are central differences over
settings of the noise, all of them one product with the nodes' weights.
Source: derived here; the gradient is Fisher's identity.
"""

from __future__ import annotations

import math
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._inference.column_table import RESIDUAL, ColumnTable
from bayescal._inference.expansion import (
    TRIED_DRAWS,
    Expansion,
    Expansions,
    ListedColumns,
    PolynomialColumns,
)
from bayescal._inference.gaussian import Conditional, Gram, Prior, condition
from bayescal._inference.noise_nodes import OneNode, Products, Weights
from bayescal._inference.noise_on_record import variances
from bayescal._inference.problem import Problem, Values
from bayescal._model.composition import expand_members
from bayescal._model.terms import Term

DIFFERENCE = 1e-3  # of a coordinate, for slopes of priors, of weights of curves and of the noise
FAR_SD = 1e3  # prior standard deviations, beyond which a fit without priors says nothing of a coefficient
CLOSE_NATS = 0.02  # log density, within which columns as polynomials are good where a posterior is
NUMBERS_AT_ONCE = 2_000_000  # in products of several φ, which bounds memory
DIRECT = 40  # pairs of columns a reading in a table, from which columns at each φ cost less
KEPT_TABLES = 3  # of a structure's rows in boxes, the latest


class Evaluation(NamedTuple):
    """A structure at one φ: log p(y, φ), x given φ; if asked for, gradient and negative curvature by coordinates."""

    log_density: float
    conditional: Conditional
    gradient: Float[np.ndarray, "d"] | None = None
    curvature: Float[np.ndarray, "d d"] | None = None


class TabulatedEffect(NamedTuple):
    """One effect of a structure: its coefficients beside each other in one block of the table."""

    key: int  # of its columns, whoever has them; a number
    expansions: Expansions  # of its columns
    terms: tuple[Term, ...]  # its coefficients
    free: list[int]  # entries of φ that its columns move with
    # for each coefficient and group member, its place in x; the residual's of one that is held
    owners: Int[np.ndarray, "m"]
    amounts: Float[np.ndarray, "m"]  # for each of these 1, or minus the value that it is held at

    def at(self, v: Float[np.ndarray, "d"], with_grad: bool) -> Expansion:
        """Return its columns near φ."""
        return self.expansions.at(v[self.free], with_grad)


class Tabulated:
    """A structure's density on a table of products, a nonlinear output linearised at x and at `expansion_point`."""

    def __init__(
        self,
        problem: Problem,
        nodes: OneNode,
        x: Float[np.ndarray, "p"],
        expansion_point: Float[np.ndarray, "d"],
    ) -> None:
        self.problem, self.nodes = problem, nodes
        self.places = {h.name: i for i, h in enumerate(problem.hypers)}
        self.noise = [i for i, kind in enumerate(problem.kinds) if kind == "noise"]
        self._tables: dict[Any, _StructureRows] = {}
        self.slopes = problem.slopes(x, problem.hyper(expansion_point))
        if problem.affine:
            self.table: ColumnTable = problem.record.table
            self.parts = self._parts(self.table)
            self.table.take([*self._plain])
        else:
            self.table = self._about(x, expansion_point)
        self.at = self._counted_from()

    def _parts(self, table: ColumnTable) -> list[TabulatedEffect]:
        problem, effects = self.problem, dict[int, list[Term]]()
        for t in problem.terms:
            effects.setdefault(id(t.effect), []).append(t)
        parts = []
        for terms in effects.values():
            names, fixed = terms[0].shape_names, problem.fixed_values
            fixed_shapes = tuple(fixed.get(n) for n in names)
            config = [(t.index, t.slot, t.factor, t.per, t.size) for t in terms]
            owners = [
                np.arange(t.x_slice.start, t.x_slice.stop)
                if t.place == "x"
                else np.full(t.size, problem.size)
                for t in terms
            ]
            amounts = [np.full(t.size, 1.0 if t.place == "x" else -t.value) for t in terms]
            parts.append(
                TabulatedEffect(
                    table.number((terms[0].columns.key, fixed_shapes, *config)),
                    problem.record.expansions(terms[0].columns, fixed_shapes),
                    tuple(terms),
                    [self.places[n] for n in names if n not in fixed],
                    np.concatenate(owners),
                    np.concatenate(amounts),
                )
            )
        return parts

    def _block(self, part: TabulatedEffect, expansion: Expansion) -> int:
        """Return the number of a part's columns in the table: for each coefficient and member as many as the rank."""
        return self.table.block(
            (part.key, expansion.number), lambda: self._columns(part, expansion)
        )

    def _columns(self, part: TabulatedEffect, expansion: Expansion) -> Float[np.ndarray, "n w"]:
        columns = []
        for t in part.terms:
            column = (self.slopes[t.slot] * t.factor)[:, None] * expansion.columns[:, t.index]
            codes = None if t.per is None else self.problem.record.codes[t.per]
            spread = expand_members(column.T, codes, t.size)  # (r, n, members)
            columns.append(spread.transpose(1, 2, 0).reshape(len(column), -1))
        return np.concatenate(columns, axis=1)

    @cached_property
    def _plain(self) -> dict[int, TabulatedEffect]:
        """Return the parts that φ does not move, by their blocks; without curves (nearly collinear)."""
        middle = np.zeros(len(self.problem.hypers))
        return {
            self._block(part, part.at(middle, False)): part
            for part in self.parts
            if not part.free and part.terms[0].effect.weights is None
        }

    def _about(self, x: Float[np.ndarray, "p"], v: Float[np.ndarray, "d"]) -> ColumnTable:
        """Return the table of a nonlinear output linearised at x: that of plain parts counted from there."""
        problem = self.problem
        residual = problem.record.y - problem.linearise(x, problem.hyper(v)).mean
        self.table = ColumnTable(residual)
        self.parts = self._parts(self.table)
        explained = dict.fromkeys(self._plain)
        for part in self.parts:
            expansion = part.at(v, False)
            inside = part.owners < problem.size
            amounts = np.where(inside, np.append(x, 0.0)[part.owners], -part.amounts)
            if (number := self._block(part, expansion)) in explained:
                explained[number] = amounts
            else:
                share = expansion.shares(v[part.free]).value
                residual += self._columns(part, expansion) @ np.kron(amounts, share)
        self.table.taken = explained
        return self.table

    def _counted_from(self) -> Float[np.ndarray, "p"]:
        """Return the origin of x (p,): the least-squares amounts that the table removed, or prior means."""
        problem = self.problem
        origin, weight = problem.mean_of_x.copy(), problem.weight_of_x
        sd = problem.sizes.fixed_sd.copy()
        origin[weight == 0] = 0.0
        sd[weight == 0] = np.inf
        for members in problem.sizes.learned_sd_masks.values():
            sd[members > 0] = np.inf
        for key, part in self._plain.items():
            if (amounts := self.table.taken.get(key)) is not None:
                inside = part.owners < problem.size
                places, amounts = part.owners[inside], amounts[inside]
                near = np.abs(amounts - origin[places]) < FAR_SD * sd[places]
                origin[places] = np.where(near, amounts, origin[places])
        return origin

    def rows(self, expansions: tuple[Expansion, ...]) -> _StructureRows:
        """Return the structure's rows in some boxes; the latest are kept."""
        if expansions not in self._tables:
            while len(self._tables) >= KEPT_TABLES:
                del self._tables[next(iter(self._tables))]
            self._tables[expansions] = _StructureRows(self, expansions)
        return self._tables[expansions]

    def weights(self, coordinates: Float[np.ndarray, "s q"]) -> Weights:
        """Return the noise at several settings."""
        problem, values = self.problem, dict[str, Any]()
        for name in problem.noise.parameters():
            values[name] = np.full(len(coordinates), problem.fixed_values.get(name, 0.0))
        for k, i in enumerate(self.noise):
            hyper = problem.hypers[i]
            values[hyper.name] = hyper.prior.value(coordinates[:, k])
        return self.nodes.weights(problem.noise, values)

    def evaluate(
        self, v: Float[np.ndarray, "d"], flat: Float[np.ndarray, "p"], with_grad: bool = True
    ) -> Evaluation | None:
        """Return the log density at a φ, with its gradient and Hessian if `with_grad`; None if undefined."""
        problem, p, q = self.problem, self.problem.size, len(self.noise)
        hyper = problem.hyper(v)
        prior = problem.prior(hyper, flat)
        if not np.all(np.isfinite(prior.sd)):
            return None
        rows = self.rows(tuple(part.at(v, with_grad) for part in self.parts))
        weights = self.weights(v[self.noise] + _stencil(q)[: None if with_grad else 1])
        if not np.isfinite(weights.log_det[0]):
            return None
        shares, slopes = rows.shares(v, with_grad)
        grams = rows.products.gram(weights, slice(0, 1 + 2 * q if with_grad else 1))
        gram = rows.select(grams[0])
        unit = shares[:, None] * rows.owned  # (R, p + 1): of J, output unit per reported unit
        pulled = gram @ unit
        conditional = condition(
            Gram.of(unit.T @ pulled, weights.log_det[0]), problem.record.size, prior, self.at
        )
        if conditional is None:
            return None
        log_prior, prior_slope, prior_bend = self._log_prior(v)
        value = conditional.log_marginal + log_prior
        if not math.isfinite(value):
            return None
        if not with_grad:
            return Evaluation(value, conditional)
        scale = np.append(prior.sd, 1.0)
        C, P = _moments(conditional, prior, self.at)
        d = scale[rows.owner] * shares
        U = pulled * scale  # G·D
        P_rows = P[rows.owner[:, None], rows.owner]
        Q = gram * P_rows
        lines, bends = self._log_sizes(v, hyper)
        a = lines[:, rows.owner] * d
        for at, ks, first, _ in slopes:
            a[np.ix_(ks, at)] = scale[rows.owner[at]] * first
        y = Q @ d
        gradient = prior_slope - a @ y
        dW = rows.owned.T @ (a[:, :, None] * U)  # (d, p + 1, p + 1)
        dW = dW + dW.transpose(0, 2, 1)
        B = (a @ Q) @ a.T
        # Second slopes of d, times Q·d: of sizes, of shapes, of both.
        moved = lines.copy()
        e = d * y
        by_size = moved[:, rows.owner]
        B += (by_size * e) @ by_size.T
        B.flat[:: len(v) + 1] += bends @ (rows.owned.T @ e)
        for at, ks, first, second in slopes:
            across = by_size[:, at] @ (scale[rows.owner[at]] * first * y[at]).T
            B[:, ks] += across
            B[ks, :] += across.T
            B[np.ix_(ks, ks)] += second @ (scale[rows.owner[at]] * y[at])
        E = P_rows * np.outer(d, d)
        D = d[:, None] * rows.owned
        for k, i in enumerate(self.noise):
            dG = rows.select(grams[1 + k] - grams[1 + q + k]) / (2 * DIFFERENCE)
            d_log_det = (weights.log_det[1 + k] - weights.log_det[1 + q + k]) / (2 * DIFFERENCE)
            dW[i] = D.T @ dG @ D
            by = (P_rows * dG) @ d
            gradient[i] -= 0.5 * (float(d @ by) + d_log_det)
            B[i, :] = B[:, i] = a @ by
        if self.noise:
            traces = rows.products.traces(weights, rows.spread(E)) + weights.log_det
            B[np.ix_(self.noise, self.noise)] = 0.5 * _second_differences(traces, q)
        # The prior's mean is at f = (mean − at)/sd, which moves with sd: w·f in p and w·f² in ρ with it.
        t = _from_point(conditional, prior, self.at)
        far = prior.weight * (t - conditional.z)
        line, z = lines[:, :p], prior.weight * conditional.z
        gradient -= line @ (z * far)
        B += (line * (far**2 - z * far)) @ line.T
        B.flat[:: len(v) + 1] += bends[:, :p] @ (z * far)
        dM = dW[:, :p, :p]
        pull = dW[:, :p, p] - dM @ t - line * far
        X = C @ dM
        H = B - 0.5 * np.einsum("kij,lji->kl", X, X) - pull @ C @ pull.T
        H.flat[:: len(H) + 1] -= prior_bend
        return Evaluation(value, conditional, gradient, 0.5 * (H + H.T))

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return weighted products of J and r, counted from `at`, at several φ."""
        p = self.problem.size
        if self.direct:
            return self._from_readings(vs)
        covers = [part.expansions.cover(vs[:, part.free]) for part in self.parts]
        products, log_det = np.empty((len(vs), p + 1, p + 1)), np.empty(len(vs))
        boxes = np.array([which for _, which in covers]).reshape(len(covers), len(vs)).T
        for box in np.unique(boxes, axis=0):
            members = np.flatnonzero(np.all(boxes == box, axis=1))
            rows = self.rows(tuple(e[i] for (e, _), i in zip(covers, box, strict=True)))
            products[members], log_det[members] = self.grams_of(rows, vs[members])
        for part, (expansions, _) in zip(self.parts, covers, strict=True):
            for listed in (e for e in expansions if isinstance(e, ListedColumns)):
                self.table.drop((part.key, listed.number))
        return Gram.of(products, log_det)

    @cached_property
    def direct(self) -> bool:
        """Return whether each φ has columns of its own, of several shapes, and readings are independent."""
        moved = any(len(part.free) > 1 for part in self.parts)
        return moved and self.problem.noise.independent and self.problem.affine

    def _from_readings(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        problem, products = self.problem, []
        size = problem.record.size * (problem.size + 1)
        for some in np.array_split(vs, min(len(vs), -(-len(vs) * size // NUMBERS_AT_ONCE))):
            hyper = problem.hyper(some.T)
            line = problem.linearise(np.tile(self.at, (len(some), 1)), hyper)
            residual = (problem.record.y - line.mean)[..., None]
            spread = variances(problem.noise, hyper, problem.record)
            spread = np.broadcast_to(spread, line.mean.shape)
            table = np.concatenate([line.jacobian, residual], axis=2) / np.sqrt(spread)[..., None]
            products.append((table.transpose(0, 2, 1) @ table, np.sum(np.log(spread), axis=1)))
        return Gram.of(*map(np.concatenate, zip(*products, strict=True)))

    def grams_of(
        self, rows: _StructureRows, vs: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b p1 p1"], Float[np.ndarray, "b"]]:
        """Return products of [J r] and log|Σ| at several φ of some rows' boxes."""
        products = []
        parts = min(len(vs), -(-len(vs) * rows.width**2 // NUMBERS_AT_ONCE))
        for some in np.array_split(vs, parts):
            weights = self.weights(some[:, self.noise])
            gram = rows.products.gram(weights)
            if not rows.plain:
                gram = gram[:, rows.column[:, None], rows.column]
            unit = rows.values(some)[:, :, None] * rows.owned
            products.append((unit.transpose(0, 2, 1) @ (gram @ unit), weights.log_det))
        grams, log_det = zip(*products, strict=True)
        return np.concatenate(grams), np.concatenate(log_det)

    def about(
        self,
        v: Float[np.ndarray, "d"],
        covariance: Float[np.ndarray, "d d"],
        flat: Float[np.ndarray, "p"],
    ) -> About | None:
        """Return the table where a Gaussian fit of φ has its draws; None where columns are no polynomials there."""
        normal = np.random.default_rng(0).standard_normal((400, len(v)))
        draws, expansions = v + normal @ np.linalg.cholesky(covariance).T, list[Expansion]()
        for part in self.parts:
            expansion = part.expansions.fitted(draws[:, part.free]) if part.free else None
            if part.free and expansion is None:
                return None
            expansions.append(expansion or part.at(v, False))
        about = About(self, tuple(expansions))
        if self.direct and about.rows.width**2 > DIRECT * self.problem.record.size:
            return None
        if not any(part.free for part in self.parts):
            return about
        some = draws[:TRIED_DRAWS]
        exact, fitted = (
            self.problem.drawn(table.grams(some), some, flat, self.at).log_marginal
            for table in (self, about)
        )
        error = fitted - exact
        return (
            about if np.max(np.abs(error[np.isfinite(exact)]), initial=0.0) < CLOSE_NATS else None
        )

    def _log_prior(self, v: Float[np.ndarray, "d"]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log prior of φ, its slopes and its second slopes."""
        h, log_priors = DIFFERENCE, np.empty((3, len(v)))
        for i, hyper in enumerate(self.problem.hypers):
            log_priors[:, i] = hyper.prior.log_density(v[i] + np.array([-h, 0.0, h]))
        low, middle, high = log_priors
        return float(middle.sum()), (high - low) / (2 * h), (high - 2 * middle + low) / h**2

    def _log_sizes(
        self, v: Float[np.ndarray, "d"], hyper: Values
    ) -> tuple[Float[np.ndarray, "d p1"], Float[np.ndarray, "d p1"]]:
        """Return first and second slopes of the log standard deviations of x, a zero for the residual last.

        Sizes that follow several shapes are products of functions of each.
        """
        problem, h = self.problem, DIFFERENCE
        first, second = np.zeros((2, len(v), problem.size + 1))
        for name, members in problem.sizes.learned_sd_masks.items():
            if (i := self.places.get(name)) is not None:
                at = v[i] + np.array([-h, 0, h])
                low, middle, high = np.log(problem.hypers[i].prior.value(at))
                first[i, :-1] += (high - low) / (2 * h) * members
                second[i, :-1] += (high - 2 * middle + low) / h**2 * members
        for name in problem.sizes.weights_by_shape:
            if (i := self.places.get(name)) is not None:
                value = problem.hypers[i].prior.value
                low, middle, high = (
                    problem.sizes.log_weights(name, {**hyper, name: value(v[i] + s)})
                    for s in (-h, 0.0, h)
                )
                first[i, :-1] += (high - low) / (2 * h)
                second[i, :-1] += (high - 2 * middle + low) / h**2
        return first, second


class About:
    """A structure's table in the place of a Gaussian fit of φ, from which the products at many φ follow at once."""

    def __init__(self, whole: Tabulated, expansions: tuple[Expansion, ...]) -> None:
        self.whole, self.at = whole, whole.at
        self.rows = _StructureRows(whole, expansions)
        for part, expansion in zip(whole.parts, expansions, strict=True):
            if part.free:  # its own
                whole.table.drop((part.key, expansion.number))

    def grams(self, vs: Float[np.ndarray, "b d"]) -> Gram:
        """Return weighted products of J and r, counted from `at`, at several φ."""
        return Gram.of(*self.whole.grams_of(self.rows, vs))

    def reaches(self, vs: Float[np.ndarray, "b d"]) -> np.ndarray:
        """Return whether each φ is where the columns were fitted."""
        inside = np.ones(len(vs), dtype=bool)
        for part, expansion in zip(self.whole.parts, self.rows.expansions, strict=True):
            if isinstance(expansion, PolynomialColumns):
                inside &= expansion.reaches(vs[:, part.free])
        return inside


class _StructureRows:
    """A structure's rows of the table in some boxes: which column each is of, whose coefficient owns it, how much."""

    def __init__(self, whole: Tabulated, expansions: tuple[Expansion, ...]) -> None:
        self.expansions, self.parts = expansions, whole.parts
        p, table, keys = whole.problem.size, whole.table, list[int]()
        column, owner, amount, self.slices = [], [], [], []
        first = 0
        for part, expansion in zip(whole.parts, expansions, strict=True):
            key = whole._block(part, expansion)
            keys.append(key)
            r = expansion.rank
            columns = first + np.arange(len(part.owners) * r)
            self.slices.append(slice(first, first + len(columns)))
            column.append(columns)
            owner.append(np.repeat(part.owners, r))
            amount.append(np.repeat(part.amounts, r))
            # The residual is counted from what was taken; x from `at`.
            inside = part.owners < p
            off = np.where(
                inside, -whole.at[np.minimum(part.owners, max(p - 1, 0))] if p else 0.0, 0.0
            )
            off += table.taken.get(key, 0.0)
            off = np.repeat(off, r)
            put_back = np.flatnonzero(off)
            column.append(columns[put_back])
            owner.append(np.full(len(put_back), p))
            amount.append(off[put_back])
            first += len(columns)
        for key in table.taken.keys() - set(keys):
            width = table.taken[key].size
            keys.append(key)
            column.append(first + np.arange(width))
            owner.append(np.full(width, p))
            amount.append(table.taken[key])
            first += width
        self.column = np.concatenate([*column, [first]]).astype(int)
        self.owner = np.concatenate([*owner, [p]]).astype(int)
        self.amount = np.concatenate([*amount, [1.0]])
        self.width = first + 1
        self.owned = np.zeros((len(self.owner), p + 1))
        self.owned[np.arange(len(self.owner)), self.owner] = 1.0
        self.plain = np.array_equal(self.column, np.arange(self.width))
        self.products: Products = table.products(whole.nodes, [*keys, RESIDUAL])

    def select(self, gram: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "R R"]:
        """Return products of the rows of products of the columns."""
        return gram if self.plain else gram[self.column[:, None], self.column]

    def spread(self, e: Float[np.ndarray, "R R"]) -> Float[np.ndarray, "w w"]:
        """Return numbers of pairs of rows added up by pairs of columns."""
        if self.plain:
            return e
        sums = np.zeros((self.width, self.width))
        np.add.at(sums, (self.column[:, None], self.column), e)
        return sums

    @cached_property
    def _moving(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Return each part that moves, its rows, and which of its expansion's columns each is."""
        moving = []
        for i, (part, columns) in enumerate(zip(self.parts, self.slices, strict=True)):
            if part.free:
                at = np.flatnonzero((self.column >= columns.start) & (self.column < columns.stop))
                moving.append((i, at, (self.column[at] - columns.start) % self.expansions[i].rank))
        return moving

    def values(self, vs: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b R"]:
        """Return each row's factor at several φ in these boxes."""
        factors = np.tile(self.amount, (len(vs), 1))
        for i, at, which in self._moving:
            factors[:, at] *= self.expansions[i].values(vs[:, self.parts[i].free])[:, which]
        return factors

    def shares(self, v: Float[np.ndarray, "d"], with_grad: bool) -> tuple[np.ndarray, list[Any]]:
        """Return each row's factor; and for each part that moves: rows, entries of φ, first and second slopes."""
        factors, slopes = self.amount.copy(), []
        for i, at, which in self._moving:
            free = self.parts[i].free
            shares = self.expansions[i].shares(v[free])
            factors[at] *= shares.value[which]
            if with_grad:
                first, second = shares.first[:, which], shares.second[:, :, which]
                slopes.append((at, free, first * self.amount[at], second * self.amount[at]))
        return factors, slopes


def _from_point(
    conditional: Conditional, prior: Prior, at: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "p"]:
    """Return t: how far the mean of x is from a point, in standard deviations of its prior."""
    off = prior.weight * (prior.mean - at)
    return conditional.z + np.where(off == 0, 0.0, off / np.where(prior.sd > 0, prior.sd, 1.0))


def _moments(
    conditional: Conditional, prior: Prior, at: Float[np.ndarray, "p"]
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p1 p1"]]:
    """Return C and P."""
    root, t, p = conditional.root_of_z, _from_point(conditional, prior, at), len(at)
    C, P = root @ root.T, np.empty((p + 1, p + 1))
    P[:p, :p], P[:p, p], P[p, :p], P[p, p] = C + np.outer(t, t), -t, -t, 1.0
    return C, P


@cache
def _stencil(q: int) -> Float[np.ndarray, "s q"]:
    """Return shifts of the noise's coordinates: none; each up, each down; each two up, both down."""
    unit = np.eye(q)
    two = np.array([unit[i] + unit[j] for i in range(q) for j in range(i)]).reshape(
        q * (q - 1) // 2, q
    )
    return DIFFERENCE * np.concatenate([np.zeros((1, q)), unit, -unit, two, -two])


def _second_differences(f: Float[np.ndarray, "s"], q: int) -> Float[np.ndarray, "q q"]:
    """Return second slopes of what was computed on the stencil."""
    middle, up, down = f[0], f[1 : 1 + q], f[1 + q : 1 + 2 * q]
    both = f[1 + 2 * q :].reshape(2, q * (q - 1) // 2).sum(axis=0)
    bends, pairs = np.diag(up - 2 * middle + down), [(i, j) for i in range(q) for j in range(i)]
    for (i, j), two in zip(pairs, both, strict=True):
        bends[i, j] = bends[j, i] = 0.5 * (two - up[i] - down[i] - up[j] - down[j] + 2 * middle)
    return bends / DIFFERENCE**2
