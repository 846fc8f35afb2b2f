"""Where it fails: output with the fit, and residuals, over columns side by side, brushed together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.events import Reset, SelectionGeometry
from bokeh.models import ColumnDataSource

from bayescal._workbench.panes.fails_data import ResidualsOfState
from bayescal._workbench.panes.fails_panel import (
    AT,
    CURVE,
    FIT,
    OUTPUT,
    WHAT,
    ColumnPanel,
)
from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.decimate import drawn_rows, sentence
from bayescal._workbench.parts.pieces import choice, column, row, several, words
from bayescal._workbench.parts.style import Palette, range_over

AFTER, BEFORE, BOTH = "after", "before", "both"  # this step, the one beside it
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

    shown: Any = None  # `ResidualsOfState`, from the first `show` on

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
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
        self.when.param.watch(lambda _: self._showing or self._fill_source(), "value")
        self.what.param.watch(lambda _: self._place(), "value")

    def show(self, state: Any, other: Any | None = None) -> None:
        """Show a state; `other` is the one that it is compared with."""
        residual = state.step.check.residuals
        earlier = None if other is None else np.asarray(other.step.check.residuals, float)
        same = earlier is not None and earlier.size == len(residual)
        before = self.shown
        self.shown = ResidualsOfState(state.step, earlier if same else None)
        self._curve: np.ndarray | None = None
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
        if before is None or not self.shown.same_readings(before):
            self._begin()
        for made in self._made.values():
            made.show(self.shown)
        self._lay_out()
        self._say_selected()

    def widen(self, wide: bool) -> None:
        """Begin with a third panel where there is room."""
        if wide and self.choice.value == self.shown.start():
            self.choice.value = self.shown.start(3)

    def preview(self, curve: np.ndarray | None) -> None:
        """Lay an effect's curve over the residuals, output unit, (n,); None takes it away."""
        self._curve = None if curve is None else np.asarray(curve, float)
        self._curves.data = self._of_curve()

    def wear(self, palette: Palette) -> None:
        self.source.data["colour"] = self.shown.colours(palette)[self.source.data["row"]]
        self._say_runs()
        for made in self._made.values():
            made.wear(palette)

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
        """Other readings: no panel over those before is of use."""
        self._made: dict[str, ColumnPanel] = {}  # of each column that was ever ticked
        self._views: dict[str, tuple[float, float]] = {}
        self.selected = np.array([], int)
        self._y = range_over(self.shown.residual)
        self.source: Any = ColumnDataSource({})
        self._curves: Any = ColumnDataSource({})  # of the preview: only what has it is drawn anew
        self.source.selected.on_change("indices", self._brushed_in_source)
        self._say_runs()

    def _lay_out(self) -> None:
        """A panel for each column chosen; those that stay are left as they are."""
        names = [n for n in self.choice.value if n in self.shown.covariates]
        self._fill_source(names)
        for name in names:
            if name not in self._made:
                self._made[name] = self._panel(name)
        self._place()
        rooms = [self._made[name].room for name in names]
        if [*self.panels] != rooms:
            self.panels.css_classes = ["panels", *["of4"] * (len(rooms) == MOST)]
            self.panels[:] = rooms

    def _now(self) -> np.ndarray:
        before = self.shown.before if self.when.value == BEFORE else None
        return self.shown.residual if before is None else before

    def _other(self) -> np.ndarray | None:
        """Residuals of the other step, where both are drawn."""
        return self.shown.before if self.when.value == BOTH else None

    def _place(self) -> None:
        for made in self._made.values():
            made.place(self.what.value)

    def _fill_source(self, coming: Sequence[str] = ()) -> None:
        """The readings that are drawn, for the panels that are there and those that come."""
        shown, residual, before = self.shown, self._now(), self._other()
        there = [n for n, made in self._made.items() if made.room in [*self.panels]]
        names, rows = list(coming) or there, np.array([], int)
        if names:
            covariates = {n: shown.places[n] for n in names}
            rows = drawn_rows(covariates, [residual, shown.measured], self._views)
        drawn = dict.fromkeys([*names, *there])  # panels that go are drawn once more
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
        self._curves.data = self._of_curve()
        self._light_up(rows)
        self.drawn.object = sentence(rows.size, residual.size)
        range_over(residual, *([] if before is None else [before]), view=self._y)

    def _of_curve(self) -> dict[str, np.ndarray]:
        """What is drawn of a preview: nothing without one."""
        at = {n: v for n, v in self.source.data.items() if n.startswith(AT)}
        if self._curve is None:
            return dict.fromkeys([*at, CURVE], np.array([]))
        return {**at, CURVE: self._curve[self.source.data["row"]]}

    def _panel(self, name: str) -> ColumnPanel:
        made = ColumnPanel(self.shown, name, self.source, self._curves, self._y)
        made.wear(self.bench.palette)
        for end in ("start", "end"):
            made.x_range.on_change(end, lambda attr, old, new: self._moved(name, made.x_range))
        for what, figure in made.figures.items():
            brushed = lambda event, what=what: self._brushed_in_panel(name, what, event)  # noqa: E731
            figure.on_event(SelectionGeometry, brushed)
            figure.on_event(Reset, lambda _: self.select(np.array([], int)))
        return made

    @property
    def _all_drawn(self) -> bool:
        return self.shown.residual.size == len(self.source.data["row"])

    def _moved(self, name: str, view: Any) -> None:
        """A panel was zoomed: of many readings, others are drawn; once, when it rests."""
        views = {n: ends for n, ends in self._views.items() if n != name}
        if (view.start, view.end) != (view.reset_start, view.reset_end):
            views[name] = (float(view.start), float(view.end))
        moved, self._views = views != self._views, views
        document = self.source.document
        if document is None or self._waiting or self._all_drawn or not moved:
            return
        self._waiting = True

        def rested() -> None:
            self._waiting = False
            self._fill_source()

        document.add_timeout_callback(rested, 120)

    def _brushed_in_panel(self, name: str, what: str, event: Any) -> None:
        """Of many readings those that are not drawn belong to a region too; of few the browser's selection has all."""
        place = event.geometry
        if not event.final or place.get("type") != "rect" or self._all_drawn:
            return
        x, y = self.shown.places[name], self.shown.measured if what == OUTPUT else self._now()
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
