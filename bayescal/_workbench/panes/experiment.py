"""Next experiment: which test would tell apart what these readings cannot."""

from __future__ import annotations

from typing import Any

from bayescal._calibration.settings import searching
from bayescal._search.next_experiment import NextExperiment, next_experiment
from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.pieces import button, column, row, words
from bayescal._workbench.parts.rows import Rows

HEAD = ["experiment", "least expected log Bayes factor", "for", ""]


class ExperimentPane(Pane):
    """Feasible experiments, the most telling first."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._state: Any = None
        self.rank = button("Rank the experiments", lambda _: self._begin(), color="primary")
        self.told = words("", "small")
        table: dict[str, Any] = {"table": True, "kind": "table", "head": HEAD}
        self.rows = Rows(label="Experiments", visible=False, **table)
        self.view = column(row(self.rank, self.told), self.rows)

    def show(self, state: Any) -> None:
        self._state = state
        self.rows.visible, self.rows.rows = False, []
        found = state.discovery
        names = [] if found is None else [e.name for e in found.rivals]
        self.rank.disabled = len(names) < 2
        if found is None:
            self.told.object = "What is missing has not been looked for yet."
        elif len(names) < 2:
            self.told.object = "Nothing is confounded here: there are no two effects to tell apart."
        else:
            self.told.object = f"To tell apart: {', '.join(names)}"

    def _begin(self) -> None:
        state = self._state

        def shown(found: NextExperiment) -> None:
            if state is self._state:
                self.rows.rows, self.rows.visible = experiment_rows(found), True

        job = lambda: next_experiment(state.calibration, state.discovery.rivals)  # noqa: E731
        self.bench.run("Ranking experiments …", job, shown)


def experiment_rows(found: NextExperiment) -> list[dict[str, Any]]:
    """A row an experiment; green where it is expected to tell."""
    rows = []
    for e in found.experiments:
        (truth, rival), least = min(e.expected.items(), key=lambda item: item[1])
        kind = "number best" if least >= searching().very_strong else "number"
        cells = [
            {"text": e.name},
            {"text": f"{least:.1f}", "kind": kind},
            {"text": f"{truth} against {rival}", "kind": "left"},
        ]
        rows.append({"id": e.name, "cells": cells})
    return rows
