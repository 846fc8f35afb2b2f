"""Report, export and Python: what leaves, as the command line writes it."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

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

    def __init__(self, label: str, begin: Callable[["Written"], None]) -> None:
        self.label = label
        self.make = button(label, lambda _: begin(self))
        self.link = download("", filename="none", file=BytesIO(), visible=False, color="primary")

    def done(self, path: Path) -> None:
        """Offer the file."""
        self.link.file, self.link.filename = str(path), path.name
        self.link.label = f"Download {path.name}"
        self.link.visible = True

    def forget(self) -> None:
        """The state is another: the file is not its."""
        self.link.visible = False


class ReportPane:
    """The report for sign-off."""

    def __init__(self, run: Callable[..., None], session: Callable[[], Any]) -> None:
        def begin(one: Written) -> None:
            run("Writing the report …", lambda: session().report(), one.done)

        self.written = Written("Write the report", begin)
        self.view = column(
            words(
                "One HTML file that needs nothing else: a one-page summary for sign-off, with appendices. The last "
                "model is fitted as bayescal calibrate fits it, which takes a few seconds.",
                "small",
            ),
            row(self.written.make, self.written.link),
        )

    def show(self, _: Any) -> None:
        """Another state."""
        self.written.forget()


class ExportPane:
    """The compensation for firmware and programs."""

    def __init__(self, run: Callable[..., None], session: Callable[[], Any]) -> None:
        self.written: list[Written] = []
        lines = []
        for label, (what, told) in EXPORTS.items():

            def begin(one: Written, what: str = what, label: str = label) -> None:
                run(f"Writing {label} …", lambda: session().export(what), one.done)

            one = Written(label, begin)
            one.make.min_width = 170
            self.written.append(one)
            lines.append(row(one.make, words(told, "small"), one.link))
        self.view = column(*lines, kinds=("bare", "scrolls"))

    def show(self, _: Any) -> None:
        """Another state."""
        for one in self.written:
            one.forget()


class PythonPane:
    """The script that does what was clicked on the way to this state."""

    def __init__(self, session: Callable[[], Any]) -> None:
        self._session = session
        self.code = code_field(
            "What was clicked on the way to this step, as Python; it gives the same numbers",
            disabled=True,
            max_length=10**6,
        )
        self.link = download(
            "Download workbench.py",
            callback=lambda: BytesIO(self.code.value.encode()),
            filename="workbench.py",
            color="primary",
            align="start",
        )
        self.view = column(self.code, row(self.link))

    def show(self, _: Any) -> None:
        """Another state, another script."""
        self.code.value = self._session().script()
