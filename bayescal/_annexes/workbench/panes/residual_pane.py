"""The residual pane ("Where it fails"): output with fit, and residuals, against several columns, with linked brushing.

All panels share one data source, drawn by WebGL if the browser has it; large data sets are decimated. A panel shows,
against one column, the output with the fit, and residuals with the noise, the worst region and a preview's curve.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    BoxAnnotation,
    ColumnDataSource,
    HoverTool,
    NoOverlap,
    PlainText,
    Range1d,
    Scatter,
    Span,
)
from bokeh.plotting import figure

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.widgets import (
    Pane,
    check_boxes,
    column,
    figure_pane,
    label,
    row,
    set_axis_range,
)

MAX_DRAWN_READINGS = 50_000  # that a browser draws without delay


def decimate(*quantities: np.ndarray) -> np.ndarray:
    """Return the indices of the readings to draw: all, or of many readings the extremes in equal segments.

    Args:
        quantities: quantities whose extremes are drawn, such as residuals and output, (n,) each.
    """
    size = quantities[0].size
    if size <= MAX_DRAWN_READINGS:
        return np.arange(size)
    ends = np.linspace(0, size, MAX_DRAWN_READINGS // (2 * len(quantities)) + 1).astype(int)
    segment, is_drawn = np.repeat(np.arange(ends.size - 1), np.diff(ends)), np.zeros(size, bool)
    for values in quantities:
        order = np.lexsort((values, segment))  # by segment, then by value
        is_drawn[order[ends[:-1]]] = is_drawn[order[ends[1:] - 1]] = True
    return np.flatnonzero(is_drawn)


PREDICTED = "predicted output"  # covariate: the output is then drawn against its prediction


class ResidualsOfState:
    """Residuals of a state, and the covariates to plot them against."""

    def __init__(self, step: Any, compared: np.ndarray | None) -> None:
        """Read a state's step; `compared` are the residuals of the step to compare with, output unit, (n,), or None."""
        readings, columns = step.calibration.readings, ws.collect_covariates(step.calibration)
        self.check: bc.Check = step.check
        self.compared, self.runs = compared, readings.groups("run")
        self.residual = np.asarray(self.check.residuals, float)
        self.output = np.asarray(readings[readings.output], float)
        # (n,) each, by name; group members as numbers 0, 1, …; the last is the predicted output.
        self.covariates = {c.name: np.asarray(c.values, float) for c in columns}
        self.covariates[PREDICTED] = self.output - self.residual
        self.unit = ws.unit_label(self.check.unit)
        self.units = {c.name: ws.unit_label(c.unit or "") for c in columns} | {PREDICTED: self.unit}
        self.levels = {c.name: c.levels for c in columns if c.levels}  # members of the groups

    def find_worst_range(self, name: str) -> tuple[float, float] | None:
        """Return the ends of a covariate's worst range; None if its log Bayes factor is not positive."""
        entry = next((e for e in self.check.entries if e.covariate == name), None)
        if entry is None or entry.log_bayes_factor <= 0:
            return None
        low, high = entry.worst.low, entry.worst.high
        if entry.by_group:
            low = high = float(self.levels[name].index(str(entry.worst.group)))
        margin = 0.02 * float(np.ptp(self.covariates[name])) if low == high else 0.0
        return low - margin, high + margin

    def choose_columns(self) -> list[str]:
        """Return the initial columns: the two continuous covariates of largest log Bayes factor."""
        ranked_names = [e.covariate for e in self.check.entries if not e.by_group]
        chosen_names = ranked_names[:2] or [n for n in self.covariates if n != PREDICTED][:2]
        return [n for n in self.covariates if n in chosen_names] or [PREDICTED]

    def describe_misfit(self) -> str:
        """Describe in a sentence the worst range of the covariate with the largest log Bayes factor."""
        entry = max(self.check.entries, key=lambda e: e.log_bayes_factor, default=None)
        if entry is None:
            return "No column varies: there is no covariate to plot the residuals against."
        rms_text = f"Residuals: {self.check.rms:.3g} {self.unit} rms; noise: {self.check.noise:.3g} {self.unit}. "
        if entry.log_bayes_factor < 0:
            return rms_text + "No log Bayes factor for a dependence on a column is above zero."
        region = ws.describe_region(entry.to_json_data(self.check.unit))
        return (
            f"{rms_text}In the worst region of the covariate {entry.covariate}, {region}, the mean residual is "
            f"{entry.worst.size:+.3g} {self.unit} (z = {entry.worst.z:+.1f}; log Bayes factor "
            f"{entry.log_bayes_factor:.1f})."
        ).replace("-", "−")


# Colours of figures, legible on a light and on a dark page.
INK_COLOUR, FIT_COLOUR, GRID_COLOUR = "#7a838b", "#d1007a", "#8a939b55"
COLOURS = ws.plot_colours.CYCLE
MARKERS = ("circle", "square", "triangle", "diamond", "inverted_triangle", "hex")
TOOLS = "box_select,lasso_select,xwheel_zoom,pan,reset,tap"
MAX_LABEL_LETTERS = 48  # of an axis label
MAX_LARGE_POINTS = 600  # number of readings up to which points are large
NOISE_COLOUR, CURVE_FIELD, FIT_FIELD, AT = "#8a939b", "curve", "fit", "at "
# Styles of a reading, of one of the compared step (hollow), and of the dots of a curve.
POINT_STYLE = {"marker": "marker", "fill_color": "colour", "line_color": None, "fill_alpha": 0.75}
COMPARED_STYLE = {"fill_color": None, "line_color": NOISE_COLOUR, "line_alpha": 0.7, "size": 4}
DOT_STYLE = {"line_color": None, "fill_color": FIT_COLOUR}
# Quantity that is drawn → its style, and the changes of style while other readings are selected.
STYLES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "measured": (POINT_STYLE, {"fill_alpha": 0.12}),
    "residual": (POINT_STYLE, {"fill_alpha": 0.12}),
    "fit before": (COMPARED_STYLE, {"line_alpha": 0.2}),
    "before": (COMPARED_STYLE, {"line_alpha": 0.2}),
    FIT_FIELD: ({**DOT_STYLE, "size": 2.5}, {"fill_alpha": 0.9}),
    CURVE_FIELD: ({**DOT_STYLE, "size": 3.5}, {"fill_alpha": 0.9}),
}


class ColumnPanel:
    """Output and residuals against one column, one above the other, with a common zoom.

    A panel is created once for the readings; another state only replaces its data, since a new figure would make the
    browser lay out the whole page again.

    Attributes:
        view: Panel view of the two figures.
    """

    def __init__(
        self,
        state: ResidualsOfState,
        name: str,
        source: ColumnDataSource,
        curves: ColumnDataSource,
        y_range: Range1d,
    ) -> None:
        """Make the figures of output and residuals.

        Args:
            state: residuals to draw.
            name: name of the column.
            source: data source of all panels, for linked brushing; it has the column as `AT` + name.
            curves: data source of a preview's curve.
            y_range: range of the residuals, common to all panels.
        """
        self._name, x = name, AT + name
        self._x_range = set_axis_range(state.covariates[name])
        output_range = set_axis_range(state.output)
        output = _make_figure(state, name, f"output [{state.unit}]", self._x_range, output_range)
        output.xaxis.axis_label, output.xaxis.major_label_text_font_size = None, "0px"
        for y in ("measured", "fit before", FIT_FIELD):
            _draw_quantity(output, x, y, source)
        residuals = _make_figure(state, name, f"residual [{state.unit}]", self._x_range, y_range)
        plain: dict[str, Any] = {"level": "underlay", "fill_alpha": 0.16}
        self._noise = BoxAnnotation(fill_color=NOISE_COLOUR, line_alpha=0.0, **plain)
        self._worst = BoxAnnotation(
            fill_color=ws.plot_colours.RED, line_color=ws.plot_colours.RED, line_alpha=0.5, **plain
        )
        zero_line = Span(location=0, dimension="width", line_color=NOISE_COLOUR, line_width=1)
        for annotation in (self._noise, zero_line, self._worst):
            residuals.add_layout(annotation)
        for y in ("before", "residual", CURVE_FIELD):
            _draw_quantity(residuals, x, y, curves if y == CURVE_FIELD else source)
        self.view: Any = column(figure_pane(output), figure_pane(residuals), kinds=("stack",))
        self.show(state)

    def show(self, state: ResidualsOfState) -> None:
        """Show another state of the same readings; a zoomed view is kept."""
        set_axis_range(state.covariates[self._name], view=self._x_range)
        self._noise.update(bottom=-state.check.noise, top=state.check.noise)
        region = state.find_worst_range(self._name)
        self._worst.visible = region is not None
        if region is not None:
            self._worst.update(left=region[0], right=region[1])


def _make_figure(
    state: ResidualsOfState, name: str, label: str, x_range: Range1d, y_range: Range1d
) -> Any:
    """Make an empty figure that fills its container; its labels are plain text, without formulas."""
    title, levels = name[:MAX_LABEL_LETTERS], state.levels.get(name)
    fig: Any = figure(
        name=f"panel {name}",
        x_axis_label=PlainText(text=title if levels else f"{title} [{state.units[name] or '1'}]"),
        y_axis_label=PlainText(text=label),
        x_range=x_range,
        y_range=y_range,
        tools=TOOLS,
        active_drag="box_select",
        active_scroll="xwheel_zoom",
        toolbar_location=None,
        output_backend="webgl",
        sizing_mode="stretch_both",
        # Otherwise the container's minimum would be their sum, and its change another layout of the page.
        min_width=0,
        min_height=0,
        min_border=6,
        border_fill_alpha=0,
        background_fill_alpha=0,
        outline_line_color=None,
    )
    for axis in fig.axis:
        axis.update(
            axis_label_text_font_style="normal",
            axis_label_text_font_size="12px",
            axis_label_text_color=INK_COLOUR,
            axis_label_standoff=4,
            axis_line_color=INK_COLOUR,
            major_label_text_font_size="11px",
            major_label_text_color=INK_COLOUR,
            major_label_policy=NoOverlap(),
            major_tick_line_color=INK_COLOUR,
            minor_tick_line_color=None,
        )
    fig.grid.grid_line_color = GRID_COLOUR
    fig.xaxis.ticker.desired_num_ticks = 5
    fig.yaxis.ticker.desired_num_ticks = 6
    if levels:
        fig.xaxis.ticker = list(range(len(levels)))
        texts = {k: PlainText(text=v[:12]) for k, v in enumerate(levels)}
        fig.xaxis.major_label_overrides = texts
    return fig


def _draw_quantity(figure: Any, x: str, y: str, source: ColumnDataSource) -> None:
    """Draw a quantity against a column by one renderer (`figure.scatter` would make twice as many Bokeh models)."""
    style, muted = STYLES[y]
    glyph = {"x": x, "y": y, **style}
    if style is not POINT_STYLE:
        figure.add_glyph(source, Scatter(**glyph), nonselection_glyph=Scatter(**{**glyph, **muted}))
        return
    glyph["size"] = 5 if len(source.data["row"]) <= MAX_LARGE_POINTS else 3.5
    points = figure.add_glyph(
        source,
        Scatter(**glyph),
        nonselection_glyph=Scatter(**{**glyph, **muted}),
        selection_glyph=Scatter(**{**glyph, "fill_alpha": 1.0}),
    )
    fields = [("reading", "@reading"), ("run", "@run"), (y, f"@{y}{{0.0000 a}}")]
    figure.add_tools(
        HoverTool(renderers=[points], tooltips=fields, point_policy="follow_mouse", limit=1)
    )


MAX_PANELS = 4  # panels side by side, at most
MAX_LEGEND_RUNS = 6  # runs that are named beside their colour
SIGNS = "●■▲◆▼⬢"  # as MARKERS
HINT = "Drag over a panel to select readings; the other panels highlight them."


class ResidualPane(Pane):
    """Pane of the residuals, in the middle of the page; `show` must be called before other methods."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self._state: ResidualsOfState | None = None
        self._curve: np.ndarray | None = None  # of a preview
        self._is_updating = False
        self.choice = check_boxes("Columns to plot residuals against", css_classes=["several"])
        self.overlay = check_boxes("Step to compare with")
        self.misfit, self.note = label(), label("", "small")
        self.legend, self.panels = row(kinds=("tight",)), column(kinds=("panels",))
        self.view = column(
            row(label("Where it fails", "title"), self.overlay, kinds=("spread",)),
            self.choice,
            self.misfit,
            self.panels,
            row(self.legend, label(HINT, "small"), self.note),
            kinds=("pane", "fails"),
        )
        self.choice.param.watch(self._change_columns, "value")
        self.overlay.param.watch(lambda _: self._is_updating or self._fill_source(), "value")

    def show(self, state: Any, other: Any | None = None) -> None:
        """Show a state; `other` is the state to compare it with."""
        compared, options, previous_state = None, list[str](), self._state
        if other is not None and len(other.calibration.readings) == len(state.calibration.readings):
            compared = np.asarray(other.step.check.residuals, float)
            options = [f"with step {other.number}"]
        self._curve = None
        self._state = ResidualsOfState(state.step, compared)
        self.misfit.object = self._state.describe_misfit()
        columns = list(self._state.covariates)
        names = [n for n in self.choice.value if n in columns]
        self._is_updating = True
        self.overlay.param.update(options=options, value=options if self.overlay.value else [])
        self.choice.param.update(options=columns, value=names or self._state.choose_columns())
        self._is_updating = False
        if previous_state is None or [*previous_state.covariates] != columns:
            self._reset(self._state)
        for panel in self._panels.values():
            panel.show(self._state)
        self._lay_out()

    def show_comparison(self) -> None:
        """Draw the residuals of the step to compare with as well."""
        self.overlay.value = self.overlay.options

    def preview(self, curve: np.ndarray | None) -> None:
        """Draw an effect's curve over the residuals, output unit, (n,); None removes it."""
        self._curve = None if curve is None else np.asarray(curve, float)
        self._fill_curve()

    def _change_columns(self, event: Any) -> None:
        """Show a panel for each selected column; if too many are selected, deselect the earliest."""
        if self._is_updating:
            return
        new_names = [n for n in event.new if n not in event.old]
        kept_names = [n for n in event.old if n in event.new][-(MAX_PANELS - len(new_names)) :]
        if len(event.new) > MAX_PANELS:
            self.choice.value = [*kept_names, *new_names]
        else:
            self._lay_out()

    def _reset(self, state: ResidualsOfState) -> None:
        """Create empty data sources, without panels, for a state with other columns than before."""
        self._panels: dict[str, ColumnPanel] = {}  # by each column that was selected before
        self._y = set_axis_range(state.residual)
        self.source: Any = ColumnDataSource({})
        self._curves: Any = ColumnDataSource({})  # of the preview, which is drawn more often
        self.legend[:] = build_legend(state.runs[0])

    def _lay_out(self) -> None:
        """Show a panel for each selected column; existing panels are reused."""
        assert self._state is not None
        names = self.choice.value
        self._fill_source(names)
        for name in names:
            if name not in self._panels:
                panel = ColumnPanel(self._state, name, self.source, self._curves, self._y)
                self._panels[name] = panel
        views = [self._panels[name].view for name in names]
        if [*self.panels] != views:
            self.panels.css_classes = ["panels", *["of4"] * (len(views) == MAX_PANELS)]
            self.panels[:] = views

    def _fill_source(self, names: Iterable[str] = ()) -> None:
        """Fill the data source with the readings to draw, for existing panels and those of the columns `names`."""
        assert self._state is not None
        state, compared = self._state, self._state.compared if self.overlay.value else None
        rows = decimate(state.residual, state.output)
        at: dict[str, Any] = {AT + n: state.covariates[n][rows] for n in {*names, *self._panels}}
        compared_rows = np.full(rows.size, np.nan) if compared is None else compared[rows]
        levels, runs = state.runs[0], state.runs[1][rows]
        self.source.data = at | {
            "row": rows,
            "reading": rows + 1,
            "run": np.array(levels)[runs],
            "residual": state.residual[rows],
            "measured": state.output[rows],
            FIT_FIELD: (state.output - state.residual)[rows],
            "before": compared_rows,
            "fit before": state.output[rows] - compared_rows,
            "colour": np.array(COLOURS)[runs % len(COLOURS)],
            # Colour is never the only distinction.
            "marker": np.array(MARKERS)[runs % len(MARKERS)],
        }
        self._fill_curve()
        text = f"{rows.size:,} of {state.residual.size:,} readings plotted (extremes of equal intervals)"
        self.note.object = text if rows.size < state.residual.size else ""
        set_axis_range(state.residual, *([] if compared is None else [compared]), view=self._y)

    def _fill_curve(self) -> None:
        """Fill the data source of a preview's curve; empty it if there is no preview."""
        x_fields = {n: v for n, v in self.source.data.items() if n.startswith(AT)}
        if self._curve is None:
            self._curves.data = dict.fromkeys([*x_fields, CURVE_FIELD], np.array([]))
        else:
            self._curves.data = {**x_fields, CURVE_FIELD: self._curve[self.source.data["row"]]}


def build_legend(levels: Sequence[str]) -> list[Any]:
    """Return the legend of the fit, and of the runs by colour and marker."""
    entries = [("•", FIT_COLOUR, "fit")]
    for k, level in enumerate(levels if 1 < len(levels) <= MAX_LEGEND_RUNS else ()):
        entries.append((SIGNS[k % len(SIGNS)], COLOURS[k % len(COLOURS)], f"run {level[:16]}"))
    parts: list[Any] = [
        row(label(sign, styles={"color": colour}), label(text, "small"), kinds=("tight",))
        for sign, colour, text in entries
    ]
    if len(levels) > MAX_LEGEND_RUNS:
        parts.append(label(f"{len(levels)} runs; colours and shapes repeat", "small"))
    return parts
