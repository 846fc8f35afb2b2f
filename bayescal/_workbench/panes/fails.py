"""Where it fails: output with the fit, and residuals, over columns side by side, brushed together."""

from __future__ import annotations

from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Reset, SelectionGeometry
from bokeh.models import ColumnDataSource

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
from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.decimate import drawn_rows, sentence
from bayescal._workbench.parts.pieces import choice, column, plot, row, several, words
from bayescal._workbench.parts.style import Palette, fixed_range, span

AFTER, BEFORE, BOTH = "after", "before", "both"  # this step, the one beside it
WHAT = ["output", "residuals"]
MOST = 4  # panels side by side, at most
LEGEND = 6  # runs that are named beside their colour
SIGNS = "●■▲◆▼⬢"  # as MARKERS
HINT = "Drag over a panel to select readings; they light up in the others."


class Fails(Pane):
    """The middle of the page; a state is shown before anything else is asked of it.

    Attributes:
        shown: the state's residuals.
        selected: rows that are brushed, of all readings.
    """

    shown: ResidualsOfState

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.selected = np.array([], int)
        self._waiting = self._showing = False
        self.choice = several([], [], "Columns that residuals are laid against")
        self.when = choice([AFTER, BEFORE, BOTH], AFTER, "Of which step")
        self.what = several(WHAT, WHAT, "What is drawn")
        self.what.css_classes = ["short"]
        self.said, self.drawn, self.brushed = words(), words("", "small"), words("", "small")
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

    def show(self, state: Any, other: Any | None = None) -> None:
        """Show a state; `other` is the one that it is compared with."""
        residual = state.step.check.residuals
        earlier = None if other is None else np.asarray(other.step.check.residuals, float)
        same = earlier is not None and earlier.size == len(residual)
        self.shown = ResidualsOfState(state.step, earlier if same else None)
        self._curve: np.ndarray | None = None
        self._views: dict[str, tuple[float, float]] = {}
        self.said.object = self.shown.sentence()
        columns = list(self.shown.covariates)
        kept = [n for n in self.choice.value if n in columns]
        names = (f"step {state.number}", "none" if other is None else f"step {other.number}", BOTH)
        options = dict(zip(names, (AFTER, BEFORE, BOTH), strict=True))
        value = self.when.value if same else AFTER
        self._showing = True
        self.when.param.update(options=options, disabled=not same, value=value)
        self.choice.param.update(options=columns, value=kept or self.shown.start())
        self._showing = False
        self._begin()
        self._say_selected()

    def widen(self, wide: bool) -> None:
        """Begin with a third panel where there is room."""
        if wide and self.choice.value == self.shown.start():
            self.choice.value = self.shown.start(3)

    def preview(self, curve: np.ndarray | None) -> None:
        """Lay an effect's curve over the residuals, output unit, (n,); None takes it away."""
        self._curve = None if curve is None else np.asarray(curve, float)
        self._curves.data[CURVE] = self._curve_at(self.source.data["row"])
        for made in self._figures.values():
            show_curve(made, self._curve is not None)

    def wear(self, palette: Palette) -> None:
        self.source.data["colour"] = self.shown.colours(palette)[self.source.data["row"]]
        self._say_runs()
        for made in (*self._figures.values(), *self._outputs.values()):
            dress_panel(made, palette)

    def select(self, rows: np.ndarray) -> None:
        """Brush rows, of all readings; in the panels those that are drawn light up."""
        self.selected = np.asarray(rows, int)
        self._light_up(self.source.data["row"])
        self._say_selected()

    def _light_up(self, drawn: np.ndarray) -> None:
        self.source.selected.indices = np.flatnonzero(np.isin(drawn, self.selected)).tolist()

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
        self._y = fixed_range(-1, 1)
        self.source: Any = ColumnDataSource({})
        self._curves: Any = ColumnDataSource({})  # of the preview: only what has it is drawn anew
        self._figures: dict[str, Any] = {}
        self._outputs: dict[str, Any] = {}
        self._panes: dict[str, pn.Column] = {}
        self._fit_range()  # before the panels are laid out: a change after it may overtake them
        self._lay_out()
        self.source.selected.on_change("indices", self._brushed_in_source)
        self._say_runs()

    def _lay_out(self) -> None:
        """A panel for each column chosen; those that stay are left as they are."""
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
                output = output_panel(self.shown, name, self.source, made)
                self._outputs[name] = self._brushable(output, name, True)
            upper = [self._outputs[name]] if name in self._outputs else []
            wanted = [*upper * (WHAT[0] in self.what.value)]
            wanted += [made] * (WHAT[1] in self.what.value or not wanted)
            if [getattr(pane, "object", None) for pane in room] != wanted:
                room[:] = [plot(one) for one in wanted]

    def _fill(self) -> None:
        """The same panels with other residuals."""
        self._fill_source(list(self._figures))
        self._fit_range()

    def _now(self) -> np.ndarray:
        before = self.shown.before if self.when.value == BEFORE else None
        return self.shown.residual if before is None else before

    def _other(self) -> np.ndarray | None:
        """Residuals of the other step, where both are drawn."""
        return self.shown.before if self.when.value == BOTH else None

    def _fill_source(self, names: list[str]) -> None:
        shown, residual, before = self.shown, self._now(), self._other()
        rows = np.array([], int)
        if names:
            covariates = {n: shown.places[n] for n in names}
            rows = drawn_rows(covariates, [residual, shown.measured], self._views)
        drawn = dict.fromkeys([*names, *self._figures])  # panels that go are drawn once more
        at: dict[str, Any] = {AT + n: shown.places[n][rows] for n in drawn}
        other = np.full(rows.size, np.nan) if before is None else before[rows]
        self.source.data = at | {
            "row": rows,
            "reading": rows + 1,
            "run": [shown.runs[0][k] for k in shown.runs[1][rows]],
            "residual": residual[rows],
            "measured": shown.measured[rows],
            FIT: (shown.measured - residual)[rows],
            "before": other,
            "fit before": shown.measured[rows] - other,
            "colour": shown.colours(self.bench.palette)[rows],
            "marker": shown.markers()[rows],
        }
        self._curves.data = {**at, CURVE: self._curve_at(rows)}
        self._light_up(rows)
        self.drawn.object = sentence(rows.size, residual.size)

    def _fit_range(self) -> None:
        other = self._other()
        values = [self._now(), *([] if other is None else [other])]
        ends = span(float(min(v.min() for v in values)), float(max(v.max() for v in values)))
        self._y.update(**ends, reset_start=ends["start"], reset_end=ends["end"])

    def _curve_at(self, rows: np.ndarray) -> np.ndarray:
        return np.full(len(rows), np.nan) if self._curve is None else self._curve[rows]

    def _panel(self, name: str) -> Any:
        made = residual_panel(self.shown, name, self.source, self._curves, self._y)
        show_curve(made, self._curve is not None)
        for end in ("start", "end"):
            made.x_range.on_change(end, lambda attr, old, new: self._moved(name, made.x_range))
        return self._brushable(made, name, name == AGAINST)

    def _brushable(self, made: Any, name: str, output: bool) -> Any:
        dress_panel(made, self.bench.palette)
        made.on_event(SelectionGeometry, lambda event: self._brushed_in_panel(name, output, event))
        made.on_event(Reset, lambda _: self.select(np.array([], int)))
        return made

    @property
    def _all_drawn(self) -> bool:
        return self.shown.residual.size == len(self.source.data["row"])

    def _moved(self, name: str, view: Any) -> None:
        """A panel was zoomed: of many readings, others are drawn; once, when it rests."""
        if self._all_drawn and not self._views:
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
        """Of many readings those that are not drawn belong to a region too; of few the browser's selection has all."""
        place = event.geometry
        if not event.final or place.get("type") != "rect" or self._all_drawn:
            return
        x, y = self.shown.places[name], self.shown.measured if output else self._now()
        low, high = sorted((place["x0"], place["x1"]))
        bottom, top = sorted((place["y0"], place["y1"]))
        self.selected = np.flatnonzero((x >= low) & (x <= high) & (y >= bottom) & (y <= top))
        self._say_selected()

    def _brushed_in_source(self, _: str, __: Any, indices: list[int]) -> None:
        if self._all_drawn or not indices:
            self.selected = np.asarray(self.source.data["row"])[np.asarray(indices, int)]
            self._say_selected()

    def _say_runs(self) -> None:
        """Which colour and shape is which run."""
        levels, palette = self.shown.runs[0], self.bench.palette
        told = [("•", palette.ink, "fit")]
        for k, level in enumerate(levels if 1 < len(levels) <= LEGEND else ()):
            colour = palette.cycle[k % len(palette.cycle)]
            told.append((SIGNS[k % len(SIGNS)], colour, f"run {level[:16]}"))
        parts: list[Any] = [
            row(words(sign, styles={"color": colour}), words(text, "small"), kinds=("tight",))
            for sign, colour, text in told
        ]
        if len(levels) > LEGEND:
            parts.append(words(f"{len(levels)} runs; colours and shapes repeat", "small"))
        self.legend[:] = parts

    def _say_selected(self) -> None:
        rows, said = self.selected, HINT
        if rows.size:
            mean = f"{self._now()[rows].mean():+.3g} {self.shown.unit}".replace("-", "−")
            said = f"{rows.size:,} readings selected, mean residual {mean}"
        self.brushed.object = said
        self.bench.tabs.describe.selected(rows)
