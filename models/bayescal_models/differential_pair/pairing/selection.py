"""Which outer and which inner device make the differential pair, with probabilities (source 3, step 1).

Each joint draw of the calibration has a best pair under each criterion; how often a pair is the best is its
probability of being so. The expected loss of choosing a pair is what its residual exceeds that of the best by, on
average: physical, in µg, because the ratio criterion has no finite mean. The best set of disjoint pairs comes from
the assignment problem (scipy.optimize.linear_sum_assignment).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

import bayescal as bc
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.best_pair_probability import Figures, judge
from bayescal_models.differential_pair.pairing.devices import Devices, devices_of
from bayescal_models.differential_pair.pairing.pair_table import Pair, PairTable, Ratio, remarks

CRITERIA = ("residual", "ratio-variance", "ratio-variance-raw")
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
