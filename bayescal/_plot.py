"""Pictures, as functions that return Matplotlib figures.

Colours that the colour-blind can tell apart (Okabe and Ito), a unit on every axis.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayescal._calibration import Calibration
from bayescal._check import Check, Entry, check, covariates_of
from bayescal._discover import Discovery
from bayescal._text import pretty
from bayescal._trail import Trail

BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#666666"


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a PNG, beside and then renamed."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        figure.savefig(beside, dpi=150, format="png")
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
    return path


def residuals(calibration: Calibration, found: Check | None = None) -> Figure:
    """Residuals against every covariate, the worst region shaded."""
    found = check(calibration) if found is None else found
    entries = [e for e in found.entries if e.against != "run"][:6]
    columns = min(3, max(1, len(entries)))
    rows = -(-len(entries) // columns) or 1
    figure = _figure(4.2 * columns, 3.0 * rows)
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for ax in axes[len(entries) :]:
        ax.set_visible(False)
    for ax, entry in zip(axes, entries, strict=False):
        _residual_panel(ax, calibration, found, entry)
    return figure


def _residual_panel(
    ax: Any, calibration: Calibration, found: Check, entry: Entry, title: str = ""
) -> None:
    """Residuals against a covariate: runs by colour, the noise in grey, the worst region in red."""
    values = covariate_values(calibration, entry.against)
    levels, codes = calibration.readings.groups("run")
    unit = pretty(found.unit)
    colours = [BLUE, ORANGE, GREEN, RED]
    for run in np.unique(codes):
        own = codes == run
        label = f"run {levels[int(run)]}" if len(levels) > 1 else None
        colour = colours[int(run) % len(colours)]
        ax.plot(values[own], found.residuals[own], ".", ms=4, color=colour, alpha=0.7, label=label)
    ax.axhspan(-found.noise, found.noise, color=GREY, alpha=0.15, lw=0)
    ax.axhline(0, color=GREY, lw=0.8)
    if entry.log_bayes_factor > 0:
        ax.axvspan(entry.worst.low, entry.worst.high, color=RED, alpha=0.10, lw=0)
    covariate_unit = pretty(entry.worst.covariate_unit)
    ax.set_xlabel(f"{entry.against} [{covariate_unit}]" if covariate_unit else entry.against)
    ax.set_ylabel(f"residual [{unit}]")
    factor = f"log Bayes factor {entry.log_bayes_factor:.1f}"
    ax.set_title(f"{title} ({factor})" if title else factor, fontsize=10, loc="left")
    if 1 < len(levels) <= len(colours):
        ax.legend(frameon=False, fontsize=8, ncols=len(levels), markerscale=2)


def covariate_values(calibration: Calibration, name: str) -> np.ndarray:
    return next(b.values for b in covariates_of(calibration) if b.name == name)


def trail(found: Trail, ax: Any = None) -> Figure:
    """The error, step by step, beside the noise floor."""
    figure = _figure(6.4, 3.8) if ax is None else ax.figure
    ax = figure.subplots() if ax is None else ax
    unit = pretty(found.final.calibration.unit)
    names = [s.title for s in found.steps]
    at = np.arange(len(names))
    series = [
        ("fitted readings", [s.rmse for s in found.steps], BLUE),
        (
            "left-out groups",
            [s.left_out.rmse if s.left_out else np.nan for s in found.steps],
            ORANGE,
        ),
        ("kept-apart readings", [s.holdout_rmse or np.nan for s in found.steps], GREEN),
    ]
    series = [s for s in series if np.isfinite(s[1]).any()]
    width = 0.8 / len(series)
    for i, (label, values, colour) in enumerate(series):
        ax.bar(
            at + (i - (len(series) - 1) / 2) * width,
            values,
            width * 0.92,
            label=label,
            color=colour,
        )
    ax.axhline(found.final.noise_floor, color=RED, ls="--", lw=1.2, label="noise floor")
    crowded = sum(map(len, names)) > 48
    ax.set_xticks(at, names, rotation=20 if crowded else 0, ha="right" if crowded else "center")
    ax.set_ylabel(f"rms error [{unit}]")
    ax.legend(frameon=False, fontsize=8)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    return figure


def missing(found: Discovery, ax: Any = None) -> Figure:
    """Log Bayes factor of each candidate."""
    shown = [c for c in found.candidates if c.log_bayes_factor is not None][:12][::-1]
    figure = _figure(6.4, 0.35 * len(shown) + 1.2) if ax is None else ax.figure
    ax = figure.subplots() if ax is None else ax
    colours = {"finding": RED, "lead": ORANGE, "not visible": "#BBBBBB"}
    values = [c.log_bayes_factor for c in shown]
    ax.barh(
        [c.effect for c in shown], values, color=[colours.get(c.kind or "", BLUE) for c in shown]
    )
    ax.set_xscale("symlog", linthresh=5)
    ax.axvline(0, color=GREY, lw=0.8)
    ax.set_xlabel("log Bayes factor (red: finding, orange: lead)")
    return figure


def loop(found: Trail) -> Figure:
    """The loop in one picture: residuals before and after, what is missing, the error falling."""
    figure = _figure(11.0, 7.4)
    axes = figure.subplots(2, 2)
    first, final = found.steps[0], found.final
    entry = next((e for e in first.check.entries if e.against != "run"), None)
    if entry is not None:
        title = "1  where the first model fails"
        _residual_panel(axes[0, 0], first.calibration, first.check, entry, title)
        after = next(e for e in final.check.entries if e.against == entry.against)
        title = "3  the same, with what was found"
        _residual_panel(axes[1, 0], final.calibration, final.check, after, title)
        axes[1, 0].set_ylim(axes[0, 0].get_ylim())
    if first.discovery is not None:
        missing(first.discovery, axes[0, 1])
    axes[0, 1].set_title("2  what is missing from it", fontsize=10, loc="left")
    trail(found, axes[1, 1])
    axes[1, 1].set_title("4  the error falls", fontsize=10, loc="left")
    return figure
