"""The residual pane ("Where it fails"): output with the fit, and residuals, over columns side by side, linked brushing.

All panels draw one source of rows, by WebGL where the browser has it. Very many readings are decimated; an axis of time
leaves out the long gaps between runs. A panel has, over one column, the output with the fit, and residuals with the
noise, the worst region, the curve of a preview.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.events import Reset
from bokeh.models import (
    BoxAnnotation,
    ColumnDataSource,
    CustomJSTickFormatter,
    HoverTool,
    PlainText,
    Range1d,
    Scatter,
    Span,
)

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.widgets import (
    FIT,
    MARKERS,
    RUNS,
    Pane,
    choice,
    column,
    new_figure,
    plot,
    range_over,
    row,
    several,
    words,
)

# A step is a gap if it is longer than so many usual ones (their median), and than this share of the time in all shorter
# steps: a pause within a run stays, and so do evenly spaced runs of one reading.
STEPS, SHARE = 10.0, 0.1
WASTED = 0.25  # of the axis that is left, about, which gaps may take up together

LABEL = """
let k = 0;
while (k + 1 < starts.length && starts[k + 1] <= tick) k += 1;
return tick > ends[k] ? "" : String(Number((tick + taken[k]).toPrecision(10)));
"""


@dataclass(frozen=True)
class CutAxis:
    """A broken axis: the intervals of a column without its long gaps."""

    starts: np.ndarray  # starts, ends: values at which each begins and ends, (k,), rising
    ends: np.ndarray
    cuts: np.ndarray  # what is left out of the axis before each, (k,), a round number each

    @classmethod
    def of(cls, values: np.ndarray) -> CutAxis:
        """Build from values (n,) in any order; one interval where no gap is long."""
        at = np.unique(values)
        steps = np.diff(at)
        rising = np.sort(steps)
        usual, shorter = np.append(rising, 0.0)[rising.size // 2], np.cumsum(rising) - rising
        long = (rising > STEPS * usual) & (rising > SHARE * shorter)
        gaps = np.flatnonzero(steps >= rising[np.argmax(long)]) if long.any() else np.array([], int)
        unit = _floor(WASTED * np.delete(steps, gaps).sum() / gaps.size) if gaps.size else np.inf
        cuts = np.floor(steps[gaps] / unit - 1 / 3) * unit
        gaps, cuts = gaps[cuts > 0], cuts[cuts > 0]
        edges = np.r_[0, gaps + 1]
        ends = np.r_[gaps, at.size - 1]
        return cls(at[edges], at[ends], np.r_[0.0, np.cumsum(cuts)])

    def place(self, values: np.ndarray) -> np.ndarray:
        """Return the positions of values on the axis."""
        k = np.searchsorted(self.starts, values, side="right") - 1
        return np.asarray(values, float) - self.cuts[np.maximum(k, 0)]

    def label(self, figure: Any, colour: str) -> None:
        """Label a figure's axis with the values themselves, and mark the gaps."""
        if self.starts.size == 1:
            return
        starts, ends = self.place(self.starts), self.place(self.ends)
        args = {"starts": starts.tolist(), "ends": ends.tolist(), "taken": self.cuts.tolist()}
        figure.xaxis.formatter = CustomJSTickFormatter(args=args, code=LABEL)
        for middle in 0.5 * (ends[:-1] + starts[1:]):
            cut: dict[str, Any] = {
                "dimension": "height",
                "line_dash": "dotted",
                "line_color": colour,
            }
            figure.add_layout(Span(location=float(middle), line_width=2, **cut))


def _floor(value: float) -> float:
    """Round a value down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(power * m for m in (1, 2, 5) if power * m <= value * (1 + 1e-12)))


DRAWN_READINGS = 50_000  # that a browser moves without a lag


def drawn_rows(*drawn: np.ndarray) -> np.ndarray:
    """Return the rows to draw, rising: all; or, of many, the lowest and highest of each of equal stretches.

    The same rows are drawn in every panel, so that what is brushed in one lights up in the others.

    Args:
        drawn: residuals, output, (n,) each: no extreme of one is lost.
    """
    size = drawn[0].size
    if size <= DRAWN_READINGS:
        return np.arange(size)
    ends = np.linspace(0, size, DRAWN_READINGS // (2 * len(drawn)) + 1).astype(int)
    chosen = np.zeros(size, bool)
    for values in drawn:
        for begin, end in itertools.pairwise(ends):
            block = values[begin:end]
            chosen[[begin + block.argmin(), begin + block.argmax()]] = True
    return np.flatnonzero(chosen)


def sentence(drawn: int, of: int) -> str:
    """State how many readings are drawn where not all are; else empty."""
    return "" if drawn == of else f"{drawn:,} of {of:,} readings drawn: extremes, evenly spread"


AGAINST = "predicted output"  # over which the output is measured against predicted
TIME = "time"  # the column whose long gaps are left out


class ResidualsOfState:
    """A state's residuals with the covariates to plot them against."""

    def __init__(self, step: Any, before: np.ndarray | None) -> None:
        """Args:
        step: the state's fit with its check.
        before: residuals of the step that it is compared with, output unit, (n,); None where there is none.
        """
        readings, columns = step.calibration.readings, ws.covariates_of(step.calibration)
        self.check: bc.Check = step.check
        self.before, self.runs = before, readings.groups("run")
        self.residual = np.asarray(self.check.residuals, float)
        self.measured = np.asarray(readings[readings.output], float)
        # (n,) each, by name; a group's members as numbers 0, 1, …; at last what the model predicts.
        self.covariates = {c.name: np.asarray(c.values, float) for c in columns}
        self.covariates[AGAINST] = self.measured - self.residual
        self.unit = ws.unit_label(self.check.unit)
        self.units = {c.name: ws.unit_label(c.unit or "") for c in columns} | {AGAINST: self.unit}
        self.levels = {c.name: c.levels for c in columns if c.levels}  # members of the groups
        # The axis of time, and where readings stand on the axis of a covariate.
        self.cut = CutAxis.of(self.covariates[TIME]) if TIME in self.covariates else None
        self.places = dict(self.covariates)
        if self.cut is not None:
            self.places[TIME] = self.cut.place(self.covariates[TIME])

    def worst(self, name: str) -> tuple[float, float] | None:
        """Return the ends of the worst region over a covariate on its axis; None without evidence of one."""
        entry = next((e for e in self.check.entries if e.against == name), None)
        if entry is None or entry.log_bayes_factor <= 0:
            return None
        low, high = entry.worst.low, entry.worst.high
        if entry.by_group:
            low = high = float(self.levels[name].index(str(entry.worst.group)))
        if name == TIME and self.cut is not None:
            low, high = map(float, self.cut.place(np.array([low, high])))
        half = 0.02 * float(np.ptp(self.places[name])) if low == high else 0.0
        return low - half, high + half

    def colours(self) -> np.ndarray:
        """Return the colour of each reading, by run."""
        return np.array(RUNS)[self.runs[1] % len(RUNS)]

    def markers(self) -> np.ndarray:
        """Return the marker of each reading, by run, so that colour is never the only distinction."""
        return np.array(MARKERS)[self.runs[1] % len(MARKERS)]

    def start(self) -> list[str]:
        """Return the initial columns: the two continuous covariates with the strongest evidence, in order."""
        ranked = [e.against for e in self.check.entries if not e.by_group]
        chosen = ranked[:2] or [n for n in self.covariates if n != AGAINST][:2]
        return [n for n in self.covariates if n in chosen] or [AGAINST]

    def sentence(self) -> str:
        """Describe the worst region of the strongest covariate in a sentence."""
        worst = max(self.check.entries, key=lambda e: e.log_bayes_factor, default=None)
        if worst is None:
            return "No column varies: there is nothing to lay the residuals against."
        rms = f"Residuals {self.check.rms:.3g} {self.unit} rms, noise {self.check.noise:.3g} {self.unit}. "
        if worst.log_bayes_factor < 0:
            return rms + "No column says anything of them: no log Bayes factor is above zero."
        side = "positive" if worst.worst.size > 0 else "negative"
        return (
            f"{rms}Against {worst.against} they are systematically {side}: {worst.worst.size:+.3g} {self.unit} on "
            f"average, {ws.place_in_words(worst.data(self.check.unit))} (z = {worst.worst.z:+.1f}; log Bayes factor "
            f"{worst.log_bayes_factor:.1f})."
        ).replace("-", "−")


TOOLS = "box_select,lasso_select,xwheel_zoom,pan,reset,tap"
LABEL_LETTERS = 48  # letters of a label
LARGE_POINT_READINGS = 600  # readings up to which points are large
NOISE, CURVE, FITTED, AT = "#8a939b", "curve", "fit", "at "
OUTPUT, RESIDUALS = WHAT = ["output", "residuals"]


class ColumnPanel:
    """One column's output and residuals, one above the other, zoomed together.

    It is made once for the readings; another state only replaces its data, since a new figure would cost the browser a
    new layout of the whole page.

    Attributes:
        figures: of output and residuals.
        x_range: of both.
        room: its container on the page.
    """

    def __init__(
        self,
        state: ResidualsOfState,
        name: str,
        source: ColumnDataSource,
        curves: ColumnDataSource,
        y_range: Range1d,
    ) -> None:
        """Args:
        state: whose residuals are drawn.
        name: of the column.
        source: of all panels, whose readings are so brushed together; the column stands in it as `AT` and its name.
        curves: the same of a preview's curve.
        y_range: of the residuals, the same in all panels.
        """
        self._name, x = name, AT + name
        self.x_range = range_over(state.places[name])
        measured = range_over(state.measured)
        output = _figure(state, name, f"output [{state.unit}]", self.x_range, measured)
        output.xaxis.axis_label, output.xaxis.major_label_text_font_size = None, "0px"
        _draw_points(output, x, "measured", source)
        _draw_compared(output, x, "fit before", source)
        _draw_curve(output, x, FITTED, source)
        figure = _figure(state, name, f"residual [{state.unit}]", self.x_range, y_range)
        plain: dict[str, Any] = {"level": "underlay", "fill_alpha": 0.16}
        self._noise = BoxAnnotation(fill_color=NOISE, line_alpha=0.0, **plain)
        self._worst = BoxAnnotation(
            fill_color=ws.plot_colours.RED, line_color=ws.plot_colours.RED, line_alpha=0.5, **plain
        )
        zero = Span(location=0, dimension="width", line_color=NOISE, line_width=1)
        for ground in (self._noise, zero, self._worst):
            figure.add_layout(ground)
        _draw_compared(figure, x, "before", source)
        _draw_points(figure, x, "residual", source)
        _draw_curve(figure, x, CURVE, curves)
        self.figures = {OUTPUT: output, RESIDUALS: figure}
        self.room: Any = column(kinds=("stack",))
        self.show(state)

    def show(self, state: ResidualsOfState) -> None:
        """Show another state of the same readings; a zoomed view stays."""
        range_over(state.places[self._name], view=self.x_range)
        self._noise.update(bottom=-state.check.noise, top=state.check.noise)
        region = state.worst(self._name)
        self._worst.visible = region is not None
        if region is not None:
            self._worst.update(left=region[0], right=region[1])

    def place(self, what: list[str]) -> None:
        """Show output, residuals or both; residuals where neither is chosen."""
        figures = [self.figures[w] for w in WHAT if w in (what or [RESIDUALS])]
        if [pane.object for pane in self.room] != figures:
            self.room[:] = [plot(figure) for figure in figures]


def _figure(
    state: ResidualsOfState, name: str, label: str, x_range: Range1d, y_range: Range1d
) -> Any:
    unit = state.units[name]
    figure = new_figure(
        name[:LABEL_LETTERS] if name in state.levels else f"{name[:LABEL_LETTERS]} [{unit or '1'}]",
        label,
        tools=TOOLS,
        active_drag="box_select",
        active_scroll="xwheel_zoom",
        x_range=x_range,
        y_range=y_range,
        output_backend="webgl",
        # Their sum would be a property of the room of all, and a change of it one layout of the page more.
        min_width=0,
        min_height=0,
    )
    figure.name = f"panel {name}"
    if name == TIME and state.cut is not None:
        state.cut.label(figure, NOISE)
    if levels := state.levels.get(name):
        figure.xaxis.ticker = list(range(len(levels)))
        texts = {k: PlainText(text=v[:12]) for k, v in enumerate(levels)}
        figure.xaxis.major_label_overrides = texts
    return figure


def _draw_compared(figure: Any, x: str, y: str, source: ColumnDataSource) -> None:
    """Draw the points of the step that this one is compared with."""
    hollow = {"fill_color": None, "line_color": NOISE, "line_alpha": 0.7, "size": 4}
    _add_glyphs(figure, source, {"x": x, "y": y, **hollow}, {"line_alpha": 0.2})


def _draw_curve(figure: Any, x: str, name: str, source: ColumnDataSource) -> None:
    """Draw a curve, a dot a reading."""
    dot = {"size": 3.5 if name == CURVE else 2.5, "line_color": None, "fill_color": FIT}
    _add_glyphs(figure, source, {"x": x, "y": name, **dot}, {"fill_alpha": 0.9})


def _draw_points(figure: Any, x: str, y: str, source: ColumnDataSource) -> None:
    size = 5 if len(source.data["row"]) <= LARGE_POINT_READINGS else 3.5
    plain = {"marker": "marker", "fill_color": "colour", "line_color": None, "fill_alpha": 0.75}
    drawn = {"x": x, "y": y, "size": size, **plain}
    points = _add_glyphs(figure, source, drawn, {"fill_alpha": 0.12}, {"fill_alpha": 1.0})
    fields = [("reading", "@reading"), ("run", "@run"), (y, f"@{y}{{0.0000 a}}")]
    figure.add_tools(
        HoverTool(renderers=[points], tooltips=fields, point_policy="follow_mouse", limit=1)
    )


def _add_glyphs(
    figure: Any,
    source: ColumnDataSource,
    drawn: dict[str, Any],
    muted: dict[str, Any],
    selected: dict[str, Any] | None = None,
) -> Any:
    """Add points with their style outside and in a selection; `figure.scatter` makes twice as many models."""
    glyphs = {"nonselection_glyph": Scatter(**{**drawn, **muted})}
    if selected:
        glyphs["selection_glyph"] = Scatter(**{**drawn, **selected})
    return figure.add_glyph(source, Scatter(**drawn), **glyphs)


AFTER, BEFORE, BOTH = "after", "before", "both"  # this step, the one beside it
PANELS_IN_A_ROW = 4  # panels side by side, at most
LEGEND = 6  # runs that are named beside their colour
SIGNS = "●■▲◆▼⬢"  # as MARKERS
HINT = "Drag over a panel to select readings; they light up in the others."


class ResidualPane(Pane):
    """The middle of the page; `show` is called before any other method.

    Attributes:
        state: its residuals.
        selected: brushed rows, of all readings.
    """

    state: Any = None  # `ResidualsOfState`, from the first `show` on

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._showing = False
        self.choice = several([], [], "Columns that residuals are laid against")
        self.when = choice([AFTER, BEFORE, BOTH], AFTER, "Of which step")
        self.what = several(WHAT, WHAT, "What is drawn")
        self.what.css_classes = ["short"]
        self.finding, self.drawn, self.brushed = words(), words("", "small"), words("", "small")
        self.legend = row(kinds=("tight",))
        self.panels = column(kinds=("panels",))
        self.view = column(
            row(words("Where it fails", "title"), self.what, self.when, kinds=("spread",)),
            self.choice,
            self.finding,
            self.panels,
            row(self.legend, self.brushed, self.drawn),
            kinds=("pane", "fails"),
        )
        self.choice.param.watch(self._chosen, "value")
        self.when.param.watch(lambda _: self._showing or self._fill_source(), "value")
        self.what.param.watch(lambda _: self._place(), "value")

    def show(self, state: Any, other: Any | None = None) -> None:
        """Show a state; `other` is the one that it is compared with."""
        residual = state.step.check.residuals
        earlier = None if other is None else np.asarray(other.step.check.residuals, float)
        same = earlier is not None and earlier.size == len(residual)
        before = self.state
        self.state = ResidualsOfState(state.step, earlier if same else None)
        self._curve: np.ndarray | None = None
        self.finding.object = self.state.sentence()
        columns = list(self.state.covariates)
        names_left = [n for n in self.choice.value if n in columns]
        names = (f"step {state.number}", "none" if other is None else f"step {other.number}", BOTH)
        options = dict(zip(names, (AFTER, BEFORE, BOTH), strict=True))
        value = self.when.value if same else AFTER
        self._showing = True
        self.when.param.update(options=options, disabled=not same, value=value)
        self.choice.param.update(options=columns, value=names_left or self.state.start())
        self._showing = False
        if before is None or [*before.covariates] != columns:
            self._begin()
        for panel in self._made.values():
            panel.show(self.state)
        self._lay_out()
        self._say_selected()

    def preview(self, curve: np.ndarray | None) -> None:
        """Draw an effect's curve over the residuals, output unit, (n,); None removes it."""
        self._curve = None if curve is None else np.asarray(curve, float)
        self._curves.data = self._of_curve()

    def select(self, rows: np.ndarray) -> None:
        """Brush rows, of all readings; in the panels those that are drawn light up."""
        self.selected = np.asarray(rows, int)
        self._light_up(self.source.data["row"])
        self._say_selected()

    def _light_up(self, drawn: np.ndarray) -> None:
        self.source.selected.indices = np.flatnonzero(np.isin(drawn, self.selected)).tolist()

    def _chosen(self, event: Any) -> None:
        """Lay out other columns; of too many, those chosen first are dropped."""
        if self._showing:
            return
        new = [n for n in event.new if n not in event.old]
        stays = [n for n in event.old if n in event.new][-(PANELS_IN_A_ROW - len(new)) :]
        if len(event.new) > PANELS_IN_A_ROW:
            self.choice.value = [*stays, *new]
        else:
            self._lay_out()

    def _begin(self) -> None:
        """Reset sources and panels for other readings."""
        self._made: dict[str, ColumnPanel] = {}  # of each column that was ever ticked
        self.selected = np.array([], int)
        self._y = range_over(self.state.residual)
        self.source: Any = ColumnDataSource({})
        self._curves: Any = ColumnDataSource({})  # of the preview: only what has it is drawn anew
        self.source.selected.on_change("indices", self._brushed_in_source)
        self._say_runs()

    def _lay_out(self) -> None:
        """Make a panel for each column chosen; existing ones are reused."""
        names = [n for n in self.choice.value if n in self.state.covariates]
        self._fill_source(names)
        for name in names:
            if name not in self._made:
                self._made[name] = self._panel(name)
        self._place()
        rooms = [self._made[name].room for name in names]
        if [*self.panels] != rooms:
            self.panels.css_classes = ["panels", *["of4"] * (len(rooms) == PANELS_IN_A_ROW)]
            self.panels[:] = rooms

    def _now(self) -> np.ndarray:
        before = self.state.before if self.when.value == BEFORE else None
        return self.state.residual if before is None else before

    def _compared(self) -> np.ndarray | None:
        """Return the residuals of the other step, where both are drawn."""
        return self.state.before if self.when.value == BOTH else None

    def _place(self) -> None:
        for panel in self._made.values():
            panel.place(self.what.value)

    def _fill_source(self, coming: Sequence[str] = ()) -> None:
        """Fill the source with the drawn readings, for present panels and those to come."""
        now, residual, before = self.state, self._now(), self._compared()
        rows = drawn_rows(residual, now.measured)
        at: dict[str, Any] = {AT + n: now.places[n][rows] for n in {*coming, *self._made}}
        other = np.full(rows.size, np.nan) if before is None else before[rows]
        self.source.data = at | {
            "row": rows,
            "reading": rows + 1,
            "run": [now.runs[0][k] for k in now.runs[1][rows]],
            "residual": residual[rows],
            "measured": now.measured[rows],
            FITTED: (now.measured - residual)[rows],
            "before": other,
            "fit before": now.measured[rows] - other,
            "colour": now.colours()[rows],
            "marker": now.markers()[rows],
        }
        self._curves.data = self._of_curve()
        self._light_up(rows)
        self.drawn.object = sentence(rows.size, residual.size)
        range_over(residual, *([] if before is None else [before]), view=self._y)

    def _of_curve(self) -> dict[str, np.ndarray]:
        """Return the data of a preview's curve, empty without one."""
        at = {n: v for n, v in self.source.data.items() if n.startswith(AT)}
        if self._curve is None:
            return dict.fromkeys([*at, CURVE], np.array([]))
        return {**at, CURVE: self._curve[self.source.data["row"]]}

    def _panel(self, name: str) -> ColumnPanel:
        panel = ColumnPanel(self.state, name, self.source, self._curves, self._y)
        for figure in panel.figures.values():
            figure.on_event(Reset, lambda _: self.select(np.array([], int)))
        return panel

    def _brushed_in_source(self, _: str, __: Any, indices: list[int]) -> None:
        self.selected = np.asarray(self.source.data["row"])[np.asarray(indices, int)]
        self._say_selected()

    def _say_runs(self) -> None:
        """Fill the legend of runs by colour and marker."""
        levels = self.state.runs[0]
        legend = [("•", FIT, "fit")]
        for k, level in enumerate(levels if 1 < len(levels) <= LEGEND else ()):
            legend.append((SIGNS[k % len(SIGNS)], RUNS[k % len(RUNS)], f"run {level[:16]}"))
        parts: list[Any] = [
            row(words(sign, styles={"color": colour}), words(text, "small"), kinds=("tight",))
            for sign, colour, text in legend
        ]
        if len(levels) > LEGEND:
            parts.append(words(f"{len(levels)} runs; colours and shapes repeat", "small"))
        self.legend[:] = parts

    def _say_selected(self) -> None:
        rows, text = self.selected, HINT
        if rows.size:
            mean = f"{self._now()[rows].mean():+.3g} {self.state.unit}".replace("-", "−")
            text = f"{rows.size:,} readings selected, mean residual {mean}"
        self.brushed.object = text
