"""Which readings are drawn where there are more than a screen can show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

MANY = 6000  # readings up to which every one is drawn: the browser moves these without a lag
PIXELS = 300  # columns of pixels of a panel, about


def drawn_rows(
    covariates: Mapping[str, np.ndarray],
    residual: np.ndarray,
    views: Mapping[str, tuple[float, float]] | None = None,
) -> np.ndarray:
    """Rows to draw: all; or, of many, those with the lowest and the highest residual in each column of pixels, and
    evenly spaced ones between them.

    The same rows are drawn in every panel, so that what is brushed in one lights up in the others: the union over the
    panels. Extremes are never lost; of what lies between them, an even share is drawn.

    Args:
        covariates: (n,) each, by panel.
        residual: (n,).
        views: lowest and highest covariate in view, by panel; all of it where none is named.

    Returns:
        Indices in rising order.
    """
    if residual.size <= MANY:
        return np.arange(residual.size)
    chosen, seen = np.zeros(residual.size, bool), np.ones(residual.size, bool)
    for name, values in covariates.items():
        low, high = (views or {}).get(name, (float(values.min()), float(values.max())))
        in_view = (values >= low) & (values <= high)
        seen &= in_view if name in (views or {}) else True
        inside = np.flatnonzero(in_view)
        if inside.size <= MANY // len(covariates):
            chosen[inside] = True
            continue
        place = (values[inside] - low) / max(high - low, 1e-300)
        pixel = np.minimum((place * PIXELS).astype(int), PIXELS - 1)
        order = inside[np.lexsort((residual[inside], pixel))]
        edges = np.flatnonzero(np.diff(np.sort(pixel))) + 1
        chosen[order[np.r_[0, edges]]] = True  # the lowest of each column
        chosen[order[np.r_[edges - 1, order.size - 1]]] = True  # and the highest
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
