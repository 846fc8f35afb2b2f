"""Pictures of what a fit knows: coefficients, how far the readings told them, their correlations, predictions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._model.frame import GROUPS
from bayescal._report.plot_colours import BLUE, GREY, ORANGE, RED
from bayescal._report.plot_style import axes_of, axis_label, new_figure, open_sides, plain

DRAWS = 1000  # in a picture
INTERVAL = 0.95
MOST = 24  # coefficients in one picture
PAIRED = 4  # unknowns in a picture of pairs


def coefficients(
    calibration: Calibration, names: Sequence[str] | None = None, columns: int = 3
) -> Figure:
    """Posterior of each coefficient, its mean and its 95 % credible interval.

    Args:
        calibration: a fit.
        names: which; the coefficients and shapes that have one value, if not given.
        columns: panels in a row.

    Raises:
        InputError: no such unknown, or none at all.
    """
    data = _chosen(calibration, names, MOST)
    across, down = min(columns, len(data)), -(-len(data) // columns)
    figure = new_figure(2.8 * across, 2.0 * down + 0.3)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for ax in panels[len(data) :]:
        ax.set_visible(False)
    for ax, (name, unknown) in zip(panels, data.items(), strict=False):
        draws = unknown.values.ravel()
        _density(ax, draws)
        ax.plot(_ends(draws, INTERVAL), [0, 0], color=ORANGE, lw=4, solid_capstyle="butt")
        ax.plot(draws.mean(), 0, "o", color=RED, ms=5)
        ax.set_xlabel(axis_label("", unknown.attrs["units"]).strip(), fontsize=9)
        ax.set_title(plain(str(name)), fontsize=9)
        ax.locator_params(axis="x", nbins=4)
        ax.tick_params(labelsize=8)
    return figure


def _density(ax: Any, draws: np.ndarray) -> None:
    """The density of draws, by a Gaussian kernel; a line where all are the same."""
    from scipy.stats import gaussian_kde  # a third of a second that only a picture needs

    if _moves(draws):
        at = np.linspace(draws.min(), draws.max(), 200)
        ax.plot(at, gaussian_kde(draws)(at), color=BLUE)
    else:
        ax.axvline(draws[0], color=BLUE)
    ax.set_yticks([])
    open_sides(ax)
    ax.spines["left"].set_visible(False)


def _ends(draws: np.ndarray, share: float) -> np.ndarray:
    """Of the credible interval that holds this share of the draws along the last axis (2, …)."""
    return np.quantile(draws, [0.5 - share / 2, 0.5 + share / 2], axis=-1)


def members(calibration: Calibration, name: str) -> Figure:
    """What each run, cell or device has of a coefficient, with 50 % and 95 % credible intervals.

    Args:
        calibration: a fit.
        name: of a coefficient with one value for each member of a group.

    Raises:
        InputError: there is no such coefficient.
    """
    posterior = calibration.posterior
    grouped = [n for n in map(str, posterior) if set(posterior[n].dims) & set(GROUPS)]
    if name not in grouped:
        raise InputError(
            f"{name!r} has no value for each member of a group; these have: {', '.join(grouped) or 'none'}"
        )
    data = posterior[name].isel(draw=_thin(posterior))
    (group,) = {str(d) for d in data.dims} - {"chain", "draw"}
    draws = data.transpose(group, ...).values.reshape(data.sizes[group], -1)
    at = np.arange(len(draws))
    figure = new_figure(6.4, 1.0 + 0.25 * len(draws))
    ax = figure.subplots()
    for share, width in ((INTERVAL, 1.5), (0.5, 4.0)):
        ax.hlines(at, *_ends(draws, share), color=BLUE, lw=width)
    ax.plot(draws.mean(axis=1), at, "o", color=RED)
    ax.set_yticks(at, [plain(f"{group} {label}") for label in data[group].values])
    ax.invert_yaxis()
    ax.set_xlabel(axis_label(name, data.attrs["units"]))
    open_sides(ax)
    return figure


def pairs(calibration: Calibration, names: Sequence[str] | None = None) -> Figure:
    """Joint draws of the unknowns, two by two, and the density of each.

    Args:
        calibration: a fit.
        names: which; the four most correlated, if not given.

    Raises:
        InputError: no such unknown, or fewer than two.
    """
    data = _chosen(calibration, names, MOST)
    if len(data) < 2:
        raise InputError(f"a picture of pairs needs two unknowns or more, not {len(data)}")
    if names is None:
        data = data[most_correlated(data)]
    draws = [unknown.values.ravel() for unknown in data.values()]
    units = [axis_label("", unknown.attrs["units"]).strip() for unknown in data.values()]
    said = [f"{plain(str(name))}\n{unit}" for name, unit in zip(data, units, strict=True)]
    side = 1.0 + 1.5 * len(data)
    figure = new_figure(side, side)
    panels = figure.subplots(len(data), len(data), sharex="col")
    for (row, column), ax in np.ndenumerate(panels):
        ax.set_visible(column <= row)
        if column == row:
            _density(ax, draws[row])
        elif column < row:  # thousands of points in a vector picture weigh too much
            ax.plot(draws[column], draws[row], ".", color=BLUE, alpha=0.25, ms=3, rasterized=True)
            ax.locator_params(axis="y", nbins=3)
        ax.tick_params(labelsize=7)
        ax.locator_params(axis="x", nbins=2)
        if row == len(said) - 1:
            ax.set_xlabel(said[column], fontsize=8)
        if column == 0 and row > 0:
            ax.set_ylabel(said[row], fontsize=8)
    return figure


def most_correlated(data: xr.Dataset) -> list[str]:
    """The unknowns of the strongest correlations, in their own order."""
    names = list(map(str, data))
    correlation = np.abs(np.corrcoef([data[n].values.ravel() for n in names]))
    order = np.dstack(
        np.unravel_index(np.argsort(-np.triu(correlation, 1), axis=None), correlation.shape)
    )
    chosen: list[int] = []
    for i, j in order[0]:
        chosen += [k for k in (int(i), int(j)) if k not in chosen]
        if len(chosen) >= min(PAIRED, len(names)):
            break
    return [names[i] for i in sorted(chosen[:PAIRED])]


def predictive(calibration: Calibration) -> Figure:
    """Whether readings fall where the model expects them (ArviZ's `plot_ppc_pit`).

    The share of readings below each predictive probability, minus that probability: a model that is right stays
    within the band.
    """
    from arviz_plots import plot_ppc_pit  # a second that only a picture needs
    from matplotlib import pyplot

    group = calibration.tree["posterior_predictive"].to_dataset()
    tree = xr.DataTree.from_dict(
        {
            "posterior_predictive": group.isel(draw=_thin(group)),
            "observed_data": calibration.tree["observed_data"].to_dataset(),
        }
    )
    made = plot_ppc_pit(
        tree,
        visuals={"title": False, "xlabel": False, "ylabel": False, "ecdf_lines": {"color": BLUE}},
        figure_kwargs={"figsize": (5.6, 3.0)},
    )
    figure = made.viz["figure"].item()
    pyplot.close(figure)  # nothing is shown, nothing is kept
    FigureCanvasAgg(figure)
    figure.set_layout_engine("constrained")
    ax = figure.axes[0]
    ax.set_xlabel("predictive probability of the reading [1]")
    ax.set_ylabel("share of readings below it,\nminus expected [1]")
    open_sides(ax)
    return figure


def identifiability(calibration: Calibration, ax: Any = None) -> Figure:
    """How much narrower than its prior each unknown became: posterior over prior standard deviation."""
    found, hyperparameters = summary(calibration)
    rows = [r for r in (*found, *hyperparameters) if r["contraction"] is not None]
    rows = sorted(rows, key=lambda r: r["contraction"])[:MOST][::-1]
    ax = axes_of(ax, 5.6, 0.28 * max(len(rows), 3) + 1.0)
    ratio = [float(np.sqrt(max(1 - r["contraction"], 1e-12))) for r in rows]
    colours = [ORANGE if value > 0.7 else BLUE for value in ratio]
    ax.barh([plain(r["name"]) for r in rows], ratio, color=colours)
    ax.axvline(1, color=GREY, lw=1)
    ax.set_xscale("log")
    ax.xaxis.set_major_formatter(lambda value, _: number(value))
    ax.xaxis.set_minor_formatter(lambda value, _: "")
    for y, value in enumerate(ratio):
        ax.text(value * 1.05, y, number(value, 2), va="center", fontsize=7.5)
    if ratio:
        ax.set_xlim(min(0.1, min(ratio)) / 2, max(2.0, 2 * max(ratio)))
    ax.set_xlabel("posterior sd / prior sd [1]")
    open_sides(ax)
    return ax.figure


def _chosen(calibration: Calibration, names: Sequence[str] | None, most: int) -> xr.Dataset:
    """Draws of the named unknowns, thinned; of those with one value each, if none is named."""
    posterior = calibration.posterior
    single = [str(n) for n in posterior if set(posterior[n].dims) == {"chain", "draw"}]
    unknown = [n for n in names or () if n not in single]
    if unknown:
        raise InputError(
            f"no unknown with one value is called {', '.join(unknown)}; there are: {', '.join(single)}"
        )
    moving = [n for n in single if _moves(posterior[n].values)]
    chosen = list(names or moving)[:most]
    if not chosen:
        raise InputError("every unknown is held at a value: there is nothing to draw")
    return posterior[chosen].isel(draw=_thin(posterior))


def _moves(draws: np.ndarray) -> bool:
    """Whether an unknown was drawn, and not held at an estimate."""
    return float(np.std(draws)) > 1e-9 * abs(float(np.mean(draws)))


def _thin(data: xr.Dataset) -> slice:
    return slice(None, None, max(1, data.sizes["draw"] * data.sizes["chain"] // DRAWS))
