"""What the page is pieced together from: its style, text, buttons, choices, rows and columns, figures, panes.

Text is always text, never HTML, whatever a file or an effect is called. Colours that carry a meaning: Okabe and Ito,
"Color universal design" (2008).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import panel as pn
import param
from bokeh.models import NoOverlap, PlainText, Range1d
from bokeh.plotting import figure
from panel.custom import JSComponent

from bayescal import workshop as ws

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


LIGHT = Palette(
    ink="#1c2126",
    quiet="#5a636b",
    line="#d9dde1",
    cycle=ws.plot_colours.CYCLE,
    blue=ws.plot_colours.BLUE,
)
DARK = Palette(
    ink="#e8eaed",
    quiet="#a3acb5",
    line="#3b424a",
    cycle=(ws.plot_colours.SKY, *ws.plot_colours.CYCLE[1:-1], YELLOW),
    blue=ws.plot_colours.SKY,
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
        axis.major_label_policy = NoOverlap()
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


def range_over(*values: np.ndarray, view: Range1d | None = None) -> Range1d:
    """A range with a little room at either end, to which a reset returns; one of the same ends keeps its view."""
    low, high = float(min(v.min() for v in values)), float(max(v.max() for v in values))
    room = 0.06 * (high - low) or abs(high) or 1.0
    start, end = low - room, high + room
    made = Range1d() if view is None else view
    if (made.reset_start, made.reset_end) != (start, end):
        made.update(start=start, end=end, reset_start=start, reset_end=end)
    return made


class Text(pn.pane.Str):
    """Panel's pane of text, which shows `<b>` in bold: here it stays text; a table, which may scroll, takes focus."""

    def _transform_object(self, obj: Any) -> dict[str, Any]:
        made = super()._transform_object(ws.html_text(obj) if obj else "")
        if "table" in self.css_classes:
            focused = "&lt;pre tabindex=&quot;0&quot;&gt;"
            made["object"] = made["object"].replace("&lt;pre&gt;", focused, 1)
        return made


def words(text: str = "", *kinds: str, **settings: Any) -> Text:
    """A text; `kinds`: "title", "small" (quiet), "table" (a printed one), "refused"."""
    settings = {"margin": 0, "css_classes": list(kinds), "stylesheets": [PLAIN], **settings}
    return Text(text, **settings)


def button(label: str, press: Any, **settings: Any) -> pn.widgets.Button:
    """A button in the page's style; `press` is called with the event."""
    made = field(pn.widgets.Button, label, **{"align": "center", **settings})
    made.on_click(press)
    return made


def row(*children: Any, kinds: tuple[str, ...] = (), **settings: Any) -> pn.Row:
    """Children beside each other, wrapped where there is no room."""
    kinds = ("line", *kinds)
    return pn.Row(*children, css_classes=list(kinds), stylesheets=[INSIDE], margin=0, **settings)


def column(*children: Any, kinds: tuple[str, ...] = ("bare",), **settings: Any) -> pn.Column:
    """Children below each other."""
    settings = {"sizing_mode": "stretch_both", "margin": 0, **settings}
    return pn.Column(*children, css_classes=list(kinds), stylesheets=[INSIDE], **settings)


def halves(left: Any, right: Any, *, even: bool = False) -> pn.Column:
    """Two parts beside each other, below each other where there is no room: the left narrower, or both alike."""
    return column(left, right, kinds=("halves", *(["even"] if even else [])))


def plot(made: Any) -> pn.pane.Bokeh:
    """A Bokeh figure that fills its room."""
    return pn.pane.Bokeh(made, sizing_mode="stretch_both", margin=0, min_height=0)


def field(kind: type[Any], label: str, **settings: Any) -> Any:
    """A widget of a kind of Panel's in the page's style."""
    return kind(label=label, **{"stylesheets": [INSIDE], "margin": 0, **settings})


def code_field(label: str, **settings: Any) -> pn.widgets.TextAreaInput:
    """A field of several lines of code."""
    settings = {"sizing_mode": "stretch_both", "css_classes": ["code"], **settings}
    return field(pn.widgets.TextAreaInput, label, **settings)


def download(label: str, **settings: Any) -> pn.widgets.FileDownload:
    """A button that downloads what it is given when it is pressed, not before."""
    settings = {"embed": False, "auto": True, "align": "center", **settings}
    return field(pn.widgets.FileDownload, label, **settings)


def choice(options: list[str], value: str, label: str) -> pn.widgets.RadioBoxGroup:
    """One of a few: radio buttons, which the keyboard reaches as Bokeh's tabs and button groups are not reached."""
    return _boxes(pn.widgets.RadioBoxGroup, label, options=options, value=value)


def several(options: list[str], value: list[str], label: str) -> pn.widgets.CheckBoxGroup:
    """Some of many, as check boxes: their labels are text (those of `MultiChoice` are HTML)."""
    kind = pn.widgets.CheckBoxGroup
    return _boxes(kind, label, options=options, value=value, css_classes=["several"])


def _boxes(kind: type[Any], label: str, **settings: Any) -> Any:
    return field(kind, label, inline=True, **{**settings, "stylesheets": [INSIDE, RADIO]})


class Rows(JSComponent):
    """A list of rows, or a table with a head.

    Attributes:
        rows: each {"id", "cells": [{"text", "bar", "kind", "title"}], "actions": [{"id", "label", "title",
            "off", "reads"}], "group", "kind", "current", "note"}; `bar` from 0 to 1.
        head: titles of a table's columns.
        table: whether it is one.
        pointing: whether pointing at a row, with the pointer or the keyboard, counts.
        pointed: the row pointed at last; empty for none.
        busy: whether its buttons are shut for now, but those of actions that only read.
        label: its name for those who hear the page.
        kind: class of its style.
    """

    rows = param.List(default=[], item_type=dict)
    head = param.List(default=[], item_type=str)
    table = param.Boolean(default=False)
    pointing = param.Boolean(default=False)
    pointed = param.String(default="")
    busy = param.Boolean(default=False)
    label = param.String(default="")
    kind = param.String(default="")

    _esm = HERE / "rows.js"
    _stylesheets = [(HERE / "rows.css").read_text("utf-8")]  # noqa: RUF012

    def __init__(self, on_press: Callable[[str, str], None] | None = None, **settings: Any) -> None:
        """As `JSComponent`; `on_press(row, action)` is called when a row's button is pressed."""
        room = {"margin": 0, "sizing_mode": "stretch_both", "styles": {"min-height": "0"}}
        super().__init__(**{**room, **settings})
        self._on_press = on_press

    def _handle_msg(self, data: Any) -> None:
        """A press in the browser: taken only where the row and its action are there and open."""
        if self._on_press is None or not isinstance(data, dict):
            return
        for row in self.rows:
            if row["id"] == data.get("row"):
                actions = [a for a in row.get("actions", ()) if not a.get("off")]
                open_now = {a["id"] for a in actions if a.get("reads") or not self.busy}
                if (action := str(data.get("action"))) in open_now:
                    self._on_press(row["id"], action)  # pyright: ignore[reportArgumentType]
                return


class Pane:
    """A part of the page; what of this it has no use for, it leaves as it is here.

    Attributes:
        bench, session: the whole page (`app.Workbench`), through which a pane acts, and what it is over.
        figures: Bokeh's, which take the colours of the ground.
        view: what Panel shows.
    """

    view: Any

    def __init__(self, bench: Any) -> None:
        self.bench, self.session = bench, bench.session
        self.figures: list[Any] = []

    def show(self, state: Any) -> None:
        """Show another state, or forget what was of the one before."""

    def wear(self, palette: Palette) -> None:
        """Take the colours of a ground."""
        for made in self.figures:
            dress(made, palette)

    def busy(self, busy: bool) -> None:
        """Shut or open what changes the model."""
