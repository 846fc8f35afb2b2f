"""Which outer and which inner device make the differential pair, with probabilities (source 3, step 1).

Each joint draw of the calibration has a best pair under each criterion; how often a pair is the best is its
probability of being so. The expected loss of choosing a pair is what its residual exceeds that of the best by, on
average: physical, in µg, because the ratio criterion has no finite mean. The best set of disjoint pairs comes from
the assignment problem (scipy.optimize.linear_sum_assignment).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

import bayescal as bc
from bayescal_models.differential_pair import criteria
from bayescal_models.differential_pair.devices import Devices, devices_of

Array = NDArray[np.float64]

UNIT = "ug"
CRITERIA = ("residual", "ratio-variance", "ratio-variance-raw")
SURE = 3.0  # standard deviations from zero, below which a ratio's denominator is said to be near it


@dataclass(frozen=True)
class Ratio:
    """λbd = λ1d/λ2d of a pair.

    Attributes:
        median, low, high: of the posterior, with the limits of its 95 % credible interval.
        sd: of the posterior; a robust one, (q84 − q16)/2, because a ratio need not have a variance.
        document: the estimator of source 3, step 2.
        document_reliable: whether its denominator Σu is away from zero.
    """

    median: float
    low: float
    high: float
    sd: float
    document: float
    document_reliable: bool


@dataclass(frozen=True)
class Pair:
    """An outer and an inner device.

    Attributes:
        outer, inner: names.
        probability_residual: of leaving the least residual.
        probability_ratio_variance: of the least variance of ratios, commanded part removed.
        probability_ratio_variance_raw: the same on raw records.
        expected_residual: posterior mean, µg.
        expected_loss: expected residual beyond that of the best pair, µg.
        ratio_variance, ratio_variance_raw: the document's own figures, from the records as they are.
        near_zero: orders whose denominator, the inner device's coefficient, is near zero.
        ratio: λbd.
    """

    outer: str
    inner: str
    probability_residual: float
    probability_ratio_variance: float
    probability_ratio_variance_raw: float
    expected_residual: float
    expected_loss: float
    ratio_variance: float
    ratio_variance_raw: float
    near_zero: tuple[int, ...]
    ratio: Ratio


@dataclass(frozen=True)
class PairTable:
    """Every pair, the best of them, and the best disjoint set; prints itself.

    Attributes:
        pairs: the best first, by the criterion.
        best: outer and inner name.
        matching: the best set of disjoint pairs.
        criterion: by which.
        remarks: what to know of this choice, a sentence each.
    """

    pairs: tuple[Pair, ...]
    best: tuple[str, str]
    matching: tuple[tuple[str, str], ...]
    criterion: str
    remarks: tuple[str, ...]

    def of(self, outer: str, inner: str) -> Pair:
        """A pair by its names.

        Raises:
            InputError: there is no such pair.
        """
        for pair in self.pairs:
            if (pair.outer, pair.inner) == (outer, inner):
                return pair
        raise bc.InputError(f"there is no pair of {outer!r} and {inner!r}")

    def data(self) -> dict[str, Any]:
        """Plain JSON."""
        return {
            "criterion": self.criterion,
            "pairs": [_pair_data(pair) for pair in self.pairs],
            "best": list(self.best),
            "matching": [list(pair) for pair in self.matching],
            "environment_ratio": vars(self.of(*self.best).ratio),
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        from bayescal_models.differential_pair.text import table_text  # it needs this module

        return table_text(self)


def _pair_data(pair: Pair) -> dict[str, Any]:
    def plain(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "outer": pair.outer,
        "inner": pair.inner,
        "probability_residual": pair.probability_residual,
        "probability_ratio_variance": pair.probability_ratio_variance,
        "probability_ratio_variance_raw": pair.probability_ratio_variance_raw,
        "expected_residual": pair.expected_residual,
        "expected_loss": pair.expected_loss,
        "unit": UNIT,
        "ratio_variance": plain(pair.ratio_variance),
        "ratio_variance_raw": plain(pair.ratio_variance_raw),
        "orders_near_zero": list(pair.near_zero),
        "environment_ratio": vars(pair.ratio),
    }


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
    made = [
        _pair(devices, figures, i, j)
        for i in range(devices.outer)
        for j in range(len(devices.names) - devices.outer)
    ]
    made.sort(key=lambda p: _rank(p, criterion))
    table = PairTable(
        tuple(made),
        (made[0].outer, made[0].inner),
        _matching(devices, figures, criterion),
        criterion,
        (),
    )
    from bayescal_models.differential_pair.text import remarks  # sentences stand apart

    return PairTable(
        table.pairs, table.best, table.matching, criterion, remarks(table, devices.commanded)
    )


def _rank(pair: Pair, criterion: str) -> tuple[float, float]:
    if criterion == "residual":
        return (pair.expected_residual, 0.0)
    raw = criterion == "ratio-variance-raw"
    share = pair.probability_ratio_variance_raw if raw else pair.probability_ratio_variance
    return (-share, pair.ratio_variance_raw if raw else pair.ratio_variance)


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
        ratios,
        calibrated,
        left,
        {name: _share_best(values, weights) for name, values in measures.items()},
        expected,
        expected - weights @ least,
        {
            "ratio-variance": criteria.ratio_variance(criteria.polynomial(time, removed), outer),
            "ratio-variance-raw": criteria.ratio_variance(
                criteria.polynomial(time, devices.records), outer
            ),
        },
        mean / np.maximum(spread, 1e-300),
        criteria.document_ratio(removed, outer),
        middle / np.maximum(width, 1e-300),
    )


def _share_best(values: Array, weights: Array) -> Array:
    """How often each pair has the least value, (outer, inner)."""
    shape = values.shape[1:]
    least = np.argmin(values.reshape(len(values), -1), axis=1)
    return np.bincount(least, weights, minlength=shape[0] * shape[1]).reshape(shape)


def _pair(devices: Devices, figures: Figures, i: int, j: int) -> Pair:
    draws, weights = figures.ratios[:, i, j], devices.weights
    q = [float(criteria.quantile(draws, weights, p)) for p in (0.025, 0.1587, 0.8413, 0.975)]
    ratio = Ratio(
        float(figures.calibrated[i, j]),
        q[0],
        q[3],
        0.5 * (q[2] - q[1]),
        float(figures.step2[i, j]),
        bool(abs(figures.step2_sure[j]) > SURE),
    )
    near = tuple(int(n) for n in np.flatnonzero(np.abs(figures.denominators[j]) < SURE))
    return Pair(
        devices.names[i],
        devices.names[devices.outer + j],
        *(
            float(figures.probability[name][i, j])
            for name in ("residual", "ratio-variance", "ratio-variance-raw")
        ),
        float(figures.expected[i, j]),
        float(figures.loss[i, j]),
        float(figures.document["ratio-variance"][i, j]),
        float(figures.document["ratio-variance-raw"][i, j]),
        near,
        ratio,
    )


def _matching(devices: Devices, figures: Figures, criterion: str) -> tuple[tuple[str, str], ...]:
    """Disjoint pairs of the least total residual, or of the greatest total probability."""
    residual = criterion == "residual"
    cost = figures.expected if residual else -figures.probability[criterion]
    rows, columns = linear_sum_assignment(cost)
    chosen = sorted(zip(rows, columns, strict=True), key=lambda at: cost[at])
    return tuple((devices.names[i], devices.names[devices.outer + j]) for i, j in chosen)
