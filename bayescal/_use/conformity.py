"""Probability of conformity, guard bands and risks of a decision, of draws or of a normal distribution.

The quantity that is limited is y, its limits [T_L, T_U], one of which may be infinite; the readings leave it known as a
posterior. Of these follow

- the probability of conformity p_c = P(T_L ≤ y ≤ T_U) (JCGM 106:2012, 7.2) and the specific risk: 1 − p_c that an item
  which is accepted does not conform, p_c that one which is rejected does (3.3.13 and 3.3.14);
- the acceptance interval [A_L, A_U] of a stated probability α of false acceptance: all estimates with which, had the
  posterior the same form about them, p_c ≥ 1 − α; the guard bands are w = T_U − A_U and A_L − T_L (8.3.2);
- the global risks: averages over a population of items y ~ N(y₀, u₀²) that are each measured with standard uncertainty
  u (9.4 and 9.5): the consumer's, that an item does not conform and is accepted, and the producer's, that it conforms
  and is not accepted.

A quantity may be a curve, which conforms where all of it does: each draw counts by its lowest and highest value. A
quantity that scatters (a reading) conforms with the probability of one reading at the least favourable place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr
from scipy.stats import multivariate_normal

PLACES = 401  # shifts among which the most favourable one is looked for: its p_c need only be within 1/400 of the top
STEPS = 60  # of bisection, each of which halves the bracket: the last is 1e-18 of it
FAR = 10.0  # standard deviations beyond which a normal distribution has 1e-23


class Limits(NamedTuple):
    """A tolerance or an acceptance interval, in the unit of the quantity; infinite where there is no limit."""

    low: float
    high: float

    def hold(self, low: float, high: float) -> bool:
        """Whether the values from `low` to `high` are inside."""
        return self.low <= low and high <= self.high


@dataclass(frozen=True)
class DrawnQuantity:
    """What the posterior says of a quantity that is limited.

    Attributes:
        low, high: lowest and highest value in the range that the limit names, (d,) each, by draw; one value twice for a
            quantity at a single point.
        estimate: the same of the posterior mean.
        scatter: standard deviation of single readings about it; zero where it does not scatter.
    """

    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]
    estimate: tuple[float, float]
    scatter: float = 0.0

    def probability(self, limits: Limits, shift: float = 0.0) -> float:
        """Probability of conformity, had the posterior stood higher by `shift`."""
        low, high = self.low + shift, self.high + shift
        if self.scatter == 0:
            return float(np.mean((low >= limits.low) & (high <= limits.high)))
        # As a function of y the probability of one reading has a single top: its least is at one of the two ends.
        return float(np.mean(np.minimum(self._inside(low, limits), self._inside(high, limits))))

    def _inside(self, value: Float[np.ndarray, "d"], limits: Limits) -> Float[np.ndarray, "d"]:
        below, above = (limits.low - value) / self.scatter, (limits.high - value) / self.scatter
        return ndtr(above) - ndtr(below)

    def probability_error(self, p: float) -> float:
        """Monte-Carlo standard error of a probability from so many draws; at most that where readings scatter."""
        return float(np.sqrt(max(p * (1 - p), 1 / len(self.low)) / len(self.low)))


def acceptance(drawn: DrawnQuantity, limits: Limits, false_accept: float) -> Limits | None:
    """The acceptance interval of a stated probability of false acceptance; None where no estimate has so small a one.

    Args:
        drawn: whose posterior, with its form, is moved along.
        limits: the tolerance interval.
        false_accept: α.
    """
    reach = FAR * drawn.scatter
    # Below the first shift p_c is zero, as no draw is above T_L; so it is above the last.
    first = limits.low - float(drawn.low.max()) - reach
    last = limits.high - float(drawn.high.min()) + reach
    best = _most_favourable(drawn, limits, first, last)
    wanted = 1.0 - false_accept
    if drawn.probability(limits, best) < wanted:
        return None
    down = first if np.isinf(first) else _edge(drawn, limits, wanted, best, first)
    up = last if np.isinf(last) else _edge(drawn, limits, wanted, best, last)
    return Limits(drawn.estimate[0] + down, drawn.estimate[1] + up)


def _most_favourable(drawn: DrawnQuantity, limits: Limits, first: float, last: float) -> float:
    """The shift with the largest p_c."""
    if np.isinf(first) and np.isinf(last):
        return 0.0
    reach = FAR * drawn.scatter
    if np.isinf(first):  # one limit: all draws inside it
        return limits.high - float(drawn.high.max()) - reach
    if np.isinf(last):
        return limits.low - float(drawn.low.min()) + reach
    shifts = np.linspace(first, last, PLACES)
    # Of equally favourable ones the middle: about it p_c falls to both sides.
    p = np.array([drawn.probability(limits, s) for s in shifts])
    return float(np.median(shifts[p == p.max()]))


def _edge(
    drawn: DrawnQuantity, limits: Limits, wanted: float, inside: float, outside: float
) -> float:
    """Where p_c falls below what is wanted, between a shift where it does not and one where it is zero."""
    for _ in range(STEPS):
        middle = 0.5 * (inside + outside)
        if drawn.probability(limits, middle) >= wanted:
            inside = middle
        else:
            outside = middle
    return inside


@dataclass(frozen=True)
class GlobalRisks:
    """Of a population of items: how many conform, how many are accepted, and how many of each wrongly.

    Attributes:
        conforming: probability that an item conforms.
        accepted: that it is accepted.
        consumer: that it does not conform and is accepted.
        producer: that it conforms and is not accepted.
    """

    conforming: float
    accepted: float
    consumer: float
    producer: float


def global_risks(
    mean: float, sd: float, uncertainty: float, limits: Limits, accepted: Limits
) -> GlobalRisks:
    """Risks over items N(mean, sd²), each measured with a normal error of a standard uncertainty.

    Args:
        mean, sd: of the population.
        uncertainty: of the measurement of one item.
        limits: the tolerance interval.
        accepted: estimates that are accepted.

    Source: JCGM 106:2012, 9.5: item and estimate are normal together, with the covariance sd².
    """
    covariance = np.full((2, 2), sd**2) + np.diag([0.0, uncertainty**2])

    def share(items: Limits, read: Limits) -> float:
        """Probability that an item is among these, and what is read of it among those."""
        ends = np.transpose([items, read])
        both = multivariate_normal(np.full(2, mean), covariance, allow_singular=True)  # pyright: ignore[reportArgumentType]
        return float(both.cdf(ends[1], lower_limit=ends[0]))

    taken, conforming = share(limits, accepted), share(limits, Limits(-np.inf, np.inf))
    below, above = Limits(-np.inf, limits.low), Limits(limits.high, np.inf)
    wrongly = share(below, accepted) + share(above, accepted)
    return GlobalRisks(conforming, taken + wrongly, wrongly, conforming - taken)


def risks_of_curves(
    devices: Float[np.ndarray, "n g"],
    errors: Float[np.ndarray, "d g"],
    limits: Limits,
    accepted: Limits,
    seed: int,
) -> GlobalRisks:
    """Risks of a quantity over a range, which conforms, and is accepted, where all of its curve is inside: by counting.

    Args:
        devices: true curves of devices of the population.
        errors: of the measurement of one, drawn.
        limits, accepted: tolerance interval, and estimates that are accepted.
        seed: of the errors that devices get.
    """
    drawn = np.random.default_rng(seed).integers(len(errors), size=len(devices))
    read = devices + errors[drawn]
    good = (devices.min(axis=1) >= limits.low) & (devices.max(axis=1) <= limits.high)
    taken = (read.min(axis=1) >= accepted.low) & (read.max(axis=1) <= accepted.high)
    counted = (good, taken, taken & ~good, good & ~taken)
    return GlobalRisks(*(float(one.mean()) for one in counted))
