"""The lower part of the page: the error, and behind it what is needed less often; one at a time.

The error is the tree of steps with the path so far, every step to go back to, the whole search with its progress.
Behind it are questions to the current step, answered in text (verdict, comparison, budget, decisions, next
experiment); the Allan deviation of the residuals; report, export and Python, as the command line writes them; a file
dropped on the page, with what `calibrate` would say of it and one form for how it is to be read.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, get_args

import panel as pn
import panel.models.file_dropper  # its scripts come with the page
from bokeh.models import ColumnDataSource, Legend, LegendItem, NumeralTickFormatter, Span

from bayescal import Budget, InputError, Measurements, next_experiment, read
from bayescal._annexes.metrology.decide import CONFORMITY, FALSE_ACCEPT, Rule
from bayescal._annexes.workbench.kept import path_to
from bayescal._annexes.workbench.panes.fails import NOISE
from bayescal._annexes.workbench.parts.pieces import (
    INSIDE,
    Palette,
    Pane,
    Rows,
    button,
    choice,
    code_field,
    column,
    download,
    field,
    halves,
    new_figure,
    plot,
    row,
    words,
)
from bayescal._data.read_options import MISSING_READINGS
from bayescal._report.plot_colours import GREEN, ORANGE, RED
from bayescal._report.report import Pictures
from bayescal._search.search_path import steps_table
from bayescal._tables.cells import ORDERS
from bayescal._tables.mapping_file import save_mapping
from bayescal._tables.open_table import TEXT
from bayescal.workshop import expected_columns, open_table, pretty, unit_label

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
            "spacing": 4,
            "glyph_width": 12,
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
        self.rows.head, self.rows.rows = step_rows(states, current)
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


SHOWN = ("step", "as fitted", "new run", "held-out", "floor", "P(complete)")
TITLES = {"P(complete)": "probability that the model is complete"}


def step_rows(states: Mapping[int, Any], current: int) -> tuple[list[str], list[dict[str, Any]]]:
    """The head, and a row a state: its errors as `SearchPath` prints them, and the way back to it."""
    told = []
    for n, lines in in_order(states):
        state, before = states[n], states.get(states[n].parent)
        row = state.step.row(before and before.step)
        complete = state.discovery and state.discovery.nothing_missing
        title = {"number": f"{lines}{n} ", "title": state.title}
        told.append({**row, **title, "nothing_missing": complete, "state": n})
    table = steps_table(told)
    table = table.only(*(c.head for c in table.shown if c.head in SHOWN))
    heads, rows = [c.head for c in table.columns], []
    rises = {"held-out": "more than a twentieth above the step before"}
    for row, (step, *cells) in zip(told, table.cells, strict=True):
        titles = TITLES | (rises if row["rises"] else {})
        numbers = [
            {"text": text, "kind": "number", "title": titles.get(head, "")}
            for head, text in zip(heads[1:], cells, strict=True)
        ]
        here = [
            {
                **{"id": "compare", "label": "Compare", "reads": True},
                "title": "with the step that is shown",
            },
            {"id": "go", "label": "Go back", "title": "what is done next branches off here"},
        ]
        now = row["state"] == current
        shown = {"cells": [{"text": step}, *numbers], "actions": [] if now else here}
        rows.append({"id": str(row["state"]), **shown, "current": now})
    return [*table.head, ""], rows


NONE = (
    "No Allan deviation: it needs a column time, and runs of 30 readings or more, evenly spaced in time "
    "within 5 %."
)

WHOLE = (
    "svg, div { height: 100%; width: 100%; } text { fill: currentColor; }"  # a picture in its room
)


class AllanPane(Pane):
    """The report's picture of the curve with its intervals and the law's band; the terms of data sheets."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.told, self.terms = words(""), words("", "table")
        room: dict[str, Any] = {"sizing_mode": "stretch_both", "margin": 0, "min_height": 0}
        self.picture = pn.pane.HTML("", stylesheets=[INSIDE, WHOLE], **room)
        self.view = halves(self.picture, column(self.told, self.terms, kinds=("bare", "scrolls")))

    def show(self, state: Any) -> None:
        found = state.step.check.allan
        drawn = Pictures().allan(state.step.check, "this step")
        self.picture.object = "" if drawn is None else str(drawn.body)
        self.told.object = NONE if found is None else found.sentence()
        self.terms.object = "" if found is None else str(found.table())


class AskPane(Pane):
    """A question with its fields, and the answer, which is marked when the model is no longer the one it is of.

    A question has its words, the rows of its fields, and `question`, which reads them on the page and returns the job.
    """

    LABEL = ""  # of the button
    TOLD = ""  # what is asked, in words
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
        left = column(words(self.TOLD, "small"), above, buttons, kinds=("bare", "scrolls"))
        self.view = halves(left, self.right)

    def question(self) -> Callable[[], Any]:
        raise NotImplementedError

    def answered(self, found: Any) -> None:
        """Show more of an answer than its text."""

    def show(self, state: Any) -> None:
        """Another state: an answer that is of the one before stays, and says so."""
        self._now = state.number
        self._say_age()
        if self.BY_ITSELF and self._of != self._now:
            self.put()

    def put(self) -> None:
        """Ask."""
        of = self._now

        def came(found: Any) -> None:
            self._of, self.answer.object = of, str(found)
            self.answered(found)
            self._say_age()

        told = "Comparing …" if self.READS else "Computing …"
        self.bench.run(told, self.question(), came, reads=self.READS)

    def _say_age(self) -> None:
        stale = self._of not in (-1, self._now)
        told = f"This answer is of step {self._of}; step {self._now} is shown." if stale else ""
        self.age.object = told or (f"Of step {self._of}." if self._of >= 0 else "")
        self.right.css_classes = [*self.KINDS, *["stale"] * stale]


class VerdictPane(AskPane):
    """Whether the result may be used, and why not."""

    LABEL, BY_ITSELF = "Judge it", True
    TOLD = "Whether this model may be used as it is, fitted as bayescal calibrate fits it."

    def question(self) -> Callable[[], Any]:
        return self.session.verdict


class ComparePane(AskPane):
    """Two steps side by side."""

    LABEL, BY_ITSELF, READS = "Compare", True, True
    TOLD = "The step that is shown beside another one; its residuals stand in the panels, hollow."

    def __init__(self, bench: Any) -> None:
        self._showing = False
        self.which = field(pn.widgets.Select, "with step", options={}, width=200)
        self.which.param.watch(lambda _: self._chosen(), "value")
        super().__init__(bench, row(self.which))

    def question(self) -> Callable[[], Any]:
        other = self.which.value
        return lambda: "" if other is None else self.session.compare(other)

    def beside(self, number: int | None) -> None:
        """Which step is the other."""
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
    TOLD = "Uncertainty of a corrected reading by its sources, at an operating point."

    def __init__(self, bench: Any) -> None:
        self._at: dict[str, Any] = {}
        self.room = row()
        super().__init__(bench, self.room)

    def question(self) -> Callable[[], Any]:
        at = {n: f.value for n, f in self._at.items() if f.value is not None}
        return lambda: self.session.budget(at)

    def answered(self, found: Budget) -> None:
        """A field a quantity of the operating point."""
        if list(self._at) == list(found.at):
            return
        self._at = {}
        for name, value in found.at.items():
            label, shown = f"{name} [{pretty(found.at_units[name] or '1')}]", float(f"{value:.6g}")
            self._at[name] = field(pn.widgets.FloatInput, label, value=shown, width=150)
        self.room[:] = list(self._at.values())


class DecisionPane(AskPane):
    """Whether it conforms to limits."""

    LABEL = "Decide"
    TOLD = (
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
        asked = {
            "rule": self.rule.value,
            "false_accept": self.risk.value or 0.0,
            "conformity": self.until.value or 0.0,
            "population": self.devices.value.strip() or None,
        }
        return lambda: self.session.decide(limits, **asked)


class ExperimentPane(AskPane):
    """Next experiment: which test would tell apart what these readings cannot."""

    LABEL = "Rank the experiments"
    TOLD = "Feasible experiments, the most telling first: what each could say of effects that are confounded here."

    def __init__(self, bench: Any) -> None:
        self.rivals = words("", "small")
        super().__init__(bench, self.rivals)

    def show(self, state: Any) -> None:
        self._calibration, found = state.calibration, state.discovery
        self._rivals = () if found is None else found.rivals
        self.begin.disabled = len(self._rivals) < 2
        if found is None:
            self.rivals.object = "What is missing has not been looked for yet."
        elif self.begin.disabled:
            self.rivals.object = (
                "Nothing is confounded here: there are no two effects to tell apart."
            )
        else:
            self.rivals.object = f"To tell apart: {', '.join(e.name for e in self._rivals)}"
        super().show(state)

    def question(self) -> Callable[[], Any]:
        calibration, rivals = self._calibration, self._rivals
        return lambda: next_experiment(calibration, rivals)


EXPORTS = {
    "C header": ("c", "Compensation as a C99 header."),
    "JSON": ("json", "Compensation as JSON, with its covariance."),
    "Python function": ("python", "Compensation as a Python function."),
    "PX4 parameters": ("px4-params", "Thermal polynomial, as PX4 takes it."),
    "ArduPilot parameters": ("ardupilot-params", "Thermal polynomial, as ArduPilot takes it."),
}


class Written:
    """A button that writes a file beside the page, and then a link to it."""

    def __init__(self, bench: Any, label: str, doing: str, write: Callable[[], Path]) -> None:
        """`write` is called beside the page while `doing` is said."""
        self.make = button(label, lambda _: bench.run(doing, write, self._done))
        self.link = download("", filename="none", file=BytesIO(), visible=False, color="primary")

    def _done(self, path: Path) -> None:
        self.link.file, self.link.filename = str(path), path.name
        self.link.label, self.link.visible = f"Download {path.name}", True

    def forget(self) -> None:
        """The state is another: the file is not its."""
        self.link.visible = False


class ReportPane(Pane):
    """The report for sign-off."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        write = lambda: self.session.report()  # noqa: E731
        self.written = Written(bench, "Write the report", "Writing the report …", write)
        told = words(
            "One HTML file that needs nothing else: a one-page summary for sign-off, with appendices. The last "
            "model is fitted as bayescal calibrate fits it, which takes a few seconds.",
            "small",
        )
        self.view = column(told, row(self.written.make, self.written.link))

    def show(self, state: Any) -> None:
        self.written.forget()


class ExportPane(Pane):
    """The compensation for firmware and programs."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.written, lines = [], []
        for label, (what, told) in EXPORTS.items():
            write = lambda what=what: self.session.export(what)  # noqa: E731
            one = Written(bench, label, f"Writing {label} …", write)
            one.make.min_width = 170
            self.written.append(one)
            lines.append(row(one.make, words(told, "small"), one.link))
        self.view = column(*lines, kinds=("bare", "scrolls"))

    def show(self, state: Any) -> None:
        for one in self.written:
            one.forget()


class PythonPane(Pane):
    """The script that does what was clicked on the way to this state."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        said = "What was clicked, in Python: the same numbers"
        self.code = code_field(said, disabled=True, max_length=10**6)
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


LARGEST_UPLOAD = 200_000_000  # bytes of one file; larger ones are given on the command line
MOST = f"{LARGEST_UPLOAD // 1_000_000}MB"
OFFERED = 300  # columns of a file that a list offers; others are typed
LONGEST_ERROR = 6000  # letters of what is wrong
AS_FOUND = "as found"


class Upload(pn.widgets.FileDropper):
    """Panel's own, which trusts the browser with the size: here more than `LARGEST_UPLOAD` is not kept either."""

    def _process_event(self, event: Any) -> None:
        name, piece = event.data.get("name"), event.data.get("data")
        kept = sum(len(part) for part in self._file_buffer.get(name, ()))
        if piece is not None and kept + len(piece) > LARGEST_UPLOAD:
            self._file_buffer.pop(name, None)
            return
        if piece is not None and event.data["chunk"] == 1:
            self.value.clear()
            self._file_buffer.clear()
        if piece is not None and event.data["chunk"] != 1 and name not in self._file_buffer:
            return
        super()._process_event(event)


class FilePane(Pane):
    """Readings from a file of the user's own."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._instrument = instrument = bench.session.current.model.instrument
        self._folder = Path(tempfile.mkdtemp(prefix="bayescal-"))
        weakref.finalize(self, shutil.rmtree, self._folder, True)
        self._path: Path | None = None
        self._readings: Measurements | None = None
        self.drop = Upload(
            multiple=False,
            max_file_size=MOST,
            previews=[],
            layout="compact",
            margin=0,
            sizing_mode="stretch_width",
            width=None,
            height=62,
            stylesheets=[INSIDE],
            chunk_size=4_000_000,
        )
        self.drop.param.watch(self._dropped, "value")
        self.told = words("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")
        self.use = button(
            "Begin with these readings",
            lambda _: self._go_on(),
            color="primary",
            visible=False,
        )
        self.again = button("Read again", lambda _: self._read(), visible=False)
        self.mapping = download(
            "Save the mapping", callback=self._mapping, filename="mapping.toml", visible=False
        )
        self.form = row(visible=False)
        self._fields: dict[str, tuple[Any, Any]] = {}
        self._others = other_fields()
        intro = f"Drop a file of readings of {instrument.name}, up to {MOST}; nothing leaves this computer."
        buttons = row(self.use, self.again, self.mapping)
        kinds = ("bare", "scrolls")
        left = column(words(intro, "small"), self.drop, buttons, self.form, kinds=kinds)
        self.view = halves(left, self.told, even=True)

    def _dropped(self, event: Any) -> None:
        if not event.new:
            return
        name, content = next(iter(event.new.items()))
        content = content.encode() if isinstance(content, str) else bytes(content)
        self.receive(str(name), content)

    def receive(self, name: str, content: bytes) -> None:
        """Take a file's content, and say what `calibrate` would."""
        if len(content) > LARGEST_UPLOAD:
            self._say(f"{name[:80]} is larger than {MOST}: give it on the command line")
            return
        self._path = self._folder / safe_name(name)
        self._path.write_bytes(content)
        self._fields = {}
        self.form.visible = False
        self._read()

    def _read(self) -> None:
        path, given = self._path, self.given()
        if path is None:
            return

        def job() -> tuple[Any, tuple[str, ...]]:
            try:
                return read(path, self._instrument, **given), headers_of(path)
            except InputError as error:
                return error, headers_of(path)

        self.bench.run(f"Reading {path.name} …", job, self._was_read)

    def _was_read(self, told: tuple[Any, tuple[str, ...]]) -> None:
        found, headers = told
        well = isinstance(found, Measurements)
        self._readings = found if well else None
        flags = "".join(f"\nwarning: {flag}" for flag in found.flags) if well else ""
        self._say(f"{len(found):,} readings\n{found}{flags}" if well else str(found))
        self.use.visible = well
        self.again.visible = self.mapping.visible = bool(headers)
        if not self._fields and headers:
            self._make_form(headers)
        self.form.visible = bool(headers)

    def _say(self, text: str) -> None:
        self.told.object = (
            text if len(text) <= LONGEST_ERROR else f"{text[:LONGEST_ERROR]}\n… and more"
        )

    def _make_form(self, headers: tuple[str, ...]) -> None:
        """A line a column that the instrument reads: which of the file's it is, and in which unit."""
        pairs: list[Any] = []
        text = pn.widgets.TextInput
        for name, known in expected_columns(self._instrument).items():
            kind, how = pn.widgets.Select, {"options": [AS_FOUND, *headers]}
            if len(headers) > OFFERED:
                kind, how = text, {"placeholder": AS_FOUND}
            which = field(kind, f"{name} is", width=150, **how)
            unit = field(text, "in", placeholder="as in the file", width=100)
            unit.disabled = known.unit is None
            self._fields[name] = (which, unit)
            pairs.append(row(which, unit, kinds=("tight",)))
        self.form[:] = [*pairs, *self._others.values()]

    def given(self) -> dict[str, Any]:
        """What the form says, as arguments of `read`."""
        columns = {
            n: w.value for n, (w, _) in self._fields.items() if w.value not in ("", AS_FOUND, None)
        }
        units = {
            columns.get(n, n): u.value.strip()
            for n, (_, u) in self._fields.items()
            if u.value.strip()
        }
        others = {n: f.value for n, f in self._others.items() if f.value not in ("", None)}
        return {"columns": columns, "units": units, **others}

    def _mapping(self) -> BytesIO:
        path = self._folder / "mapping.toml"
        save_mapping(path, self.given())
        return BytesIO(path.read_bytes())

    def _go_on(self) -> None:
        if self._readings is not None:
            self.bench.begin_with(self._readings)


def other_fields() -> dict[str, Any]:
    """What `read` takes beside columns and units, by its names."""
    text, choose = pn.widgets.TextInput, pn.widgets.Select
    return {
        "nominal_scale": field(text, "nominal scale", placeholder="250 V/g", width=110),
        "nominal_zero": field(text, "nominal zero", placeholder="1.21 V", width=110),
        "local_gravity": field(
            pn.widgets.FloatInput,
            "local gravity [m/s²]",
            value=None,
            placeholder="9.80665, uncertain",
            width=130,
        ),
        "missing": field(choose, "missing readings", options=list(MISSING_READINGS), width=110),
        "decimal": field(choose, "decimal sign", options={"as found": "", ".": ".", ",": ","}),
        "date_order": field(
            choose, "dates are", options={"as found": "", **{o: o for o in ORDERS}}
        ),
    }


def safe_name(name: str) -> str:
    """A dropped file's name as the name of a file here: its last part, in letters that no system refuses."""
    last = re.sub(r"[^\w.+ -]", "_", name.replace("\\", "/").rpartition("/")[2])[-80:].strip(". ")
    return last if "." in last else f"readings-{last or 'without-name'}"


def headers_of(path: Path) -> tuple[str, ...]:
    """Names of a text file's columns; none where it cannot be opened."""
    if path.suffix.lower() not in (*TEXT, ".parquet", ".nc", ".xlsx", ".mat"):
        return ()
    try:
        return tuple(h.name for h in open_table(path, path.name).headers)
    except InputError:
        return ()


ERROR = "The error"


class Tabs(Pane):
    """Which of them is seen; each is brought up to date when it is looked at, not before."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.compare, self.file = ComparePane(bench), FilePane(bench)
        self._panes: dict[str, Pane] = {
            "Side by side": self.compare,
            "Verdict": VerdictPane(bench),
            "Budget": BudgetPane(bench),
            "Decision": DecisionPane(bench),
            "Next experiment": ExperimentPane(bench),
            "Allan deviation": AllanPane(bench),
            "Report": ReportPane(bench),
            "Export": ExportPane(bench),
            "Python": PythonPane(bench),
            "File": self.file,
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

    def looked(self, state: Any) -> None:
        """What is missing from the state is known now."""
        self._state = state
        self._stale.add("Next experiment")
        self._freshen()

    def wear(self, palette: Palette) -> None:
        for pane in self._panes.values():
            pane.wear(palette)

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
