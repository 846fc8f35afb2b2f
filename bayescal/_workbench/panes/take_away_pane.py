"""Report, export and Python: what leaves, as the command line writes it."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.pieces import button, code_field, column, download, row, words

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
        said = "What was clicked on the way to this step, as Python; it gives the same numbers"
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
