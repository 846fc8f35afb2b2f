"""How the page looks: its colours, light and dark, its grid at three widths, and Bokeh figures in the same colours.

Colours that carry a meaning: Okabe and Ito, "Color universal design" (2008).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bokeh.models import Legend, PlainText, Range1d
from bokeh.plotting import figure

from bayescal._report.plot_colours import BLUE, CYCLE, GREEN, ORANGE, PURPLE, RED, SKY

YELLOW = "#F0E442"
HERE = Path(__file__).parent
CSS = (HERE / "page.css").read_text("utf-8")  # the grid and the colours, of the whole page
INSIDE = (HERE / "inside.css").read_text("utf-8")  # Panel's own widgets within it
PLAIN = (HERE / "plain.css").read_text("utf-8")  # text
RADIO = (HERE / "radio.css").read_text("utf-8")  # choices


class Palette(NamedTuple):
    """Colours of what Bokeh draws, for one of the two grounds."""

    ink: str
    quiet: str
    line: str
    cycle: tuple[str, ...]
    blue: str


LIGHT = Palette(ink="#1c2126", quiet="#5a636b", line="#d9dde1", cycle=CYCLE, blue=BLUE)
DARK = Palette(
    ink="#e8eaed",
    quiet="#a3acb5",
    line="#3b424a",
    cycle=(SKY, ORANGE, GREEN, RED, PURPLE, YELLOW),
    blue=SKY,
)
MARKERS = ("circle", "square", "triangle", "diamond", "inverted_triangle", "hex")


def new_figure(x_label: str, y_label: str, **settings: Any) -> Any:
    """An empty Bokeh figure that fills its room, with the tools of all; `$$` in a label begins no formula."""
    made: Any = figure(
        **{
            "sizing_mode": "stretch_both",
            "min_width": 120,
            "min_height": 110,
            "toolbar_location": None,
            "x_axis_label": PlainText(text=x_label),
            "y_axis_label": PlainText(text=y_label),
            **settings,
        }
    )
    made.border_fill_alpha = made.background_fill_alpha = 0
    made.outline_line_color = None
    made.min_border = 6
    for axis in made.axis:
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "12px"
        axis.major_label_text_font_size = "11px"
        axis.minor_tick_line_color = None
        axis.axis_label_standoff = 4
    made.xaxis.ticker.desired_num_ticks = 5
    made.yaxis.ticker.desired_num_ticks = 6
    return made


def dress(made: Any, palette: Palette) -> None:
    """A figure in the colours of its ground."""
    for axis in made.axis:
        axis.axis_label_text_color = palette.ink
        axis.major_label_text_color = palette.quiet
        axis.axis_line_color = axis.major_tick_line_color = palette.quiet
    for grid in made.grid:
        grid.grid_line_color = palette.line
        grid.grid_line_alpha = 0.6
    if made.title is not None:
        made.title.text_color = palette.ink
    for legend in made.select(Legend):
        legend.label_text_color = palette.ink
        legend.background_fill_alpha = legend.border_line_alpha = 0


def range_over(*values: np.ndarray, view: Range1d | None = None) -> Range1d:
    """A range with a little room at either end, to which a reset returns; one of the same ends keeps its view."""
    low, high = float(min(v.min() for v in values)), float(max(v.max() for v in values))
    room = 0.06 * (high - low) or abs(high) or 1.0
    start, end = low - room, high + room
    made = Range1d() if view is None else view
    if (made.reset_start, made.reset_end) != (start, end):
        made.update(start=start, end=end, reset_start=start, reset_end=end)
    return made
