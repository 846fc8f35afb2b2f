"""What the page is pieced together from: text (always text, never HTML, whatever a file or an effect is called),
buttons, choices, rows and columns.
"""

from __future__ import annotations

from typing import Any

import panel as pn

from bayescal._core.quoting import html_text
from bayescal._workbench.parts.style import INSIDE, PLAIN, RADIO


class Text(pn.pane.Str):
    """Panel's pane of text, which shows `<b>` in bold: here it stays text."""

    def _transform_object(self, obj: Any) -> dict[str, Any]:
        return super()._transform_object(html_text(obj) if obj else "")


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
