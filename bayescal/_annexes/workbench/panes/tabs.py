"""Lower part of the workbench page: tabs with errors of all steps, comparison, verdict, files and Python script.

The error tab has the tree of steps, with the path to the current one and buttons to go back, and the progress of the
whole search. The other tabs compare two steps, show the verdict, write files, and show the steps in Python.
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import panel as pn

from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.widgets import (
    INSIDE,
    Pane,
    Rows,
    button,
    choice,
    column,
    download,
    field,
    halves,
    row,
    words,
)
from bayescal._annexes.workbench.session_store import path_to

WHOLE = (
    # The picture fills its container, in the page's colours and without a background.
    "svg, div { height: 100%; width: 100%; } text { fill: currentColor; }"
    ' [style="fill: #ffffff"] { fill-opacity: 0; }'
)


class ErrorPane(Pane):
    """Pane with the figure of the errors along the path to the current step, and the tree of steps."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        to = {"go": lambda n: bench.act("go_to", n), "compare": bench.compare}
        press = lambda state, action: to[action](int(state))  # noqa: E731
        self.rows = Rows(press, table=True, kind="table", label="Steps")
        self.find = button("Find all", lambda _: bench.find_all(), color="primary")
        self.halt = button("Stop", lambda _: bench.stop(), disabled=True)
        self.progress = words("", "small")
        room: dict[str, Any] = {"sizing_mode": "stretch_both", "margin": 0, "min_height": 0}
        self.picture = pn.pane.HTML("", stylesheets=[INSIDE, WHOLE], **room)
        buttons = row(self.find, self.halt, self.progress)
        self.view = column(buttons, halves(self.picture, self.rows), kinds=("bare", "error"))

    def show(self, state: Any) -> None:
        """Show the tree of states, and a figure of the errors on the path to the current state."""
        states, current = self.session.states, state.number
        steps = [states[n].step.errors() for n in path_to(states, current)]
        self.picture.object = str(ws.Pictures().draw_errors(steps).html)
        self.rows.head, self.rows.rows = step_rows(states, current)

    def busy(self, busy: bool) -> None:
        self.rows.busy = self.find.disabled = busy

    def show_search_progress(self, on: bool, text: str = "") -> None:
        """Show the progress text of a search; enable the stop button while the search is running."""
        self.halt.disabled = not on
        self.progress.object = text


COLUMNS = ("step", "rms as fitted", "new run", "held-out", "noise floor", "P(complete)")
STEP_ACTIONS = [
    {"id": "compare", "label": "Compare", "title": "with the current step"},
    {"id": "go", "label": "Go back", "title": "further changes branch off here"},
]
TITLES = {"P(complete)": "probability that no testable effect is missing"}


def step_rows(states: Mapping[int, Any], current: int) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the table head, and a row per state: its errors as in a printed `SearchPath`, and its actions."""
    steps = []
    for n, state in sorted(states.items()):
        before, branch = states.get(state.parent), state.parent not in (None, n - 1)
        row = state.step.row(before and before.step)
        complete = state.discovery and state.discovery.nothing_missing
        title = {"number": f"{n} ", "title": state.title + f" (from {state.parent})" * branch}
        steps.append({**row, **title, "nothing_missing": complete, "state": n})
    table = ws.steps_table(steps)
    table = table.only(*(c.head for c in table.printed_columns if c.head in COLUMNS))
    heads, rows = [c.head for c in table.columns], []
    rises = {"held-out": "more than a twentieth above the step before"}
    for row, (step, *cells) in zip(steps, table.cells, strict=True):
        titles = TITLES | (rises if row["rises"] else {})
        numbers = [
            {"text": text, "kind": "number", "title": titles.get(head, "")}
            for head, text in zip(heads[1:], cells, strict=True)
        ]
        now = row["state"] == current
        texts = {"cells": [{"text": step}, *numbers], "actions": [] if now else STEP_ACTIONS}
        rows.append({"id": str(row["state"]), **texts, "current": now})
    return [*table.head, ""], rows


def answer_text() -> Any:
    """Make a scrollable text pane for a printed table."""
    return words("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")


class VerdictPane(Pane):
    """Pane of the verdict: whether the result may be used, with reasons."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        about = "Verdict on this model, fitted as by `bayescal calibrate`: whether it may be used."
        self.answer = answer_text()
        self.view = column(words(about, "small"), self.answer)

    def show(self, state: Any) -> None:
        self.answer.object = ""
        answered = lambda verdict: self.answer.param.update(object=verdict)  # noqa: E731
        self.bench.run(self.session.verdict, answered, "Computing the verdict …")


class ComparePane(Pane):
    """Pane that compares the current step with another one."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._showing = False
        self.which = field(pn.widgets.Select, "with step", options={}, width=200)
        self.which.param.watch(lambda _: self._chosen(), "value")
        about = (
            "The current step compared with another one, whose residuals are hollow in the panels."
        )
        self.answer = answer_text()
        self.view = halves(column(words(about, "small"), row(self.which)), self.answer)

    def set_other(self, number: int | None) -> None:
        """Set the step to compare with."""
        states, now = self.session.states, self.session.current.number
        self._showing = True
        options = {f"{n} {s.title}": n for n, s in states.items() if n != now}
        self.which.param.update(options=options, value=number)
        self._showing = False

    def show(self, state: Any) -> None:
        self.answer.object, other = "", self.which.value
        if other is not None:
            answered = lambda text: self.answer.param.update(object=text)  # noqa: E731
            self.bench.run(lambda: self.session.compare(other), answered, "Comparing …")

    def _chosen(self) -> None:
        if not self._showing and self.which.value is not None:
            self.bench.compare(self.which.value)


# Label of the button → file, description.
FILES = {
    "Report": ("report.html", "For sign-off: a one-page summary, with appendices, in one file."),
    "C header": ("compensation.h", "Compensation as a C99 header."),
    "JSON": ("compensation.json", "Compensation as JSON, with its covariance."),
    "Python function": ("compensation.py", "Compensation as a Python function."),
}


class FilesPane(Pane):
    """Pane of files, report and compensations: a button writes a file, then a link downloads it."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._links = {label: download("", visible=False) for label in FILES}
        self.view = column(*map(self._line, FILES), kinds=("bare", "scrolls"))

    def _line(self, label: str) -> Any:
        file, about = FILES[label]
        write, link = lambda: self.session.write(file), self._links[label]

        def show(path: Path) -> None:
            link.param.update(file=str(path), filename=file, label=f"Download {file}", visible=True)

        press = lambda _: self.bench.run(write, show, f"Writing {file} …")  # noqa: E731
        return row(button(label, press, min_width=170), words(about, "small"), link)

    def show(self, state: Any) -> None:
        for link in self._links.values():
            link.visible = False


class PythonPane(Pane):
    """Pane of the script that reproduces the steps up to the current one."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.code = field(
            pn.widgets.TextAreaInput,
            "The steps in Python, with identical numbers",
            sizing_mode="stretch_both",
            css_classes=["code"],
            disabled=True,
            max_length=10**6,
        )
        script = lambda: BytesIO(self.code.value.encode())  # noqa: E731
        link = download("Download workbench.py", callback=script, filename="workbench.py")
        self.view = column(self.code, row(link))

    def show(self, state: Any) -> None:
        self.code.value = self.session.script()


ERROR = "The error"


class Tabs(Pane):
    """Tabs that select the lower pane; a pane is updated when its tab is opened."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.compare = ComparePane(bench)
        self._panes: dict[str, Pane] = {
            ERROR: bench.error,
            "Side by side": self.compare,
            "Verdict": VerdictPane(bench),
            "Files": FilesPane(bench),
            "Python": PythonPane(bench),
        }
        self._state: Any = None
        self._stale = set[str]()
        self.which = choice([*self._panes], ERROR, "Lower part")
        self.which.param.watch(lambda _: self._freshen(), "value")
        self.room = pn.Column(bench.error.view, sizing_mode="stretch_both", margin=0, min_height=0)
        self.view = column(self.which, self.room, kinds=("pane", "tabs"))

    def show(self, state: Any) -> None:
        self._state, self._stale = state, {*self._panes} - {ERROR}
        self._freshen()

    def _freshen(self) -> None:
        pane = self._panes[self.which.value]
        if self.which.value in self._stale:
            self._stale.discard(self.which.value)
            pane.show(self._state)
        if [*self.room] != [pane.view]:
            self.room[:] = [pane.view]
