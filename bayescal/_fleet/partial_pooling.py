"""A population put to the devices that it was learned from: each moves toward it by what its readings leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayescal._core.errors import ModelError
from bayescal._fleet.device_result import BatchPart
from bayescal._fleet.population import FEWEST, Named, Population, pool


def pooled(
    parts: Sequence[BatchPart], ok: np.ndarray, named: Named, seed: int
) -> tuple[list[BatchPart], Population]:
    """Learn the population from all devices that can be trusted, and put it to each of them.

    Raises:
        ModelError: fewer than three of them.
    """
    mean, covariance = summed_up(parts, ok, named)
    if len(mean) < FEWEST:
        raise ModelError(
            f"a population is learned from at least {FEWEST} devices that converge; here {len(mean)} did"
        )
    learned = pool(mean, covariance, named, seed)
    return put_to(parts, ok, named, learned.mean, learned.covariance), learned.population


def summed_up(
    parts: Sequence[BatchPart], ok: np.ndarray, named: Named
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the named coefficients of the devices that can be trusted, part by part."""
    # Of unknowns that differ from part to part, the named ones alone take part; the others of a part follow there.
    some = [(part, ok[part.devices], _named_in(part, named)) for part in parts]
    k = len(named)
    mean = [part.mean[good][:, of] for part, good, of in some]
    covariance = [part.covariance[good][:, of[:, None], of] for part, good, of in some]
    return np.concatenate([np.zeros((0, k)), *mean]), np.concatenate(
        [np.zeros((0, k, k)), *covariance]
    )


def put_to(
    parts: Sequence[BatchPart],
    ok: np.ndarray,
    named: Named,
    mean: np.ndarray,
    covariance: np.ndarray,
) -> list[BatchPart]:
    """The parts, where the named coefficients of trusted devices, part by part, have a new mean and covariance."""
    changed, begin = [], 0
    for part in parts:
        good, of = ok[part.devices], _named_in(part, named)
        some = slice(begin, begin + int(good.sum()))
        begin = some.stop
        new_mean, new_covariance = part.mean.copy(), part.covariance.copy()
        new_mean[good], new_covariance[good] = _follow(part, good, of, mean[some], covariance[some])
        changed.append(replace(part, mean=new_mean, covariance=new_covariance))
    return changed


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
