"""The worst region of a covariate: where the residuals are most systematically positive or negative."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayescal._calibration import covariate_evidence
from bayescal._calibration.calibration import Calibration
from bayescal._calibration.settings import guarding

BINS = 12  # of a covariate


@dataclass(frozen=True)
class Region:
    """A part of a covariate where the residuals are systematically positive or negative.

    Attributes:
        low, high: of the covariate, in `covariate_unit`.
        group: the run, where it is one run's alone; the member, where the covariate is a group.
        size: mean residual there (weighted by the noise law), output unit.
        z: size over its standard uncertainty.
    """

    low: float
    high: float
    group: str | None
    size: float
    z: float
    covariate_unit: str


@dataclass(frozen=True)
class _Binned:
    """A covariate cut into bins, over all readings or one run's."""

    covariate: int
    group: str | None
    bins: np.ndarray  # (n,), −1 outside
    count: int
    longest: int


def worst_regions(
    calibration: Calibration, covariates: list[covariate_evidence.Covariate]
) -> list[Region]:
    """For each covariate the range of neighbouring bins whose mean residual is worst against its uncertainty.

    Means and uncertainties follow the noise law: under correlated noise a long range counts for less.
    """
    levels, codes = calibration.readings.groups("run")
    cuts: list[_Binned] = []
    for i, block in enumerate(covariates):
        cuts.append(_cut(i, block, np.ones(len(codes), bool), None))
        if len(levels) > 1 and not block.levels:
            for k, level in enumerate(levels):
                if (codes == k).sum() >= guarding().run_region:
                    cuts.append(_cut(i, block, codes == k, level))
    best: dict[int, tuple[float, Region]] = {}
    for cut in cuts:
        indicators = (cut.bins[:, None] == np.arange(cut.count)).astype(float)
        pull, weight = calibration.linear.along(indicators)
        region = _worst(cut, covariates[cut.covariate], pull, weight)
        # One run's own region must be clearly worse than the common one to be named.
        rank = abs(region.z) - (1.0 if cut.group is not None else 0.0)
        if cut.covariate not in best or rank > best[cut.covariate][0]:
            best[cut.covariate] = (rank, region)
    regions = [best[i][1] for i in range(len(covariates))]
    return [
        replace(r, group=b.levels[int(r.low)]) if b.levels else r
        for r, b in zip(regions, covariates, strict=True)
    ]


def _cut(
    index: int, block: covariate_evidence.Covariate, own: np.ndarray, group: str | None
) -> _Binned:
    values = block.values[own]
    distinct = np.unique(values)
    bins = np.full(len(block.values), -1)
    if block.levels or len(distinct) <= BINS:
        bins[own] = np.searchsorted(distinct, values)
        count = len(distinct)
    else:
        edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
        bins[own], count = np.searchsorted(edges, values, side="right"), BINS
    longest = 1 if block.levels else max(1, (2 * count) // 3)
    return _Binned(covariate=index, group=group, bins=bins, count=count, longest=longest)


def _worst(
    cut: _Binned, block: covariate_evidence.Covariate, pull: np.ndarray, weight: np.ndarray
) -> Region:
    starts, ends = np.triu_indices(cut.count + 1, 1)
    short = ends - starts <= cut.longest
    starts, ends = starts[short], ends[short]
    pulls = np.append(0.0, np.cumsum(pull))
    weights = np.zeros((cut.count + 1, cut.count + 1))
    weights[1:, 1:] = weight.cumsum(axis=0).cumsum(axis=1)
    total = pulls[ends] - pulls[starts]
    information = (weights[ends, ends] - weights[starts, ends]) - (
        weights[ends, starts] - weights[starts, starts]
    )
    known = information > 0
    scores = np.where(known, total, 0.0) / np.sqrt(np.where(known, information, 1.0))
    at = int(np.argmax(np.abs(scores)))
    i, j, z, size = starts[at], ends[at], float(scores[at]), 0.0
    if z != 0:
        size = float(total[at] / information[at])
    inside = (cut.bins >= i) & (cut.bins < j)
    values = block.values[inside] if inside.any() else block.values
    return Region(
        low=float(values.min()),
        high=float(values.max()),
        group=cut.group,
        size=size,
        z=z,
        covariate_unit=block.unit,
    )
