"""Pictures of what a fit knows: coefficients, how far the readings told them, their correlations, predictions.

Built on ArviZ's plots where there is one; their figures are handed back as Matplotlib's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.summary import summary
from bayescal._core.atomic_file import renamed
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._model.frame import GROUPS
from bayescal._report.plot_colours import BLUE, GREY, ORANGE, RED
from bayescal._report.plot_style import axes_of, axis_label, open_sides, plain

DRAWS = 1000  # in a picture
INTERVAL = 0.95
MOST = 24  # coefficients in one picture
PAIRED = 4  # unknowns in a picture of pairs


def coefficients(
    calibration: Calibration, names: Sequence[str] | None = None, columns: int = 3
) -> Figure:
    """Posterior of each coefficient, its mean and its 95 % credible interval (ArviZ's `plot_dist`).

    Args:
        calibration: a fit.
        names: which; the coefficients and shapes that have one value, if not given.
        columns: panels in a row.

    Raises:
        InputError: no such unknown, or none at all.
    """
    from arviz_plots import plot_dist  # a second that only a picture needs

    data = _shown(_chosen(calibration, names, MOST))
    rows = -(-len(data) // columns)
    made = plot_dist(
        xr.DataTree.from_dict({"posterior": data}),
        var_names=list(map(str, data)),
        kind="kde",
        col_wrap=columns,
        visuals={
            "dist": {"color": BLUE},
            "credible_interval": False,  # these two by hand: ArviZ 0.8 rounds them
            "point_estimate": False,
            "point_estimate_text": False,
            "title": False,
        },
        figure_kwargs={
            "figsize": (2.8 * min(columns, len(data)), 2.0 * rows + 0.3),
            "sharex": False,
        },
    )
    figure = _taken(made)
    for name in map(str, data):
        ax = made.viz["plot"][name].item()
        draws = data[name].values.ravel()
        low, high = np.quantile(draws, [0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2])
        ax.plot([low, high], [0, 0], color=ORANGE, lw=4, solid_capstyle="butt", zorder=3)
        ax.plot(draws.mean(), 0, "o", color=RED, ms=5, zorder=4)
        ax.set_xlabel(axis_label("", data[name].attrs["units"]).strip(), fontsize=9)
        ax.set_title(plain(name), fontsize=9)
        ax.locator_params(axis="x", nbins=4)
        ax.tick_params(labelsize=8)
    return figure


def _shown(data: xr.Dataset) -> xr.Dataset:
    """Unknowns under names that a tree can hold, in which a / would part groups."""
    return renamed(data, lambda name: name.replace("/", "\u2215"))


def members(calibration: Calibration, name: str) -> Figure:
    """What each run, cell or device has of a coefficient, with 95 % credible intervals (ArviZ's `plot_forest`).

    Args:
        calibration: a fit.
        name: of a coefficient with one value for each member of a group.

    Raises:
        InputError: there is no such coefficient.
    """
    from arviz_plots import plot_forest

    posterior = calibration.posterior
    grouped = [n for n in map(str, posterior) if set(posterior[n].dims) & set(GROUPS)]
    if name not in grouped:
        raise InputError(
            f"{name!r} has no value for each member of a group; these have: {', '.join(grouped) or 'none'}"
        )
    data = _shown(posterior[[name]].isel(draw=_thin(posterior)))
    (name,) = map(str, data)
    group = next(str(d) for d in data[name].dims if d not in ("chain", "draw"))
    made = plot_forest(
        xr.DataTree.from_dict({"posterior": data}),
        combined=True,
        labels=[group],
        ci_kind="eti",
        ci_probs=(0.5, INTERVAL),
        point_estimate="mean",
        visuals={
            "trunk": {"color": BLUE},
            "twig": {"color": BLUE},
            "point_estimate": {"color": RED},
        },
    )
    figure = _taken(made)
    figure.set_size_inches(6.4, 1.0 + 0.25 * data[name].sizes[group])
    figure.axes[-1].set_xlabel(axis_label(name, data[name].attrs["units"]))
    return figure


def pairs(calibration: Calibration, names: Sequence[str] | None = None) -> Figure:
    """Joint draws of the unknowns, two by two (ArviZ's `plot_pair`).

    Args:
        calibration: a fit.
        names: which; the four most correlated, if not given.

    Raises:
        InputError: no such unknown, or fewer than two.
    """
    from arviz_plots import plot_pair

    data = _shown(_chosen(calibration, names, MOST))
    if len(data) < 2:
        raise InputError(f"a picture of pairs needs two unknowns or more, not {len(data)}")
    if names is None:
        data = data[most_correlated(data)]
    side = 1.0 + 1.5 * len(data)
    made = plot_pair(
        xr.DataTree.from_dict({"posterior": data}),
        var_names=list(map(str, data)),
        marginal=True,
        visuals={
            "scatter": {"color": BLUE, "alpha": 0.25, "size": 6},
            "dist": {"color": BLUE},
            "divergence": False,
            "label": False,
            "credible_interval": False,
            "point_estimate": False,
            "point_estimate_text": False,
            "xlabel": False,
            "ylabel": False,
        },
        figure_kwargs={"figsize": (side, side)},
    )
    figure = _taken(made)
    for ax in figure.axes:
        for points in ax.collections:
            points.set_rasterized(True)  # thousands of points in a vector picture weigh too much
    _label_matrix(figure, data)
    return figure


def _label_matrix(figure: Figure, data: xr.Dataset) -> None:
    """Names and units along the lower and the left edge of a matrix of panels."""
    units = {str(n): axis_label("", v.attrs["units"]).strip() for n, v in data.items()}
    said = [f"{plain(name)}\n{unit}" for name, unit in units.items()]
    for ax in figure.axes:
        place = ax.get_subplotspec()
        if place is None:
            continue
        row, column = place.rowspan.start, place.colspan.start
        ax.tick_params(labelsize=7)
        ax.locator_params(axis="x", nbins=2)
        ax.locator_params(axis="y", nbins=3)
        if row == len(said) - 1:
            ax.set_xlabel(said[column], fontsize=8)
        if column == 0 and row > 0:
            ax.set_ylabel(said[row], fontsize=8)


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
    from arviz_plots import plot_ppc_pit

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
    figure = _taken(made)
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


def _taken(made: Any) -> Figure:
    """ArviZ's figure, out of pyplot's hands: nothing is shown, nothing is kept."""
    from matplotlib import pyplot

    figure = made.viz["figure"].item()
    pyplot.close(figure)
    FigureCanvasAgg(figure)
    figure.set_layout_engine("constrained")
    return figure
