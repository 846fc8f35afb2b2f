"""Widgets of the page: style, text, buttons, choices, rows and columns, figures, panes.

Text is never interpreted as HTML, including names of files and effects. Colours with a meaning are those of Okabe and
Ito, "Color universal design" (2008).
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.models import Range1d
from panel.custom import JSComponent

from bayescal import workshop as ws

FOLDER = Path(__file__).parent
CSS = (FOLDER / "page.css").read_text("utf-8")  # the grid and the colours, of the whole page
INSIDE = (FOLDER / "inside.css").read_text("utf-8")  # Panel's own widgets within it
TEXT_CSS = (FOLDER / "plain.css").read_text("utf-8")  # text
CHOICE_CSS = (FOLDER / "radio.css").read_text("utf-8")  # choices


def set_axis_range(*values: np.ndarray, view: Range1d | None = None) -> Range1d:
    """Return an axis range that covers the values with a margin; an existing `view` of that range keeps its zoom."""
    low, high = float(min(v.min() for v in values)), float(max(v.max() for v in values))
    margin = 0.06 * (high - low) or abs(high) or 1.0
    start, end = low - margin, high + margin
    axis = Range1d() if view is None else view
    if (axis.reset_start, axis.reset_end) != (start, end):
        axis.update(start=start, end=end, reset_start=start, reset_end=end)
    return axis


class Text(pn.pane.Str):
    """Text pane without HTML (Panel's would show `<b>` in bold); a table, which may scroll, accepts focus."""

    def _transform_object(self, obj: Any) -> dict[str, Any]:
        model = super()._transform_object(ws.escape_html(obj) if obj else "")
        if "table" in self.css_classes:
            focusable_tag = "&lt;pre tabindex=&quot;0&quot;&gt;"
            model["object"] = model["object"].replace("&lt;pre&gt;", focusable_tag, 1)
        return model


def label(text: str = "", *kinds: str, **settings: Any) -> Text:
    """Make a text of CSS classes `kinds`: "title", "small", "table" (a printed table), "refused" (an error)."""
    settings = {"margin": 0, "css_classes": list(kinds), "stylesheets": [TEXT_CSS], **settings}
    return Text(text, **settings)


def button(label: str, on_click: Any, **settings: Any) -> pn.widgets.Button:
    """Make a button in the page's style; `on_click` is called with the event."""
    panel_button = widget(pn.widgets.Button, label, **{"align": "center", **settings})
    panel_button.on_click(on_click)
    return panel_button


def row(*children: Any, kinds: tuple[str, ...] = (), **settings: Any) -> pn.Row:
    """Lay children out in a row, wrapped if the page is too narrow."""
    kinds = ("line", *kinds)
    return pn.Row(*children, css_classes=list(kinds), stylesheets=[INSIDE], margin=0, **settings)


def column(*children: Any, kinds: tuple[str, ...] = ("bare",), **settings: Any) -> pn.Column:
    """Lay children out in a column."""
    settings = {"sizing_mode": "stretch_both", "margin": 0, **settings}
    return pn.Column(*children, css_classes=list(kinds), stylesheets=[INSIDE], **settings)


def pair(left: Any, right: Any) -> pn.Column:
    """Lay out two widgets side by side, the left one narrower, or stacked if the page is too narrow."""
    return column(left, right, kinds=("halves",))


def figure_pane(fig: Any) -> pn.pane.Bokeh:
    """Wrap a Bokeh figure in a pane that fills its container."""
    return pn.pane.Bokeh(fig, sizing_mode="stretch_both", margin=0, min_height=0)


def widget(kind: type[Any], label: str, **settings: Any) -> Any:
    """Make a Panel widget in the page's style."""
    return kind(label=label, **{"stylesheets": [INSIDE], "margin": 0, **settings})


def download_button(label: str, **settings: Any) -> pn.widgets.FileDownload:
    """Make a button that downloads a file: `file`, or the one that `callback` returns when it is pressed."""
    options = {"file": BytesIO(), "filename": "none"} if "callback" not in settings else {}
    options |= {"embed": False, "auto": True, "align": "center", "color": "primary"}
    return widget(pn.widgets.FileDownload, label, **{**options, **settings})


def radio_buttons(options: list[str], value: str, label: str) -> pn.widgets.RadioBoxGroup:
    """Make radio buttons, which are accessible by keyboard, unlike Bokeh's tabs and button groups."""
    settings: dict[str, Any] = {"options": options, "value": value, "inline": True}
    return widget(pn.widgets.RadioBoxGroup, label, stylesheets=[INSIDE, CHOICE_CSS], **settings)


def check_boxes(label: str, **settings: Any) -> pn.widgets.CheckBoxGroup:
    """Make check boxes, whose labels are text (those of `MultiChoice` are HTML)."""
    options = {"inline": True, "stylesheets": [INSIDE, CHOICE_CSS], **settings}
    return widget(pn.widgets.CheckBoxGroup, label, **options)


class Rows(JSComponent):
    """List of rows with buttons, or a table with column headers.

    Attributes:
        rows: each {"id", "cells": [{"text", "bar", "kind", "title"}], "actions": [{"id", "label", "title"}], "group",
            "kind", "current", "note"}; `bar` is the length of a bar, from 0 to 1.
        head: column headers of a table.
        table: whether the rows are shown as a table.
        pointing: whether hovering over a row, or focusing on it, sets `pointed`.
        pointed: id of the row last pointed at; empty for none.
        busy: whether the buttons are disabled.
        label: label for screen readers.
        kind: CSS class.
    """

    rows = param.List(default=[], item_type=dict)
    head = param.List(default=[], item_type=str)
    table = param.Boolean(default=False)
    pointing = param.Boolean(default=False)
    pointed = param.String(default="")
    busy = param.Boolean(default=False)
    label = param.String(default="")
    kind = param.String(default="")

    _esm = FOLDER / "rows.js"
    _stylesheets = [(FOLDER / "rows.css").read_text("utf-8")]  # noqa: RUF012

    def __init__(self, on_press: Callable[[str, str], None] | None = None, **settings: Any) -> None:
        """Make the list; `on_press` is called with the ids of the row and of the action when a button is pressed."""
        sizing = {"margin": 0, "sizing_mode": "stretch_both", "styles": {"min-height": "0"}}
        super().__init__(**{**sizing, **settings})
        self._on_press = on_press

    def _handle_msg(self, data: Any) -> None:
        """Call `on_press` after a click in the browser, if the row and its action exist and are enabled."""
        if self._on_press is None or self.busy or not isinstance(data, dict):
            return
        pressed = data.get("row"), data.get("action")
        if pressed in {(row["id"], a["id"]) for row in self.rows for a in row.get("actions", ())}:
            self._on_press(*map(str, pressed))


class Pane:
    """Base class of the panes of the page.

    Attributes:
        page, session: the page (`app.Workbench`), whose methods are a pane's actions, and its session.
        view: Panel view of the pane.
    """

    view: Any

    def __init__(self, page: Any) -> None:
        self.page, self.session = page, page.session

    def show(self, state: Any) -> None:
        """Show a state of the session."""
