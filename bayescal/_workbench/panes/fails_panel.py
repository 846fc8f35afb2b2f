"""A panel of "where it fails": over one column the output with the fit, and the residuals with the noise, the worst
region, the curve of a preview.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, HoverTool, PlainText, Range1d, Span

from bayescal._report.plot_colours import RED
from bayescal._workbench.panes.fails_data import AGAINST, TIME, ResidualsOfState
from bayescal._workbench.parts.style import Palette, dress, fixed_range, new_figure

TOOLS = "box_select,lasso_select,xwheel_zoom,pan,reset,tap"
SHORT = 48  # letters of a label
FEW = 600  # readings up to which points are large
NOISE, CURVE, FIT, AT = "#8a939b", "curve", "fit", "at "


def residual_panel(
    shown: ResidualsOfState,
    name: str,
    source: ColumnDataSource,
    curves: ColumnDataSource,
    y_range: Range1d,
) -> Any:
    """A figure of one column; its readings come from the source of all panels, which are so brushed together.

    Args:
        shown: the state.
        name: of the column, or AGAINST: measured against predicted.
        source: of all panels; the column stands in it as `AT` and its name.
        curves: the same of a preview's curve.
        y_range: of the residuals, the same in all panels.
    """
    if name == AGAINST:
        return _against(shown, source)
    made = _figure(shown, name, f"residual [{shown.unit}]", y_range)
    _ground(made, shown, name)
    _other(made, AT + name, "before", source)
    _points(made, AT + name, "residual", source)
    _dots(made, AT + name, CURVE, curves)
    return made


def output_panel(shown: ResidualsOfState, name: str, source: ColumnDataSource, beneath: Any) -> Any:
    """The output over the column of the panel beneath it, with the fit on it; both are zoomed together."""
    measured = fixed_range(float(shown.measured.min()), float(shown.measured.max()))
    made = _figure(shown, name, f"output [{shown.unit}]", measured, beneath.x_range)
    made.xaxis.axis_label, made.xaxis.major_label_text_font_size = None, "0px"
    made.min_width = 0
    _points(made, AT + name, "measured", source)
    _other(made, AT + name, "fit before", source)
    _dots(made, AT + name, FIT, source)
    return made


def _figure(
    shown: ResidualsOfState, name: str, label: str, y_range: Range1d, x_range: Range1d | None = None
) -> Any:
    at, unit = shown.places[name], shown.units[name]
    made = new_figure(
        name[:SHORT] if name in shown.levels else f"{name[:SHORT]} [{unit or '1'}]",
        label,
        tools=TOOLS,
        active_drag="box_select",
        active_scroll="xwheel_zoom",
        x_range=x_range or fixed_range(float(at.min()), float(at.max())),
        y_range=y_range,
    )
    made.name = f"panel {name}"
    if name == TIME and shown.cut is not None:
        shown.cut.label(made, NOISE)
    if levels := shown.levels.get(name):
        made.xaxis.ticker = list(range(len(levels)))
        made.xaxis.major_label_overrides = {k: PlainText(text=v[:12]) for k, v in enumerate(levels)}
    return made


def _against(shown: ResidualsOfState, source: ColumnDataSource) -> Any:
    """Measured against predicted, with the line on which they are equal."""
    measured = fixed_range(float(shown.measured.min()), float(shown.measured.max()))
    made = _figure(shown, AGAINST, f"measured [{shown.unit}]", measured)
    made.xaxis.axis_label = PlainText(text=f"predicted [{shown.unit}]")
    ends = [float(np.min(shown.covariates[AGAINST])), float(np.max(shown.covariates[AGAINST]))]
    made.line(ends, ends, color=NOISE, line_dash="dashed")
    _points(made, AT + AGAINST, "measured", source)
    return made


def show_curve(made: Any, on: bool) -> None:
    """Whether a panel has the curve of a preview."""
    for renderer in made.renderers:
        if renderer.name == CURVE:
            renderer.visible = on


def dress_panel(made: Any, palette: Palette) -> None:
    """A panel in the colours of its ground."""
    dress(made, palette)
    for renderer in made.renderers:
        if renderer.name in (CURVE, FIT):
            renderer.glyph.fill_color = palette.ink


def _ground(made: Any, shown: ResidualsOfState, name: str) -> None:
    """The noise, zero, and the worst region."""
    noise, entry = shown.check.noise, shown.entry(name)
    plain = {"line_alpha": 0.0, "level": "underlay"}
    made.add_layout(
        BoxAnnotation(bottom=-noise, top=noise, fill_color=NOISE, fill_alpha=0.16, **plain)
    )
    made.add_layout(Span(location=0, dimension="width", line_color=NOISE, line_width=1))
    if entry is None or entry.log_bayes_factor <= 0:
        return
    low, high = entry.worst.low, entry.worst.high
    if entry.by_group:
        low = high = float(shown.levels[name].index(str(entry.worst.group)))
    if name == TIME and shown.cut is not None:
        low, high = map(float, shown.cut.place(np.array([low, high])))
    wide = 0.02 * float(np.ptp(shown.places[name])) if low == high else 0.0
    region = {"fill_color": RED, "fill_alpha": 0.14, "line_color": RED, "line_alpha": 0.5}
    made.add_layout(BoxAnnotation(left=low - wide, right=high + wide, level="underlay", **region))


def _other(made: Any, x: str, y: str, source: ColumnDataSource) -> None:
    """Of the step that this one is compared with."""
    hollow = {"fill_color": None, "line_color": NOISE, "line_alpha": 0.7}
    made.scatter(x, y, source=source, size=4, nonselection_line_alpha=0.2, **hollow)


def _dots(made: Any, x: str, name: str, source: ColumnDataSource) -> None:
    """A curve, a dot a reading."""
    size = 3.5 if name == CURVE else 2.5
    made.scatter(
        x, name, source=source, size=size, line_color=None, name=name, nonselection_alpha=0.9
    )


def _points(made: Any, x: str, y: str, source: ColumnDataSource) -> None:
    points = made.scatter(
        x,
        y,
        source=source,
        size=5 if len(source.data["row"]) <= FEW else 3.5,
        marker="marker",
        fill_color="colour",
        line_color=None,
        fill_alpha=0.75,
        nonselection_fill_alpha=0.12,
        selection_fill_alpha=1.0,
    )
    told = [("reading", "@reading"), ("run", "@run"), (y, f"@{y}{{0.0000 a}}")]
    made.add_tools(
        HoverTool(renderers=[points], tooltips=told, point_policy="follow_mouse", limit=1)
    )
