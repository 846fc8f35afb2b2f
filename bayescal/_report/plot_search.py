"""Pictures of the search: what is missing, and how the error falls.

Both are drawn from results, or from what `result.json` says of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.transforms import ScaledTranslation

from bayescal._calibration.leave_group_out import scheme
from bayescal._core.formatting import number
from bayescal._report.plot_colours import BLUE, GREEN, GREY, ORANGE, PALE, RED
from bayescal._report.plot_residuals import residual_panel
from bayescal._report.plot_style import (
    axes_of,
    axis_label,
    new_figure,
    no_formula,
    open_sides,
    plain,
)
from bayescal._report.result_json import is_quiet
from bayescal._search.discover import Discovery
from bayescal._search.search_path import SearchPath

MOST = 12  # candidates
BELOW = 0.45  # inch, from an axis to its legend: its numbers and its label stand between
# No line runs through the words.
ON_GROUND = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
KINDS = {"finding": RED, "lead": ORANGE, "not visible": PALE}


def trail(found: SearchPath | Mapping[str, Any], ax: Any = None) -> Figure:
    """The error of each step, with the fall from the step before, and the noise floor.

    Args:
        found: a trail, or what its result.json holds.
        ax: where to draw; a figure of its own if not given.
    """
    steps = [s.errors() for s in found.steps] if isinstance(found, SearchPath) else found["steps"]
    left_out, last = [s["leave_one_group_out"] or {} for s in steps], steps[-1]
    ax = axes_of(ax, 5.6, 0.75 + 1.0 * len(steps))
    # Without an effect of a run there is no second bar.
    runs = any(s["rmse"] > 1.001 * s["rmse_fitted"] for s in steps)
    series = [
        ("as fitted", [s["rmse_fitted"] for s in steps], BLUE),
        ("new run", [s["rmse"] if runs else None for s in steps], PALE),
        (scheme(left_out[-1].get("group", "group")), [s.get("rmse") for s in left_out], ORANGE),
        ("held-out", [s["holdout_rmse"] for s in steps], GREEN),
    ]
    series = [s for s in series if any(v is not None for v in s[1])]
    largest = max(v for _, values, _ in series for v in values if v is not None)
    height = 0.66 / len(series)
    for i, (label, values, colour) in enumerate(series):
        at = np.arange(len(steps)) + (i + 0.5) * height
        shown = np.array([np.nan if v is None else v for v in values], float)
        ax.barh(at, shown, height * 0.9, label=no_formula(label), color=colour)
        for y, value in zip(at, shown, strict=True):
            if np.isfinite(value):
                at = value + 0.01 * largest
                ax.text(at, y, number(value), va="center", fontsize=7.5, bbox=ON_GROUND)
    for i, step in enumerate(steps):
        title = f"{i}  {plain(step['title'])}{_fall(steps, i)}"
        ax.text(0.01 * largest, i - 0.03, title, va="bottom", bbox=ON_GROUND)
    floor = last["noise_floor"]
    ax.axvline(floor, color=RED, ls="--", lw=1.2, label=f"floor {number(floor)}")
    ax.set(xlim=(0, 1.14 * max(largest, floor)), ylim=(len(steps) - 0.25, -0.35), yticks=[])
    ax.set_xlabel(axis_label("rms error", last["unit"]))
    handles, _ = ax.get_legend_handles_labels()
    handles.sort(key=lambda h: h.get_label().startswith("floor"))  # the last, as in the tables
    _legend_below(ax, handles, 2)
    open_sides(ax)
    return ax.figure


def _legend_below(ax: Any, handles: list[Any], columns: int) -> None:
    """A legend below the axis' label, however tall the axes are."""
    below = ax.transAxes + ScaledTranslation(0, -BELOW, ax.figure.dpi_scale_trans)
    ax.legend(
        handles=handles,
        frameon=False,
        fontsize=8,
        ncols=columns,
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        bbox_transform=below,
    )


def _fall(steps: Sequence[Mapping[str, Any]], i: int) -> str:
    """How much smaller the error as fitted is than one step before."""
    now, before = steps[i]["rmse_fitted"], steps[i - 1]["rmse_fitted"]
    if i == 0 or not before:
        return ""
    return f"   ({100 * (now / before - 1):+.0f} %)".replace("-", "−")


def missing(found: Discovery | Mapping[str, Any], ax: Any = None) -> Figure:
    """Log Bayes factor of each candidate for being missing.

    Args:
        found: a discovery, or one entry of `missing` in result.json.
        ax: where to draw; a figure of its own if not given.
    """
    everyone = (
        [vars(c) for c in found.candidates] if isinstance(found, Discovery) else found["candidates"]
    )
    tested = [c for c in everyone if c["log_bayes_factor"] is not None]
    ranked = sorted(
        (c for c in tested if not is_quiet(c)),
        key=lambda c: (c["kind"] == "finding", c["log_bayes_factor"]),
    )
    shown = ranked[-MOST:]
    ax = axes_of(ax, 5.6, 0.3 * len(shown) + 1.3)
    values = [c["log_bayes_factor"] for c in shown]
    colours = [KINDS.get(c["kind"] or "", BLUE) for c in shown]
    ax.barh([plain(c["effect"]) for c in shown], values, color=colours)
    ax.set_xscale("symlog", linthresh=5)
    ax.set_xticks(_ticks(min([0.0, *values]), max([0.0, *values])))
    ax.minorticks_off()
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
    ax.axvline(0, color=GREY, lw=0.8)
    ax.set_xlabel("log Bayes factor for being missing [1]")
    kinds = list(dict.fromkeys(c["kind"] for c in shown[::-1]))
    rest = "explained by the finding, or none" if "finding" in kinds else "no evidence"
    names = [Patch(color=KINDS.get(k or "", BLUE), label=no_formula(k or rest)) for k in kinds]
    if names:
        _legend_below(ax, names, len(names))
    open_sides(ax)
    return ax.figure


def _ticks(low: float, high: float) -> list[float]:
    """Zero and powers of ten on either side."""
    powers = [10.0**k for k in range(1, 7)]
    up = [p for p in powers if p <= high * 1.2] or [5.0]
    return [-p for p in powers[::-1] if -p >= low * 1.2] + [0.0, *up]


def loop(found: SearchPath) -> Figure:
    """The loop in one picture: residuals before and after, what is missing, the error falling."""
    lower = max(3.7, 0.9 + 0.8 * len(found.steps))  # inch: four bars and a title for each step
    figure = new_figure(11.0, 3.7 + lower)
    axes = figure.subplots(2, 2, height_ratios=(3.7, lower))
    first, final = found.steps[0], found.final
    entry = next((e for e in first.check.entries if not e.by_group), None)
    if entry is not None:
        title = "1  where the first model fails"
        residual_panel(axes[0, 0], first.calibration, first.check, entry, title)
        after = next(e for e in final.check.entries if e.against == entry.against)
        title = "3  the same, with what was found"
        residual_panel(axes[1, 0], final.calibration, final.check, after, title)
        axes[1, 0].set_ylim(axes[0, 0].get_ylim())
    if first.discovery is not None:
        missing(first.discovery, axes[0, 1])
    axes[0, 1].set_title("2  what is missing from it", fontsize=10, loc="left")
    trail(found, axes[1, 1])
    axes[1, 1].set_title("4  the error falls", fontsize=10, loc="left")
    return figure
