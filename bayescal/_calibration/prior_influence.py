"""Prior influence: the shares of a variance due to priors and to readings; prior-dominated quantities.

For a quantity q of jointly normal unknowns c with prior variances D, the priors contribute Σ cov(q, c)²/D to var(q),
and the noise of the readings the remainder: P = P·D⁻¹·P + P·JᵀΣ⁻¹J·P for the posterior covariance P. For a single
coefficient the prior's share is one less its contraction.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.judgement import FREE_SD_FACTOR
from bayescal._calibration.summary import CONCERNED_SHARE, WEAK_INFORMATION
from bayescal._core.formatting import format_value, number
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Coefficient
from bayescal._model.parameters import Unknown
from bayescal._model.prior import slope


def variance_by_origin(
    calibration: Calibration, sensitivities: Mapping[str, float]
) -> tuple[float, dict[str, float]]:
    """Split the variance of Σ sensitivity·unknown into the part due to noise and each prior's part, by name.

    With J the Jacobian of the readings, Σ their noise and D the prior covariance at the fit, the linearised
    posterior covariance P = (JᵀΣ⁻¹J + D⁻¹)⁻¹ splits exactly into P·JᵀΣ⁻¹J·P and P·D⁻¹·P, a sum over priors.
    Sensitivities ∂q/∂unknown are per reported unit, by the unknown's name; other names are ignored, and so are
    directions that neither readings nor priors determine.
    """
    layout, linear = calibration.layout, calibration.linear
    nonlinear_indices = layout.nonlinear_phi
    weights = np.zeros(layout.size + len(nonlinear_indices))
    for u in (u for u in calibration.unknowns if u.name in sensitivities):
        if u.x is not None:
            weights[u.x] = sensitivities[u.name]
        elif u.v in nonlinear_indices:
            unit_slope = float(slope(layout.hypers[u.v].prior, calibration.mode.v[u.v]))
            weights[layout.size + nonlinear_indices.index(u.v)] = sensitivities[u.name] * unit_slope
    projection = linear.root @ (linear.root.T @ (weights * linear.sd))  # in units of the priors
    names = [b.name for b in layout.x_blocks for _ in range(b.size)]
    names += [layout.hypers[i].name for i in nonlinear_indices]
    prior_variances = defaultdict[str, float](float)
    for name, value in zip(names, linear.weight * projection**2, strict=True):
        prior_variances[name] += float(value)
    readings_variance = float(np.sum((linear.white_nuisance @ projection) ** 2))
    return readings_variance, {n: value for n, value in prior_variances.items() if value > 0}


@dataclass(frozen=True)
class PriorDominance:
    """The unknowns whose priors determine a quantity more than the readings do."""

    names: tuple[str, ...]  # of the unknowns, by decreasing share of the quantity's variance
    words: str  # posterior and prior of each unknown, as text
    cure: str  # readings that would measure the quantity, a sentence without full stop
    hyperparameter: bool = False  # the quantity is a hyperparameter: no draws without its prior

    def __str__(self) -> str:
        return f"the prior contributes more than the readings to {self.words}"

    def update_by_readings(
        self, calibration: Calibration, values: Float[np.ndarray, "d g"]
    ) -> Float[np.ndarray, "d g"]:
        """Return the quantity's draws under uninformative priors of the unknowns `names`.

        The readings' information is P⁻¹ − D⁻¹, with posterior covariance P and prior covariance D. Directions without
        information get a thousand prior standard deviations. The quantity is updated by its regression on the unknowns.
        """
        coefficients = [(u, c) for u, c, _ in _list_priors(calibration) if u.name in self.names]
        if not coefficients:
            return values
        draws = [(calibration.samples(u.name) - c.mean) / c.size for u, c in coefficients]
        presence_masks = [calibration.inclusion_masks[u.effect] for u, _ in coefficients]
        unknowns, presence, quantity = np.array(draws).T, np.array(presence_masks).T, values.copy()
        for pattern in np.unique(presence, axis=0):  # structures of a model average
            has_pattern = np.all(presence == pattern, axis=1)
            pattern_draws = unknowns[has_pattern][:, pattern]
            if not pattern.any() or len(pattern_draws) <= 2 * pattern_draws.shape[1]:
                continue
            mean = pattern_draws.mean(axis=0)
            centred, y = pattern_draws - mean, values[has_pattern]
            spectrum, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
            spectrum = np.maximum(spectrum, np.finfo(float).tiny)
            information = np.where(1 / spectrum - 1 < WEAK_INFORMATION, 0.0, 1 / spectrum - 1)
            freed_variance, means = 1 / (information + FREE_SD_FACTOR**-2), mean @ vectors
            shifted_means = np.where(information > 0, means * freed_variance / spectrum, means)
            scores = shifted_means + (centred @ vectors) * np.sqrt(freed_variance / spectrum)
            slope = vectors / spectrum @ vectors.T @ centred.T @ (y - y.mean(axis=0)) / len(centred)
            quantity[has_pattern] = y + (scores @ vectors.T - pattern_draws) @ slope
        return quantity


def find_prior_dominance(
    calibration: Calibration,
    values: Float[np.ndarray, "d g"],
    *,
    name: str = "",
    sd: Float[np.ndarray, "g"] | float = 0.0,
    max_inclusion: float = 0.0,
) -> PriorDominance | None:
    """Return the unknowns whose priors determine a quantity more than the readings do, or None.

    Besides `name`, only coefficients with a stated prior (neither flat nor hierarchical) in a slot that a correction
    uses are tested, hence not those of a rig or a thermometer.

    Args:
        calibration: a fit, or an average over structures; an effect is tested on the draws that include it.
        values: draws of the quantity at several points; the point with the largest prior share decides.
        name: name of the unknown, if the quantity is an unknown.
        sd: standard deviation of single readings about the quantity, at each point.
        max_inclusion: effects up to this inclusion probability are ignored.
    """
    unknown = next((u for u in calibration.unknowns if u.name == name), None)
    if unknown is not None and unknown.prior is not None:
        # A positive unknown is measured if its variance is halved on a linear scale (near zero) or a logarithmic one.
        samples, prior_sd = calibration.samples(name), unknown.prior_sd
        is_halved = prior_sd is not None and 2 * samples.var() <= prior_sd**2
        v = calibration.draws().v[:, unknown.v]
        if is_halved or 2 * np.var(v) <= unknown.prior.coordinate_variance:
            return None
        prior_words = _format_unknown(unknown, samples)
        return PriorDominance((name,), prior_words, "To measure it, take more readings", True)
    candidates = list[tuple[Unknown, np.ndarray, float]]()
    shares, is_counted = list[np.ndarray](), list[bool]()
    total_variance = values.var(axis=0) + sd**2
    for u, c, is_used in _list_priors(calibration):
        has_effect = calibration.inclusion_masks[u.effect]
        if has_effect.mean() <= max_inclusion:
            continue
        samples, quantity = calibration.samples(u.name)[has_effect], values[has_effect]
        covariance = (samples - samples.mean()) @ (quantity - quantity.mean(axis=0)) / len(samples)
        prior_share = has_effect.mean() * (covariance / c.size) ** 2
        shares.append(prior_share / np.where(total_variance > 0, total_variance, np.inf))
        candidates.append((u, samples, c.size))
        is_counted.append(is_used or u.name == name)
    if not any(is_counted):
        return None
    shares_at_points = np.array(shares)
    worst_shares = shares_at_points[:, int(np.argmax(shares_at_points[is_counted].sum(axis=0)))]
    if worst_shares[is_counted].sum() <= 0.5:  # readings contribute more than priors
        return None
    indices = np.flatnonzero(worst_shares >= min(CONCERNED_SHARE, worst_shares[is_counted].max()))
    indices = sorted(indices, key=lambda i: (not is_counted[i], -worst_shares[i]))
    samples, remedy = [candidates[i] for i in indices if is_counted[i]], "more readings"
    blocks = (u.block for u, *_ in samples)
    if columns := dict.fromkeys(c for block in blocks if block for c in block.effect.columns):
        remedy = f"readings over a wider range of {' and '.join(columns)}"
    elif len(indices) > 1:
        remedy = f"readings that separate {' and '.join(candidates[i][0].name for i in indices)}"
    texts = (_format_unknown(u, x, f", prior ± {number(size)}") for u, x, size in samples)
    names = tuple(u.name for u, *_ in samples)
    return PriorDominance(names, " and ".join(texts), f"To measure it, take {remedy}")


def _format_unknown(u: Unknown, draws: Float[np.ndarray, "d"], suffix: str = "") -> str:
    """Format an unknown's name, mean ± standard deviation and unit."""
    value = f"{format_value(float(draws.mean()), float(draws.std()))} {unit_label(u.unit)}".rstrip()
    return f"{u.name} ({value}{suffix})"


def find_prior_dominated_coefficients(calibration: Calibration) -> set[str]:
    """Return the names of the coefficients that priors determine more than the readings."""
    names, samples = (u.name for u, *_ in _list_priors(calibration)), calibration.samples
    return {n for n in names if find_prior_dominance(calibration, samples(n)[:, None], name=n)}


def _list_priors(calibration: Calibration) -> Iterator[tuple[Unknown, Coefficient, bool]]:
    """Yield coefficients with a stated prior, neither flat nor hierarchical, and whether a correction uses them."""
    instrument = calibration.model.instrument
    slots = {s.name for s in instrument.slots}
    if instrument.vector is not None:
        slots -= {*instrument.vector.rig}
    elif instrument.use is not None and instrument.use.slots:
        slots = {*instrument.use.slots}
    for u in calibration.unknowns:
        # `held` unknowns are excluded: the temperature of a body and the coefficient of the dependence on it.
        if u.block is not None and not u.held and u.prior_sd is not None:
            yield u, u.block.coefficient, u.block.slot in slots
