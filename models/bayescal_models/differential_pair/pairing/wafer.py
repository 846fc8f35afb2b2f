"""The best pairs of very many devices: pairs that a bound excludes are never looked at; the answer is the full table's.

The expected residual of a pair is E|a − r·b|/|s₁ + r·s₂| over the draws, with a, b the environments of the two devices
and r their ratio as calibrated. A norm is convex, so that it is at least

    |ā − r·b̄| / (s·(1 + r))  =  |(1 − q)·ā − q·b̄| / s,   q = r/(1 + r),

with posterior means ā and b̄ and s the largest scale of all draws: the distance from the origin to a piece of the
segment from ā to −b̄. r lies between the extremes of its draws. The pairs of the least bounds are computed first, which
gives a limit; then those that are left in the order of their bounds, until no bound is below what was found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import Devices

Array = NDArray[np.float64]
Places = NDArray[np.int64]

AT_ONCE = 500  # pairs whose expected residual is computed at once
KEPT = 500_000  # pairs whose bounds are held at once


@dataclass(frozen=True)
class Wafer:
    """Joint draws of many devices, outer ones first, environments in an orthonormal basis of the record.

    Attributes:
        names: of the devices, (K,).
        outer: number of outer devices.
        weights: of the draws, adding up to one, (d,).
        scale, sensitivity: (d, K); positive.
        environment: µg, (d, K, m), such that the rms over the record is the norm over m.
    """

    names: tuple[str, ...]
    outer: int
    weights: Array
    scale: Array
    sensitivity: Array
    environment: Array

    @classmethod
    def of(cls, devices: Devices) -> Wafer:
        """The devices of a calibration: their environments lie in the span of a few polynomials."""
        flat = devices.environment.reshape(-1, devices.environment.shape[-1])
        _, size, axes = np.linalg.svd(flat, full_matrices=False)
        image = flat @ axes[size > 1e-12 * size[0]].T / np.sqrt(flat.shape[1])
        kept = {n: getattr(devices, n) for n in ("weights", "scale", "sensitivity")}
        image = image.reshape(*devices.environment.shape[:2], -1)
        return cls(devices.names, devices.outer, **kept, environment=image)


@dataclass(frozen=True)
class WaferPairs:
    """The pairs of least expected residual, and what excluded the others.

    Attributes:
        pairs: (outer, inner, expected residual, µg, environment ratio), the best first.
        bounded: pairs excluded by their bound.
        evaluated: pairs whose expected residual was computed.
        least_excluded: least bound of what was excluded, µg: not below the residual of the last pair.
    """

    pairs: tuple[tuple[str, str, float, float], ...]
    bounded: int
    evaluated: int
    least_excluded: float


def best_pairs(wafer: Wafer, count: int = 12) -> WaferPairs:
    """The pairs of least expected residual among all outer and inner devices.

    Raises:
        InputError: a sensitivity or scale that is not positive, or no pair.
    """
    if np.min(wafer.sensitivity) <= 0 or np.min(wafer.scale) <= 0:
        raise bc.InputError(
            "pairs are bounded for positive scales and sensitivities: leave others out"
        )
    inner = len(wafer.names) - wafer.outer
    if not 0 < wafer.outer < len(wafer.names):
        raise bc.InputError("a pair is one outer and one inner device: give both")
    first = np.zeros((0, 2))  # bounds and places of the pairs with the least ones
    for place, bound in _bounds(wafer):
        least = np.argsort(bound, kind="stable")[:AT_ONCE]
        first = np.concatenate([first, np.stack([bound[least], place + least], axis=1)])
        first = first[np.argsort(first[:, 0], kind="stable")][:AT_ONCE]
    chosen = first[:, 1].astype(np.int64)
    found = np.stack([chosen, *expected_residual(wafer, *np.divmod(chosen, inner))], axis=1)
    evaluated, least_excluded = len(found), np.inf
    for place, bound in _bounds(wafer):
        bound[chosen[(chosen >= place) & (chosen < place + len(bound))] - place] = np.nan
        found = found[np.argsort(found[:, 1], kind="stable")][:count]
        order = np.argsort(bound, kind="stable")
        for begin in range(0, len(order), AT_ONCE):
            some = order[begin : begin + AT_ONCE]
            limit = found[-1, 1] if len(found) == count else np.inf
            some = some[bound[some] < limit]
            if not len(some):
                break
            now = place + some
            more = np.stack([now, *expected_residual(wafer, *np.divmod(now, inner))], axis=1)
            found = np.concatenate([found, more])
            found = found[np.argsort(found[:, 1], kind="stable")][:count]
            bound[some] = np.nan  # computed, not excluded
            evaluated += len(some)
        least_excluded = min(least_excluded, float(np.nanmin(bound, initial=np.inf)))
    found = found[np.argsort(found[:, 1], kind="stable")][:count]
    pairs = [
        (wafer.names[int(at) // inner], wafer.names[wafer.outer + int(at) % inner], residual, ratio)
        for at, residual, ratio in found.tolist()
    ]
    return WaferPairs(tuple(pairs), wafer.outer * inner - evaluated, evaluated, least_excluded)


def expected_residual(wafer: Wafer, outer: Places, inner: Places) -> tuple[Array, Array]:
    """Expected residual, µg, and ratio of pairs given by the places of their devices, (pairs,) each."""
    inner = inner + wafer.outer
    ratio = criteria.median(
        wafer.sensitivity[:, outer] / wafer.sensitivity[:, inner], wafer.weights
    )
    left = wafer.environment[:, outer] - ratio[:, None] * wafer.environment[:, inner]
    divisor = wafer.scale[:, outer] + ratio * wafer.scale[:, inner]
    return wafer.weights @ (np.linalg.norm(left, axis=-1) / np.abs(divisor)), ratio


def _bounds(wafer: Wafer) -> Iterator[tuple[int, Array]]:
    """Bounds of all pairs, µg, some outer devices at a time, with the place of the first pair."""
    mean = np.einsum("d,dkm->km", wafer.weights, wafer.environment)
    least, most = wafer.sensitivity.min(axis=0), wafer.sensitivity.max(axis=0)
    below = mean[wafer.outer :]
    other = np.sum(below**2, axis=1)
    rows = max(1, KEPT // len(below))
    for begin in range(0, wafer.outer, rows):
        some = slice(begin, min(begin + rows, wafer.outer))
        above = mean[some]
        low = least[some, None] / most[wafer.outer :]
        high = most[some, None] / least[wafer.outer :]
        own, cross = np.sum(above**2, axis=1)[:, None], above @ below.T
        length = own + 2 * cross + other  # of the segment, squared
        q = np.where(length > 0, (own + cross) / np.where(length > 0, length, 1.0), 0.0)
        q = np.clip(q, low / (1 + low), high / (1 + high))
        square = (1 - q) ** 2 * own - 2 * q * (1 - q) * cross + q**2 * other
        # Rounding of the squares must not exclude: a millionth of the vectors is given away.
        spare = 1e-7 * np.sqrt(own + other)
        distance = np.maximum(np.sqrt(np.maximum(square, 0.0)) - spare, 0.0)
        yield begin * len(below), (distance / wafer.scale.max()).ravel()
