"""Products over the readings as polynomials along parameters of φ, where no table tells them (`tabulated`).

The columns of all coefficients stand beside each other in one matrix Φ (n, m), what the expected output leaves of the
readings beside them: one column where nothing moves it; where it moves with a shape within a box, the few that it is a
sum of: J(ψ) = Φ·S(ψ). Parameters of correlated noise on uneven steps, promoted coefficients and other shapes are *outer
axes*: along them ΦᵀΣ⁻¹Φ is a polynomial, fitted about a Laplace fit. The log evidence follows from these products,
JᵀΣ⁻¹J = Sᵀ·(ΦᵀΣ⁻¹Φ)·S, and the readings are not touched again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._data.column import UNCERTAINTY
from bayescal._inference.expansion import Expansion
from bayescal._inference.gaussian import Gram, Prior
from bayescal._inference.noise_on_record import Whitening
from bayescal._inference.polynomials import Polynomials
from bayescal._inference.problem import Problem, Values
from bayescal._model.composition import Linearised, by_member
from bayescal._model.prior import Normal
from bayescal._model.terms import Term


class Columns(NamedTuple):
    """S(ψ): which columns of the table each coefficient's column is a sum of, and in which shares.

    Coefficients are in the order of x, then those that are held at a value.

    Attributes:
        plain: coefficients whose columns nothing moves (f,); they are the table's first.
        moving: coefficients whose columns move with a shape (k,).
        owner: for each further column of the table, which of `moving` it belongs to (r,).
        by: entries of φ that give the shares, each with the columns that follow it and what these are.
    """

    plain: Int[np.ndarray, "f"]
    moving: Int[np.ndarray, "k"]
    owner: Int[np.ndarray, "r"]
    by: tuple[tuple[int, Int[np.ndarray, "_"], Expansion], ...]

    def at(self, v: Float[np.ndarray, "*b d"]) -> Float[np.ndarray, "*b r k"]:
        """Shares at coordinates of φ, as a matrix from the table's further columns to the moving coefficients."""
        found = np.zeros((*v.shape[:-1], len(self.owner), len(self.moving)))
        for i, own, expansion in self.by:
            shares = expansion.values(v[..., [i]].reshape(-1, 1)).reshape(*v.shape[:-1], -1)
            found[..., own, self.owner[own]] = shares
        return found


class Products:
    """Products of a structure linearised at a point, as functions of φ.

    Attributes:
        problem: the structure on its record.
        x: x̂.
        there: coordinates of φ at which a nonlinear output is linearised in its shapes too.
        outer: the axes along which they are polynomials.
        at: where what is left of the readings was taken, held coefficients last (q,): zero for what shapes move.
    """

    def __init__(
        self,
        problem: Problem,
        x: Float[np.ndarray, "p"],
        there: Float[np.ndarray, "d"],
        outer: Axes,
    ) -> None:
        self.problem, self.x, self.there, self.outer = problem, x, there, outer
        self.size = problem.record.size
        # Where columns of the readings are corrected, every coefficient moves all columns: J is taken as it is.
        places = ("x",) if problem.corrected else ("x", "fixed")
        self.terms = [t for t in problem.terms if t.place in places]
        self._held = np.array(
            [t.value for t in self.terms if t.place == "fixed" for _ in range(t.size)]
        )
        self.columns = self._laid_out()
        self.at = np.append(x, self._held)
        self.at[self.columns.moving] = 0.0
        self.polynomials: Polynomials | None = None

    @property
    def width(self) -> int:
        """Columns of the table, the residual's among them."""
        return len(self.columns.plain) + len(self.columns.owner) + 1

    # what the table is ------------------------------------------------------------------------------------------

    def _laid_out(self) -> Columns:
        names, end = self.problem.layout.index_in_phi, self.problem.size
        plain, moving, owner, by = [np.zeros(0, int)], [], [], []
        for t in self.terms:
            place = (
                np.arange(t.at.start, t.at.stop) if t.place == "x" else np.arange(end, end + t.size)
            )
            end += t.size if t.place == "fixed" else 0
            box = self.outer.box_of(t)
            if box is None:
                plain.append(place)
                continue
            for member in place:
                own = len(owner) + np.arange(box.rank)
                by.append((names[t.known.shape_names[0]], own, box))
                owner += [len(moving)] * box.rank
                moving.append(member)
        return Columns(
            plain=np.concatenate(plain),
            moving=np.array(moving, dtype=int),
            owner=np.array(owner, dtype=int),
            by=tuple(by),
        )

    def _in_order(self, parts: list[np.ndarray]) -> np.ndarray:
        """What belongs to the terms' columns, last axis, in the table's order."""
        is_plain = [self.outer.box_of(t) is None for t in self.terms]
        order = [p for p, first in zip(parts, is_plain, strict=True) if first]
        order += [p for p, first in zip(parts, is_plain, strict=True) if not first]
        return np.concatenate(order, axis=-1)

    def _of_term(
        self, t: Term, columns: Float[np.ndarray, "n k r"], slope: np.ndarray
    ) -> Float[np.ndarray, "n w"]:
        """The table's columns of a term: for each member of its group, as many as its columns are sums of."""
        columns = (slope * t.factor)[:, None] * columns[:, t.index]
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
        for t in self.terms:
            if (box := self.outer.box_of(t)) is not None:
                columns = box.columns
            else:
                shapes = tuple(float(hyper[name]) for name in t.known.shape_names)
                columns = problem.record.columns(t.known.columns, shapes)[:, :, None]
            parts.append(self._of_term(t, columns, slopes[t.slot]))
        if not parts:
            return residual[:, None]
        table, moving = self._in_order(parts), self.columns.moving
        if len(moving):  # what shapes move is no constant part of μ(x̂), but J·x̂
            amounts = self.columns.at(v) @ np.append(self.x, self._held)[moving]
            residual = residual + table[:, len(self.columns.plain) :] @ amounts
        return np.column_stack([table, residual])

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
        """Whether columns are sums of few there, and polynomials were fitted."""
        assert self.polynomials is not None
        hyper = self.problem.hyper(np.moveaxis(vs, -1, 0))
        found = self.polynomials.reach(self.outer.of(hyper, vs))
        for i, box in self.outer.boxes.items():
            found = found & (np.abs(vs[..., i] - box.middle[0]) <= box.half)
        return found

    def _whole(self, v: np.ndarray, hyper: Values) -> tuple[Float[np.ndarray, "m1 m1"], float]:
        """[Φ r]ᵀΣ⁻¹[Φ r] and log|Σ|."""
        assert self.polynomials is not None
        unit = float(self.outer.unit(hyper))
        terms = self.polynomials.terms(self.outer.of(hyper, v[None]))[0]
        made = (terms @ self._flat_sets).reshape(self._sets.shape[1:])
        return made / unit, float(terms @ self._volumes) + self.size * math.log(unit)

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

    # at many φ --------------------------------------------------------------------------------------------------

    def grams(self, vs: Float[np.ndarray, "b d"], hyper: Mapping[str, Any]) -> Gram:
        """Weighted products of J and r at several φ."""
        assert self.polynomials is not None
        unit = np.broadcast_to(self.outer.unit(hyper), len(vs))
        terms = self.polynomials.terms(self.outer.of(hyper, vs))
        whole = (terms @ self._flat_sets).reshape(len(vs), *self._sets.shape[1:])
        logdet = terms @ self._volumes
        made = self._selected(whole, self.columns.at(vs)) / unit[:, None, None]
        return Gram.of(made, logdet + self.size * np.log(unit))

    # polynomials along the outer axes ---------------------------------------------------------------------------

    def refit(self, polynomials: Polynomials, rows: Float[np.ndarray, "c s"]) -> None:
        """Take polynomials through products at some points, as `row` gives them."""
        table = polynomials.fit(rows)
        self._volumes = table[:, -1]
        i, j = np.triu_indices(self.width)
        self._sets = np.empty((len(table), self.width, self.width))
        self._sets[:, i, j] = self._sets[:, j, i] = table[:, :-1]
        self._flat_sets = self._sets.reshape(len(table), -1)
        self.polynomials = polynomials

    def row(self, coordinates: Float[np.ndarray, "m"]) -> Float[np.ndarray, "s"]:
        """Products at one point of the outer axes in units of the noise there, and log|Σ| likewise."""
        hyper, v = self.outer.values(coordinates, self.there)
        unit = float(self.outer.unit(hyper))
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
        boxes: entries of φ that are none of these, since columns are sums of few along them.
    """

    def __init__(
        self, problem: Problem, v: Float[np.ndarray, "d"], reach: Float[np.ndarray, "d"]
    ) -> None:
        """Args:
        problem: the structure on its record.
        v: coordinates of φ that products are about.
        reach: how far from there they are asked for.
        """
        self.problem = problem
        hypers, noise, record = problem.hypers, problem.noise, problem.record
        free = {h.name for h in hypers}
        self._spreads = {
            name: t.group_sd_name
            for t in problem.terms
            if t.place == "phi" and t.group_sd_name is not None
            for name in t.members
        }
        self.boxes = dict[int, Expansion]()
        self._boxes = dict[Any, Expansion]()
        places = {h.name: i for i, h in enumerate(hypers)}
        moving = [t for t in problem.terms if t.place in ("x", "fixed") and t.known.shape_names]
        for t in () if problem.corrected else moving:
            i = places.get(t.known.shape_names[0])
            if len(t.known.shape_names) == 1 and i is not None:
                box = record.expansions(t.known.columns, (None,)).at(v[[i]], True)
                if box.half - abs(v[i] - box.middle[0]) >= reach[i]:
                    self.boxes[i] = self._boxes[t.known.key] = box
        smooth = {hypers[i].name for i in self.boxes}
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

    def box_of(self, t: Term) -> Expansion | None:
        """Return the columns of a term's effect as sums of few; None where none are or an outer axis moves them."""
        return self._boxes.get(t.known.key)

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
