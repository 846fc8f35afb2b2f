"""Selection of the outer and inner device of a differential pair, with probabilities (source 3, step 1).

Each joint draw of the calibration has a best pair under each criterion; the fraction of draws in which a pair is best
is its probability. The expected loss of a pair is the mean excess of its residual over that of the best pair,
in µg, because the ratio criterion has no finite mean. The best set of disjoint pairs comes from
the assignment problem (scipy.optimize.linear_sum_assignment).
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

import bayescal as bc
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import Devices, devices_of
from bayescal_models.differential_pair.pairing.pair_table import Pair, PairTable, Ratio, remarks

CRITERIA = ("residual", "ratio-variance", "ratio-variance-raw")
Array = NDArray[np.float64]
SURE = 3.0  # standard deviations from zero below which a ratio's denominator counts as near zero


def select(found: bc.Calibration | Devices, *, criterion: str = "residual") -> PairTable:
    """Evaluate and rank all pairs.

    Args:
        found: a calibration of a batch, or its devices.
        criterion: criterion of the ranking: "residual", "ratio-variance" (with the commanded part removed), or
            "ratio-variance-raw" (of the records, as in source 3).

    Raises:
        InputError: the readings cannot be paired, or an unknown criterion.
    """
    if criterion not in CRITERIA:
        raise bc.InputError(f"criterion {criterion!r} is not one of {', '.join(CRITERIA)}")
    devices = found if isinstance(found, Devices) else devices_of(found)
    figures = judge(devices)
    places = np.ndindex(figures.residual.shape[1:])
    ranked = sorted((_pair(devices, figures, *at) for at in places), key=partial(_rank, criterion))
    return PairTable(
        tuple(ranked),
        ranked[0].names,
        _matching(devices, figures, criterion),
        criterion,
        remarks=remarks(ranked, devices.commanded),
    )


class Figures(NamedTuple):
    """Values of the criteria for all pairs."""

    # of_pair, of_ratio: fields of `Pair` and of `Ratio` by name, (outer, inner)
    of_pair: dict[str, Array]
    of_ratio: dict[str, Array]
    residual: Array  # draws, µg, (d, outer, inner)
    near_zero: Array  # whether the denominator of an order is near zero, (inner, 4)


def judge(devices: Devices) -> Figures:
    """Evaluate every pair under every criterion, draw by draw."""
    outer, time = devices.outer, devices.time
    ratios = devices.sensitivity[:, :outer, None] / devices.sensitivity[:, None, outer:]
    median = np.median(ratios, axis=0)
    residual = criteria.residual(devices.environment, devices.scale, median)
    of_environment = criteria.polynomial(time, devices.environment)
    deviation = devices.scale - devices.scale.mean(axis=0)  # of the commanded part, draw by draw
    of_known = criteria.polynomial(time, devices.known)
    of_commanded = criteria.polynomial(time, devices.commanded)
    raw = of_known + (devices.sign * deviation)[..., None] * of_commanded + of_environment
    removed = devices.records - devices.known
    of_pair = {
        "probability_residual": _share_best(residual),
        "expected_residual": residual.mean(axis=0),
        "expected_loss": residual.mean(axis=0) - residual.min(axis=(1, 2)).mean(),
    }
    for name, draws, records in (
        ("ratio_variance", of_environment, removed),
        ("ratio_variance_raw", raw, devices.records),
    ):
        of_pair[f"probability_{name}"] = _share_best(criteria.ratio_variance(draws, outer))
        of_pair[name] = criteria.ratio_variance(criteria.polynomial(time, records), outer)
    low, lower, upper, high = np.quantile(ratios, (0.025, 0.1587, 0.8413, 0.975), axis=0)
    near = _near_zero(devices.environment[:, outer:].mean(axis=-1))
    of_ratio = {
        "median": median,
        "low": low,
        "high": high,
        "sd": 0.5 * (upper - lower),
        "document": criteria.document_ratio(removed, outer),
        "document_reliable": np.broadcast_to(np.logical_not(near), median.shape),
    }
    return Figures(of_pair, of_ratio, residual, near_zero=_near_zero(of_environment[:, outer:]))


def _near_zero(draws: Array) -> Array:
    """Return whether denominators are near zero, from their draws (d, …)."""
    return np.abs(draws.mean(axis=0)) < SURE * draws.std(axis=0)


def _share_best(values: Array) -> Array:
    """Return the fraction of draws in which each pair has the smallest value, (outer, inner)."""
    count, *shape = values.shape
    least = np.argmin(values.reshape(count, -1), axis=1)
    return np.bincount(least, minlength=math.prod(shape)).reshape(shape) / count


def _rank(criterion: str, pair: Pair) -> tuple[float, float]:
    if criterion == "residual":
        return (pair.expected_residual, 0.0)
    name = criterion.replace("-", "_")
    return (-getattr(pair, f"probability_{name}"), getattr(pair, name))


def _pair(devices: Devices, figures: Figures, i: int, j: int) -> Pair:
    return Pair(
        devices.names[i],
        devices.names[devices.outer + j],
        **{name: float(values[i, j]) for name, values in figures.of_pair.items()},
        orders_near_zero=tuple(np.flatnonzero(figures.near_zero[j]).tolist()),
        environment_ratio=Ratio(
            **{name: values[i, j].item() for name, values in figures.of_ratio.items()}
        ),
    )


def _matching(devices: Devices, figures: Figures, criterion: str) -> tuple[tuple[str, str], ...]:
    """Find the disjoint pairs with the smallest total residual, or the largest total probability."""
    share = figures.of_pair[f"probability_{criterion.replace('-', '_')}"]
    cost = figures.of_pair["expected_residual"] if criterion == "residual" else -share
    rows, columns = linear_sum_assignment(cost)
    chosen = sorted(zip(rows, columns, strict=True), key=lambda at: cost[at])
    return tuple((devices.names[i], devices.names[devices.outer + j]) for i, j in chosen)
