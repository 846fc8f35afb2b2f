"""Lower part of the workbench page: tabs with errors of all steps, comparison, verdict, files and Python script.

The error tab has the tree of steps, with the path to the current one and buttons to go back, and the progress of the
search. The other tabs compare two steps, show the verdict, write files, and show the steps in Python.
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
    column,
    download_button,
    label,
    pair,
    radio_buttons,
    row,
    widget,
)
from bayescal._annexes.workbench.session_store import list_path

FIGURE_CSS = (
    # The figure fills its container, in the page's colours and without a background.
    "svg, div { height: 100%; width: 100%; } text { fill: currentColor; }"
    ' [style="fill: #ffffff"] { fill-opacity: 0; }'
)


class ErrorPane(Pane):
    """Pane of the tree of steps, with a figure of the errors on the path to the current step."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        actions = {"go": lambda n: page.act("go_to", n), "compare": page.compare}
        press = lambda state, action: actions[action](int(state))  # noqa: E731
        self.rows = Rows(press, table=True, kind="table", label="Steps")
        self.find_button = button("Find all", lambda _: page.find_all(), color="primary")
        self.stop_button = button("Stop", lambda _: page.stop(), disabled=True)
        self.progress = label("", "small")
        sizing: dict[str, Any] = {"sizing_mode": "stretch_both", "margin": 0, "min_height": 0}
        self.figure = pn.pane.HTML("", stylesheets=[INSIDE, FIGURE_CSS], **sizing)
        buttons = row(self.find_button, self.stop_button, self.progress)
        self.view = column(buttons, pair(self.figure, self.rows), kinds=("bare", "error"))

    def show(self, state: Any) -> None:
        """Show the tree of states, and a figure of the errors on the path to the current state."""
        states, current = self.session.states, state.number
        steps = [states[n].step.errors() for n in list_path(states, current)]
        self.figure.object = str(ws.Pictures().draw_errors(steps).html)
        self.rows.head, self.rows.rows = list_steps(states, current)

    def set_busy(self, is_busy: bool) -> None:
        self.rows.busy = self.find_button.disabled = is_busy

    def show_search_progress(self, is_running: bool, text: str = "") -> None:
        """Show the progress text of a search; enable the stop button while the search is running."""
        self.stop_button.disabled = not is_running
        self.progress.object = text


STEP_COLUMNS = ("step", "rms as fitted", "new run", "held-out", "noise floor", "P(complete)")
STEP_ACTIONS = [
    {"id": "compare", "label": "Compare", "title": "with the current step"},
    {"id": "go", "label": "Go back", "title": "further changes branch off here"},
]
COLUMN_TOOLTIPS = {"P(complete)": "probability that no testable candidate is missing"}


def list_steps(states: Mapping[int, Any], current: int) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the headers, and one row per state: the errors that a printed `SearchPath` shows, and its actions."""
    steps = []
    for n, state in sorted(states.items()):
        parent, is_branch = states.get(state.parent), state.parent not in (None, n - 1)
        row = state.step.row(parent and parent.step)
        completeness = state.discovery and state.discovery.nothing_missing
        title = {"number": f"{n} ", "title": state.title + f" (from {state.parent})" * is_branch}
        steps.append({**row, **title, "nothing_missing": completeness, "state": n})
    table = ws.steps_table(steps)
    table = table.select(*(c.heading for c in table.printed_columns if c.heading in STEP_COLUMNS))
    headers, rows = [c.heading for c in table.columns], []
    increase_title = {"held-out": "more than a twentieth above the step before"}
    for row, (step, *cells) in zip(steps, table.cells, strict=True):
        tooltips = COLUMN_TOOLTIPS | (increase_title if row["rises"] else {})
        numbers = [
            {"text": text, "kind": "number", "title": tooltips.get(head, "")}
            for head, text in zip(headers[1:], cells, strict=True)
        ]
        is_current = row["state"] == current
        texts = {"cells": [{"text": step}, *numbers], "actions": [] if is_current else STEP_ACTIONS}
        rows.append({"id": str(row["state"]), **texts, "current": is_current})
    return [*table.headings, ""], rows


def make_table_pane() -> Any:
    """Make a scrollable pane for a printed table."""
    return label("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")


class VerdictPane(Pane):
    """Pane of the verdict: whether the result may be used, with reasons."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        description = "Verdict on the model, fitted as by `bayescal calibrate`: may it be used?"
        self.text = make_table_pane()
        self.view = column(label(description, "small"), self.text)

    def show(self, state: Any) -> None:
        self.text.object = ""
        show_text = lambda verdict: self.text.param.update(object=verdict)  # noqa: E731
        self.page.run(self.session.verdict, show_text, "Computing the verdict …")


class ComparePane(Pane):
    """Pane that compares the current step with another one."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self._is_updating = False
        self.selection = widget(pn.widgets.Select, "with step", options={}, width=200)
        self.selection.param.watch(lambda _: self._compare(), "value")
        description = (
            "The current step compared with another one, whose residuals are hollow in the panels."
        )
        self.text = make_table_pane()
        self.view = pair(column(label(description, "small"), row(self.selection)), self.text)

    def set_other(self, number: int | None) -> None:
        """Select the step to compare with, without starting a comparison."""
        states, current = self.session.states, self.session.current.number
        self._is_updating = True
        options = {f"{n} {s.title}": n for n, s in states.items() if n != current}
        self.selection.param.update(options=options, value=number)
        self._is_updating = False

    def show(self, state: Any) -> None:
        self.text.object, other = "", self.selection.value
        if other is not None:
            show_text = lambda text: self.text.param.update(object=text)  # noqa: E731
            self.page.run(lambda: self.session.compare(other), show_text, "Comparing …")

    def _compare(self) -> None:
        if not self._is_updating and self.selection.value is not None:
            self.page.compare(self.selection.value)


# Label of the button → file, description.
FILES = {
    "Report": ("report.html", "For sign-off: a one-page summary, with appendices, in one file."),
    "C header": ("compensation.h", "Compensation as a C99 header."),
    "JSON": ("compensation.json", "Compensation as JSON, with its covariance."),
    "Python function": ("compensation.py", "Compensation as a Python function."),
}


class FilesPane(Pane):
    """Pane of the report and exports: a button writes a file, and a link then downloads it."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self._links = {name: download_button("", visible=False) for name in FILES}
        self.view = column(*map(self._make_row, FILES), kinds=("bare", "scrolls"))

    def _make_row(self, name: str) -> Any:
        file, description = FILES[name]
        write, link = lambda: self.session.write(file), self._links[name]

        def show(path: Path) -> None:
            link.param.update(file=str(path), filename=file, label=f"Download {file}", visible=True)

        press = lambda _: self.page.run(write, show, f"Writing {file} …")  # noqa: E731
        return row(button(name, press, min_width=170), label(description, "small"), link)

    def show(self, state: Any) -> None:
        for link in self._links.values():
            link.visible = False


class PythonPane(Pane):
    """Pane of the script that reproduces the steps up to the current one."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self.code = widget(
            pn.widgets.TextAreaInput,
            "The steps in Python, with identical numbers",
            sizing_mode="stretch_both",
            css_classes=["code"],
            disabled=True,
            max_length=10**6,
        )
        script = lambda: BytesIO(self.code.value.encode())  # noqa: E731
        link = download_button("Download workbench.py", callback=script, filename="workbench.py")
        self.view = column(self.code, row(link))

    def show(self, state: Any) -> None:
        self.code.value = self.session.script()


ERROR_TAB = "The error"


class Tabs(Pane):
    """Tabs that select the lower pane; a pane is updated when its tab is opened."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self.compare_pane = ComparePane(page)
        self._panes: dict[str, Pane] = {
            ERROR_TAB: page.errors,
            "Side by side": self.compare_pane,
            "Verdict": VerdictPane(page),
            "Files": FilesPane(page),
            "Python": PythonPane(page),
        }
        self._state: Any = None
        self._stale = set[str]()
        self.selection = radio_buttons([*self._panes], ERROR_TAB, "Lower part")
        self.selection.param.watch(lambda _: self._update_pane(), "value")
        self.body = pn.Column(page.errors.view, sizing_mode="stretch_both", margin=0, min_height=0)
        self.view = column(self.selection, self.body, kinds=("pane", "tabs"))

    def show(self, state: Any) -> None:
        self._state, self._stale = state, {*self._panes} - {ERROR_TAB}
        self._update_pane()

    def _update_pane(self) -> None:
        pane = self._panes[self.selection.value]
        if self.selection.value in self._stale:
            self._stale.discard(self.selection.value)
            pane.show(self._state)
        if [*self.body] != [pane.view]:
            self.body[:] = [pane.view]
