"""Describe: a selected region, its shape and size, and the draft of an effect as code."""

from __future__ import annotations

from typing import Any

import numpy as np
import panel as pn

from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.pieces import button, code_field, column, field, halves, row, words

RUNS = (
    "Loading runs this code on this computer, with your rights. Read it first; then tick the box."
)


class DescribePane(Pane):
    """An unexplained pattern, from a region to an effect of one's own."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._rows = np.array([], int)
        self.by = field(pn.widgets.Select, "column", options=[], width=110)
        self.low = field(pn.widgets.FloatInput, "from", width=110)
        self.high = field(pn.widgets.FloatInput, "to", width=110)
        self.region = button("Select", lambda _: self._select_region(), align="end")
        self.describe = button(
            "Describe it", lambda _: self._describe(), color="primary", disabled=True
        )
        self.chosen = words("", "small")
        self.told = words("")
        self.code = code_field(
            "Draft of an effect, to be edited", max_length=100_000, min_height=110
        )
        self.sure = field(pn.widgets.Checkbox, "I have read it: run it", align="center")
        self.load = button("Load the effect", lambda _: self._load(), disabled=True)
        for one in (self.sure, self.code):
            one.param.watch(lambda _: self._open(), "value")
        self.code.param.watch(lambda _: setattr(self.sure, "value", False), "value")
        self.by.param.watch(lambda _: self._ends(), "value")
        left = column(
            words("Drag over a panel, or give a region here.", "small"),
            row(self.by, self.low, self.high, self.region),
            self.chosen,
            row(self.describe),
            self.told,
            kinds=("bare", "scrolls"),
        )
        right = column(self.code, row(words(RUNS, "small")), row(self.sure, self.load))
        self.view = halves(left, right, even=True)

    def show(self, state: Any) -> None:
        """Another state: the region stays, the draft does not."""
        self._columns = self.bench.fails.shown.numbers
        names = list(self._columns)
        value = self.by.value if self.by.value in names else names[0]
        self.by.param.update(options=names, value=value)
        self._ends()
        self.told.object, self.code.value, self.sure.value = "", "", False

    def selected(self, rows: np.ndarray) -> None:
        """Rows were brushed."""
        self._rows = rows
        self.describe.disabled = not rows.size
        count = f"{rows.size:,} readings selected" if rows.size else "No reading is selected."
        self.chosen.object = count

    def _ends(self) -> None:
        values, unit = self._columns.get(self.by.value, (np.array([0.0, 1.0]), ""))
        self.low.label, self.high.label = f"from [{unit or '1'}]", f"to [{unit or '1'}]"
        self.low.value, self.high.value = float(np.min(values)), float(np.max(values))

    def _select_region(self) -> None:
        values, _ = self._columns[self.by.value]
        low, high = self.low.value, self.high.value
        if low is not None and high is not None:
            self.bench.fails.select(np.flatnonzero((values >= low) & (values <= high)))

    def _describe(self) -> None:
        rows = self._rows
        job = lambda: self.session.describe(rows)  # noqa: E731
        self.bench.run("Describing the region …", job, self._drafted)

    def _drafted(self, draft: Any) -> None:
        self.told.object, self.code.value = str(draft), draft.code

    def _open(self) -> None:
        self.load.disabled = not (self.sure.value and self.code.value.strip())

    def _load(self) -> None:
        code = self.code.value
        if self.sure.value and code.strip():
            load = lambda: self.session.load_draft(code)  # noqa: E731
            self.bench.run("Loading the effect …", load, self.bench.done)
