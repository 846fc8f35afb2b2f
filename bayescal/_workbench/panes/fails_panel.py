"""A panel of "where it fails": over one column the output with the fit, and residuals with the noise, the worst region,
the curve of a preview.
"""

from __future__ import annotations

from typing import Any

from bokeh.models import (
    BoxAnnotation,
    ColumnDataSource,
    HoverTool,
    PlainText,
    Range1d,
    Scatter,
    Span,
)

from bayescal._report.plot_colours import RED
from bayescal._workbench.panes.fails_data import TIME, ResidualsOfState
from bayescal._workbench.parts.pieces import column, plot
from bayescal._workbench.parts.style import Palette, dress, new_figure, range_over

TOOLS = "box_select,lasso_select,xwheel_zoom,pan,reset,tap"
SHORT = 48  # letters of a label
FEW = 600  # readings up to which points are large
NOISE, CURVE, FIT, AT = "#8a939b", "curve", "fit", "at "
OUTPUT, RESIDUALS = WHAT = ["output", "residuals"]


class ColumnPanel:
    """One column's output and residuals, one above the other, zoomed together.

    It is made once for the readings: of another state, only what is drawn in it changes. A new figure would cost the
    browser a new layout of the whole page.

    Attributes:
        figures: of output and residuals.
        x_range: of both.
        room: what the page shows.
    """

    def __init__(
        self,
        shown: ResidualsOfState,
        name: str,
        source: ColumnDataSource,
        curves: ColumnDataSource,
        y_range: Range1d,
    ) -> None:
        """Args:
        shown: the state.
        name: of the column.
        source: of all panels, whose readings are so brushed together; the column stands in it as `AT` and its name.
        curves: the same of a preview's curve.
        y_range: of the residuals, the same in all panels.
        """
        self._name, x = name, AT + name
        self.x_range = range_over(shown.places[name])
        measured = range_over(shown.measured)
        output = _figure(shown, name, f"output [{shown.unit}]", self.x_range, measured)
        output.xaxis.axis_label, output.xaxis.major_label_text_font_size = None, "0px"
        _points(output, x, "measured", source)
        _other(output, x, "fit before", source)
        _dots(output, x, FIT, source)
        made = _figure(shown, name, f"residual [{shown.unit}]", self.x_range, y_range)
        plain: dict[str, Any] = {"level": "underlay", "fill_alpha": 0.16}
        self._noise = BoxAnnotation(fill_color=NOISE, line_alpha=0.0, **plain)
        self._worst = BoxAnnotation(fill_color=RED, line_color=RED, line_alpha=0.5, **plain)
        zero = Span(location=0, dimension="width", line_color=NOISE, line_width=1)
        for ground in (self._noise, zero, self._worst):
            made.add_layout(ground)
        _other(made, x, "before", source)
        _points(made, x, "residual", source)
        _dots(made, x, CURVE, curves)
        self.figures = {OUTPUT: output, RESIDUALS: made}
        self.room: Any = column(kinds=("stack",))
        self.show(shown)

    def show(self, shown: ResidualsOfState) -> None:
        """Show another state of the same readings; a view of a part stays where its column does."""
        range_over(shown.places[self._name], view=self.x_range)
        self._noise.update(bottom=-shown.check.noise, top=shown.check.noise)
        region = shown.worst(self._name)
        self._worst.visible = region is not None
        if region is not None:
            self._worst.update(left=region[0], right=region[1])

    def place(self, what: list[str]) -> None:
        """Have output, residuals or both in the room; residuals where neither is asked for."""
        wanted = [self.figures[w] for w in WHAT if w in (what or [RESIDUALS])]
        if [pane.object for pane in self.room] != wanted:
            self.room[:] = [plot(one) for one in wanted]

    def wear(self, palette: Palette) -> None:
        """Take the colours of a ground."""
        for made in self.figures.values():
            dress(made, palette)
            for renderer in made.renderers:
                if renderer.name in (CURVE, FIT):
                    renderer.glyph.fill_color = renderer.nonselection_glyph.fill_color = palette.ink


def _figure(
    shown: ResidualsOfState, name: str, label: str, x_range: Range1d, y_range: Range1d
) -> Any:
    unit = shown.units[name]
    made = new_figure(
        name[:SHORT] if name in shown.levels else f"{name[:SHORT]} [{unit or '1'}]",
        label,
        tools=TOOLS,
        active_drag="box_select",
        active_scroll="xwheel_zoom",
        x_range=x_range,
        y_range=y_range,
        # Their sum would be a property of the room of all, and a change of it one layout of the page more.
        min_width=0,
        min_height=0,
    )
    made.name = f"panel {name}"
    if name == TIME and shown.cut is not None:
        shown.cut.label(made, NOISE)
    if levels := shown.levels.get(name):
        made.xaxis.ticker = list(range(len(levels)))
        made.xaxis.major_label_overrides = {k: PlainText(text=v[:12]) for k, v in enumerate(levels)}
    return made


def _other(made: Any, x: str, y: str, source: ColumnDataSource) -> None:
    """Of the step that this one is compared with."""
    hollow = {"fill_color": None, "line_color": NOISE, "line_alpha": 0.7, "size": 4}
    _scatter(made, source, {"x": x, "y": y, **hollow}, {"line_alpha": 0.2})


def _dots(made: Any, x: str, name: str, source: ColumnDataSource) -> None:
    """A curve, a dot a reading."""
    dot = {"size": 3.5 if name == CURVE else 2.5, "line_color": None}
    _scatter(made, source, {"x": x, "y": name, **dot}, {"fill_alpha": 0.9}).name = name


def _points(made: Any, x: str, y: str, source: ColumnDataSource) -> None:
    size = 5 if len(source.data["row"]) <= FEW else 3.5
    plain = {"marker": "marker", "fill_color": "colour", "line_color": None, "fill_alpha": 0.75}
    drawn = {"x": x, "y": y, "size": size, **plain}
    points = _scatter(made, source, drawn, {"fill_alpha": 0.12}, {"fill_alpha": 1.0})
    told = [("reading", "@reading"), ("run", "@run"), (y, f"@{y}{{0.0000 a}}")]
    made.add_tools(
        HoverTool(renderers=[points], tooltips=told, point_policy="follow_mouse", limit=1)
    )


def _scatter(
    made: Any,
    source: ColumnDataSource,
    drawn: dict[str, Any],
    beside: dict[str, Any],
    selected: dict[str, Any] | None = None,
) -> Any:
    """Points, what differs of those beside a selection and in it; `figure.scatter` makes twice as many models."""
    glyphs = {"nonselection_glyph": Scatter(**{**drawn, **beside})}
    if selected:
        glyphs["selection_glyph"] = Scatter(**{**drawn, **selected})
    return made.add_glyph(source, Scatter(**drawn), **glyphs)
