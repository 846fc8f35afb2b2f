"""The error: the tree of steps with the path so far, every step to go back to, the whole search with its progress."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bokeh.models import ColumnDataSource, Legend, LegendItem, NumeralTickFormatter, Span

from bayescal._core.formatting import number, probability
from bayescal._data.unit_conversion import unit_label
from bayescal._report.plot_colours import GREEN, ORANGE, RED
from bayescal._search.search_path import RISES
from bayescal._workbench.kept import path_to
from bayescal._workbench.panes.fails import NOISE
from bayescal._workbench.parts.pieces import (
    Palette,
    Pane,
    Rows,
    button,
    column,
    halves,
    new_figure,
    plot,
    row,
    words,
)

SERIES = (  # of a step's errors: name, marker, colour (None: the ground's blue)
    ("as fitted", "circle", None),
    ("new run", "square", ORANGE),
    ("held out", "triangle", GREEN),
)


class ErrorPane(Pane):
    """The bottom of the page."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        to = {"go": lambda n: bench.act("go_to", n), "compare": bench.compare}
        press = lambda state, action: to[action](int(state))  # noqa: E731
        self.rows = Rows(press, table=True, kind="table", label="Steps")
        self.find = button("Find all", lambda _: bench.find_all(), color="primary")
        self.halt = button("Stop", lambda _: bench.stop(), disabled=True)
        self.undo = button("Undo", lambda _: bench.undo(), disabled=True)
        self.progress = words("", "small")
        empty: dict[str, Any] = {name: [] for name in (*(s[0] for s in SERIES), "step", "floor")}
        self.source: Any = ColumnDataSource(empty)
        self.branches: Any = ColumnDataSource({"xs": [], "ys": []})
        self.numbers: Any = ColumnDataSource({"x": [], "y": [], "text": []})
        self.figure = self._figure()
        self.figures = [self.figure]
        buttons = row(self.find, self.halt, self.undo, self.progress)
        kinds = ("bare", "error")
        self.view = column(buttons, halves(plot(self.figure), self.rows), kinds=kinds)

    def _figure(self) -> Any:
        ranges: dict[str, Any] = {"x_range": (-0.3, 1.3), "y_range": (0.0, 1.0)}
        made = new_figure("step of the path", "rms error", tools="", **ranges)
        made.name = "the error"
        ticks: dict[str, Any] = {"desired_num_ticks": 8, "mantissas": [1, 2, 5], "min_interval": 1}
        made.xaxis[0].ticker.update(**ticks)
        made.xaxis.formatter = NumeralTickFormatter(format="0")
        made.multi_line("xs", "ys", source=self.branches, color=NOISE, line_width=1.5)
        place: dict[str, Any] = {"x_offset": 5, "y_offset": -4, "text_font_size": "11px"}
        self._numbers = made.text("x", "y", "text", source=self.numbers, **place)
        items = []
        for name, marker, colour in SERIES:
            own = {"source": self.source, "color": colour or self.bench.palette.blue}
            drawn = [
                made.line("step", name, line_width=2, **own),
                made.scatter("step", name, size=8, marker=marker, **own),
            ]
            items.append(LegendItem(label=name, renderers=drawn))
        self._blue = items[0].renderers
        dashed: dict[str, Any] = {"line_color": RED, "line_dash": "dashed"}
        self._floor = Span(location=0, dimension="width", line_width=1.5, **dashed)
        made.add_layout(self._floor)
        line = made.line("step", "floor", source=self.source, **dashed)
        items.append(LegendItem(label="floor", renderers=[line]))
        plain: dict[str, Any] = {"border_line_alpha": 0, "background_fill_alpha": 0}
        room: dict[str, Any] = {
            "margin": 0,
            "spacing": 8,
            "glyph_width": 16,
            "label_text_font_size": "11px",
        }
        self._legend: Any = Legend(items=items, orientation="horizontal", **room, **plain)
        made.add_layout(self._legend, "above")
        return made

    def show(self, state: Any) -> None:
        """Show the tree of states; the figure has the path to the current one."""
        states, current = self.session.states, state.number
        path = path_to(states, current)
        errors = [states[n].step.errors() for n in path]
        unit, floor = unit_label(errors[-1]["unit"]), errors[-1]["noise_floor"]
        held_out = [e["holdout_rmse"] for e in errors]
        kept_apart = any(v is not None for v in held_out)
        values = {
            "as fitted": [e["rmse_fitted"] for e in errors],
            "new run": [e["rmse"] for e in errors],
            "held out": [float("nan") if v is None else v for v in held_out],
        }
        self.source.data = {"step": list(range(len(path))), "floor": [floor] * len(path), **values}
        largest = max(v for series in values.values() for v in series if v == v)
        deepest, highest = self._show_branches(states, path)
        self.figure.y_range.end = 1.2 * max(largest, floor, highest)
        self.figure.x_range.start, self.figure.x_range.end = -0.3, max(1, deepest) + 0.3
        self.figure.yaxis.axis_label = f"rms error [{unit}]"
        self._floor.location = floor
        for item in self._legend.items:
            item.visible = item.label.value != "held out" or kept_apart
        further = ["held out"] if kept_apart else []
        self.rows.head = [
            *("step", f"as fitted [{unit}]", "new run", *further, "floor", "complete", "")
        ]
        self.rows.rows = step_rows(states, current, kept_apart)
        self.undo.disabled = self.session.before is None

    def _show_branches(self, states: Mapping[int, Any], path: list[int]) -> tuple[int, float]:
        """Draw the steps off the path, each from its parent, and number all; the longest way, the largest error."""
        depth = {n: len(path_to(states, n)) - 1 for n in states}
        error = {n: float(states[n].step.errors()["rmse_fitted"]) for n in states}
        off = [(states[n].parent, n) for n in states if n not in path]
        at = {"x": list(depth.values()), "y": list(error.values())}
        self.numbers.data = {**at, "text": [str(n) for n in depth]}
        self.branches.data = {
            "xs": [[depth[a], depth[b]] for a, b in off],
            "ys": [[error[a], error[b]] for a, b in off],
        }
        return max(depth.values()), max(error.values())

    def wear(self, palette: Palette) -> None:
        super().wear(palette)
        self._numbers.glyph.text_color = palette.ink
        self._blue[0].glyph.line_color = palette.blue
        self._blue[1].glyph.fill_color = self._blue[1].glyph.line_color = palette.blue

    def busy(self, busy: bool) -> None:
        self.rows.busy = self.find.disabled = busy

    def searching(self, on: bool, told: str = "") -> None:
        """Whether the whole search is under way, and how far it is."""
        self.halt.disabled = not on
        self.progress.object = told


def in_order(states: Mapping[int, Any]) -> list[tuple[int, str]]:
    """(number, the lines of the tree before it), each state after its parent.

    A first child stands in its parent's column; every other begins a branch, drawn between the two.
    """
    children: dict[int | None, list[int]] = {}
    for n in sorted(states):
        children.setdefault(states[n].parent, []).append(n)
    found: list[tuple[int, str]] = []
    waiting = [(n, "", "") for n in reversed(children.get(None, []))]
    while waiting:
        n, before, below = waiting.pop()
        found.append((n, before))
        first, others = children.get(n, [])[:1], children.get(n, [])[1:]
        waiting += [(c, below, below) for c in first]
        waiting += [(c, f"{below}├ ", f"{below}│ ") for c in reversed(others)]
    return found


def step_rows(states: Mapping[int, Any], current: int, kept_apart: bool) -> list[dict[str, Any]]:
    """A row a state: its errors, and the way back to it."""
    rows = []
    for n, lines in in_order(states):
        state, before = states[n], states.get(states[n].parent)
        e, found = state.step.errors(), state.discovery
        told = [{"text": number(e["rmse_fitted"])}, {"text": number(e["rmse"])}]
        if kept_apart:
            worse = before is not None and state.step.raises_holdout(before.step)
            said = "more than a twentieth above the step before" if worse else ""
            told.append({"text": f"{number(e['holdout_rmse'])}{RISES * worse}", "title": said})
        complete = probability(None if found is None else found.nothing_missing)
        told.append({"text": number(e["noise_floor"])})
        told.append({"text": complete, "title": "probability that the model is complete"})
        here = [
            {"id": "compare", "label": "Compare", "title": "with the step that is shown"},
            {"id": "go", "label": "Go back", "title": "what is done next branches off here"},
        ]
        title = {"text": f"{lines}{n}  {state.title}"}
        row = {"id": str(n), "cells": [title, *({**one, "kind": "number"} for one in told)]}
        rows.append({**row, "actions": [] if n == current else here, "current": n == current})
    return rows
