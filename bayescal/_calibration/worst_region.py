"""The worst region of a covariate: where the residuals are most systematically positive or negative."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayescal._calibration.covariate_evidence import Covariate
from bayescal._calibration.fitted import Fitted

RUN_REGION_READINGS = 8  # readings that a run needs for a region of its own where a model fails

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


def worst_regions(calibration: Fitted, covariates: list[Covariate]) -> list[Region]:
    """For each covariate the range of neighbouring bins whose mean residual is worst against its uncertainty.

    Means and uncertainties follow the noise law: under correlated noise a long range counts for less.
    """
    levels, codes = calibration.readings.groups("run")
    every: list[tuple[str | None, np.ndarray]] = [(None, np.ones(len(codes), bool))]
    runs = [(level, codes == k) for k, level in enumerate(levels)] if len(levels) > 1 else []
    runs = [(level, own) for level, own in runs if own.sum() >= RUN_REGION_READINGS]
    found = []
    for covariate in covariates:
        parts = every if covariate.levels else [*every, *runs]
        regions = [_worst(calibration, covariate, own, run) for run, own in parts]
        # One run's own region must be clearly worse than the common one to be named.
        region = max(regions, key=lambda r: abs(r.z) - (r.group is not None))
        group = covariate.levels[int(region.low)] if covariate.levels else region.group
        found.append(replace(region, group=group))
    return found


def _binned(covariate: Covariate, own: np.ndarray) -> tuple[np.ndarray, int]:
    """The bin of each reading, −1 for those that are not its own; and how many bins there are."""
    values = covariate.values[own]
    distinct, bins = np.unique(values), np.full(len(covariate.values), -1)
    if covariate.levels or len(distinct) <= BINS:
        bins[own] = np.searchsorted(distinct, values)
        return bins, len(distinct)
    edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
    bins[own] = np.searchsorted(edges, values, side="right")
    return bins, BINS


def _worst(calibration: Fitted, covariate: Covariate, own: np.ndarray, run: str | None) -> Region:
    """Of all readings, or one run's own."""
    bins, count = _binned(covariate, own)
    pull, weight = calibration.linear.along((bins[:, None] == np.arange(count)).astype(float))
    starts, ends = np.triu_indices(count + 1, 1)
    short = ends - starts <= (1 if covariate.levels else max(1, (2 * count) // 3))
    starts, ends = starts[short], ends[short]
    pulls = np.append(0.0, np.cumsum(pull))
    weights = np.pad(weight.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    total = pulls[ends] - pulls[starts]
    information = (weights[ends, ends] - weights[starts, ends]) - (
        weights[ends, starts] - weights[starts, starts]
    )
    known = information > 0
    scores = np.where(known, total, 0.0) / np.sqrt(np.where(known, information, 1.0))
    at = int(np.argmax(np.abs(scores)))
    z = float(scores[at])
    inside = (bins >= starts[at]) & (bins < ends[at])
    values = covariate.values[inside] if inside.any() else covariate.values
    return Region(
        low=float(values.min()),
        high=float(values.max()),
        group=run,
        size=float(total[at] / information[at]) if z != 0 else 0.0,
        z=z,
        covariate_unit=covariate.unit,
    )
