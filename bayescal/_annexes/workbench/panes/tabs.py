"""The lower part of the page: the error, and behind it what is needed less often; one at a time.

The error is the tree of steps with the path so far, every step to go back to, the whole search with its progress.
Behind it are questions to the current step, answered in text (verdict, comparison, budget, decisions, next
experiment); report, export and Python, as the command line writes them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, get_args

import panel as pn

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.metrology.decide import CONFORMITY, FALSE_ACCEPT, Rule
from bayescal._annexes.workbench.parts.widgets import (
    INSIDE,
    Pane,
    Rows,
    button,
    choice,
    code_field,
    column,
    download,
    field,
    halves,
    row,
    words,
)
from bayescal._annexes.workbench.session_store import path_to

WHOLE = (
    # A picture in its room and its colours, with no ground of its own.
    "svg, div { height: 100%; width: 100%; } text { fill: currentColor; }"
    ' [style="fill: #ffffff"] { fill-opacity: 0; }'
)


def picture_room() -> pn.pane.HTML:
    """Make a container for a picture of the report, in the colours of the page."""
    room: dict[str, Any] = {"sizing_mode": "stretch_both", "margin": 0, "min_height": 0}
    return pn.pane.HTML("", stylesheets=[INSIDE, WHOLE], **room)


class ErrorPane(Pane):
    """The bottom of the page: the report's picture of the way to the current step, and the tree of steps."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        to = {"go": lambda n: bench.act("go_to", n), "compare": bench.compare}
        press = lambda state, action: to[action](int(state))  # noqa: E731
        self.rows = Rows(press, table=True, kind="table", label="Steps")
        self.find = button("Find all", lambda _: bench.find_all(), color="primary")
        self.halt = button("Stop", lambda _: bench.stop(), disabled=True)
        self.undo = button("Undo", lambda _: bench.undo(), disabled=True)
        self.progress, self.picture = words("", "small"), picture_room()
        buttons = row(self.find, self.halt, self.undo, self.progress)
        kinds = ("bare", "error")
        self.view = column(buttons, halves(self.picture, self.rows), kinds=kinds)

    def show(self, state: Any) -> None:
        """Show the tree of states; the picture has the path to the current one."""
        states, current = self.session.states, state.number
        steps = [states[n].step.errors() for n in path_to(states, current)]
        self.picture.object = str(ws.Pictures().error(steps).body)
        self.rows.head, self.rows.rows = step_rows(states, current)
        self.undo.disabled = self.session.before is None

    def busy(self, busy: bool) -> None:
        self.rows.busy = self.find.disabled = busy

    def searching(self, on: bool, text: str = "") -> None:
        """Show whether the whole search is running, and its progress."""
        self.halt.disabled = not on
        self.progress.object = text


def in_order(states: Mapping[int, Any]) -> list[tuple[int, str]]:
    """Return (number, tree lines before it) of the states, each after its parent.

    A first child stands in its parent's column; every other begins a branch, drawn between the two.
    """
    children: dict[int | None, list[int]] = {}
    for n in sorted(states):
        children.setdefault(states[n].parent, []).append(n)
    order: list[tuple[int, str]] = []
    waiting = [(n, "", "") for n in reversed(children.get(None, []))]
    while waiting:
        n, before, below = waiting.pop()
        order.append((n, before))
        first, others = children.get(n, [])[:1], children.get(n, [])[1:]
        waiting += [(c, below, below) for c in first]
        waiting += [(c, f"{below}├ ", f"{below}│ ") for c in reversed(others)]
    return order


COLUMNS = ("step", "as fitted", "new run", "held-out", "noise floor", "P(complete)")
TITLES = {"P(complete)": "probability that the model is complete"}


def step_rows(states: Mapping[int, Any], current: int) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the head, and a row for each state: its errors as `SearchPath` prints them, and its actions."""
    steps = []
    for n, lines in in_order(states):
        state, before = states[n], states.get(states[n].parent)
        row = state.step.row(before and before.step)
        complete = state.discovery and state.discovery.nothing_missing
        title = {"number": f"{lines}{n} ", "title": state.title}
        steps.append({**row, **title, "nothing_missing": complete, "state": n})
    table = ws.steps_table(steps)
    table = table.only(*(c.head for c in table.shown if c.head in COLUMNS))
    heads, rows = [c.head for c in table.columns], []
    rises = {"held-out": "more than a twentieth above the step before"}
    for row, (step, *cells) in zip(steps, table.cells, strict=True):
        titles = TITLES | (rises if row["rises"] else {})
        numbers = [
            {"text": text, "kind": "number", "title": titles.get(head, "")}
            for head, text in zip(heads[1:], cells, strict=True)
        ]
        buttons = [
            {
                **{"id": "compare", "label": "Compare", "reads": True},
                "title": "with the step that is shown",
            },
            {"id": "go", "label": "Go back", "title": "what is done next branches off here"},
        ]
        now = row["state"] == current
        texts = {"cells": [{"text": step}, *numbers], "actions": [] if now else buttons}
        rows.append({"id": str(row["state"]), **texts, "current": now})
    return [*table.head, ""], rows


class AskPane(Pane):
    """A query with its fields, and the answer, which is marked as stale when the model changes.

    `question` reads the fields on the page and returns the job.
    """

    LABEL = ""  # of the button
    INTRO = ""  # what is asked, in words
    BY_ITSELF = False  # whether it is asked when it is looked at
    READS = False  # whether it fits nothing, and waits for no search
    KINDS: tuple[str, ...] = ("bare",)  # classes of the style of the answer's room

    def __init__(self, bench: Any, *fields: Any) -> None:
        super().__init__(bench)
        self._now, self._of = -1, -1
        self.begin = button(self.LABEL, lambda _: self.put(), color="primary")
        self.age = words("", "small")
        above = column(*fields, sizing_mode="stretch_width", styles={"flex": "0 0 auto"})
        self.answer = words("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")
        self.right = column(self.answer, kinds=self.KINDS)
        buttons = row(self.begin, self.age)
        inputs = column(words(self.INTRO, "small"), above, buttons, kinds=("bare", "scrolls"))
        self.view = halves(inputs, self.right)

    def question(self) -> Callable[[], Any]:
        raise NotImplementedError

    def answered(self, answer: Any) -> None:
        """Show parts of an answer apart from its text."""

    def show(self, state: Any) -> None:
        """Show another state; an answer of a former state stays, marked as stale."""
        self._now = state.number
        self._say_age()
        if self.BY_ITSELF and self._of != self._now:
            self.put()

    def put(self) -> None:
        """Run the query in a worker thread."""
        number = self._now

        def show(answer: Any) -> None:
            self._of, self.answer.object = number, str(answer)
            self.answered(answer)
            self._say_age()

        status = "Comparing …" if self.READS else "Computing …"
        self.bench.run(status, self.question(), show, reads=self.READS)

    def _say_age(self) -> None:
        stale = self._of not in (-1, self._now)
        age = f"This answer is of step {self._of}; step {self._now} is shown." if stale else ""
        self.age.object = age or (f"Of step {self._of}." if self._of >= 0 else "")
        self.right.css_classes = [*self.KINDS, *["stale"] * stale]


class VerdictPane(AskPane):
    """The verdict: whether the result may be used, and why not."""

    LABEL, BY_ITSELF = "Judge it", True
    INTRO = "Whether this model may be used as it is, fitted as bayescal calibrate fits it."

    def question(self) -> Callable[[], Any]:
        return self.session.verdict


class ComparePane(AskPane):
    """Two steps side by side."""

    LABEL, BY_ITSELF, READS = "Compare", True, True
    INTRO = "The step that is shown beside another one; its residuals stand in the panels, hollow."

    def __init__(self, bench: Any) -> None:
        self._showing = False
        self.which = field(pn.widgets.Select, "with step", options={}, width=200)
        self.which.param.watch(lambda _: self._chosen(), "value")
        super().__init__(bench, row(self.which))

    def question(self) -> Callable[[], Any]:
        other = self.which.value
        return lambda: "" if other is None else self.session.compare(other)

    def set_other(self, number: int | None) -> None:
        """Set the step to compare with."""
        states, now = self.session.states, self.session.current.number
        options = {f"{n} {s.title}": n for n, s in states.items() if n != now}
        value = number if number in options.values() else None
        self._showing = True
        self.which.param.update(options=options, value=value)
        self._showing = False

    def show(self, state: Any) -> None:
        self.begin.disabled = self.which.value is None
        self._of = -1  # the other step may be another one
        super().show(state)

    def _chosen(self) -> None:
        if not self._showing and self.which.value is not None:
            self.bench.compare(self.which.value)


class BudgetPane(AskPane):
    """The uncertainty budget at an operating point."""

    LABEL, BY_ITSELF = "Make the budget", True
    INTRO = "Uncertainty of a corrected reading by its sources, at an operating point."

    def __init__(self, bench: Any) -> None:
        self._at: dict[str, Any] = {}
        self.room = row()
        super().__init__(bench, self.room)

    def question(self) -> Callable[[], Any]:
        at = {n: f.value for n, f in self._at.items() if f.value is not None}
        return lambda: self.session.budget(at)

    def answered(self, budget: bc.Budget) -> None:
        """Make a field for each quantity of the operating point."""
        if list(self._at) == list(budget.at):
            return
        self._at = {}
        for name, value in budget.at.items():
            label, start = (
                f"{name} [{ws.pretty(budget.at_units[name] or '1')}]",
                float(f"{value:.6g}"),
            )
            self._at[name] = field(pn.widgets.FloatInput, label, value=start, width=150)
        self.room[:] = list(self._at.values())


class DecisionPane(AskPane):
    """The decision on conformity to limits."""

    LABEL = "Decide"
    INTRO = (
        "Does it meet its specification, and until when? Limits such as “bias: ±0.5 °/s”, “corrected reading: "
        "±0.1 °/s over -20..60 °C”. What is decided stands first in the report."
    )

    def __init__(self, bench: Any) -> None:
        w, room = pn.widgets, {"height": 74, "sizing_mode": "stretch_width"}
        self.limits = code_field("Limits, one a line", max_length=10_000, **room)
        self.rule = field(
            w.Select, "rule", options=list(get_args(Rule)), value="guarded", width=110
        )
        self.risk = field(w.FloatInput, "false acceptance", value=FALSE_ACCEPT, width=100)
        self.until = field(w.FloatInput, "conformity until", value=CONFORMITY, width=100)
        how: dict[str, Any] = {"placeholder": "sd 0.2 °/s", "width": 150}
        self.devices = field(w.TextInput, "devices, for global risks", **how)
        super().__init__(bench, self.limits, row(self.rule, self.risk, self.until, self.devices))

    def question(self) -> Callable[[], Any]:
        limits = [line.strip() for line in self.limits.value.splitlines() if line.strip()]
        options = {
            "rule": self.rule.value,
            "false_accept": self.risk.value or 0.0,
            "conformity": self.until.value or 0.0,
            "population": self.devices.value.strip() or None,
        }
        return lambda: self.session.decide(limits, **options)


class ExperimentPane(AskPane):
    """The next experiment: tests that discriminate the effects that these readings confound."""

    LABEL = "Rank the experiments"
    INTRO = "Feasible experiments, the most telling first: what each could say of effects that are confounded here."

    def __init__(self, bench: Any) -> None:
        self.rivals = words("", "small")
        super().__init__(bench, self.rivals)

    def show(self, state: Any) -> None:
        self._calibration, discovery = state.calibration, state.discovery
        self._rivals = () if discovery is None else discovery.rivals
        self.begin.disabled = len(self._rivals) < 2
        names = ", ".join(e.name for e in self._rivals)
        self.rivals.object = f"To tell apart: {names or 'nothing that was found'}"
        super().show(state)

    def question(self) -> Callable[[], Any]:
        calibration, rivals = self._calibration, self._rivals
        return lambda: bc.next_experiment(calibration, rivals)


EXPORTS = {
    "C header": ("compensation.h", "Compensation as a C99 header."),
    "JSON": ("compensation.json", "Compensation as JSON, with its covariance."),
    "Python function": ("compensation.py", "Compensation as a Python function."),
}


class Written:
    """A button that writes a file beside the page, and then a link to it."""

    def __init__(self, bench: Any, label: str, doing: str, write: Callable[[], Path]) -> None:
        """Make a button whose press runs `write` in a worker thread while `doing` is shown."""
        self.make = button(label, lambda _: bench.run(doing, write, self._done))
        self.link = download("", filename="none", file=BytesIO(), visible=False, color="primary")

    def _done(self, path: Path) -> None:
        self.link.file, self.link.filename = str(path), path.name
        self.link.label, self.link.visible = f"Download {path.name}", True

    def forget(self) -> None:
        """Hide the link when the state changes."""
        self.link.visible = False


class ReportPane(Pane):
    """The report for sign-off."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        write = lambda: self.session.report()  # noqa: E731
        self.written = Written(bench, "Write the report", "Writing the report …", write)
        note = words(
            "One HTML file that needs nothing else: a one-page summary for sign-off, with appendices. The last "
            "model is fitted as bayescal calibrate fits it, which takes a few seconds.",
            "small",
        )
        self.view = column(note, row(self.written.make, self.written.link))

    def show(self, state: Any) -> None:
        self.written.forget()


class ExportPane(Pane):
    """The compensation for firmware and programs."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.written, lines = [], []
        for label, (file, note) in EXPORTS.items():
            write = lambda file=file: self.session.export(file)  # noqa: E731
            entry = Written(bench, label, f"Writing {label} …", write)
            entry.make.min_width = 170
            self.written.append(entry)
            lines.append(row(entry.make, words(note, "small"), entry.link))
        self.view = column(*lines, kinds=("bare", "scrolls"))

    def show(self, state: Any) -> None:
        for entry in self.written:
            entry.forget()


class PythonPane(Pane):
    """The script that reproduces the actions up to this state."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        label = "What was clicked, in Python: the same numbers"
        self.code = code_field(label, disabled=True, max_length=10**6)
        self.link = download(
            "Download workbench.py",
            callback=lambda: BytesIO(self.code.value.encode()),
            filename="workbench.py",
            color="primary",
            align="start",
        )
        self.view = column(self.code, row(self.link))

    def show(self, state: Any) -> None:
        self.code.value = self.session.script()


ERROR = "The error"


class Tabs(Pane):
    """The choice of the lower pane; each is updated when it is opened, not before."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.compare = ComparePane(bench)
        self._panes: dict[str, Pane] = {
            "Side by side": self.compare,
            "Verdict": VerdictPane(bench),
            "Budget": BudgetPane(bench),
            "Decision": DecisionPane(bench),
            "Next experiment": ExperimentPane(bench),
            "Report": ReportPane(bench),
            "Export": ExportPane(bench),
            "Python": PythonPane(bench),
        }
        self._state: Any = None
        self._stale = set(self._panes)
        self.which = choice([ERROR, *self._panes], ERROR, "Lower part")
        self.which.param.watch(lambda _: self._open(), "value")
        self.room = pn.Column(bench.error.view, sizing_mode="stretch_both", margin=0, min_height=0)
        self.view = column(self.which, self.room, kinds=("pane", "tabs"))

    def show(self, state: Any) -> None:
        self._state, self._stale = state, set(self._panes)
        self._freshen()

    def show_missing(self, state: Any) -> None:
        """Update after a search for effects missing from the state."""
        self._state = state
        self._stale.add("Next experiment")
        self._freshen()

    def open(self, name: str) -> None:
        """Bring one to the front."""
        self.which.value = name

    def _open(self) -> None:
        self._freshen()
        self.room[:] = [(self._panes.get(self.which.value) or self.bench.error).view]

    def _freshen(self) -> None:
        name = self.which.value
        if name in self._stale and self._state is not None:
            self._stale.discard(name)
            self._panes[name].show(self._state)
