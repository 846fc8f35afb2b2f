"""Which readings are drawn where there are more than a screen can show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

MANY = 6000  # readings up to which every one is drawn: the browser moves these without a lag
PIXELS = 300  # columns of pixels of a panel, about


def drawn_rows(
    covariates: Mapping[str, np.ndarray],
    drawn: Sequence[np.ndarray],
    views: Mapping[str, tuple[float, float]] | None = None,
) -> np.ndarray:
    """Rows to draw: all; or, of many, the lowest and the highest in each column of pixels, and evenly spaced ones
    between them.

    The same rows are drawn in every panel, so that what is brushed in one lights up in the others: the union over the
    panels. Extremes are never lost; of what lies between them, an even share is drawn.

    Args:
        covariates: (n,) each, by panel.
        drawn: what is drawn over them, (n,) each: residuals, output.
        views: lowest and highest covariate in view, by panel; all of it where none is named.

    Returns:
        Indices in rising order.
    """
    size = drawn[0].size
    if size <= MANY:
        return np.arange(size)
    rising = [np.argsort(values) for values in drawn]
    chosen, seen = np.zeros(size, bool), np.ones(size, bool)
    for name, values in covariates.items():
        low, high = (views or {}).get(name, (float(values.min()), float(values.max())))
        in_view = (values >= low) & (values <= high)
        seen &= in_view if name in (views or {}) else True
        if np.count_nonzero(in_view) <= MANY // len(covariates):
            chosen |= in_view
            continue
        place = (values - low) / max(high - low, 1e-300)
        pixel = np.where(in_view, np.clip(place * PIXELS, 0, PIXELS - 1), PIXELS).astype(int)
        for order in rising:
            end = np.full(PIXELS + 1, -1)  # of each column of pixels, and of what is out of view
            for way in (order, order[::-1]):  # the last that is put there stays: highest, lowest
                end[pixel[way]] = way
                chosen[end[:PIXELS][end[:PIXELS] >= 0]] = True
    between = np.flatnonzero(seen & ~chosen)
    chosen[between[:: max(1, -(-between.size // (MANY - min(int(chosen.sum()), MANY // 2))))]] = (
        True
    )
    return np.flatnonzero(chosen)


def sentence(drawn: int, of: int) -> str:
    """What is drawn, where it is not all; else empty."""
    if drawn == of:
        return ""
    return f"{drawn:,} of {of:,} readings drawn: lowest and highest of every column of pixels, an even share between"
