"""Selection of the outer and inner device of a differential pair, with probabilities (source 3, step 1).

In each joint posterior draw one pair is best under a criterion; the fraction of draws in which a pair is best is its
probability. The expected loss of a pair is the mean excess of its residual over that of the draw's best pair, µg (the
ratio variance has no finite mean). The best set of disjoint pairs solves the assignment problem
(scipy.optimize.linear_sum_assignment).
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

import bayescal as bc
from bayescal_models.differential_pair.pairing import criteria, pair_table
from bayescal_models.differential_pair.pairing.devices import Devices, devices_of
from bayescal_models.differential_pair.pairing.pair_table import Pair, PairTable, Ratio

CRITERIA = ("residual", "ratio-variance", "ratio-variance-raw")
Array = NDArray[np.float64]
NEAR_ZERO_SDS = 3.0  # sds from zero, below which a ratio's denominator counts as near zero


def select(batch: bc.Calibration | Devices, *, criterion: str = "residual") -> PairTable:
    """Evaluate all pairs of an outer and an inner device, and rank them by a criterion.

    Args:
        batch: calibration of a batch, or its devices.
        criterion: ranking criterion (equations: `pairing.criteria`): "residual", the expected rms of the environment
            that remains in a pair's measurement; "ratio-variance", the probability of the smallest ratio variance
            without the commanded acceleration; "ratio-variance-raw", the same for raw records.

    Raises:
        InputError: the readings cannot be paired, or an unknown criterion.
    """
    if criterion not in CRITERIA:
        raise bc.InputError(f"criterion {criterion!r} is not one of {', '.join(CRITERIA)}")
    devices = batch if isinstance(batch, Devices) else devices_of(batch)
    scores = evaluate_pairs(devices)
    indices = np.ndindex(scores.residual.shape[1:])
    ranked_pairs = sorted(
        (_build_pair(devices, scores, *at) for at in indices), key=partial(_rank, criterion)
    )
    return PairTable(
        tuple(ranked_pairs),
        ranked_pairs[0].names,
        _match_pairs(devices, scores, criterion),
        criterion,
        remarks=pair_table.list_remarks(ranked_pairs, devices.commanded),
    )


class Scores(NamedTuple):
    """Criteria of all pairs: fields of `Pair` and of `Ratio` by name, (outer, inner)."""

    pair_fields: dict[str, Array]
    ratio_fields: dict[str, Array]
    residual: Array  # posterior draws, µg, (d, outer, inner)
    near_zero: Array  # whether the denominator of an order is near zero, (inner, 4)


def evaluate_pairs(devices: Devices) -> Scores:
    """Evaluate the criteria of all pairs in every posterior draw; return probabilities, means and quantiles."""
    outer, time = devices.outer, devices.time
    ratios = devices.sensitivity[:, :outer, None] / devices.sensitivity[:, None, outer:]
    median = np.median(ratios, axis=0)
    residual = criteria.compute_residual_rms(devices.environment, devices.scale, median)
    env_terms = criteria.fit_polynomial(time, devices.environment)
    scale_deviation = devices.scale - devices.scale.mean(axis=0)  # between draws
    known_terms = criteria.fit_polynomial(time, devices.known)
    commanded_terms = criteria.fit_polynomial(time, devices.commanded)
    scale_terms = (devices.sign * scale_deviation)[..., None] * commanded_terms
    env_records = devices.records - devices.known
    pair_fields = {
        "probability_smallest_residual": _compute_best_fraction(residual),
        "expected_residual": residual.mean(axis=0),
        "expected_loss": residual.mean(axis=0) - residual.min(axis=(1, 2)).mean(),
    }
    for name, draws, records in (
        ("ratio_variance", env_terms, env_records),
        ("ratio_variance_raw", known_terms + scale_terms + env_terms, devices.records),
    ):
        pair_fields[f"probability_smallest_{name}"] = _compute_best_fraction(
            criteria.ratio_variance(draws, outer)
        )
        pair_fields[name] = criteria.ratio_variance(criteria.fit_polynomial(time, records), outer)
    q025, q16, q84, q975 = np.quantile(ratios, (0.025, 0.1587, 0.8413, 0.975), axis=0)
    has_small_sum = _is_near_zero(devices.environment[:, outer:].mean(axis=-1))
    ratio_fields = {
        "median": median,
        "low": q025,
        "high": q975,
        "sd": 0.5 * (q84 - q16),
        "document": criteria.compute_ratio_of_sums(env_records, outer),
        "document_reliable": np.broadcast_to(np.logical_not(has_small_sum), median.shape),
    }
    return Scores(pair_fields, ratio_fields, residual, _is_near_zero(env_terms[:, outer:]))


def _is_near_zero(draws: Array) -> Array:
    """Return whether posterior means are near zero relative to the posterior sds, from draws (d, …)."""
    return np.abs(draws.mean(axis=0)) < NEAR_ZERO_SDS * draws.std(axis=0)


def _compute_best_fraction(values: Array) -> Array:
    """Return the fraction of draws in which each pair has the smallest value, (outer, inner)."""
    count, *shape = values.shape
    best_index = np.argmin(values.reshape(count, -1), axis=1)
    return np.bincount(best_index, minlength=math.prod(shape)).reshape(shape) / count


def _rank(criterion: str, pair: Pair) -> tuple[float, float]:
    if criterion == "residual":
        return (pair.expected_residual, 0.0)
    name = criterion.replace("-", "_")
    return (-getattr(pair, f"probability_smallest_{name}"), getattr(pair, name))


def _build_pair(devices: Devices, scores: Scores, i: int, j: int) -> Pair:
    return Pair(
        devices.names[i],
        devices.names[devices.outer + j],
        **{name: float(values[i, j]) for name, values in scores.pair_fields.items()},
        orders_near_zero=tuple(np.flatnonzero(scores.near_zero[j]).tolist()),
        environment_ratio=Ratio(
            **{name: values[i, j].item() for name, values in scores.ratio_fields.items()}
        ),
    )


def _match_pairs(devices: Devices, scores: Scores, criterion: str) -> tuple[tuple[str, str], ...]:
    """Return the set of disjoint pairs with the smallest total residual or, by other criteria, largest probability."""
    probability = scores.pair_fields[f"probability_smallest_{criterion.replace('-', '_')}"]
    cost = scores.pair_fields["expected_residual"] if criterion == "residual" else -probability
    outer_indices, inner_indices = linear_sum_assignment(cost)
    matched_pairs = sorted(zip(outer_indices, inner_indices, strict=True), key=lambda at: cost[at])
    return tuple((devices.names[i], devices.names[devices.outer + j]) for i, j in matched_pairs)
