"""The lower part of the page: the error, and behind it what is needed less often; one at a time."""

from __future__ import annotations

from typing import Any

import panel as pn

from bayescal._workbench.panes.allan_pane import AllanPane
from bayescal._workbench.panes.ask_pane import (
    BudgetPane,
    ComparePane,
    DecisionPane,
    ExperimentPane,
    PlanPane,
    VerdictPane,
)
from bayescal._workbench.panes.describe_pane import DescribePane
from bayescal._workbench.panes.file import FilePane
from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.panes.take_away_pane import ExportPane, PythonPane, ReportPane
from bayescal._workbench.parts.pieces import choice, column
from bayescal._workbench.parts.style import Palette

ERROR = "The error"


class Tabs(Pane):
    """Which of them is seen; each is brought up to date when it is looked at, not before."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.compare, self.file, self.describe = (
            ComparePane(bench),
            FilePane(bench),
            DescribePane(bench),
        )
        self._panes: dict[str, Pane] = {
            "Side by side": self.compare,
            "Verdict": VerdictPane(bench),
            "Budget": BudgetPane(bench),
            "Decision": DecisionPane(bench),
            "Where to measure": PlanPane(bench),
            "Next experiment": ExperimentPane(bench),
            "Allan deviation": AllanPane(bench),
            "Report": ReportPane(bench),
            "Export": ExportPane(bench),
            "Python": PythonPane(bench),
            "File": self.file,
            "Describe": self.describe,
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
