"""What every picture shares: figures, labels with units, saving."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayescal._core.atomic_file import replacing_for_user
from bayescal._data.unit_conversion import unit_label

LONGEST = 32  # letters of a label; what is longer leaves no room for the picture


def new_figure(width: float, height: float) -> Figure:
    """An empty figure that no window knows of; inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def axes_of(ax: Any, width: float, height: float) -> Any:
    """The axes to draw in: those given, or of a figure of their own, inches."""
    return new_figure(width, height).subplots() if ax is None else ax


def plain(text: str) -> str:
    """A text from a file as a label: cut short, and its dollar signs begin no formula."""
    return no_formula(text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…")


def no_formula(text: str) -> str:
    """A text as Matplotlib draws it: its dollar signs begin no formula."""
    return text.replace("$", r"\$")


def axis_label(name: str, unit: str) -> str:
    """A name with its unit, "temperature [°C]"; a pure number is in units of one, "[1]"."""
    return f"{plain(name)} [{unit_label(unit) or '1'}]"


def open_sides(ax) -> None:
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def save(figure: Figure, path: Path) -> Path:
    """Write a PNG, beside and then renamed.

    Raises:
        InputError: no such folder, or a place that cannot be written to.
    """
    path = Path(path)
    with replacing_for_user(path) as partial:
        figure.savefig(partial, dpi=150, format="png")
    return path
