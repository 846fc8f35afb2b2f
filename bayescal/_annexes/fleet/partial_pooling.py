"""A population put to the devices that it was learned from: each moves toward it by what its readings leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayescal._annexes.fleet.batch_result import BatchPart, BatchResult
from bayescal._annexes.fleet.population import (
    DeviceEstimates,
    Learned,
    Named,
    estimates,
    learn,
)


def pooled(result: BatchResult, named: Named, seed: int) -> BatchResult:
    """The result under the population that is learned from all its devices that are reliable.

    Raises:
        ModelError: fewer than three of them.
    """
    own = _estimates_of(result, named)
    return _under_population(result, own, named, learn(own, named, seed))


def _estimates_of(result: BatchResult, named: Named) -> DeviceEstimates:
    """What the readings alone say of the named coefficients of the reliable devices, part by part."""
    k = len(named)
    mean, covariance = [np.zeros((0, k))], [np.zeros((0, k, k))]
    for part in result.parts:
        good, of = result.ok[part.devices], _named_in(part, named)
        mean.append(part.mean[good][:, of])
        covariance.append(part.covariance[good][:, of[:, None], of])
    return estimates(np.concatenate(mean), np.concatenate(covariance), named)


def _under_population(
    result: BatchResult, own: DeviceEstimates, named: Named, learned: Learned
) -> BatchResult:
    """The result, where the named coefficients of its reliable devices have their moments under the population."""
    moments, changed, begin = learned.moments(own), [], 0
    for part in result.parts:
        good = result.ok[part.devices]
        some = slice(begin, begin + int(good.sum()))
        begin = some.stop
        mean, covariance = part.mean.copy(), part.covariance.copy()
        new = moments.mean[some], moments.covariance[some]
        mean[good], covariance[good] = _follow(part, good, _named_in(part, named), *new)
        changed.append(replace(part, mean=mean, covariance=covariance))
    return replace(result, parts=tuple(changed), population=learned.population)


def _named_in(part: BatchPart, named: Named) -> np.ndarray:
    return np.array([part.names.index(name) for name in named])


def _follow(
    part: BatchPart, good: np.ndarray, of: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """All unknowns of some devices, where the named ones have a new mean and covariance: by regression on them."""
    old_mean, old = part.mean[good], part.covariance[good]
    moving = np.isfinite(np.diagonal(old, axis1=1, axis2=2)).all(axis=0)
    rest = np.flatnonzero(moving)
    inner = old[:, of[:, None], of]
    gain = old[:, rest[:, None], of] @ np.linalg.inv(inner)
    new_mean, new = old_mean.copy(), old.copy()
    new_mean[:, rest] += np.einsum("bqk,bk->bq", gain, mean - old_mean[:, of])
    change = gain @ (covariance - inner) @ np.swapaxes(gain, 1, 2)
    new[:, rest[:, None], rest] += change
    return new_mean, new
