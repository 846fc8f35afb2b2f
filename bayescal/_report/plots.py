"""Plots of residuals, missing effects, errors and noise (posterior draws are plotted by ArviZ).

Plots of a search are drawn from its result, or from the data in `result.json`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from threading import RLock
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.transforms import ScaledTranslation

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import Check, Entry, check, collect_covariates
from bayescal._calibration.leave_group_out import scheme
from bayescal._calibration.sensor_noise import SensorNoise
from bayescal._core.atomic_file import replace_user_file
from bayescal._core.formatting import number
from bayescal._data.allan_deviation import AllanDeviation
from bayescal._data.unit_conversion import unit_label
from bayescal._report.plot_colours import BLUE, CYCLE, GREEN, GREY, ORANGE, PALE, PURPLE, RED
from bayescal._report.report_text import describe_change
from bayescal._search.discover import Discovery, is_quiet
from bayescal._search.search_path import SearchPath, differs_in_new_run

MAX_LABEL = 32  # characters; longer labels leave no room for the axes
MAX_TITLE = 52  # characters; longer titles are wrapped
DRAWING_LOCK = RLock()  # Matplotlib's settings are global, so that one thread draws at a time


@contextmanager
def use_own_style(**settings: Any) -> Iterator[None]:
    """Apply Matplotlib's defaults and `settings` within the `with` block, ignoring the user's configuration file.

    The settings are global to the process: one thread draws at a time.
    """
    with DRAWING_LOCK, style.context(["default", settings]):
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that opens no window; `width` and `height` in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def open_axes(ax: Any, width: float, height: float) -> Any:
    """Return axes without upper and right spines: `ax`, or if None those of a new figure (size in inches)."""
    ax = new_figure(width, height).subplots() if ax is None else ax
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def format_label(text: str) -> str:
    """Format text from a file as a label: at most `MAX_LABEL` characters, with escaped dollar signs."""
    return escape(text if len(text) <= MAX_LABEL else f"{text[: MAX_LABEL - 1]}…")


def escape(text: str) -> str:
    """Escape dollar signs, which Matplotlib would read as marks of a formula."""
    return text.replace("$", r"\$")


def format_axis(name: str, unit: str) -> str:
    """Format a name with its unit, as in "temperature [°C]"; that of a pure number is "[1]"."""
    return f"{format_label(name)} [{unit_label(unit) or '1'}]"


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as a PNG file atomically; raise InputError if the file cannot be written."""
    path = Path(path)
    dpi = figure.dpi
    with replace_user_file(path) as partial:
        figure.dpi = 150
        FigureCanvasAgg(figure).print_png(partial)  # `savefig` would draw it twice
    figure.dpi = dpi
    return path


MAX_PANELS = 6  # panels of residuals in a figure
MIN_RASTER_READINGS = 3000  # more readings are drawn as a raster image in an SVG
MARKERS = "o^sDvx"  # markers of the runs, distinct in grey print
DERIVED_UNITS = {"order": "row"}  # units of covariates that are not columns


def residuals(
    calibration: Calibration, found: Check | None = None, against: str | None = None
) -> Figure:
    """Plot residuals against covariates: runs in different colours, the noise in grey, the worst region in red.

    Args:
        calibration: a fit.
        found: residual checks of the fit; computed if None.
        against: name of a single covariate to plot; if None, up to six are plotted, the worst first.
    """
    found = check(calibration) if found is None else found
    entries = [e for e in found.entries if not e.by_group][:MAX_PANELS]
    if against is not None:
        entries = [e for e in found.entries if e.covariate == against]
    columns, rows = min(3, max(1, len(entries))), -(-len(entries) // 3) or 1
    figure = new_figure(4.2 * columns, 3.0 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, entry in zip(axes, entries, strict=False):
        plot_residual_panel(ax, calibration, found, entry)
    for ax in axes[len(entries) :]:
        ax.set_visible(False)
    return figure


def plot_residual_panel(
    ax: Any, calibration: Calibration, check: Check, entry: Entry, title: str = ""
) -> None:
    """Plot residuals against the covariate of a check's `entry` in axes `ax`."""
    values = next(b.values for b in collect_covariates(calibration) if b.name == entry.covariate)
    body_temperatures = compute_body_temperature(calibration, entry.covariate)
    values = values if body_temperatures is None else body_temperatures
    levels, codes = calibration.readings.groups("run")
    for run in np.unique(codes):
        rows = codes == run
        label = f"run {format_label(levels[int(run)])}" if len(levels) > 1 else None
        ax.plot(
            values[rows],
            check.residuals[rows],
            MARKERS[int(run) % len(MARKERS)],
            ms=3,
            color=CYCLE[int(run) % len(CYCLE)],
            alpha=0.7,
            label=label,
            rasterized=len(values) > MIN_RASTER_READINGS,
        )
    ax.axhspan(-check.noise, check.noise, color=GREY, alpha=0.18, lw=0)
    ax.axhline(0, color=GREY, lw=0.8)
    if entry.log_bayes_factor > 0 and body_temperatures is None:
        ax.axvspan(entry.worst.low, entry.worst.high, color=RED, alpha=0.13, lw=0)
    unit = entry.worst.covariate_unit or DERIVED_UNITS.get(entry.covariate, "")
    name = "lagged " * (body_temperatures is not None) + entry.covariate
    ax.set_xlabel(f"{name} [{unit}]" if unit == "row" else format_axis(name, unit))
    ax.set_ylabel(format_axis("residual", check.unit))
    factor = f"log Bayes factor {entry.log_bayes_factor:z.1f}".replace("-", "−")
    ax.set_title(f"{title} ({factor})" if title else factor, fontsize=10, loc="left")
    ax.locator_params(axis="x", nbins=6)
    if 1 < len(levels) <= 4:
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.15 * (high - low))  # room for the legend
        ax.legend(frameon=False, fontsize=8, ncols=len(levels), markerscale=2, loc="upper left")


def compute_body_temperature(calibration: Calibration, column: str) -> np.ndarray | None:
    """Return the temperature T̃ (n,), °C, of the body that lags behind `column` in the model, at the posterior mode.

    None if the model has no such body; of several bodies, that of the last effect.
    """
    hyper, values = calibration.problem.hyper(calibration.mode.v), None
    catalogue = calibration.model.instrument.known
    for e in calibration.model.effects:
        if column in e.varies and catalogue.get(e.family_name, e).kind == "lag":
            shapes = tuple(float(hyper[e.shape_name(s)]) for s in e.shapes)
            columns = np.asarray(e.basis(calibration.frame, *shapes))
            values = calibration.readings[column] + columns[:, int(e.slot == column)]
    return values


MAX_CANDIDATES = 12  # bars of a plot, to be readable
LEGEND_INCHES = 0.45  # from an axis to its legend, below tick labels and axis label
TEXT_BOX = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}  # hides lines behind text
KINDS = {"one of several": "one of these is missing", "not visible": "not detectable"}
COLOURS = {"finding": RED, "one of several": PURPLE, "lead": ORANGE, "not visible": PALE}


def trail(found: SearchPath | Mapping[str, Any], ax: Any = None, title: str = "") -> Figure:
    """Plot the rms errors of each step of a search, their change since the previous step, and the noise floor.

    Args:
        found: a search path, or its data in result.json.
        ax: axes to draw in; a new figure if None.
        title: start of the title, which goes on to say of each kind of error whether it fell; "" for no title.
    """
    steps = [s.errors() for s in found.steps] if isinstance(found, SearchPath) else found["steps"]
    left_out, last_step = [s["leave_one_group_out"] or {} for s in steps], steps[-1]
    ax = open_axes(ax, 5.6, 0.75 + 1.0 * len(steps))
    # Without an effect of a run there is no second bar.
    runs = differs_in_new_run(steps)
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
        positions = np.arange(len(steps)) + (i + 0.5) * height
        lengths = np.array([np.nan if v is None else v for v in values], float)
        ax.barh(positions, lengths, height * 0.9, label=escape(label), color=colour)
        for y, value in zip(positions, lengths, strict=True):
            if np.isfinite(value):
                x = value + 0.01 * largest
                ax.text(x, y, number(value), va="center", fontsize=7.5, bbox=TEXT_BOX)
    for i, (previous_step, step) in enumerate(zip([{}, *steps], steps, strict=False)):
        change, previous = "", previous_step.get("rmse_fitted")
        if previous:
            change = f"   ({100 * (step['rmse_fitted'] / previous - 1):+.0f} %)".replace("-", "−")
        step_text = f"{i}  {format_label(step['title'])}{change}"
        ax.text(0.01 * largest, i - 0.03, step_text, va="bottom", bbox=TEXT_BOX)
    ends = [(label, v[0], v[-1]) for label, v, _ in series if None not in (v[0], v[-1])]
    verbs = [describe_change(*e).split()[0] for _, *e in ends]  # "fell", "stayed" or "rose"
    labels = ["all"] if len({*verbs}) == 1 < len(verbs) else [label for label, *_ in ends]
    changes = ", ".join(map(" ".join, zip(labels, verbs, strict=False)))
    title += f": {changes}" * (len(steps) > 1 and title != "")
    ax.set_title(fill(title, MAX_TITLE), fontsize=10 if len(title) < MAX_TITLE else 9, loc="left")
    floor = last_step["noise_floor"]
    line = ax.axvline(floor, color=RED, ls="--", lw=1.2, label=f"noise floor {number(floor)}")
    ax.set(xlim=(0, 1.14 * max(largest, floor)), ylim=(len(steps) - 0.25, -0.35), yticks=[])
    ax.set_xlabel(format_axis("rms error", last_step["unit"]))
    handles = sorted(ax.get_legend_handles_labels()[0], key=lambda handle: handle is line)
    _place_legend_below(ax, handles, 2)
    return ax.figure


def _place_legend_below(ax: Any, handles: list[Any], column_count: int) -> None:
    """Place a legend `LEGEND_INCHES` below the axes, whatever their height, so that the axis label fits between."""
    transform = ax.transAxes + ScaledTranslation(0, -LEGEND_INCHES, ax.figure.dpi_scale_trans)
    options = {"loc": "upper center", "bbox_to_anchor": (0.5, 0), "bbox_transform": transform}
    ax.legend(handles=handles, frameon=False, fontsize=8, ncols=column_count, **options)


def missing(found: Discovery | Mapping[str, Any], ax: Any = None) -> Figure:
    """Plot the log Bayes factor of each candidate effect, of the model with the effect against that without it.

    Args:
        found: a discovery, or one entry of `missing` in result.json.
        ax: axes to draw in; a new figure if None.
    """
    is_discovery, found_kinds = isinstance(found, Discovery), ("finding", "one of several")
    candidates = [vars(c) for c in found.candidates] if is_discovery else found["candidates"]
    entries = [c for c in candidates if c["log_bayes_factor"] is not None and not is_quiet(c)]
    entries.sort(key=lambda c: (c["kind"] in found_kinds, c["log_bayes_factor"]))
    bars = entries[-MAX_CANDIDATES:]
    ax = open_axes(ax, 5.6, 0.3 * len(bars) + 1.3)
    values = [c["log_bayes_factor"] for c in bars]
    colours = [COLOURS.get(c["kind"] or "", BLUE) for c in bars]
    ax.barh([format_label(c["effect"]) for c in bars], values, color=colours)
    ax.set_xscale("symlog", linthresh=5)
    low, high, ticks = min([0.0, *values]), max([0.0, *values]), [10.0**k for k in range(1, 7)]
    positive_ticks = [p for p in ticks if p <= high * 1.2] or [5.0]
    ax.set_xticks([*(-p for p in ticks[::-1] if -p >= low * 1.2), 0.0, *positive_ticks])
    ax.minorticks_off()
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
    ax.axvline(0, color=GREY, lw=0.8)
    ax.set_xlabel("log Bayes factor of the effect (scale logarithmic beyond ±5) [no unit]")
    kinds = list(dict.fromkeys(c["kind"] for c in bars[::-1]))
    other_label = "not needed with the findings" if {*kinds} & {*found_kinds} else "improbable"
    labels = KINDS | {None: other_label}
    names = [Patch(color=COLOURS.get(k or "", BLUE), label=escape(labels.get(k, k))) for k in kinds]
    if names:
        _place_legend_below(ax, names, len(names))
    return ax.figure


def loop(found: SearchPath) -> Figure:
    """Plot a search in one figure: residuals of the first and the last model, missing effects, errors by step."""
    height = max(3.7, 0.9 + 0.8 * len(found.steps))  # inch: four bars and a title for each step
    figure = new_figure(11.0, 3.7 + height)
    (first_ax, bars), (last_ax, error_ax) = figure.subplots(2, 2, height_ratios=(3.7, height))
    first_step, last_step = found.steps[0], found.final
    first_entry = next((e for e in first_step.check.entries if not e.by_group), None)
    if first_entry is not None:
        title = "1  residuals of the first model"
        plot_residual_panel(first_ax, first_step.calibration, first_step.check, first_entry, title)
        covariate, entries = first_entry.covariate, last_step.check.entries
        last_entry = next(e for e in entries if e.covariate == covariate)
        title = "3  residuals of the last model"
        plot_residual_panel(last_ax, last_step.calibration, last_step.check, last_entry, title)
        label = f"residual{' (another scale)' * (last_step is not first_step)}"
        last_ax.set_ylabel(format_axis(label, last_step.check.unit))
    if first_step.discovery is not None:
        missing(first_step.discovery, bars)
    bars.set_title("2  effects added singly to the first model", fontsize=10, loc="left")
    trail(found, error_ax, "4  rms error")
    return figure


def allan(found: AllanDeviation) -> Figure:
    """Plot an Allan deviation, the result of `bc.allan_deviation`, with 95 % intervals over the averaging time."""
    ax = open_axes(None, 5.2, 3.6)
    _plot_allan(ax, found, fmt="o-", lw=1.2, label="readings")
    return _label_allan(ax, found.unit, [])


def noise(found: SensorNoise) -> Figure:
    """Plot the Allan deviation of a record with 95 % intervals, and posterior and predictive bands of its noise model.

    Args:
        found: the result of `bc.noise`.
    """
    terms = [
        f"{f.symbol} = {number(f.value)} {unit_label(f.unit)}"
        for f in found.figures
        if f.symbol and not f.bound
    ]
    ax, tau = open_axes(None, 5.2, 3.6), found.measured.tau
    is_fit = all(claim.severity == "note" for claim in found.claims)
    noise_text = found.law + " (does not fit)" * (not is_fit)
    bands = (
        (found.estimate_low, found.estimate_high, GREY, 0.2, "95 % of simulated records"),
        (found.low, found.high, ORANGE, 0.4, "noise law, 95 % credible"),
    )
    for low, high, colour, alpha, label in bands:
        ax.fill_between(tau, low, high, color=colour, alpha=alpha, lw=0, label=label)
    ax.plot(tau, found.expected, "--", color=ORANGE, lw=1.2, label=f"noise law: {noise_text}")
    _plot_allan(ax, found.measured, fmt="o", lw=1, label="readings, 95 %")
    return _label_allan(ax, found.unit, terms)


def _plot_allan(ax: Any, m: AllanDeviation, **options: Any) -> None:
    error = np.array([m.deviation - m.low, m.high - m.deviation])
    ax.errorbar(m.tau, m.deviation, yerr=error, ms=4, capsize=2, color=BLUE, **options)


def _label_allan(ax: Any, unit: str, terms: Sequence[str]) -> Figure:
    """Label the axes of an Allan deviation in `unit`, with `terms` (noise parameters) as title; return the figure."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(format_axis("averaging time τ", "s"))
    ax.set_ylabel(format_axis("Allan deviation", unit))
    ax.set_title(", ".join(terms), fontsize=9, loc="left")
    ax.legend(frameon=False, fontsize=8)
    return ax.figure
