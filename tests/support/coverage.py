"""Whether intervals of posteriors hold what was simulated as often as they say."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

import bayescal as bc


def assert_intervals_cover(fits: Iterable[bc.Calibration], truth: Mapping[str, float]) -> None:
    """95 % intervals of many fits of the same truth hold it in 95 % of them, within four standard errors."""
    covered = []
    for calibration in fits:
        for name, true in truth.items():
            low, high = np.quantile(calibration.samples(name), [0.025, 0.975])
            covered.append(low <= true <= high)
    each = np.mean(np.reshape(covered, (-1, len(truth))), axis=1)
    assert abs(each.mean() - 0.95) < 4 * each.std() / np.sqrt(len(each))
