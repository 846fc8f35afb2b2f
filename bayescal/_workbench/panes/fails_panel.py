"""One panel of "where it fails": residuals against one column, the noise, the worst region, the curve of a preview."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, HoverTool, PlainText, Range1d, Span

from bayescal._workbench.panes.fails_data import AGAINST, ResidualsOfState
from bayescal._workbench.parts.style import RED, Palette, dress, fixed_range, new_figure

TOOLS = "box_select,lasso_select,xwheel_zoom,pan,reset,tap"
SHORT = 48  # letters of a label
FEW = 600  # readings up to which points are large
NOISE, CURVE, AT = "#8a939b", "curve", "at "


def residual_panel(
    shown: ResidualsOfState, name: str, source: ColumnDataSource, y_range: Range1d
) -> Any:
    """A figure of one column; its readings come from the source of all panels, which are so brushed together.

    Args:
        shown: the state.
        name: of the column, or AGAINST: measured against predicted.
        source: of all panels; the column stands in it as `AT` and its name.
        y_range: of the residuals, the same in all panels.
    """
    values, unit, against = shown.covariates[name], shown.units[name], name == AGAINST
    x = AT + name
    low, high = float(values.min()), float(values.max())
    label = "predicted" if against else name[:SHORT]
    made = new_figure(
        label if name in shown.levels else f"{label} [{unit or '1'}]",
        f"measured [{shown.unit}]" if against else f"residual [{shown.unit}]",
        tools=TOOLS,
        active_drag="box_select",
        active_scroll="xwheel_zoom",
        x_range=fixed_range(low, high),
        y_range=fixed_range(float(shown.measured.min()), float(shown.measured.max()))
        if against
        else y_range,
    )
    made.name = f"panel {name}"
    if against:
        made.line([low, high], [low, high], color=NOISE, line_dash="dashed")
    else:
        _ground(made, shown, name)
        made.scatter(
            x,
            "before",
            source=source,
            size=4,
            fill_color=None,
            line_color=NOISE,
            line_alpha=0.7,
            nonselection_line_alpha=0.2,
        )
    _points(made, x, "measured" if against else "residual", source)
    if not against:
        made.scatter(
            x, CURVE, source=source, size=3.5, line_color=None, name=CURVE, nonselection_alpha=0.9
        )
    if levels := shown.levels.get(name):
        made.xaxis.ticker = list(range(len(levels)))
        made.xaxis.major_label_overrides = {k: PlainText(text=v[:12]) for k, v in enumerate(levels)}
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
        if renderer.name == CURVE:
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
    wide = 0.02 * float(np.ptp(shown.covariates[name])) if low == high else 0.0
    region = {"fill_color": RED, "fill_alpha": 0.14, "line_color": RED, "line_alpha": 0.5}
    made.add_layout(BoxAnnotation(left=low - wide, right=high + wide, level="underlay", **region))


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
