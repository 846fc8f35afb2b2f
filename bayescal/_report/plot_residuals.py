"""Pictures of residuals: where a model fails."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import check, covariates_of
from bayescal._calibration.check_result import Check, Entry
from bayescal._report.plot_colours import CYCLE, GREY, RED
from bayescal._report.plot_style import axis_label, new_figure, plain

MOST = 6  # panels
MANY = 3000  # readings from which points become one image within a vector picture
NO_UNIT = {"order": "row"}  # covariates that count


def residuals(
    calibration: Calibration, found: Check | None = None, against: str | None = None
) -> Figure:
    """Residuals against every covariate: runs by colour, the noise in grey, the worst region in red.

    Args:
        calibration: a fit.
        found: its check, if it is at hand.
        against: one covariate alone; at most six, the worst first, if none is named.
    """
    found = check(calibration) if found is None else found
    entries = [e for e in found.entries if not e.by_group][:MOST]
    if against is not None:
        entries = [e for e in found.entries if e.against == against]
    columns = min(3, max(1, len(entries)))
    rows = -(-len(entries) // columns) or 1
    figure = new_figure(4.2 * columns, 3.0 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(entries) :]:
        ax.set_visible(False)
    for ax, entry in zip(axes, entries, strict=False):
        residual_panel(ax, calibration, found, entry)
    return figure


def residual_panel(
    ax: Any, calibration: Calibration, found: Check, entry: Entry, title: str = ""
) -> None:
    """Residuals against one covariate."""
    values = covariate_values(calibration, entry.against)
    levels, codes = calibration.readings.groups("run")
    for run in np.unique(codes):
        own = codes == run
        label = f"run {plain(levels[int(run)])}" if len(levels) > 1 else None
        ax.plot(
            values[own],
            found.residuals[own],
            ".",
            ms=4,
            color=CYCLE[int(run) % len(CYCLE)],
            alpha=0.7,
            label=label,
            rasterized=len(values) > MANY,
        )
    ax.axhspan(-found.noise, found.noise, color=GREY, alpha=0.18, lw=0)
    ax.axhline(0, color=GREY, lw=0.8)
    if entry.log_bayes_factor > 0:
        ax.axvspan(entry.worst.low, entry.worst.high, color=RED, alpha=0.13, lw=0)
    unit = entry.worst.covariate_unit or NO_UNIT.get(entry.against, "")
    name = f"{entry.against} [{unit}]" if unit == "row" else axis_label(entry.against, unit)
    ax.set_xlabel(name)
    ax.set_ylabel(axis_label("residual", found.unit))
    factor = f"log Bayes factor {entry.log_bayes_factor:z.1f}".replace("-", "−")
    ax.set_title(f"{title} ({factor})" if title else factor, fontsize=10, loc="left")
    ax.locator_params(axis="x", nbins=6)
    if 1 < len(levels) <= 4:
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.15 * (high - low))  # room for the legend
        ax.legend(frameon=False, fontsize=8, ncols=len(levels), markerscale=2, loc="upper left")


def covariate_values(calibration: Calibration, name: str) -> np.ndarray:
    return next(b.values for b in covariates_of(calibration) if b.name == name)
