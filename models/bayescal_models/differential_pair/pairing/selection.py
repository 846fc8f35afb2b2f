"""Which outer and which inner device make the differential pair, with probabilities (source 3, step 1).

Each joint draw of the calibration has a best pair under each criterion; how often a pair is the best is its
probability of being so. The expected loss of choosing a pair is what its residual exceeds that of the best by, on
average: physical, in µg, because the ratio criterion has no finite mean. The best set of disjoint pairs comes from
the assignment problem (scipy.optimize.linear_sum_assignment).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

import bayescal as bc
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import Devices, devices_of
from bayescal_models.differential_pair.pairing.pair_table import Pair, PairTable, Ratio, remarks

CRITERIA = ("residual", "ratio-variance", "ratio-variance-raw")
Array = NDArray[np.float64]
SURE = 3.0  # standard deviations from zero, below which a ratio's denominator is said to be near it


def select(found: bc.Calibration | Devices, *, criterion: str = "residual") -> PairTable:
    """Judge every pair.

    Args:
        found: a calibration of a batch, or its devices.
        criterion: that orders the pairs and names the best: "residual", "ratio-variance" (of what is left when
            the commanded part is removed), "ratio-variance-raw" (of the records as source 3 prints it).

    Raises:
        InputError: the readings cannot be paired, or an unknown criterion.
    """
    if criterion not in CRITERIA:
        raise bc.InputError(
            f"criterion {criterion!r} is not one of {', '.join(CRITERIA)}: choose one"
        )
    devices = found if isinstance(found, Devices) else devices_of(found)
    figures = judge(devices)
    places = np.ndindex(figures.calibrated.shape)
    made = sorted(
        (_pair(devices, figures, i, j) for i, j in places), key=lambda p: _rank(p, criterion)
    )
    matching = _matching(devices, figures, criterion)
    said = remarks(made, devices.commanded)
    return PairTable(tuple(made), made[0].names, matching, criterion, remarks=said)


@dataclass(frozen=True)
class Figures:
    """All that is computed of the pairs; arrays (outer, inner) unless said otherwise.

    Attributes:
        ratios: draws of λbd, (d, outer, inner).
        calibrated: posterior medians of λbd.
        residual: draws, µg, (d, outer, inner).
        probability: of being the best, by criterion.
        expected, loss: of the residual, µg.
        document: variances of ratios from the records as they are: "ratio-variance" and "ratio-variance-raw".
        denominators: posterior mean of each inner coefficient over its standard deviation, (inner, 4).
        step2: the document's λbd.
        step2_sure: mean over standard deviation of its denominators, (inner,).
    """

    ratios: Array
    calibrated: Array
    residual: Array
    probability: dict[str, Array]
    expected: Array
    loss: Array
    document: dict[str, Array]
    denominators: Array
    step2: Array
    step2_sure: Array


def judge(devices: Devices) -> Figures:
    """Every pair under every criterion, draw by draw."""
    outer, weights, time = devices.outer, devices.weights, devices.time
    ratios = devices.sensitivity[:, :outer, None] / devices.sensitivity[:, None, outer:]
    calibrated = criteria.median(ratios, weights)
    left = criteria.residual(devices.environment, devices.scale, calibrated)
    of_environment = criteria.polynomial(time, devices.environment)
    moved = devices.scale - weights @ devices.scale  # of the commanded part, draw by draw
    of_known = criteria.polynomial(time, devices.known)
    of_commanded = criteria.polynomial(time, devices.commanded)
    raw = of_known + (devices.sign * moved)[..., None] * of_commanded + of_environment
    removed = devices.records - devices.known
    measures = {
        "residual": left,
        "ratio-variance": criteria.ratio_variance(of_environment, outer),
        "ratio-variance-raw": criteria.ratio_variance(raw, outer),
    }
    below = of_environment[:, outer:]
    mean = np.einsum("d,dki->ki", weights, below)
    spread = np.sqrt(np.einsum("d,dki->ki", weights, (below - mean) ** 2))
    total = devices.environment[:, outer:].mean(axis=-1)
    middle = weights @ total
    width = np.sqrt(weights @ (total - middle) ** 2)
    expected = np.einsum("d,dij->ij", weights, left)
    least = np.min(left, axis=(1, 2))
    return Figures(
        ratios=ratios,
        calibrated=calibrated,
        residual=left,
        probability={name: _share_best(values, weights) for name, values in measures.items()},
        expected=expected,
        loss=expected - weights @ least,
        document={
            name: criteria.ratio_variance(criteria.polynomial(time, records), outer)
            for name, records in (
                ("ratio-variance", removed),
                ("ratio-variance-raw", devices.records),
            )
        },
        denominators=mean / np.maximum(spread, 1e-300),
        step2=criteria.document_ratio(removed, outer),
        step2_sure=middle / np.maximum(width, 1e-300),
    )


def _share_best(values: Array, weights: Array) -> Array:
    """How often each pair has the least value, (outer, inner)."""
    shape = values.shape[1:]
    least = np.argmin(values.reshape(len(values), -1), axis=1)
    found = np.bincount(least, weights, minlength=shape[0] * shape[1])
    return np.asarray(found, dtype=float).reshape(shape)


def _rank(pair: Pair, criterion: str) -> tuple[float, float]:
    if criterion == "residual":
        return (pair.expected_residual, 0.0)
    raw = criterion == "ratio-variance-raw"
    share = pair.probability_ratio_variance_raw if raw else pair.probability_ratio_variance
    return (-share, pair.ratio_variance_raw if raw else pair.ratio_variance)


def _pair(devices: Devices, figures: Figures, i: int, j: int) -> Pair:
    draws, weights = figures.ratios[:, i, j], devices.weights
    q = [float(criteria.quantile(draws, weights, p)) for p in (0.025, 0.1587, 0.8413, 0.975)]
    ratio = Ratio(
        float(figures.calibrated[i, j]),
        low=q[0],
        high=q[3],
        sd=0.5 * (q[2] - q[1]),
        document=float(figures.step2[i, j]),
        document_reliable=bool(abs(figures.step2_sure[j]) > SURE),
    )
    near = tuple(int(n) for n in np.flatnonzero(np.abs(figures.denominators[j]) < SURE))
    measured = {f"probability_{n}": share for n, share in figures.probability.items()}
    measured |= figures.document
    measured |= {"expected_residual": figures.expected, "expected_loss": figures.loss}
    return Pair(
        devices.names[i],
        devices.names[devices.outer + j],
        **{n.replace("-", "_"): float(values[i, j]) for n, values in measured.items()},
        near_zero=near,
        ratio=ratio,
    )


def _matching(devices: Devices, figures: Figures, criterion: str) -> tuple[tuple[str, str], ...]:
    """Disjoint pairs of the least total residual, or of the greatest total probability."""
    residual = criterion == "residual"
    cost = figures.expected if residual else -figures.probability[criterion]
    rows, columns = linear_sum_assignment(cost)
    chosen = sorted(zip(rows, columns, strict=True), key=lambda at: cost[at])
    return tuple((devices.names[i], devices.names[devices.outer + j]) for i, j in chosen)
