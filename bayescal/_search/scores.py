"""Every addition and every pair at once, in closed form, at a structure's φ̂: in which order moves are tried.

A score is the log Bayes factor of a linear model that was fitted before: it says where to look; a refit answers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from bayescal._core.parallel import on_one_thread
from bayescal._inference.linear_model import LinearModel, explained_sum_of_squares
from bayescal._search.library import GridPoint, Library, Size
from bayescal._search.structures import Weighed

HINTS = 2  # grid points at which a refit begins
IN_PAIRS = 2  # grid points of each candidate that are tried in pairs


@dataclass(eq=False)
class ScoredPoint:
    """One candidate at one point of its shapes, at the likeliest size there."""

    point: GridPoint  # which
    gain: float  # log Bayes factor by score, averaged over sizes
    size: Size  # the likeliest
    view: View  # of the structure that it is beside
    inside: Float[np.ndarray, "q k"]  # what the nuisances take of its columns (q, k)
    u: Float[np.ndarray, "k"]  # score after the nuisances

    @property
    def effect(self) -> str:
        return self.point.effect

    @property
    def hint(self) -> dict[str, float]:
        """Return coordinates of φ by name, to begin a refit at."""
        return {**self.point.hint, **self.size.hint}

    @property
    def products(self) -> Float[np.ndarray, "k k"]:
        """Return the Gram matrix of these whitened columns."""
        return self.view.products[self.effect][self.point.index]

    @cached_property
    def information(self) -> Float[np.ndarray, "k k"]:
        return self.products - self.inside.T @ self.inside

    @cached_property
    def standard(self) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Return score and information in units of the plausible sizes: of standard normal coefficients."""
        sd = self.size.sd
        return sd * self.u, sd[:, None] * self.information * sd


class View:
    """A structure as a linear model about its mode, all candidates beside it: what may be added, dropped, exchanged.

    Products are computed once, of some candidates at a time: memory may not hold columns of all at all points.

    Attributes:
        line: the structure on the readings.
        means: the same on means of them, where the record is long.
        products: of each candidate, those of its whitened columns at each point (points, k, k).
    """

    @on_one_thread
    def __init__(self, library: Library, at: Weighed):
        line = library.structures.line(at)
        self.library, self.at, self.line, self.means = library, at, line, library.on_means(line)
        whole = dict[LinearModel, tuple[np.ndarray, np.ndarray]]()
        for rows in {line, self.means}:
            both = rows.decorrelate(np.column_stack([rows.nuisance, rows.residual]))
            whole[rows] = both[:, :-1], both[:, -1]
        # With whitened nuisances A, residual r and a column c all scores follow from AᵀA, Aᵀc, cᵀc and cᵀr.
        nuisance, _ = whole[line]
        self.inner = nuisance.T @ nuisance
        self.cross = np.empty((nuisance.shape[1], library.width))
        self.u = np.empty(library.width)
        products: dict[str, list[np.ndarray]] = {name: [] for name in library.points}
        for points in library.blocks(self.means.size):
            rows, begin = self.rows(points), points[0].at.start
            nuisance, residual = whole[rows]
            white = rows.decorrelate(self.columns(rows, points))
            block = slice(begin, points[-1].at.stop)
            self.cross[:, block] = nuisance.T @ white
            self.u[block] = white.T @ residual
            for p in points:
                columns = white[:, p.at.start - begin : p.at.stop - begin]
                products[p.effect].append(columns.T @ columns)
        self.products = {name: np.stack(matrices) for name, matrices in products.items()}
        self.volume = 0.0
        self.volume = self.without().volume

    def rows(self, points: Sequence[GridPoint]) -> LinearModel:
        """Return the linear model that scores these points: on means, unless a candidate changes within them."""
        blurred = any(p.effect in self.library.blurred for p in points)
        return self.line if blurred else self.means

    def columns(self, rows: LinearModel, points: Sequence[GridPoint]) -> Float[np.ndarray, "n k"]:
        """Return the columns of candidates at some points."""
        return self.library.columns(rows, points, self.at.acting)

    def without(self, *names: str) -> WithoutNuisances:
        """Return the structure without some of its effects, φ held."""
        line, gone = self.line, {*names}
        is_kept = np.array([owner not in gone for owner in line.owners], dtype=bool)
        # z: of what is dropped. Without its coefficients its shapes move nothing. With these at their prior's mean, all
        # else where it is, r becomes r₀ = r + A·z; at the mode Aᵀr = W·z, so that |r₀|² = |r|² + 2·zᵀWz + zᵀAᵀA·z, and
        # what is kept is pulled by AᵀA·z alone.
        of_x = np.arange(is_kept.size) < line.problem.size
        z = np.where(is_kept | ~of_x, 0.0, line.z)
        prior_squares, of_start = float(line.weight @ z**2), self.inner @ z
        shapes = float(line.weight[~is_kept & ~of_x] @ line.z[~is_kept & ~of_x] ** 2)
        squares = line.rss + prior_squares + float(z @ of_start) - shapes
        inner = self.inner[np.ix_(is_kept, is_kept)] + np.diag(line.weight[is_kept])
        chol = np.linalg.cholesky(inner + 1e-12 * np.diag(np.diag(inner)))
        # Kept nuisances fitted anew: L·Lᵀ = AᵀA + W, what they take of r₀ and of each column by L⁻¹Aᵀ.
        half = solve_triangular(chol, of_start[is_kept], lower=True)
        inside = solve_triangular(chol, self.cross[is_kept], lower=True)
        return WithoutNuisances(
            view=self,
            inside=inside,
            u=self.u + self.cross.T @ z - inside.T @ half,
            rss=squares - float(half @ half),
            volume=float(np.sum(np.log(np.diag(chol)))),
        )


class WithoutNuisances(NamedTuple):
    """What of the readings and of all candidates' columns some nuisances leave.

    inside (q, P): what they take of the columns; u (P,): score; rss: sum of squares; volume: Σ log of the factor.
    """

    view: View
    inside: Float[np.ndarray, "q P"]
    u: Float[np.ndarray, "P"]
    rss: float
    volume: float

    @on_one_thread
    def scores(self, names: Sequence[str]) -> dict[str, list[ScoredPoint]]:
        """Return every grid point of these candidates, each candidate's most probable first."""
        by_name = {}
        for name in names:
            points = self.view.library.points[name]
            # Most candidates have one column: their points are scored in one array, without a matrix for each.
            alone = points[0].at.stop - points[0].at.start == 1
            gains = self._of_columns(name) if alone else self._of_blocks(name)
            totals, best = np.logaddexp.reduce(gains, axis=1), np.argmax(gains, axis=1)
            sizes, order = self.view.library.sizes[name], np.argsort(-totals, kind="stable")
            by_name[name] = [
                ScoredPoint(
                    p, float(total), sizes[b], self.view, self.inside[:, p.at], self.u[p.at]
                )
                for p, total, b in ((points[i], totals[i], best[i]) for i in order)
            ]
        return by_name

    def _of_columns(self, name: str) -> Float[np.ndarray, "points sizes"]:
        """Return log Bayes factors of a candidate of one column, at each point and size."""
        library = self.view.library
        at = slice(library.points[name][0].at.start, library.points[name][-1].at.stop)
        information = self.view.products[name][:, 0, 0] - np.sum(self.inside[:, at] ** 2, axis=0)
        square = np.array([s.sd[0] ** 2 for s in library.sizes[name]])
        weight = np.array([s.log_weight for s in library.sizes[name]])
        # A coefficient of prior sd s and information K: log Bayes factor ½·s²u²/(1 + s²K) − ½·log(1 + s²K), the
        # squares as `_gain` has them. All points and sizes in one array.
        inner = 1 + np.maximum(information, 0.0)[:, None] * square
        explained = self.u[at, None] ** 2 * square / inner
        return self._gain(0.5 * np.log(inner), explained) + weight

    def _of_blocks(self, name: str) -> Float[np.ndarray, "points sizes"]:
        """Return log Bayes factors of a candidate of several columns, at each point and size."""
        library, places = self.view.library, [p.at for p in self.view.library.points[name]]
        inside = np.stack([self.inside[:, at] for at in places])
        u = np.stack([self.u[at] for at in places])[:, None]
        information = self.view.products[name] - inside.mT @ inside
        sd = np.stack([s.sd for s in library.sizes[name]])
        gains = self.gain(sd * u, sd[:, :, None] * information[:, None] * sd[:, None])
        return gains + [s.log_weight for s in library.sizes[name]]

    @property
    def dropped(self) -> float:
        """Return the log Bayes factor of the reduced against the whole structure."""
        return float(self._gain(0.0, 0.0))

    def gain(
        self, u: Float[np.ndarray, "*b k"], information: Float[np.ndarray, "*b k k"]
    ) -> Float[np.ndarray, "*b"]:
        """Return the log Bayes factor of the reduced structure with standard normal columns against the whole.

        The noise is taken as large as it then is likely to be.
        """
        return self._gain(*explained_sum_of_squares(u, information))

    def _gain(self, volume: Any, explained: Any) -> Any:
        """Return the log Bayes factor by the columns' log volume and explained sum of squares."""
        # With the noise's variance at its likeliest, squares/n, the log likelihood is −½·n·log(squares) but for
        # constants: a column that takes most of the squares gains more than under the noise as it was.
        rss_ratio = np.maximum((self.rss - explained) / self.view.line.rss, 1e-12)
        return self.lost - volume - 0.5 * self.view.line.size * np.log(rss_ratio)

    @property
    def lost(self) -> float:
        """Return the change of log volume by dropping, part of every gain."""
        return self.view.volume - self.volume

    @on_one_thread
    def pairs(
        self, scores: Mapping[str, list[ScoredPoint]]
    ) -> list[tuple[float, ScoredPoint, ScoredPoint]]:
        """Return log Bayes factors of two candidates at once, the best first."""
        points = [p for candidate_scores in scores.values() for p in candidate_scores[:IN_PAIRS]]
        family = self.view.library.structures.family
        families = [family(p.effect) for p in points]
        indices = itertools.combinations(range(len(points)), 2)
        together = [(i, j) for i, j in indices if families[i] != families[j]]
        if not together:
            return []
        # Columns of all points side by side, and one of zeros, which changes no gain: it fills those of fewer up.
        sd = np.concatenate([*(p.size.sd for p in points), [0.0]])
        rows = self.view.rows([p.point for p in points])
        columns, inside = (
            np.column_stack([part, np.zeros(len(part))])
            for part in (
                rows.decorrelate(self.view.columns(rows, [p.point for p in points])),
                np.column_stack([p.inside for p in points]),
            )
        )
        u = sd * np.concatenate([*(p.u for p in points), [0.0]])
        information = sd[:, None] * (columns.T @ columns - inside.T @ inside) * sd
        counts = np.array([len(p.u) for p in points])
        start, step = np.cumsum(counts) - counts, np.arange(counts.max())
        at = np.where(step < counts[:, None], start[:, None] + step, len(sd) - 1)
        both = at[np.array(together)].reshape(len(together), -1)
        gains = self.gain(u[both], information[both[:, :, None], both[:, None]]).tolist()
        pairs = zip(gains, together, strict=True)
        return sorted(((g, points[i], points[j]) for g, (i, j) in pairs), key=lambda m: -m[0])


def gain_of(points: Sequence[ScoredPoint]) -> float:
    """Return a candidate's log Bayes factor by score, averaged over its grid."""
    return float(np.logaddexp.reduce([p.gain for p in points]) - math.log(len(points)))
