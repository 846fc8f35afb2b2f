"""How much of what a calibration knows comes from its priors, and how much from the readings; what was not measured.

A quantity q of jointly normal unknowns c, each with a prior of variance D, has the variance Σ cov(q, c)²/D from the
priors, and the rest from the noise of the readings: P·D⁻¹·P and P·JᵀΣ⁻¹J·P of the posterior covariance P. Of one
coefficient by itself the part that is its prior's is one less its contraction.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.judgement import FREE_SIZES
from bayescal._calibration.summary import CONCERNED_SHARE, WEAK_INFORMATION
from bayescal._core.formatting import number, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Coefficient
from bayescal._model.parameters import Unknown
from bayescal._model.prior import slope


def variance_by_origin(
    calibration: Calibration, slopes: Mapping[str, float]
) -> tuple[float, dict[str, float]]:
    """Return the variance of Σ slope·unknown that the readings' noise makes, and that each prior does, by its name.

    With J the Jacobian of the readings, Σ their noise and D the prior covariance at the fit, the linearised
    posterior covariance P = (JᵀΣ⁻¹J + D⁻¹)⁻¹ splits exactly into P·JᵀΣ⁻¹J·P and P·D⁻¹·P, a sum over priors.

    Slopes are by the names of unknowns, per reported unit; what is no unknown of the fit is passed over. Of directions
    that readings and priors leave open nothing is said.
    """
    layout, linear = calibration.layout, calibration.linear
    moving = layout.moving
    weights = np.zeros(layout.size + len(moving))
    for u in (u for u in calibration.unknowns if u.name in slopes):
        if u.x is not None:
            weights[u.x] = slopes[u.name]
        elif u.v in moving:
            unit = float(slope(layout.hypers[u.v].prior, calibration.mode.v[u.v]))
            weights[layout.size + moving.index(u.v)] = slopes[u.name] * unit
    pulled = linear.root @ (linear.root.T @ (weights * linear.sd))  # in units of the priors
    names = [b.name for b in layout.x_blocks for _ in range(b.size)]
    names += [layout.hypers[i].name for i in moving]
    priors = defaultdict[str, float](float)
    for name, value in zip(names, linear.weight * pulled**2, strict=True):
        priors[name] += float(value)
    readings = float(np.sum((linear.white_nuisance @ pulled) ** 2))
    return readings, {n: value for n, value in priors.items() if value > 0}


@dataclass(frozen=True)
class NotMeasured:
    """Of what a quantity is made that was not measured."""

    names: tuple[str, ...]  # of unknowns, the largest part of its variance first
    words: str  # what is known of each, and was before the readings
    cure: str  # what would tell, a sentence without its full stop
    # Whether it is one by itself, whose draws without its prior are not known.
    hyperparameter: bool = False

    def __str__(self) -> str:
        return f"the readings tell less of {self.words} than was known before"

    def by_readings_alone(
        self, calibration: Calibration, values: Float[np.ndarray, "d g"]
    ) -> Float[np.ndarray, "d g"]:
        """Draws of the quantity as they would be with priors of these unknowns that say nothing.

        A posterior covariance P and a prior's D leave P⁻¹ − D⁻¹ to the readings. What these hardly tell at all gets a
        thousand plausible sizes. The quantity follows by its regression on the unknowns.
        """
        rows = [(u, c) for u, c, _ in _with_stated_priors(calibration) if u.name in self.names]
        if not rows:
            return values
        draws = [(calibration.samples(u.name) - c.mean) / c.size for u, c in rows]
        there = [calibration.having[u.effect] for u, _ in rows]
        every, present, found = np.array(draws).T, np.array(there).T, values.copy()
        for pattern in np.unique(present, axis=0):  # of an average over structures
            own = np.all(present == pattern, axis=1)
            known = every[own][:, pattern]
            if not pattern.any() or len(known) <= 2 * known.shape[1]:
                continue
            middle = known.mean(axis=0)
            away, q = known - middle, values[own]
            weights, axes = np.linalg.eigh(away.T @ away / len(away))
            weights = np.maximum(weights, np.finfo(float).tiny)
            told = 1 / weights - 1
            told = np.where(told < WEAK_INFORMATION, 0.0, told)
            wider = 1 / (told + FREE_SIZES**-2)
            along = middle @ axes
            moved = np.where(told > 0, along * wider / weights, along)
            freed = moved + (away @ axes) * np.sqrt(wider / weights)
            slope = axes / weights @ axes.T @ away.T @ (q - q.mean(axis=0)) / len(away)
            found[own] = q + (freed @ axes.T - known) @ slope
        return found


def not_measured(
    calibration: Calibration,
    values: Float[np.ndarray, "d g"],
    *,
    of: str = "",
    scatter: Float[np.ndarray, "g"] | float = 0.0,
    rare: float = 0.0,
) -> NotMeasured | None:
    """What stands against calling a quantity measured: priors say more of it than the readings; None where they do not.

    Counted are coefficients with a stated prior that act in use: what is known beforehand of a rig, or of a
    thermometer, is no property of the device.

    Args:
        calibration: a fit, or an average over structures: of an effect the draws that have it are asked.
        values: of the quantity in each draw, at several places; the worst one counts.
        of: the unknown that it is, where it is one.
        scatter: standard deviation of single readings about it, at each place.
        rare: probability of an effect up to which it does not count.
    """
    unknown = next((u for u in calibration.unknowns if u.name == of), None)
    if unknown is not None and unknown.prior is not None:
        # What is positive may be told by its size (a spread near zero) or its logarithm (one far above).
        own, before = calibration.samples(of), unknown.prior_sd
        by_size = before is not None and 2 * own.var() <= before**2
        v = calibration.draws().v[:, unknown.v]
        if by_size or 2 * np.var(v) <= unknown.prior.coordinate_variance:
            return None
        known = _known(unknown, own)
        return NotMeasured((of,), known, "What would tell: more readings", hyperparameter=True)
    found = list[tuple[Unknown, np.ndarray, float]]()
    shares, counts = list[np.ndarray](), list[bool]()
    total = values.var(axis=0) + scatter**2
    for u, c, acting in _with_stated_priors(calibration):
        among = calibration.having[u.effect]
        if among.mean() <= rare:
            continue
        own, inside = calibration.samples(u.name)[among], values[among]
        covariance = (own - own.mean()) @ (inside - inside.mean(axis=0)) / len(own)
        part = among.mean() * (covariance / c.size) ** 2
        shares.append(part / np.where(total > 0, total, np.inf))
        found.append((u, own, c.size))
        counts.append(acting or u.name == of)
    if not any(counts):
        return None
    by_prior = np.array(shares)
    worst = by_prior[:, int(np.argmax(by_prior[counts].sum(axis=0)))]
    if worst[counts].sum() <= 0.5:  # the readings say more
        return None
    named = np.flatnonzero(worst >= min(CONCERNED_SHARE, worst[counts].max()))
    named = sorted(named, key=lambda i: (not counts[i], -worst[i]))
    own, told = [found[i] for i in named if counts[i]], "more readings"
    blocks = (u.block for u, *_ in own)
    if columns := dict.fromkeys(c for block in blocks if block for c in block.effect.columns):
        told = f"readings over more of {' and '.join(columns)}"
    elif len(named) > 1:
        told = f"readings that tell {' and '.join(found[i][0].name for i in named)} apart"
    words = (_known(u, draws, f", ± {number(size)} before them") for u, draws, size in own)
    names = tuple(u.name for u, *_ in own)
    return NotMeasured(names, " and ".join(words), f"What would tell: {told}")


def _known(u: Unknown, draws: Float[np.ndarray, "d"], before: str = "") -> str:
    """Return what is known of an unknown, in words."""
    value = f"{with_error(float(draws.mean()), float(draws.std()))} {unit_label(u.unit)}".rstrip()
    return f"{u.name} ({value}{before})"


def coefficients_not_measured(calibration: Calibration) -> set[str]:
    """Names of the coefficients of which priors say more than the readings do."""
    names, samples = (u.name for u, *_ in _with_stated_priors(calibration)), calibration.samples
    return {n for n in names if not_measured(calibration, samples(n)[:, None], of=n)}


def _with_stated_priors(calibration: Calibration) -> Iterator[tuple[Unknown, Coefficient, bool]]:
    """Coefficients whose prior is stated, neither flat nor learned, and whether they are of the device in use."""
    instrument = calibration.model.instrument
    slots = {s.name for s in instrument.slots}
    if instrument.vector is not None:
        slots -= {*instrument.vector.rig}
    elif instrument.use is not None and instrument.use.slots:
        slots = {*instrument.use.slots}
    for u in calibration.unknowns:
        # What is held is a body's temperature, which has the coefficient of what depends on it.
        if u.block is not None and not u.held and u.prior_sd is not None:
            yield u, u.block.coefficient, u.block.slot in slots
