"""Prior influence: the shares of a variance from priors and from readings; quantities not measured.

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
    """Split the variance of Σ slope·unknown into that of the readings' noise, and each prior's, by name.

    With J the Jacobian of the readings, Σ their noise and D the prior covariance at the fit, the linearised
    posterior covariance P = (JᵀΣ⁻¹J + D⁻¹)⁻¹ splits exactly into P·JᵀΣ⁻¹J·P and P·D⁻¹·P, a sum over priors.
    Slopes are by the names of unknowns, per reported unit; other names are ignored, and so are directions that neither
    readings nor priors determine.
    """
    layout, linear = calibration.layout, calibration.linear
    moving = layout.nonlinear_phi
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
    """The unknowns that make a quantity prior-dominated: not measured."""

    names: tuple[str, ...]  # of unknowns, the largest part of its variance first
    words: str  # posterior and prior of each
    cure: str  # which readings would measure it, a sentence without its full stop
    # Whether it is a hyperparameter itself: its draws without the prior are unknown.
    hyperparameter: bool = False

    def __str__(self) -> str:
        return f"the readings tell less of {self.words} than was known before"

    def by_readings_alone(
        self, calibration: Calibration, values: Float[np.ndarray, "d g"]
    ) -> Float[np.ndarray, "d g"]:
        """Return the quantity's draws under uninformative priors of these unknowns.

        The readings' information is P⁻¹ − D⁻¹, of posterior covariance P and prior covariance D. Directions without
        information get a thousand plausible sizes. The quantity follows by its regression on the unknowns.
        """
        rows = [(u, c) for u, c, _ in _with_stated_priors(calibration) if u.name in self.names]
        if not rows:
            return values
        draws = [(calibration.samples(u.name) - c.mean) / c.size for u, c in rows]
        presence = [calibration.having[u.effect] for u, _ in rows]
        unknowns, present, quantity = np.array(draws).T, np.array(presence).T, values.copy()
        for pattern in np.unique(present, axis=0):  # of an average over structures
            in_pattern = np.all(present == pattern, axis=1)
            pattern_draws = unknowns[in_pattern][:, pattern]
            if not pattern.any() or len(pattern_draws) <= 2 * pattern_draws.shape[1]:
                continue
            middle = pattern_draws.mean(axis=0)
            centred, q = pattern_draws - middle, values[in_pattern]
            weights, axes = np.linalg.eigh(centred.T @ centred / len(centred))
            weights = np.maximum(weights, np.finfo(float).tiny)
            information = 1 / weights - 1
            information = np.where(information < WEAK_INFORMATION, 0.0, information)
            wider = 1 / (information + FREE_SIZES**-2)
            along = middle @ axes
            shifted = np.where(information > 0, along * wider / weights, along)
            freed = shifted + (centred @ axes) * np.sqrt(wider / weights)
            slope = axes / weights @ axes.T @ centred.T @ (q - q.mean(axis=0)) / len(centred)
            quantity[in_pattern] = q + (freed @ axes.T - pattern_draws) @ slope
        return quantity


def not_measured(
    calibration: Calibration,
    values: Float[np.ndarray, "d g"],
    *,
    of: str = "",
    scatter: Float[np.ndarray, "g"] | float = 0.0,
    rare: float = 0.0,
) -> NotMeasured | None:
    """Return the unknowns whose priors determine a quantity more than the readings; None where they do not.

    Only coefficients with a stated prior that act in use count, not those of a rig or a thermometer.

    Args:
        calibration: a fit, or an average over structures; an effect is judged by the draws that include it.
        values: of the quantity in each draw, at several points; the worst one counts.
        of: the unknown's name, if the quantity is one.
        scatter: standard deviation of single readings about it, at each value.
        rare: probability of an effect up to which it does not count.
    """
    unknown = next((u for u in calibration.unknowns if u.name == of), None)
    if unknown is not None and unknown.prior is not None:
        # A positive unknown may be measured on a linear scale (near zero) or a logarithmic one.
        samples, before = calibration.samples(of), unknown.prior_sd
        by_size = before is not None and 2 * samples.var() <= before**2
        v = calibration.draws().v[:, unknown.v]
        if by_size or 2 * np.var(v) <= unknown.prior.coordinate_variance:
            return None
        prior_words = _in_words(unknown, samples)
        return NotMeasured(
            (of,), prior_words, "What would tell: more readings", hyperparameter=True
        )
    candidates = list[tuple[Unknown, np.ndarray, float]]()
    shares, counts = list[np.ndarray](), list[bool]()
    total = values.var(axis=0) + scatter**2
    for u, c, acting in _with_stated_priors(calibration):
        present = calibration.having[u.effect]
        if present.mean() <= rare:
            continue
        samples, quantity = calibration.samples(u.name)[present], values[present]
        covariance = (samples - samples.mean()) @ (quantity - quantity.mean(axis=0)) / len(samples)
        part = present.mean() * (covariance / c.size) ** 2
        shares.append(part / np.where(total > 0, total, np.inf))
        candidates.append((u, samples, c.size))
        counts.append(acting or u.name == of)
    if not any(counts):
        return None
    by_prior = np.array(shares)
    worst = by_prior[:, int(np.argmax(by_prior[counts].sum(axis=0)))]
    if worst[counts].sum() <= 0.5:  # the readings say more
        return None
    named = np.flatnonzero(worst >= min(CONCERNED_SHARE, worst[counts].max()))
    named = sorted(named, key=lambda i: (not counts[i], -worst[i]))
    samples, cure = [candidates[i] for i in named if counts[i]], "more readings"
    blocks = (u.block for u, *_ in samples)
    if columns := dict.fromkeys(c for block in blocks if block for c in block.effect.columns):
        cure = f"readings over more of {' and '.join(columns)}"
    elif len(named) > 1:
        cure = f"readings that tell {' and '.join(candidates[i][0].name for i in named)} apart"
    words = (_in_words(u, x, f", ± {number(size)} before them") for u, x, size in samples)
    names = tuple(u.name for u, *_ in samples)
    return NotMeasured(names, " and ".join(words), f"What would tell: {cure}")


def _in_words(u: Unknown, draws: Float[np.ndarray, "d"], before: str = "") -> str:
    """Return an unknown's name and value, in words."""
    value = f"{with_error(float(draws.mean()), float(draws.std()))} {unit_label(u.unit)}".rstrip()
    return f"{u.name} ({value}{before})"


def coefficients_not_measured(calibration: Calibration) -> set[str]:
    """Return the names of the coefficients that priors determine more than the readings."""
    names, samples = (u.name for u, *_ in _with_stated_priors(calibration)), calibration.samples
    return {n for n in names if not_measured(calibration, samples(n)[:, None], of=n)}


def _with_stated_priors(calibration: Calibration) -> Iterator[tuple[Unknown, Coefficient, bool]]:
    """Yield coefficients of stated prior, neither flat nor learned, and whether the device in use has them."""
    instrument = calibration.model.instrument
    slots = {s.name for s in instrument.slots}
    if instrument.vector is not None:
        slots -= {*instrument.vector.rig}
    elif instrument.use is not None and instrument.use.slots:
        slots = {*instrument.use.slots}
    for u in calibration.unknowns:
        # A held unknown is a body's temperature, with the coefficient of the dependence on it.
        if u.block is not None and not u.held and u.prior_sd is not None:
            yield u, u.block.coefficient, u.block.slot in slots
