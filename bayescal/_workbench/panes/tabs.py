"""The lower part of the page: the error, and behind it what is needed less often; one at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import panel as pn

from bayescal._workbench.panes.allan_pane import AllanPane
from bayescal._workbench.panes.ask_pane import (
    BudgetPane,
    ComparePane,
    DecisionPane,
    PlanPane,
    VerdictPane,
)
from bayescal._workbench.panes.describe_pane import DescribePane
from bayescal._workbench.panes.experiment import ExperimentPane
from bayescal._workbench.panes.file import FilePane
from bayescal._workbench.panes.take_away_pane import ExportPane, PythonPane, ReportPane
from bayescal._workbench.parts.pieces import choice, column
from bayescal._workbench.parts.style import Palette

ERROR = "The error"


class Tabs:
    """Which of them is seen; each is brought up to date when it is looked at, not before."""

    def __init__(self, bench: Any, error: Any) -> None:
        session = lambda: bench.session  # noqa: E731
        self.compare = ComparePane(bench.run, session, bench.compare)
        self.plan = PlanPane(bench.run, session)
        self.experiment = ExperimentPane(bench.run)
        self.allan = AllanPane()
        self.report = ReportPane(bench.run, session)
        self.export = ExportPane(bench.run, session)
        self.python = PythonPane(session)
        instrument = bench.session.current.step.calibration.model.instrument
        self.file = FilePane(bench.run, instrument, bench.begin_with)
        numbers = lambda: bench.fails.shown.numbers  # noqa: E731
        self.describe = DescribePane(bench.run, session, bench.fails.select, numbers, bench.done)
        self._panes: dict[str, Any] = {
            "Side by side": self.compare,
            "Verdict": VerdictPane(bench.run, session),
            "Budget": BudgetPane(bench.run, session),
            "Decision": DecisionPane(bench.run, session),
            "Where to measure": self.plan,
            "Next experiment": self.experiment,
            "Allan deviation": self.allan,
            "Report": self.report,
            "Export": self.export,
            "Python": self.python,
            "File": self.file,
            "Describe": self.describe,
        }
        self._error, self._state = error, None
        self._stale = set(self._panes)
        self.which = choice([ERROR, *self._panes], ERROR, "Lower part")
        self.which.param.watch(lambda _: self._open(), "value")
        self.room = pn.Column(error, sizing_mode="stretch_both", margin=0, min_height=0)
        self.view = column(self.which, self.room, kinds=("pane", "tabs"))

    def show(self, state: Any) -> None:
        """Another state."""
        self._state, self._stale = state, set(self._panes) - {"File"}
        self._freshen()

    def looked(self, state: Any) -> None:
        """What is missing from the state is known now."""
        self._state = state
        self._stale.add("Next experiment")
        self._freshen()

    def selected(self, rows: np.ndarray) -> None:
        """Rows were brushed."""
        self.describe.selected(rows)

    def wear(self, palette: Palette) -> None:
        """Take the colours of a ground."""
        self.allan.wear(palette)
        self.plan.wear(palette)

    def open(self, name: str) -> None:
        """Bring one to the front."""
        self.which.value = name

    def _open(self) -> None:
        self._freshen()
        name = self.which.value
        self.room[:] = [self._error if name == ERROR else self._panes[name].view]

    def _freshen(self) -> None:
        name = self.which.value
        if name in self._stale and self._state is not None:
            self._stale.discard(name)
            self._panes[name].show(self._state)
