"""All that is computed of the pairs: every pair under every criterion, draw by draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import Devices

Array = NDArray[np.float64]


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
