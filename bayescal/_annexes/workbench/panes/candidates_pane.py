"""The candidates pane ("What is missing"): each candidate effect with its probability; *Add* adds it."""

from __future__ import annotations

from typing import Any

import panel as pn

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.widgets import Pane, Rows, button, column, field, row, words

NOT_VISIBLE = "Not detectable in this experiment"
NOT_TESTABLE = "Not testable with these readings"
HINT = "Point at a candidate, with the pointer or with Tab and the arrows, to see its curve over the residuals."


class CandidatesPane(Pane):
    """Pane of the candidate effects, on the right of the page."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.complete = words("")
        self.hint = words(HINT, "small", min_height=36)
        add = lambda effect, _: bench.act("add", effect)  # noqa: E731
        self.rows = Rows(add, kind="pair", pointing=True, label="Candidates")
        self.rows.param.watch(lambda event: bench.point(event.new), "pointed")
        options: dict[str, Any] = {"placeholder": "supply: s * (supply_voltage - 5); s = 0.1 mV/V"}
        room: dict[str, Any] = {"sizing_mode": "stretch_width", "min_width": 90, "max_length": 500}
        self.formula = field(
            pn.widgets.TextInput, "or type a formula: Enter draws it", **options, **room
        )
        self.formula.param.watch(lambda _: self._draw(), "value")
        self.add_typed = button("Add it", lambda _: self._add_typed(), disabled=True, align="end")
        title = row(words("What is missing", "title"))
        typed = row(self.formula, self.add_typed, kinds=("spread",))
        self.view = column(
            *(title, self.complete, self.hint, self.rows, typed), kinds=("pane", "missing")
        )

    def show(self, state: Any, reason: str = "Looking for what is missing …") -> None:
        """Show the effects missing from a state, or the reason why they are not known."""
        discovery: bc.Discovery | None = state.discovery
        self.rows.pointed = ""
        self.hint.object = HINT if discovery is not None else ""
        if discovery is None:
            self.complete.object, self.rows.rows = reason, []
            return
        text = f"Probability that the model is complete: {discovery.complete_in_words}"
        self.complete.object = f"{text}\n{discovery.stopped}" if discovery.stopped else text
        self.rows.rows = candidate_rows(discovery)

    def _draw(self) -> None:
        """Draw the curve of the typed formula over the residuals with its preview, or report its error."""
        line, bench = self.formula.value.strip(), self.bench
        self.add_typed.disabled = True
        if not line:
            return

        def draw(preview: Any) -> None:
            if line == self.formula.value.strip():
                bench.residuals.preview(preview.curve)
                self.preview(preview.in_words)
                self.add_typed.disabled = self.rows.busy

        bench.work.preview(lambda: bench.session.preview("add", bench.session.typed(line)), draw)

    def _add_typed(self) -> None:
        self.bench.act("add_typed", self.formula.value.strip())
        self.formula.value = ""

    def preview(self, text: str) -> None:
        """Show the preview of the candidate under the pointer."""
        self.hint.object = text or HINT

    def busy(self, busy: bool) -> None:
        self.rows.busy = busy
        self.add_typed.disabled = self.add_typed.disabled or busy


def candidate_rows(discovery: bc.Discovery) -> list[dict[str, Any]]:
    """Return rows: findings (alternatives as "one of these"), leads, others; undetectable and untestable in grey."""
    by_name = {c.effect: c for c in discovery.candidates}
    rows, placed = [], set()
    for i, alternatives in enumerate(discovery.findings):
        which = "Missing" if i == 0 else "Also missing"
        if len(alternatives.effects) > 1:
            which = "One of these, which the readings do not distinguish"
        group = f"{which}: probability {ws.probability(alternatives.probability)}"
        names = [n for n in alternatives.effects if n in by_name and n not in placed]
        rows += [_row(by_name[name], group, "found") for name in names]
        placed |= set(alternatives.effects)
    others = [c for c in discovery.candidates if c.effect not in placed]
    has_found = rows or any(c.kind == "lead" for c in others)
    kinds = {
        "lead": ("Leads", "lead"),
        None: ("The others" if has_found else "Nothing is found; the candidates", ""),
        "not visible": (NOT_VISIBLE, "quiet"),
        "not testable": (NOT_TESTABLE, "quiet"),
    }
    for kind, labels in kinds.items():
        rows += [_row(c, *labels) for c in others if (c.kind if c.kind in kinds else None) == kind]
    return rows


def _row(c: Any, group: str, kind: str) -> dict[str, Any]:
    cells: list[dict[str, Any]] = [{"text": c.effect, "kind": "name"}]
    if c.probability is not None:
        text = ws.probability(c.probability)
        factor = f"log Bayes factor {ws.number(c.log_bayes_factor)} by {c.source}"
        bar = {"bar": c.probability, "kind": "value number"}
        if c.size is not None:
            size = f"{ws.with_error(c.size, c.size_sd or 0.0)} {ws.unit_label(c.unit)}"
            bar["text"] = f"{text} · {size}"
        cells.append({"text": text, "title": f"probability {text}; {factor}", **bar})
    add = {"id": "add", "label": "Add", "title": f"fit the model with {c.form or c.effect}"}
    note, rivals = c.reason, c.indistinguishable_from
    if c.kind in ("finding", "lead") and rivals:
        further = f" and {len(rivals) - 3} more" if len(rivals) > 3 else ""
        note = f"confounded with {', '.join(rivals[:3])}{further}"
    actions = [] if c.kind == "not testable" else [add]
    row = {"group": group, "cells": cells, "note": note, "kind": kind}
    return {"id": c.effect, **row, "actions": actions}
