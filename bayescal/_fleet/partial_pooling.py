"""A population put to the devices that it was learned from: each moves toward it by what its readings leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayescal._core.errors import ModelError
from bayescal._fleet.device_result import BatchPart
from bayescal._fleet.population import FEWEST, Named, Population, pool


def pooled(
    parts: list[BatchPart], ok: np.ndarray, named: Named, seed: int
) -> tuple[list[BatchPart], Population]:
    """Learn the population from all devices that can be trusted, and put it to each of them.

    Raises:
        ModelError: fewer than three of them.
    """
    good = [ok[part.devices] for part in parts]
    if (count := int(sum(g.sum() for g in good))) < FEWEST:
        raise ModelError(
            f"a population is learned from at least {FEWEST} devices that converge; here {count} did"
        )
    # Of unknowns that differ from part to part, the named ones alone take part; the others of a part follow there.
    own = [_named_in(part, named) for part in parts]
    mean = np.concatenate([p.mean[g][:, i] for p, g, i in zip(parts, good, own, strict=True)])
    covariance = np.concatenate(
        [p.covariance[g][:, i[:, None], i] for p, g, i in zip(parts, good, own, strict=True)]
    )
    learned = pool(mean, covariance, named, seed)
    changed, begin = [], 0
    for part, g, i in zip(parts, good, own, strict=True):
        some = slice(begin, begin + int(g.sum()))
        begin = some.stop
        new_mean, new_covariance = part.mean.copy(), part.covariance.copy()
        moved = _follow(part, g, i, learned.mean[some], learned.covariance[some])
        new_mean[g], new_covariance[g] = moved
        changed.append(replace(part, mean=new_mean, covariance=new_covariance))
    return changed, learned.population


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
