"""Combined evidence of the channels of a unit on a shape that they share, such as the lag of their body.

If the unit has the effect, a fraction of its channels has it, with a uniform prior. Given shape and fraction, channels
are independent: their likelihoods multiply, and the evidence of all others is a channel's cavity prior.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import expit

from bayescal._core.renamed import renamed
from bayescal._model.effect import CENTRAL_95, Shape
from bayescal._search.library import Library
from bayescal._search.scores import Scorer
from bayescal._search.structures import COARSE_NATS, LAW_WINDOW_NATS, EvaluatedStructure, Structures

SHARES = (np.arange(10) + 0.5)[:, None] / 10  # grid of the share of channels that show the effect
GRID_LIMIT_SD, GRID_STEP_SD = 3.5, 0.25  # limit and step of a shape's grid, prior sd
RAGGED_STEP_SD = 0.02  # step where the evidence has many maxima, as over a period
FINE_GRID_SD = np.linspace(-4.0, 4.0, 25)  # grid about a channel's mode, posterior sd
MIN_SD = 1e-4  # smallest standard deviation that the grid resolves, prior standard deviations
MIN_CHANGE = 0.1  # change of an effect's probability from which a channel is searched again
MIN_NATS = 0.125  # divergence from which structures are evaluated anew: a shift of half an sd
# Most probable structures with the effect and without, from which a channel's evidence is computed.
MAX_STRUCTURES = 3


class CavityPrior(NamedTuple):
    """Cavity distribution of an effect in one channel, given the evidence of the other channels."""

    log_odds: float  # that this channel shows the effect
    low: float  # central 95 % range of its shape, in the shape's unit
    high: float


class ShapeEvidence(NamedTuple):
    """Evidence of one channel on a shape."""

    v: Float[np.ndarray, "k"]  # coordinates of the shape
    log_ratio: Float[
        np.ndarray, "k"
    ]  # log Bayes factor of the effect, its shape at v, against none

    def update(self, prior: CavityPrior, shape: Shape) -> ChannelPosterior:
        """Return the channel's posterior of the effect under a cavity prior."""
        low, high = (shape.prior.coordinate(limit) for limit in (prior.low, prior.high))
        mean_v, sd = (low + high) / 2, (high - low) / (2 * CENTRAL_95)
        v = _sort_distinct(np.concatenate([self.v, mean_v + sd * FINE_GRID_SD]))
        # Cavity prior mass times the channel's own ratio, on a grid refined where the prior lies.
        log_joint = np.interp(v, self.v, self.log_ratio) + log_mass(v, mean_v, sd)
        log_ratio = float(np.logaddexp.reduce(log_joint))
        weight = np.exp(log_joint - log_ratio)
        mean = float(weight @ v)
        sd_post = math.sqrt(float(weight @ (v - mean) ** 2))
        return ChannelPosterior(float(expit(prior.log_odds + log_ratio)), mean, sd_post)


class ChannelPosterior(NamedTuple):
    """Posterior of an effect in one channel."""

    probability: float  # that the channel has the effect
    v: float  # mean and standard deviation of its shape's coordinate
    sd: float

    def differs_from(self, previous: ChannelPosterior) -> tuple[bool, bool]:
        """Return whether the effect's probability changed by `MIN_CHANGE`, and whether that or the shape changed."""
        is_changed = abs(self.probability - previous.probability) > MIN_CHANGE
        is_possible = max(self.probability, previous.probability) > MIN_CHANGE
        # Kullback–Leibler divergence of N(v, sd²) from the previous one: ½·(r² + d² − 1) − log r, r the ratio of the
        # standard deviations and d the shift over the previous one. A shift of half a standard deviation alone is ⅛.
        r, d = self.sd / previous.sd, (self.v - previous.v) / previous.sd
        compute_divergence = (r**2 + d**2 - 1) / 2 - math.log(r)
        return is_changed, is_changed or (is_possible and compute_divergence > MIN_NATS)


@renamed(says="log_ratios", evidence="log_bayes_factor", from_others="cavity_prior")
@dataclass(frozen=True, eq=False)
class SharedShape:
    """Evidence of all channels on an effect whose shape they share."""

    effect: str
    shape: Shape
    v: Float[np.ndarray, "k"]  # coordinates of the shape
    prior: float  # probability that the unit has the effect
    log_ratios: Mapping[str, Float[np.ndarray, "k"]]  # `ShapeEvidence.log_ratio` of each channel

    @classmethod
    def from_evidence(
        cls, effect: str, shape: Shape, prior: float, evidence: Mapping[str, ShapeEvidence]
    ) -> SharedShape:
        """Interpolate the evidence of each channel to the grid points of all channels."""
        v = _sort_distinct(np.concatenate([e.v for e in evidence.values()]))
        log_ratios = {name: np.interp(v, e.v, e.log_ratio) for name, e in evidence.items()}
        return cls(effect, shape, v, prior, log_ratios)

    def _log_joint(self, names: Iterable[str]) -> Float[np.ndarray, "shares k"]:
        """Return log [P(effect, fraction, shape, readings of given channels)/P(readings | no effect)] on both grids."""
        # A channel has the effect with probability s: likelihood ratio (1 − s) + s·ratio(v), independent given v, s.
        logs = (np.logaddexp(np.log1p(-SHARES), np.log(SHARES) + self.log_ratios[n]) for n in names)
        return log_mass(self.v) - math.log(SHARES.size) + sum(logs) + math.log(self.prior)

    def cavity_prior(self, channel: str) -> CavityPrior:
        """Return the prior of the effect in one channel given the evidence of all others."""
        log_joint = self._log_joint(n for n in self.log_ratios if n != channel)
        with_effect, without_effect = log_joint + np.log(SHARES), log_joint + np.log1p(-SHARES)
        # The channel shows the effect with probability s if the unit has it, and never if not.
        log_without = np.logaddexp.reduce(without_effect, axis=None)
        log_odds = np.logaddexp.reduce(with_effect, axis=None)
        log_odds -= np.logaddexp(log_without, math.log1p(-self.prior))
        _, low, high = self._range(with_effect)
        return CavityPrior(float(log_odds), low, high)

    def log_bayes_factor(self, channel: str) -> float:
        """Return the log Bayes factor of the effect in one channel, averaged over the cavity prior of its shape."""
        log_joint = self._log_joint(n for n in self.log_ratios if n != channel)
        mass = np.logaddexp.reduce(log_joint + np.log(SHARES), axis=0)
        log_mean = np.logaddexp.reduce(mass + self.log_ratios[channel])
        return float(log_mean - np.logaddexp.reduce(mass))

    @property
    def probability(self) -> float:
        """Return the probability that the unit has the effect."""
        log_with_effect = float(np.logaddexp.reduce(self._log_joint(self.log_ratios), axis=None))
        return math.exp(log_with_effect - np.logaddexp(log_with_effect, math.log1p(-self.prior)))

    @property
    def posterior(self) -> tuple[float, float, float]:
        """Return the shape's posterior median and central 95 % interval, in its unit, if the unit has the effect."""
        return self._range(self._log_joint(self.log_ratios))

    def _range(self, log_joint: Float[np.ndarray, "shares k"]) -> tuple[float, float, float]:
        # The share is summed out: what remains is the shape's own posterior on the grid.
        weight = np.exp(log_joint - log_joint.max()).sum(axis=0)
        weight /= weight.sum()
        mean = float(weight @ self.v)
        # One grid point may have all the mass: the grid resolves no smaller standard deviation.
        sd = max(math.sqrt(float(weight @ (self.v - mean) ** 2)), MIN_SD)
        value = self.shape.prior.value
        low, median, high = (float(value(mean + s * CENTRAL_95 * sd)) for s in (-1, 0, 1))
        return median, low, high


def log_mass(v: Float[np.ndarray, "k"], mean: float = 0.0, sd: float = 1.0) -> np.ndarray:
    """Return the log prior mass at each grid point under a normal prior."""
    # The grid is uneven: each point stands for half the distance to both its neighbours.
    log_density = -0.5 * ((v - mean) / sd) ** 2 + np.log(np.gradient(v))
    return log_density - np.logaddexp.reduce(log_density)


def evaluate_shape(structures: Structures, name: str, shape: Shape) -> ShapeEvidence:
    """Compute a channel's evidence on a shape from the structures evaluated with and without the effect."""
    local_shape = structures.candidates[name].shared_shape
    assert local_shape is not None
    # Structures fitted in the previous round only have their log posterior corrected for the new priors.
    refits = {**structures.previous_round, **structures.visited}
    fits = (w for w in refits.values() if math.isfinite(w.log_posterior))
    sorted_fits = sorted(fits, key=lambda w: -w.log_posterior)
    fits_with = [w for w in sorted_fits if name in w.structure.effects][:MAX_STRUCTURES]
    fits_without = [w for w in sorted_fits if name not in w.structure.effects][:MAX_STRUCTURES]
    v = _build_shape_coordinates(shape, local_shape, fits_with[:1], f"{name}.{shape.name}")
    u = np.array([local_shape.prior.coordinate(float(shape.prior.value(x))) for x in v])
    library = Library(structures, {name: u[:, None]})
    # An effect that was never fitted has the log posterior below which no structure is fitted.
    log_with_effect = [np.full(len(v), structures.best.log_posterior - LAW_WINDOW_NATS)]
    for fit in fits_with:
        # A fit gives the integral over v, the score the form over v, scaled so that its prior mean is the evidence of
        # the fit, and flat far behind the best. For structures to which no fit adds the effect the score gives both.
        is_near = structures.is_in_window(fit.log_posterior, COARSE_NATS)
        factors = _score_shape(library, fit, name) if is_near else np.zeros(len(v))
        log_posterior = fit.log_posterior - structures.log_odds[name]
        log_with_effect.append(log_posterior + factors - np.logaddexp.reduce(factors + log_mass(u)))
    for fit in fits_without if name in library.points else ():
        is_allowed = name not in structures.excluded_candidates(fit.structure)
        if is_allowed and fit.structure.with_effects(name) not in refits:
            log_with_effect.append(fit.log_posterior + _score_shape(library, fit, name))
    log_without = np.logaddexp.reduce([w.log_posterior for w in fits_without])
    return ShapeEvidence(v, np.logaddexp.reduce(log_with_effect, axis=0) - log_without)


def _build_shape_coordinates(
    shape: Shape, local_shape: Shape, best_fits: Sequence[EvaluatedStructure], name: str
) -> np.ndarray:
    """Return a grid of shape coordinates: even over both prior ranges, and finer about the channel's mode."""
    steps = RAGGED_STEP_SD if shape.ragged else GRID_STEP_SD, GRID_STEP_SD
    even_grid, coarse_grid = (np.arange(-GRID_LIMIT_SD, GRID_LIMIT_SD, step) for step in steps)
    values = [local_shape.prior.value(coarse_grid)]
    for fit in best_fits:
        index = fit.problem.layout.index_in_phi[name]
        sd = math.sqrt(fit.mode.covariance[index, index])
        # At the channel's mode the evidence may have a peak narrower than the even step.
        fine_grid = fit.mode.v[index] + np.clip(sd, MIN_SD, 1.0) * FINE_GRID_SD
        values.append(fit.problem.hypers[index].prior.value(fine_grid))
    coordinates = [shape.prior.coordinate(float(value)) for value in np.concatenate(values)]
    return _sort_distinct(np.concatenate([even_grid, coordinates]))


def _sort_distinct(v: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return sorted distinct coordinates within the limits of the grid."""
    v = np.sort(v[np.abs(v) <= GRID_LIMIT_SD])
    return v[np.insert(np.diff(v) > 1e-6, 0, True)]


def _score_shape(library: Library, fit: EvaluatedStructure, name: str) -> Float[np.ndarray, "k"]:
    """Return an effect's log Bayes factor, up to a constant, from its score at each grid point of its shape.

    For an effect that corrects a column (no score): the log density of φ, others at the mode, less the shape's prior.
    """
    if name not in library.points:
        candidate_shape = library.structures.candidates[name].column_shapes[0]
        shape = fit.model.effect(name).column_shapes[0]
        values = candidate_shape.prior.value(library.grids[name][:, 0])
        v = np.array([shape.prior.coordinate(float(value)) for value in values])
        log_prior = np.asarray(shape.prior.log_density(v))
        return fit.log_density_along(f"{name}.{shape.name}", v) - log_prior
    points = Scorer(library, fit).reduced_model(name).score_candidates([name])[name]
    return np.array([s.log_bayes_factor for s in sorted(points, key=lambda s: s.point.block.start)])
