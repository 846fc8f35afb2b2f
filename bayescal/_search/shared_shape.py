"""A shape that the channels of a unit share, such as the lag of their body: what each says of it, and what all do.

The unit has the effect or not; if it has, some share of its channels shows it, any share as probable as another. Given
shape and share the channels are independent: what they say multiplies, and what the others say is a channel's prior.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import expit

from bayescal._inference.density import Density
from bayescal._model.effect import CENTRAL_95, Shape
from bayescal._search.library import Library
from bayescal._search.scores import View
from bayescal._search.structures import OTHER_LAW_NATS, ROUGHLY_NATS, Structures, Weighed

SHARES = (np.arange(10) + 0.5)[:, None] / 10  # of the channels that show what their unit has
REACH, STEP = 3.5, 0.25  # of the shape's grid, prior standard deviations
RAGGED_STEP = 0.02  # the same where the evidence has many maxima, as over a period
CLOSE_SD = np.linspace(-4.0, 4.0, 25)  # about what a channel found, in its standard deviations
FINEST_SD = 1e-4  # of a shape, prior standard deviations, that its grid tells
LIKELIER_BY = 0.1  # by which an effect's probability moves before the channel is searched again
NEWS_NATS = 0.125  # nats that others tell of a shape before its structures are weighed again: half a standard deviation
# Most probable structures with the effect and without, of which a channel is asked.
ASKED_STRUCTURES = 3


class FromOthers(NamedTuple):
    """What the other channels say of an effect: log odds that this one shows it, and its shape's plausible range."""

    log_odds: float
    low: float
    high: float


class ShapeEvidence(NamedTuple):
    """What one channel says of a shape: log ratio of its evidence with the effect, at each v, to that without it."""

    v: Float[np.ndarray, "k"]
    log_ratio: Float[np.ndarray, "k"]

    def conclude(self, others: FromOthers, shape: Shape) -> Conclusion:
        """Return what the channel concludes of the effect where the others say this."""
        low, high = (shape.prior.coordinate(end) for end in (others.low, others.high))
        middle, sd = (low + high) / 2, (high - low) / (2 * CENTRAL_95)
        v = _distinct(np.concatenate([self.v, middle + sd * CLOSE_SD]))
        # Prior mass as the others have it times the channel's own ratio; the grid is refined where that prior lies,
        # which may be narrower than any step of the channel's grid.
        joint = np.interp(v, self.v, self.log_ratio) + log_mass(v, middle, sd)
        log_ratio = float(np.logaddexp.reduce(joint))
        weight = np.exp(joint - log_ratio)
        mean = float(weight @ v)
        spread = math.sqrt(float(weight @ (v - mean) ** 2))
        return Conclusion(float(expit(others.log_odds + log_ratio)), mean, spread)


class Conclusion(NamedTuple):
    """Of one channel about an effect: how probable it is there, and its shape's coordinate with its uncertainty."""

    probability: float
    v: float
    sd: float

    def changed(self, then: Conclusion) -> tuple[bool, bool]:
        """Return whether the probability of the effect moved by what counts, and whether that or its shape did."""
        likelier = abs(self.probability - then.probability) > LIKELIER_BY
        may_be = max(self.probability, then.probability) > LIKELIER_BY
        # Kullback–Leibler divergence of N(v, sd²) from what it was: ½·(r² + d² − 1) − log r, r the ratio of the
        # standard deviations and d the distance in the former one. Half a standard deviation of shift alone is ⅛.
        r, d = self.sd / then.sd, (self.v - then.v) / then.sd
        return likelier, likelier or (may_be and (r**2 + d**2 - 1) / 2 - math.log(r) > NEWS_NATS)


@dataclass(frozen=True, eq=False)
class SharedShape:
    """What the channels say of an effect whose shape they share, and how probable it is a priori that the unit has it.

    Each says the log ratio of its evidence with the effect, at each v of the shape's coordinate, to that without (k,).
    """

    effect: str
    shape: Shape
    v: Float[np.ndarray, "k"]
    prior: float
    says: Mapping[str, Float[np.ndarray, "k"]]

    @classmethod
    def of(
        cls, effect: str, shape: Shape, prior: float, evidence: Mapping[str, ShapeEvidence]
    ) -> SharedShape:
        """Interpolate the evidence of each channel on the points of all."""
        v = _distinct(np.concatenate([ratio.v for ratio in evidence.values()]))
        says = {name: np.interp(v, ratio.v, ratio.log_ratio) for name, ratio in evidence.items()}
        return cls(effect, shape, v, prior, says)

    def _joint(self, names: Iterable[str]) -> Float[np.ndarray, "shares k"]:
        """Return log prior of share and shape plus these channels' log likelihood, if the unit has it."""
        # A channel shows the effect with probability s, the share: it says (1 − s)·1 + s·ratio(v). Channels multiply,
        # since given v and s they are independent.
        logs = (np.logaddexp(np.log1p(-SHARES), np.log(SHARES) + self.says[n]) for n in names)
        return log_mass(self.v) - math.log(SHARES.size) + sum(logs) + math.log(self.prior)

    def from_others(self, channel: str) -> FromOthers:
        """Return what all but one channel say of the effect in that channel."""
        joint = self._joint(n for n in self.says if n != channel)
        with_effect, without_effect = joint + np.log(SHARES), joint + np.log1p(-SHARES)
        # The channel has the effect with probability s in units that have it, never in units that have not.
        log_without = np.logaddexp.reduce(without_effect, axis=None)
        log_odds = np.logaddexp.reduce(with_effect, axis=None)
        log_odds -= np.logaddexp(log_without, math.log1p(-self.prior))
        _, low, high = self._range(with_effect)
        return FromOthers(float(log_odds), low, high)

    def evidence(self, channel: str) -> float:
        """Return the log Bayes factor of the effect in one channel, its shape as the others have it."""
        joint = self._joint(n for n in self.says if n != channel)
        # The shape as the others leave it is the prior, over which this channel's ratio is averaged.
        mass = np.logaddexp.reduce(joint + np.log(SHARES), axis=0)
        return float(np.logaddexp.reduce(mass + self.says[channel]) - np.logaddexp.reduce(mass))

    @property
    def probability(self) -> float:
        """Return the probability that the unit has the effect."""
        with_it = float(np.logaddexp.reduce(self._joint(self.says), axis=None))
        return math.exp(with_it - np.logaddexp(with_it, math.log1p(-self.prior)))

    @property
    def posterior(self) -> tuple[float, float, float]:
        """Return the shape's middle and central 95 % interval, in its unit, if the unit has the effect."""
        return self._range(self._joint(self.says))

    def _range(self, joint: Float[np.ndarray, "shares k"]) -> tuple[float, float, float]:
        # The share is summed out: what remains is the shape's own posterior on the grid.
        weight = np.exp(joint - joint.max()).sum(axis=0)
        weight /= weight.sum()
        mean = float(weight @ self.v)
        # One point of the grid may hold it all: what the grid tells is no finer than its closest points.
        sd = max(math.sqrt(float(weight @ (self.v - mean) ** 2)), FINEST_SD)
        value = self.shape.prior.value
        low, middle, high = (float(value(mean + s * CENTRAL_95 * sd)) for s in (-1, 0, 1))
        return middle, low, high


def log_mass(v: Float[np.ndarray, "k"], mean: float = 0.0, sd: float = 1.0) -> np.ndarray:
    """Return the log of a normal prior's mass about each point of a grid."""
    # Points are uneven: each stands for half the way to both its neighbours.
    width = np.gradient(v)
    log_density = -0.5 * ((v - mean) / sd) ** 2 + np.log(width)
    return log_density - np.logaddexp.reduce(log_density)


def evidence_of(structures: Structures, name: str, shape: Shape) -> ShapeEvidence:
    """Return a channel's evidence on a shape by the structures evaluated with and without it."""
    own_shape = structures.candidates[name].shared_shape
    assert own_shape is not None
    # What was refitted in an earlier round, and not since, counts by what is expected of it now.
    refits = {**structures.earlier, **structures.visited}
    finite = (w for w in refits.values() if math.isfinite(w.total))
    evaluated = sorted(finite, key=lambda w: -w.total)
    holding = [w for w in evaluated if name in w.structure.effects][:ASKED_STRUCTURES]
    without = [w for w in evaluated if name not in w.structure.effects][:ASKED_STRUCTURES]
    v = _grid(shape, own_shape, holding[:1], f"{name}.{shape.name}")
    u = np.array([own_shape.prior.coordinate(float(shape.prior.value(x))) for x in v])
    fine = Library(structures, {name: u[:, None]})
    # Where it was not worth a refit, it is as improbable as makes none worth while.
    with_it = [np.full(len(v), structures.best.total - OTHER_LAW_NATS)]
    for weighed in holding:
        # A refit knows the integral over v, the score its form: the form is scaled so that its prior mean is the
        # refit's evidence; far behind it does not count. Of structures without the effect, to which no refit adds it,
        # the score stands for both.
        near = weighed.total > structures.best.total - ROUGHLY_NATS
        gains = _gains(fine, weighed, name) if near else np.zeros(len(v))
        total = weighed.total - structures.log_odds[name]
        with_it.append(total + gains - np.logaddexp.reduce(gains + log_mass(u)))
    for weighed in without:
        scored = name in fine.points and name not in structures.barred(weighed.structure)
        if scored and weighed.structure.plus(name) not in refits:
            with_it.append(weighed.total + _gains(fine, weighed, name))
    totals = [w.total for w in without]
    return ShapeEvidence(v, np.logaddexp.reduce(with_it, axis=0) - np.logaddexp.reduce(totals))


def _grid(shape: Shape, local: Shape, best: Sequence[Weighed], name: str) -> np.ndarray:
    """Return coordinates: even ones, over the channel's own range too, and closer about its mode."""
    even = np.arange(-REACH, REACH, RAGGED_STEP if shape.ragged else STEP)
    values = [local.prior.value(np.arange(-REACH, REACH, STEP))]
    for weighed in best:
        at = weighed.problem.layout.index_in_phi[name]
        sd = math.sqrt(weighed.mode.covariance[at, at])
        # About what the channel found the evidence may have a peak narrower than the even step.
        close = weighed.mode.v[at] + np.clip(sd, FINEST_SD, 1.0) * CLOSE_SD
        values.append(weighed.problem.hypers[at].prior.value(close))
    moved = [shape.prior.coordinate(float(value)) for value in np.concatenate(values)]
    return _distinct(np.concatenate([even, moved]))


def _distinct(v: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return sorted distinct coordinates within reach."""
    v = np.sort(v[np.abs(v) <= REACH])
    return v[np.insert(np.diff(v) > 1e-6, 0, True)]


def _gains(fine: Library, at: Weighed, name: str) -> Float[np.ndarray, "k"]:
    """Return an effect's log Bayes factor by score at each point of its grid, up to a constant.

    Of one that corrects a column, which has no score, the density of φ along its shape, all else held.
    """
    if name not in fine.points:
        shape = fine.structures.candidates[name].column_shapes[0]
        return _along(at, name, shape.prior.value(fine.grids[name][:, 0]))
    scored = View(fine, at).without(name).scores([name])[name]
    return np.array([s.gain for s in sorted(scored, key=lambda s: s.point.at.start)])


def _along(at: Weighed, name: str, values: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return the log density of φ at values of an effect's one shape, without its prior there, all else as it is."""
    own_shape = at.model.effect(name).column_shapes[0]
    coordinates = np.array([own_shape.prior.coordinate(float(value)) for value in values])
    place = at.problem.layout.index_in_phi[f"{name}.{own_shape.name}"]
    vs = np.tile(at.mode.v, (len(coordinates), 1))
    vs[:, place] = coordinates
    prior = np.asarray(own_shape.prior.log_density(coordinates))
    density = Density(at.problem, at.mode.x, at.mode.flat, at.mode.v)
    return density.values(vs) - prior
