"""Where it fails: output with the fit, and residuals, over columns side by side, brushed together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Reset, SelectionGeometry
from bokeh.models import ColumnDataSource, Range1d

from bayescal._workbench.panes.fails_data import AGAINST, ResidualsOfState
from bayescal._workbench.panes.fails_panel import (
    AT,
    CURVE,
    FIT,
    dress_panel,
    output_panel,
    residual_panel,
    show_curve,
)
from bayescal._workbench.parts.decimate import drawn_rows, sentence
from bayescal._workbench.parts.pieces import choice, column, plot, row, several, words
from bayescal._workbench.parts.style import LIGHT, Palette, fixed_range, span

AFTER, BEFORE, BOTH = "after", "before", "both"  # this step, the one beside it
WHAT = ["output", "residuals"]
MOST = 4  # panels side by side, at most
LEGEND = 6  # runs that are named beside their colour
SIGNS = "●■▲◆▼⬢"  # as MARKERS


class Fails:
    """The middle of the page.

    Attributes:
        view: what Panel shows.
        selected: rows that are brushed, of all readings.
    """

    def __init__(self, on_select: Callable[[np.ndarray], None] = lambda _: None) -> None:
        self._on_select = on_select
        self.shown: ResidualsOfState | None = None
        self.palette: Palette = LIGHT
        self.selected = np.array([], int)
        self.source: Any = ColumnDataSource({})
        self._curves: Any = ColumnDataSource({})  # of the preview: only what has it is drawn anew
        self._curve: np.ndarray | None = None
        self._views: dict[str, tuple[float, float]] = {}
        self._figures: dict[str, Any] = {}
        self._outputs: dict[str, Any] = {}
        self._panes: dict[str, pn.Column] = {}
        self._y = Range1d()
        self._waiting = self._showing = False
        self.choice = several([], [], "Columns that residuals are laid against")
        self.when = choice([AFTER, BEFORE, BOTH], AFTER, "Of which step")
        self.what = several(WHAT, WHAT, "What is drawn")
        self.what.css_classes = ["short"]
        self.said = words()
        self.drawn = words("", "small")
        self.brushed = words("", "small")
        self.legend = row(kinds=("tight",))
        self.panels = column(kinds=("panels",))
        self.view = column(
            row(words("Where it fails", "title"), self.what, self.when, kinds=("spread",)),
            self.choice,
            self.said,
            self.panels,
            row(self.legend, self.brushed, self.drawn),
            kinds=("pane", "fails"),
        )
        self.choice.param.watch(self._chosen, "value")
        self.when.param.watch(lambda _: self._showing or self._fill(), "value")
        self.what.param.watch(lambda _: self._place(), "value")

    def show(self, step: Any, before: Any | None, names: tuple[str, str] = (AFTER, BEFORE)) -> None:
        """Show a state; `before` is the step that it is compared with, `names` are those of both."""
        earlier = None if before is None else np.asarray(before.check.residuals, float)
        same = earlier is not None and earlier.size == len(step.check.residuals)
        self.shown = ResidualsOfState(step, earlier if same else None)
        self._curve = None
        self._views = {}
        self.said.object = self.shown.sentence()
        columns = list(self.shown.covariates)
        kept = [n for n in self.choice.value if n in columns]
        self._showing = True
        options = dict(zip((*names, BOTH), (AFTER, BEFORE, BOTH), strict=True))
        value = self.when.value if same else AFTER
        self.when.param.update(options=options, disabled=not same, value=value)
        self.choice.param.update(options=columns, value=kept or self.shown.start())
        self._showing = False
        self._begin()
        self._say_selected()

    def widen(self, wide: bool) -> None:
        """Begin with a third panel where there is room."""
        if wide and self.shown is not None and self.choice.value == self.shown.start():
            self.choice.value = self.shown.start(3)

    def preview(self, curve: np.ndarray | None) -> None:
        """Lay an effect's curve over the residuals, output unit, (n,); None takes it away."""
        self._curve = None if curve is None else np.asarray(curve, float)
        if self.shown is not None:
            self._curves.data[CURVE] = self._curve_at(self.source.data["row"])
            for made in self._figures.values():
                show_curve(made, self._curve is not None)

    def wear(self, palette: Palette) -> None:
        """Take the colours of a ground."""
        self.palette = palette
        if self.shown is not None:
            self.source.data["colour"] = self.shown.colours(palette)[self.source.data["row"]]
            self._say_runs()
        for made in (*self._figures.values(), *self._outputs.values()):
            dress_panel(made, palette)

    def select(self, rows: np.ndarray) -> None:
        """Brush rows, of all readings; in the panels those that are drawn light up."""
        self.selected = np.asarray(rows, int)
        drawn = self.source.data.get("row", np.array([], int))
        self.source.selected.indices = np.flatnonzero(np.isin(drawn, self.selected)).tolist()
        self._say_selected()

    def _chosen(self, event: Any) -> None:
        """Other columns; of too many, those chosen first go."""
        if self._showing:
            return
        new = [n for n in event.new if n not in event.old]
        kept = [n for n in event.old if n in event.new][-(MOST - len(new)) :]
        if len(event.new) > MOST:
            self.choice.value = [*kept, *new]
        else:
            self._lay_out()

    def _begin(self) -> None:
        """A source and panels of another state: those that go keep theirs."""
        assert self.shown is not None
        self._y = fixed_range(-1, 1)
        self.source, self._curves = ColumnDataSource({}), ColumnDataSource({})
        self._figures, self._outputs, self._panes = {}, {}, {}
        self._fit_range()  # before the panels are laid out: a change after it may overtake them
        self._lay_out()
        self.source.selected.on_change("indices", self._brushed_in_source)
        self._say_runs()

    def _lay_out(self) -> None:
        """A panel for each column chosen; those that stay are left as they are."""
        if self.shown is None:
            return
        names = [n for n in self.choice.value if n in self.shown.covariates]
        self._fill_source(names)
        self._figures = {name: self._figures.get(name) or self._panel(name) for name in names}
        self._panes = {name: self._panes.get(name) or column(kinds=("stack",)) for name in names}
        self._place()
        self.panels.css_classes = ["panels", f"of{len(names)}"]
        self.panels[:] = list(self._panes.values())

    def _place(self) -> None:
        """In the room of each column its output, its residuals, or both."""
        for name, room in self._panes.items():
            made = self._figures[name]
            if name not in self._outputs and name != AGAINST and WHAT[0] in self.what.value:
                self._outputs[name] = self._output(name, made)
            upper = [self._outputs[name]] if name in self._outputs else []
            wanted = [*upper * (WHAT[0] in self.what.value)]
            wanted += [made] * (WHAT[1] in self.what.value or not wanted)
            if [getattr(pane, "object", None) for pane in room] != wanted:
                room[:] = [plot(one) for one in wanted]

    def _fill(self) -> None:
        """The same panels with other residuals."""
        if self.shown is not None:
            self._fill_source(list(self._figures))
            self._fit_range()

    def _now(self) -> np.ndarray:
        shown = self.shown
        assert shown is not None
        before = shown.before if self.when.value == BEFORE else None
        return shown.residual if before is None else before

    def _fill_source(self, names: list[str]) -> None:
        shown = self.shown
        assert shown is not None
        residual = self._now()
        covariates = {n: shown.places[n] for n in names}
        rows = np.array([], int)
        if names:
            rows = drawn_rows(covariates, [residual, shown.measured], self._views)
        drawn = dict.fromkeys([*names, *self._figures])  # panels that go are drawn once more
        data: dict[str, Any] = {AT + n: shown.places[n][rows] for n in drawn}
        both = self.when.value == BOTH and shown.before is not None
        other = np.full(rows.size, np.nan)
        if both and shown.before is not None:
            other = shown.before[rows]
        data |= {
            "row": rows,
            "reading": rows + 1,
            "run": [shown.runs[0][k] for k in shown.runs[1][rows]],
            "residual": residual[rows],
            "measured": shown.measured[rows],
            FIT: (shown.measured - residual)[rows],
            "before": other,
            "fit before": shown.measured[rows] - other,
            "colour": shown.colours(self.palette)[rows],
            "marker": shown.markers()[rows],
        }
        chosen = self.selected
        self.source.data = data
        at = {n: values for n, values in data.items() if n.startswith(AT)}
        self._curves.data = {**at, CURVE: self._curve_at(rows)}
        self.source.selected.indices = np.flatnonzero(np.isin(rows, chosen)).tolist()
        self.drawn.object = sentence(rows.size, residual.size)

    def _fit_range(self) -> None:
        shown = self.shown
        assert shown is not None
        values = [self._now()]
        if self.when.value == BOTH and shown.before is not None:
            values.append(shown.before)
        low, high = min(v.min() for v in values), max(v.max() for v in values)
        ends = span(float(low), float(high))
        self._y.update(**ends, reset_start=ends["start"], reset_end=ends["end"])

    def _curve_at(self, rows: np.ndarray) -> np.ndarray:
        return np.full(len(rows), np.nan) if self._curve is None else self._curve[rows]

    def _panel(self, name: str) -> Any:
        shown = self.shown
        assert shown is not None
        made = residual_panel(shown, name, self.source, self._curves, self._y)
        show_curve(made, self._curve is not None)
        for end in ("start", "end"):
            made.x_range.on_change(end, lambda attr, old, new: self._moved(name, made.x_range))
        return self._brushable(made, name, name == AGAINST)

    def _output(self, name: str, beneath: Any) -> Any:
        assert self.shown is not None
        return self._brushable(output_panel(self.shown, name, self.source, beneath), name, True)

    def _brushable(self, made: Any, name: str, output: bool) -> Any:
        dress_panel(made, self.palette)
        made.on_event(SelectionGeometry, lambda event: self._brushed_in_panel(name, output, event))
        made.on_event(Reset, lambda _: self.select(np.array([], int)))
        return made

    def _moved(self, name: str, view: Any) -> None:
        """A panel was zoomed: of many readings, others are drawn; once, when it rests."""
        shown = self.shown
        if shown is None:
            return
        if shown.residual.size == len(self.source.data["row"]) and not self._views:
            return
        self._views[name] = (float(view.start), float(view.end))
        document = self.source.document
        if document is None or self._waiting:
            return
        self._waiting = True

        def rested() -> None:
            self._waiting = False
            self._fill_source(list(self._figures))

        document.add_timeout_callback(rested, 120)

    def _brushed_in_panel(self, name: str, output: bool, event: Any) -> None:
        """Of many readings those that are not drawn belong to a region too."""
        shown, place = self.shown, event.geometry
        if shown is None or not event.final or place.get("type") != "rect":
            return
        if shown.residual.size == len(self.source.data["row"]):
            return  # the browser's own selection has them all
        x, y = shown.places[name], shown.measured if output else self._now()
        low, high = sorted((place["x0"], place["x1"]))
        bottom, top = sorted((place["y0"], place["y1"]))
        self.selected = np.flatnonzero((x >= low) & (x <= high) & (y >= bottom) & (y <= top))
        self._say_selected()

    def _brushed_in_source(self, _: str, __: Any, indices: list[int]) -> None:
        rows = self.source.data["row"]
        if self.shown is None or (len(rows) != self.shown.residual.size and indices):
            return
        self.selected = np.asarray(rows)[np.asarray(indices, int)]
        self._say_selected()

    def _say_runs(self) -> None:
        """Which colour and shape is which run."""
        assert self.shown is not None
        levels, cycle = self.shown.runs[0], self.palette.cycle
        told = [("•", self.palette.ink, "fit")]
        if 1 < len(levels) <= LEGEND:
            signs = [(SIGNS[k % len(SIGNS)], cycle[k % len(cycle)]) for k in range(len(levels))]
            told += [
                (*sign, f"run {level[:16]}") for sign, level in zip(signs, levels, strict=True)
            ]
        parts: list[Any] = [
            row(words(sign, styles={"color": colour}), words(text, "small"), kinds=("tight",))
            for sign, colour, text in told
        ]
        if len(levels) > LEGEND:
            parts.append(words(f"{len(levels)} runs; colours and shapes repeat", "small"))
        self.legend[:] = parts

    def _say_selected(self) -> None:
        rows = self.selected
        if rows.size and self.shown is not None:
            own = self._now()[rows]
            mean = f"mean residual {own.mean():+.3g} {self.shown.unit}".replace("-", "−")
            self.brushed.object = f"{rows.size:,} readings selected, {mean}"
        else:
            self.brushed.object = (
                "Drag over a panel to select readings; they light up in the others."
            )
        self._on_select(rows)
