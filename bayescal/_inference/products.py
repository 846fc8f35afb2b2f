"""Products over the readings as functions of φ: the one table that searches, fits and samplers read.

The columns of all coefficients stand beside each other in one table Φ (n, m), what the expected output leaves of the
readings beside them: one column where nothing moves it; where it moves with a shape, the few that it is a sum of, with
shares s(ψ) interpolated between Chebyshev's points: J(ψ) = Φ·S(ψ). The log evidence and its slopes by every entry of φ
then follow from the products of the table with itself, JᵀΣ⁻¹J = Sᵀ·(ΦᵀΣ⁻¹Φ)·S, and the readings are not touched again.

Where one variance holds for all readings, ΦᵀΣ⁻¹Φ is ΦᵀΦ over it; an affine output keeps these products for all its
structures at once (`ColumnProducts`). Parameters of correlated or uneven noise, promoted coefficients and shapes that
cannot be interpolated are *outer axes*: along them ΦᵀΣ⁻¹Φ is a polynomial, fitted about a Laplace fit.
Source: G. Migliorati et al., Found. Comput. Math. 14 (2014) 419 (polynomials by least squares at Chebyshev's density).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._data.column import UNCERTAINTY
from bayescal._inference.chebyshev import REACH, weights, weights_and_slopes
from bayescal._inference.column_products import ColumnProducts
from bayescal._inference.gaussian import Conditional, Gram, Prior
from bayescal._inference.noise_on_record import Whitening
from bayescal._inference.problem import Problem, Values
from bayescal._inference.record import Basis
from bayescal._model.composition import Linearised, by_member
from bayescal._model.prior import Normal
from bayescal._model.terms import Term

BOX = 5.0  # standard deviations of a Gaussian fit of φ, up to which polynomials are fitted
FEW = {1: (6, 12, 20), 2: (4, 8, 12, 17), 3: (3, 5, 7, 9)}
DEGREES = FEW | {4: (2, 4, 6), 5: (2, 4), 6: (2, 3, 4)}  # tried in turn, by the number of axes


class Columns(NamedTuple):
    """S(ψ): which columns of the table each coefficient's column is a sum of, and in which shares.

    Coefficients are in the order of x, then those that are held at a value.

    Attributes:
        plain: coefficients whose columns nothing moves (f,); they are the table's first.
        moving: coefficients whose columns move with a shape (k,).
        owner: for each further column of the table, which of `moving` it belongs to (r,).
        by: entries of φ that give the shares, each with the columns that follow it.
        shares: at the nodes of that entry's coordinate (r, nodes).
    """

    plain: Int[np.ndarray, "f"]
    moving: Int[np.ndarray, "k"]
    owner: Int[np.ndarray, "r"]
    by: tuple[tuple[int, Int[np.ndarray, "_"]], ...]
    shares: Float[np.ndarray, "r s"]

    def at(self, v: Float[np.ndarray, "*b d"]) -> Float[np.ndarray, "*b r k"]:
        """Shares at coordinates of φ, as a matrix from the table's further columns to the moving coefficients."""
        found = np.zeros((*v.shape[:-1], len(self.owner), len(self.moving)))
        for i, own in self.by:
            # A column at ψ is Σᵣ uᵣ·sᵣ(ψ) of singular vectors u; their shares s are known at the nodes, and between
            # them by the weights of Chebyshev's interpolation.
            found[..., own, self.owner[own]] = weights(v[..., i]) @ self.shares[own].T
        return found

    def slopes(self, v: Float[np.ndarray, "d"]) -> Float[np.ndarray, "r"]:
        """Of each share, by its own entry of φ."""
        found = np.empty(len(self.owner))
        for i, own in self.by:
            found[own] = self.shares[own] @ weights_and_slopes(v[i])[1]
        return found


def basis_of(t: Term, problem: Problem) -> Basis | None:
    """The columns of a term's effect as sums of a few; None where they cannot be interpolated along its free shapes."""
    fixed = problem.fixed_values
    if t.known.shape_names and all(name in fixed for name in t.known.shape_names):
        values = tuple(float(fixed[name]) for name in t.known.shape_names)
        return Basis(problem.record.columns(t.known.columns, values)[:, :, None], None)
    return problem.record.basis_along(t.known.columns)


class Products:
    """Products of a structure linearised at a point, as functions of φ.

    Attributes:
        problem: the structure on its record.
        x: x̂.
        there: coordinates of φ at which a nonlinear output is linearised in its shapes too.
        outer: the axes along which they are polynomials; None where there is none.
        at: where what is left of the readings was taken, held coefficients last (q,): zero for what shapes move.
    """

    def __init__(
        self,
        problem: Problem,
        x: Float[np.ndarray, "p"],
        there: Float[np.ndarray, "d"],
        outer: Axes | None = None,
    ) -> None:
        self.problem, self.x, self.there, self.outer = problem, x, there, outer
        self.size = problem.record.size
        # Where columns of the readings are corrected, every coefficient moves all columns: J is taken as it is.
        places = ("x",) if problem.corrected else ("x", "fixed")
        self.terms = [t for t in problem.terms if t.place in places]
        self._bases = [self._basis(t) for t in self.terms]
        self._held = np.array(
            [t.value for t in self.terms if t.place == "fixed" for _ in range(t.size)]
        )
        self.columns = self._laid_out()
        self.at = np.append(x, self._held)
        self.at[self.columns.moving] = 0.0
        self._inner = [i for i, _ in self.columns.by]
        self.polynomials: Polynomials | None = None
        if outer is None:
            self._sets = self._once()[None]

    @property
    def width(self) -> int:
        """Columns of the table, the residual's among them."""
        return len(self.columns.plain) + len(self.columns.owner) + 1

    # what the table is ------------------------------------------------------------------------------------------

    def _basis(self, t: Term) -> Basis | None:
        """The columns of a term's effect; None where an outer axis moves them."""
        moved = self.outer is not None and set(t.known.shape_names) & set(self.outer.names)
        return None if moved or self.problem.corrected else basis_of(t, self.problem)

    def _laid_out(self) -> Columns:
        names, end = self.problem.layout.index_in_phi, self.problem.size
        plain, moving, owner = [np.zeros(0, int)], [], []
        by: dict[int, list[int]] = {}
        shares = [np.zeros((0, len(weights(0.0))))]
        for t, basis in zip(self.terms, self._bases, strict=True):
            place = (
                np.arange(t.at.start, t.at.stop) if t.place == "x" else np.arange(end, end + t.size)
            )
            end += t.size if t.place == "fixed" else 0
            if basis is None or basis.shares is None:
                plain.append(place)
                continue
            along = by.setdefault(names[t.known.shape_names[0]], [])
            for member in place:
                along += range(len(owner), len(owner) + basis.rank)
                owner += [len(moving)] * basis.rank
                shares.append(basis.shares)
                moving.append(member)
        return Columns(
            plain=np.concatenate(plain),
            moving=np.array(moving, dtype=int),
            owner=np.array(owner, dtype=int),
            by=tuple((i, np.array(own)) for i, own in by.items()),
            shares=np.concatenate(shares),
        )

    def _in_order(self, parts: list[np.ndarray]) -> np.ndarray:
        """What belongs to the terms' columns, last axis, in the table's order."""
        is_plain = [b is None or b.shares is None for b in self._bases]
        order = [p for p, first in zip(parts, is_plain, strict=True) if first]
        order += [p for p, first in zip(parts, is_plain, strict=True) if not first]
        return np.concatenate(order, axis=-1)

    def _of_term(self, t: Term, basis: Basis, slope: np.ndarray) -> Float[np.ndarray, "n w"]:
        """The table's columns of a term: for each member of its group, as many as its basis has."""
        columns = (slope * t.factor)[:, None] * basis.columns[:, t.index]
        codes = None if t.known.per is None else self.problem.record.codes[t.known.per]
        # by_member spreads the last axis: (r, n) to (r, n, members), then members before the columns of the basis
        found = by_member(np, columns.T, codes, t.size)
        return found.transpose(1, 2, 0).reshape(len(columns), -1)

    def _table(self, hyper: Values, v: np.ndarray, line: Linearised) -> Float[np.ndarray, "n m1"]:
        """[Φ r]; at a φ as far as outer axes move them."""
        problem = self.problem
        residual = problem.record.y - line.mean
        if problem.corrected:
            return np.column_stack([line.jacobian, residual])
        slopes, parts = problem.slopes(self.x, hyper), []
        for t, basis in zip(self.terms, self._bases, strict=True):
            if basis is None:
                shapes = tuple(float(hyper[name]) for name in t.known.shape_names)
                basis = Basis(problem.record.columns(t.known.columns, shapes)[:, :, None], None)
            parts.append(self._of_term(t, basis, slopes[t.slot]))
        if not parts:
            return residual[:, None]
        table, moving = self._in_order(parts), self.columns.moving
        if len(moving):  # what shapes move is no constant part of μ(x̂), but J·x̂
            amounts = self.columns.at(v) @ np.append(self.x, self._held)[moving]
            residual = residual + table[:, len(self.columns.plain) :] @ amounts
        return np.column_stack([table, residual])

    def _once(self) -> Float[np.ndarray, "m1 m1"]:
        """Products where no outer axis moves them; an affine output's from those that its record keeps."""
        problem = self.problem
        if not problem.affine:
            hyper = problem.hyper(self.there)
            table = self._table(hyper, self.there, problem.linearise(self.x, hyper))
            return table.T @ table
        store: ColumnProducts = problem.record.products
        slopes, parts = problem.slopes(self.x, {}), [np.zeros(0, int)]
        for t, basis in zip(self.terms, self._bases, strict=True):
            assert basis is not None
            held = (
                None
                if basis.shares is not None
                else [self.problem.fixed_values.get(n) for n in t.known.shape_names]
            )
            key = (t.known.key, t.index, t.slot, t.factor, t.known.per, tuple(held or ()))
            if key not in store.places:
                store.places[key] = store.add(self._of_term(t, basis, slopes[t.slot]))
            parts.append(store.places[key])
        places = self._in_order(parts[1:]) if len(parts) > 1 else parts[0]
        plain = places[: len(self.columns.plain)]
        if not store.taken:  # by the columns of named effects: those of a curve are nearly alike
            own = [
                p
                for t, p in zip(self.terms, parts[1:], strict=True)
                if t.known.effect.weights is None
            ]
            store.take(np.intersect1d(plain, np.concatenate([plain[:0], *own])))
        # The products are about what named columns left of the readings: coefficients are counted from what these
        # took.
        self.at = np.zeros(len(self.at))
        self.at[self.columns.plain] = [store.taken.get(int(i), 0.0) for i in plain]
        return store.beside_residual(places)

    # at one φ ---------------------------------------------------------------------------------------------------

    def prior(self, own: Prior) -> Prior:
        """Of x, then of held coefficients, whose standard deviation is zero."""
        more = len(self._held)
        if not more:
            return own
        # A standard deviation of zero holds a coefficient at its mean: in A its row is that of the unit matrix.
        sd = np.concatenate([own.sd, np.zeros((*own.sd.shape[:-1], more))], axis=-1)
        return Prior(np.append(own.mean, self._held), sd, np.append(own.weight, np.ones(more)))

    def reaches(self, vs: Float[np.ndarray, "*b d"]) -> Any:
        """Whether columns are interpolated there, and polynomials were fitted."""
        inside = np.all(np.abs(vs[..., self._inner]) <= REACH, axis=-1)
        if self.polynomials is None:
            return inside
        hyper = self.problem.hyper(np.moveaxis(vs, -1, 0))
        return inside & self.polynomials.reach(self._axes.of(hyper, vs))

    @property
    def _axes(self) -> Axes:
        assert self.outer is not None
        return self.outer

    def _whole(self, v: np.ndarray, hyper: Values) -> tuple[Float[np.ndarray, "m1 m1"], float]:
        """[Φ r]ᵀΣ⁻¹[Φ r] and log|Σ|."""
        if self.polynomials is None:
            variance = float(self.problem.noise.shared_variance(hyper))
            return self._sets[0] / variance, self.size * math.log(variance)
        unit = float(self._axes.unit(hyper))
        terms = self.polynomials.terms(self._axes.of(hyper, v[None]))[0]
        made = (terms @ self._flat_sets).reshape(self._sets.shape[1:])
        return made / unit, float(terms @ self.polynomials.volumes) + self.size * math.log(unit)

    def gram(self, v: Float[np.ndarray, "d"], hyper: Values) -> Gram:
        """Weighted products of J and r at a φ."""
        whole, logdet = self._whole(v, hyper)
        return Gram.of(self._selected(whole[None], self.columns.at(v)[None])[0], logdet)

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Where plain coefficients and the residual stand: among all coefficients, and in the table."""
        plain, f = self.columns.plain, len(self.columns.plain)
        return np.append(plain, len(self.at)), np.append(np.arange(f), f + len(self.columns.owner))

    def _selected(
        self, whole: Float[np.ndarray, "b m1 m1"], block: Float[np.ndarray, "b r k"]
    ) -> Float[np.ndarray, "b q1 q1"]:
        """SᵀGS, with what is left of the readings last."""
        moving, (places, kept) = self.columns.moving, self._places
        f, q = len(self.columns.plain), len(self.at)
        if not len(moving) and np.array_equal(places, kept):
            return whole
        made = np.empty((max(len(whole), len(block)), q + 1, q + 1))
        made[:, places[:, None], places] = whole[:, kept[:, None], kept]
        if len(moving):
            # S = [P | B], P the plain columns and B the shares: of SᵀGS the block PᵀGP is copied, PᵀG·B and BᵀG·B are
            # made.
            right = whole[:, :, f:-1] @ block
            made[:, places[:, None], moving] = right[:, kept]
            made[:, moving[:, None], places] = right[:, kept].transpose(0, 2, 1)
            made[:, moving[:, None], moving] = block.transpose(0, 2, 1) @ right[:, f:-1]
        return made

    def slopes(
        self, v: Float[np.ndarray, "d"], hyper: Values, prior: Prior, found: Conditional
    ) -> Float[np.ndarray, "d"]:
        """Slopes of the log marginal density by φ's coordinates, where no outer axis moves the products.

        With x̄ and C the posterior mean and covariance of x and E = [[m·mᵀ + C, −m], [−mᵀ, 1]], m = x̄ − at, a change
        dG of the products moves it by −½·(tr E·dG + d log|Σ|): nothing else moves to first order (envelope theorem).
        """
        made = np.zeros(len(v))
        # tr E·G: squares of the residuals at the mean, and the degrees of freedom that x took
        taken = found.squares + len(found.z) - float(prior.weight @ found.variance_of_z)
        for i, kind in enumerate(self.problem.kinds):
            if kind == "noise":
                made[i] = 0.5 * (taken - self.size) * self.problem.log_variance_slope(v, i)
        moving, (places, kept), f = self.columns.moving, self._places, len(self.columns.plain)
        if not len(moving):
            return made
        whole, _ = self._whole(v, hyper)
        # The columns of E that belong to moving coefficients. With d(SᵀGS) = SᵀG·dS and its transpose, −½·tr
        # E·d(SᵀGS) is −tr E·SᵀG·dS, and dS has one entry a share: in its own row, in the column of its owner.
        move, root = found.mean - self.at, found.root
        spread = np.concatenate(
            [np.outer(move, move[moving]) + root @ root[moving].T, -move[None, moving]]
        )
        selected = np.zeros(
            (len(whole), len(self.at) + 1)
        )  # S, with what is left of the readings last
        selected[kept, places] = 1.0
        selected[f:-1, moving] = self.columns.at(v)
        pull = whole[f:-1] @ (selected @ spread)
        along = self.columns.slopes(v) * pull[np.arange(len(pull)), self.columns.owner]
        for i, own in self.columns.by:
            made[i] -= along[own].sum()
        return made

    # at many φ --------------------------------------------------------------------------------------------------

    def grams(self, vs: Float[np.ndarray, "b d"], hyper: Mapping[str, Any]) -> Gram:
        """Weighted products of J and r at several φ."""
        whole, logdet = self._sets, 0.0
        if self.polynomials is None:
            unit = np.broadcast_to(self.problem.noise.shared_variance(hyper), len(vs))
        else:
            unit = np.broadcast_to(self._axes.unit(hyper), len(vs))
            terms = self.polynomials.terms(self._axes.of(hyper, vs))
            whole = (terms @ self._flat_sets).reshape(len(vs), *self._sets.shape[1:])
            logdet = terms @ self.polynomials.volumes
        made = self._selected(whole, self.columns.at(vs)) / unit[:, None, None]
        return Gram.of(made, logdet + self.size * np.log(unit))

    # polynomials along the outer axes ---------------------------------------------------------------------------

    def refit(self, polynomials: Polynomials, rows: Float[np.ndarray, "c s"]) -> None:
        """Take polynomials through products at some points, as `row` gives them."""
        table = polynomials.fit(rows)
        i, j = np.triu_indices(self.width)
        self._sets = np.empty((len(table), self.width, self.width))
        self._sets[:, i, j] = self._sets[:, j, i] = table[:, :-1]
        self._flat_sets = self._sets.reshape(len(table), -1)
        self.polynomials = polynomials

    def row(self, coordinates: Float[np.ndarray, "m"]) -> Float[np.ndarray, "s"]:
        """Products at one point of the outer axes in units of the noise there, and log|Σ| likewise."""
        hyper, v = self._axes.values(coordinates, self.there)
        unit = float(self._axes.unit(hyper))
        line = self.problem.linearise(self.x, hyper)
        white = Whitening(self.problem.noise, hyper, self.problem.record, self.problem.extra(line))
        # In units of the noise there the products hardly follow its amplitude, so that a low degree describes them.
        whole, logdet = white.gram(self._table(hyper, v, line))
        return np.append(
            unit * whole[np.triu_indices(len(whole))], logdet - self.size * math.log(unit)
        )


class Axes:
    """What products move with beside interpolated shapes: other shapes, promoted coefficients, the noise's parameters.

    Attributes:
        names: shapes, promoted coefficients and parameters of the noise.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        hypers, noise, record = problem.hypers, problem.noise, problem.record
        free = {h.name for h in hypers}
        self._spreads = {
            name: t.group_sd_name
            for t in problem.terms
            if t.place == "phi" and t.group_sd_name is not None
            for name in t.members
        }
        smooth = {
            t.known.shape_names[0]
            for t in problem.terms
            if t.place in ("x", "fixed")
            and t.known.shape_names
            and not problem.corrected
            and basis_of(t, problem) is not None
        }
        self._shapes = {
            h.name: i for i, h in enumerate(hypers) if h.kind == "shape" and h.name not in smooth
        }
        self._promoted = [h.name for h in hypers if h.kind == "promoted"]
        steps = record.in_time[1]
        self._step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
        known = UNCERTAINTY in record.frame.columns
        self._floor = float(np.median(np.asarray(record.frame[UNCERTAINTY]) ** 2)) if known else 0.0
        # Where no variance is known beforehand, all amplitudes are taken in units of the first.
        absolute = known or problem.noisy
        self._amplitudes: tuple[str, ...] = (
            () if absolute or not set(noise.amplitudes) <= free else noise.amplitudes
        )
        priors = noise.parameters()
        self._even = noise.even(record.frame) and not problem.noisy
        self._noise = [
            n for n in priors if n in free and n not in self._amplitudes[:1] and not self._even
        ]
        self._linear = {n for n, prior in priors.items() if isinstance(prior, Normal)}
        self.names = (*self._shapes, *self._promoted, *self._noise)

    def unit(self, hyper: Mapping[str, Any]) -> Any:
        """A variance that the products are about inversely proportional to."""
        noise = self.problem.noise
        if self._even:
            return noise.shared_variance(hyper)
        return noise.fresh_variance(hyper, self._step) + self._floor

    def of(
        self, hyper: Mapping[str, Any], vs: Float[np.ndarray, "*b d"]
    ) -> Float[np.ndarray, "*b m"]:
        """Coordinates along the axes."""
        found: list[Any] = [vs[..., i] for i in self._shapes.values()]
        for name in self._promoted:
            spread = self._spreads.get(name)
            found.append(hyper[name] * (hyper[spread] if spread else 1.0))
        for name in self._noise:
            relative = name in self._amplitudes
            value = hyper[name] / hyper[self._amplitudes[0]] if relative else hyper[name]
            found.append(value if name in self._linear else np.log(value))
        size = vs.shape[:-1]
        return np.stack([np.broadcast_to(one, size) for one in found], axis=-1)

    def values(
        self, coordinates: Float[np.ndarray, "m"], there: Float[np.ndarray, "d"]
    ) -> tuple[Values, Float[np.ndarray, "d"]]:
        """φ by name, and coordinates of its shapes, at a point of the axes; what does not move products is as `there`.

        Amplitudes that the unit is one of are one.
        """
        hyper, v = self.problem.hyper(there), there.copy()
        hyper.update(dict.fromkeys(self._spreads.values(), 1.0))
        hyper.update(dict.fromkeys(self._amplitudes[:1], 1.0))
        along = iter(coordinates)
        for name, i in self._shapes.items():
            v[i] = next(along)
            hyper[name] = float(self.problem.hypers[i].prior.value(v[i]))
        for name in self._promoted:
            hyper[name] = float(next(along))
        for name in self._noise:
            hyper[name] = next(along) if name in self._linear else math.exp(next(along))
        return hyper, v


class Polynomials:
    """Chebyshev's polynomials up to a total degree, in coordinates that a Gaussian fit is round in."""

    def __init__(self, draws: Float[np.ndarray, "s m"], degree: int) -> None:
        self.centre = draws.mean(axis=0)
        covariance = np.atleast_2d(np.cov(draws.T))
        self.root = BOX * np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
        self.degree, self.dim = degree, len(self.centre)
        powers = list(combinations_with_replacement(range(self.dim + 1), degree))
        self.count = len(powers)
        self._powers = np.array([[c.count(j + 1) for j in range(self.dim)] for c in powers])
        # Twice as many points as terms, and a few: with points of the density 1/√(1 − t²), which the cosine below
        # gives, least squares is then stable (Migliorati et al. 2014).
        count = 2 * math.comb(self.dim + degree, self.dim) + 4
        # Where the products are computed: a sequence, dense at the ends where there are few axes.
        # A Kronecker sequence: multiples of irrational steps, modulo one, leave no gaps whatever their number.
        ratio = _golden(self.dim)
        steps = (np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1, self.dim + 1) + 0.5) % 1
        t = np.cos(np.pi * steps)
        if self.dim > 3:  # corners of a cube are far out
            t = t / np.maximum(1.0, np.linalg.norm(t, axis=1))[:, None]
        self.points = self.centre + t @ self.root.T

    def fit(self, rows: Float[np.ndarray, "c s"]) -> Float[np.ndarray, "t s"]:
        """Coefficients of each term, for numbers at the points; log|Σ| is the last of them."""
        table = np.linalg.lstsq(self.terms(self.points), rows, rcond=None)[0]
        self.volumes = table[:, -1]
        return table

    def _round(self, coordinates: Float[np.ndarray, "*b m"]) -> Float[np.ndarray, "*b m"]:
        return np.linalg.solve(self.root, (coordinates - self.centre)[..., None])[..., 0]

    def reach(self, coordinates: Float[np.ndarray, "*b m"]) -> Any:
        """Whether they are where the polynomials were fitted."""
        return np.max(np.abs(self._round(coordinates)), axis=-1) <= 1

    def terms(self, coordinates: Float[np.ndarray, "b m"]) -> Float[np.ndarray, "b t"]:
        t = self._round(coordinates)
        # Beyond the box a polynomial means nothing: the value at the box's edge, on the way to its centre, stands for
        # it.
        t = t / np.maximum(1.0, np.max(np.abs(t), axis=1))[:, None]
        # Tₖ(cos θ) = cos kθ.
        angle = np.arccos(np.clip(t, -1.0, 1.0))
        one = np.cos(angle[:, :, None] * np.arange(self.degree + 1))
        found = np.ones((len(t), len(self._powers)))
        for j in range(self.dim):
            found *= one[:, j, self._powers[:, j]]
        return found


def _golden(dim: int) -> float:
    """The root of x^(d+1) = x + 1, whose powers make an even sequence in d dimensions."""
    x = 2.0
    for _ in range(40):
        x = (1 + x) ** (1 / (dim + 1))
    return x
