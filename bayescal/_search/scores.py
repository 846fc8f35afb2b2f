"""Log Bayes factors of all single additions and pairs, in closed form, by the linear model at a structure's mode.

The log Bayes factor from the score ranks the moves of a search; a fit then gives the evidence.
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

from bayescal._core.parallel import run_on_one_thread
from bayescal._inference.linear_model import LinearModel, explained_sum_of_squares
from bayescal._search.library import GridPoint, Library, PriorScale
from bayescal._search.structures import EvaluatedStructure

MAX_STARTS = 2  # grid points of a candidate at which a fit starts
POINTS_IN_PAIRS = 2  # grid points of each candidate scored in pairs
Scores = Mapping[str, Sequence["ScoredPoint"]]  # points of each candidate, the most probable first


@dataclass(eq=False)
class ScoredPoint:
    """One candidate at one point of its shapes, scored at the most probable prior scale there."""

    point: GridPoint
    log_bayes_factor: float  # computed from the score, averaged over prior scales
    prior_scale: PriorScale  # the most probable
    scorer: Scorer  # scorer of the structure to which the candidate would be added
    projection: Float[np.ndarray, "q k"]  # projection of its whitened columns on the nuisances
    score: Float[np.ndarray, "k"]  # at coefficients zero, nuisances integrated out

    @property
    def name(self) -> str:
        return self.point.name

    @property
    def start(self) -> dict[str, float]:
        """Return coordinates of φ by name at which to start a fit."""
        return {**self.point.start, **self.prior_scale.start}

    @property
    def gram(self) -> Float[np.ndarray, "k k"]:
        """Return the Gram matrix of the candidate's whitened columns at this point."""
        return self.scorer.gram[self.name][self.point.index]

    @cached_property
    def information(self) -> Float[np.ndarray, "k k"]:
        """Return the information on the coefficients, nuisances integrated out."""
        return self.gram - self.projection.T @ self.projection

    @cached_property
    def standardised(self) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Return score and information of the coefficients in units of their prior standard deviations."""
        sd = self.prior_scale.sd
        return sd * self.score, sd[:, None] * self.information * sd


class Scorer:
    """Linear model of a structure about its mode, with the inner products of all candidates' columns.

    Inner products are computed once, block by block: memory may not hold all columns at all points.

    Attributes:
        linear: the structure's linear model on the readings.
        linear_means: its linear model on means of readings where the record is long, else `linear`.
        gram: Gram matrices of each candidate's whitened columns (points, k, k).
        inner, cross, scores: inner products of the whitened nuisances with themselves (m, m) and with all columns
            (m, P), and of all columns with the whitened residual (P,).
    """

    @run_on_one_thread
    def __init__(self, library: Library, fit: EvaluatedStructure):
        self.library, self.fit = library, fit
        self.linear = linear = library.structures.linearise(fit)
        self.linear_means = library.average(linear)
        whitened_by_model = dict[LinearModel, tuple[np.ndarray, np.ndarray]]()
        for rows in {linear, self.linear_means}:
            whitened_columns = rows.decorrelate(np.column_stack([rows.nuisance, rows.residual]))
            whitened_by_model[rows] = whitened_columns[:, :-1], whitened_columns[:, -1]
        # With whitened nuisances A, residual r and a column c all scores follow from AᵀA, Aᵀc, cᵀc and cᵀr.
        nuisances, _ = whitened_by_model[linear]
        self.inner = nuisances.T @ nuisances
        self.cross = np.empty((nuisances.shape[1], library.column_count))
        self.scores = np.empty(library.column_count)
        gram: dict[str, list[np.ndarray]] = {name: [] for name in library.points}
        for points in library.iterate_blocks(self.linear_means.size):
            rows, first = self.choose_linear_model(points), points[0].block.start
            nuisances, residual = whitened_by_model[rows]
            candidate_columns = rows.decorrelate(self.columns(rows, points))
            block = slice(first, points[-1].block.stop)
            self.cross[:, block] = nuisances.T @ candidate_columns
            self.scores[block] = candidate_columns.T @ residual
            for p in points:
                columns = candidate_columns[:, p.block.start - first : p.block.stop - first]
                gram[p.name].append(columns.T @ columns)
        self.gram = {name: np.stack(matrices) for name, matrices in gram.items()}
        self.half_logdet = 0.0
        self.half_logdet = self.reduced_model().half_logdet

    def choose_linear_model(self, points: Sequence[GridPoint]) -> LinearModel:
        """Return the linear model that scores these points: on means, unless a candidate varies within them."""
        varies_within_means = any(p.name in self.library.unaveraged for p in points)
        return self.linear if varies_within_means else self.linear_means

    def columns(self, rows: LinearModel, points: Sequence[GridPoint]) -> Float[np.ndarray, "n k"]:
        """Return the basis columns of candidates at given grid points, on the rows of a linear model."""
        return self.library.columns(rows, points, self.fit.column_corrections)

    def reduced_model(self, *names: str) -> ReducedModel:
        """Return the linear model without some of the structure's effects, at fixed φ."""
        linear, dropped_names = self.linear, {*names}
        is_kept = np.array([owner not in dropped_names for owner in linear.owners], dtype=bool)
        # z: the dropped coefficients (shapes have no effect without them). With z at its prior mean, all else fixed,
        # r becomes r₀ = r + A·z; at the mode Aᵀr = W·z, so that |r₀|² = |r|² + 2·zᵀWz + zᵀAᵀA·z, and the score of the
        # kept nuisances is AᵀA·z alone.
        is_in_x = np.arange(is_kept.size) < linear.problem.size
        z = np.where(is_kept | ~is_in_x, 0.0, linear.z)
        prior_squares, inner_z = float(linear.weight @ z**2), self.inner @ z
        shapes = float(linear.weight[~is_kept & ~is_in_x] @ linear.z[~is_kept & ~is_in_x] ** 2)
        sum_of_squares = linear.rss + prior_squares + float(z @ inner_z) - shapes
        precision = self.inner[np.ix_(is_kept, is_kept)] + np.diag(linear.weight[is_kept])
        cholesky = np.linalg.cholesky(precision + 1e-12 * np.diag(np.diag(precision)))
        # The kept nuisances are integrated out: with L·Lᵀ = AᵀA + W, by the projections L⁻¹Aᵀ of r₀ and each column.
        kept_score = solve_triangular(cholesky, inner_z[is_kept], lower=True)
        projection = solve_triangular(cholesky, self.cross[is_kept], lower=True)
        return ReducedModel(
            scorer=self,
            projection=projection,
            scores=self.scores + self.cross.T @ z - projection.T @ kept_score,
            rss=sum_of_squares - float(kept_score @ kept_score),
            half_logdet=float(np.sum(np.log(np.diag(cholesky)))),
        )


class ReducedModel(NamedTuple):
    """A linear model without some of its effects, its nuisances integrated out of the readings and all columns."""

    scorer: Scorer
    projection: Float[np.ndarray, "q P"]  # L⁻¹Aᵀ of all columns, L·Lᵀ = AᵀA + W of the nuisances
    scores: Float[np.ndarray, "P"]  # score of each column
    rss: float  # residual sum of squares
    half_logdet: float  # log determinant of L, half that of AᵀA + W

    @run_on_one_thread
    def score_candidates(self, names: Sequence[str]) -> dict[str, list[ScoredPoint]]:
        """Score every grid point of these candidates, each candidate's most probable point first."""
        scores = {}
        for name in names:
            points = self.scorer.library.points[name]
            # Most candidates have one column: their points are scored in one array, without a matrix for each.
            is_single = points[0].block.stop - points[0].block.start == 1
            factors = self._score_columns(name) if is_single else self._score_blocks(name)
            means, best_scales = np.logaddexp.reduce(factors, axis=1), np.argmax(factors, axis=1)
            scales = self.scorer.library.prior_scales[name]
            scored_points = scores[name] = list[ScoredPoint]()
            for i in np.argsort(-means, kind="stable"):
                p, scale = points[i], scales[best_scales[i]]
                terms = self.projection[:, p.block], self.scores[p.block]
                scored_points.append(ScoredPoint(p, float(means[i]), scale, self.scorer, *terms))
        return scores

    def _score_columns(self, name: str) -> Float[np.ndarray, "points sizes"]:
        """Return log Bayes factors of a candidate with one column, at each point and prior scale."""
        points, scales = self.scorer.library.points[name], self.scorer.library.prior_scales[name]
        columns = slice(points[0].block.start, points[-1].block.stop)
        projected_squares = np.sum(self.projection[:, columns] ** 2, axis=0)
        information = self.scorer.gram[name][:, 0, 0] - projected_squares
        prior_variances = np.array([s.sd[0] ** 2 for s in scales])
        log_weight = np.array([s.log_weight for s in scales])
        # A coefficient of prior sd s, score u and information K: log Bayes factor ½·s²u²/(1 + s²K) − ½·log(1 + s²K) at
        # known noise; `_compute_log_bayes_factor` maximises over the noise. All points and scales in one array.
        variance_ratio = 1 + np.maximum(information, 0.0)[:, None] * prior_variances
        explained = self.scores[columns, None] ** 2 * prior_variances / variance_ratio
        return self._compute_log_bayes_factor(0.5 * np.log(variance_ratio), explained) + log_weight

    def _score_blocks(self, name: str) -> Float[np.ndarray, "points sizes"]:
        """Return log Bayes factors of a candidate with several columns, at each point and prior scale."""
        library = self.scorer.library
        blocks, scales = [p.block for p in library.points[name]], library.prior_scales[name]
        projection = np.stack([self.projection[:, block] for block in blocks])
        score = np.stack([self.scores[block] for block in blocks])[:, None]
        information = self.scorer.gram[name] - projection.mT @ projection
        sd = np.stack([s.sd for s in scales])
        information = sd[:, :, None] * information[:, None] * sd[:, None]
        return self.log_bayes_factor(sd * score, information) + [s.log_weight for s in scales]

    @property
    def drop_log_bayes_factor(self) -> float:
        """Return the log Bayes factor of the reduced structure against the full structure."""
        return float(self._compute_log_bayes_factor(0.0, 0.0))

    def log_bayes_factor(
        self, score: Float[np.ndarray, "*b k"], information: Float[np.ndarray, "*b k k"]
    ) -> Float[np.ndarray, "*b"]:
        """Return the log Bayes factor of the reduced structure plus given columns against the full structure.

        The columns' coefficients have standard normal priors; the noise variance has its maximum-likelihood value.
        """
        return self._compute_log_bayes_factor(*explained_sum_of_squares(score, information))

    def _compute_log_bayes_factor(self, half_logdet: Any, explained_squares: Any) -> Any:
        """Compute the log Bayes factor from half the log determinant and the explained sum of squares of columns."""
        # At the noise variance of maximum likelihood, RSS/n, the log likelihood is −½·n·log(RSS) but for constants.
        rss_ratio = np.maximum((self.rss - explained_squares) / self.scorer.linear.rss, 1e-12)
        half_logdet = self.half_logdet + half_logdet - self.scorer.half_logdet
        return -half_logdet - 0.5 * self.scorer.linear.size * np.log(rss_ratio)

    @run_on_one_thread
    def score_pairs(self, scores: Scores) -> list[tuple[float, ScoredPoint, ScoredPoint]]:
        """Return log Bayes factors of pairs of candidates of two families, the highest first."""
        points = [p for scored in scores.values() for p in scored[:POINTS_IN_PAIRS]]
        family = self.scorer.library.structures.family
        families = [family(p.name) for p in points]
        indices = itertools.combinations(range(len(points)), 2)
        index_pairs = [(i, j) for i, j in indices if families[i] != families[j]]
        if not index_pairs:
            return []
        # Columns of all points side by side, and a column of zeros to pad candidates with fewer columns.
        sd = np.concatenate([*(p.prior_scale.sd for p in points), [0.0]])
        grid_points = [p.point for p in points]
        rows = self.scorer.choose_linear_model(grid_points)
        columns = rows.decorrelate(self.scorer.columns(rows, grid_points))
        projection = np.column_stack([p.projection for p in points])
        columns, projection = (np.pad(a, ((0, 0), (0, 1))) for a in (columns, projection))
        score = sd * np.concatenate([*(p.score for p in points), [0.0]])
        information = sd[:, None] * (columns.T @ columns - projection.T @ projection) * sd
        counts = np.array([len(p.score) for p in points])
        starts, offsets = np.cumsum(counts) - counts, np.arange(counts.max())
        column_index = np.where(offsets < counts[:, None], starts[:, None] + offsets, len(sd) - 1)
        pair_columns = column_index[np.array(index_pairs)].reshape(len(index_pairs), -1)
        information = information[pair_columns[:, :, None], pair_columns[:, None]]
        factors = self.log_bayes_factor(score[pair_columns], information).tolist()
        pairs = zip(factors, index_pairs, strict=True)
        return sorted(((f, points[i], points[j]) for f, (i, j) in pairs), key=lambda m: -m[0])


def log_mean_bayes_factor(points: Sequence[ScoredPoint]) -> float:
    """Return the log of a candidate's mean Bayes factor over its grid points."""
    return float(np.logaddexp.reduce([p.log_bayes_factor for p in points]) - math.log(len(points)))
