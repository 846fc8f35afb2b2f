"""The candidates pane ("What is missing"): each candidate effect with its probability; *Add* adds it."""

from __future__ import annotations

from typing import Any

import panel as pn

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.widgets import Pane, Rows, button, column, label, row, widget

NOT_VISIBLE = "Not detectable in this experiment"
NOT_TESTABLE = "Not testable with these readings"
HINT = "Point at a candidate, with the pointer or with Tab and the arrows, to see its curve over the residuals."


class CandidatesPane(Pane):
    """Pane of the candidate effects, on the right of the page."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self.completeness = label("")
        self.hint = label(HINT, "small", min_height=36)
        add_candidate = lambda effect, _: page.act("add", effect)  # noqa: E731
        self.rows = Rows(add_candidate, kind="pair", pointing=True, label="Candidates")
        self.rows.param.watch(lambda event: page.draw_candidate(event.new), "pointed")
        options: dict[str, Any] = {"placeholder": "supply: s * (supply_voltage - 5); s = 0.1 mV/V"}
        size: dict[str, Any] = {"sizing_mode": "stretch_width", "min_width": 90, "max_length": 500}
        self.formula = widget(
            pn.widgets.TextInput, "or type a formula: Enter draws it", **options, **size
        )
        self.formula.param.watch(lambda _: self._preview_formula(), "value")
        self.button = button("Add it", lambda _: self._add_formula(), disabled=True, align="end")
        title_row = row(label("What is missing", "title"))
        entry = row(self.formula, self.button, kinds=("spread",))
        self.view = column(
            *(title_row, self.completeness, self.hint, self.rows, entry), kinds=("pane", "missing")
        )

    def show(self, state: Any, reason: str = "Searching for missing effects …") -> None:
        """Show the effects missing from a state, or the reason why there is no result of a search for them."""
        discovery: bc.Discovery | None = state.discovery
        self.rows.pointed = ""
        self.hint.object = HINT if discovery is not None else ""
        if discovery is None:
            self.completeness.object, self.rows.rows = reason, []
            return
        text = f"P(complete), that no testable candidate is missing: {discovery.complete_in_words}"
        self.completeness.object = f"{text}\n{discovery.stopped}" if discovery.stopped else text
        self.rows.rows = build_candidate_rows(discovery)

    def _preview_formula(self) -> None:
        """Draw the curve of the typed formula over the residuals and show its preview, or the error in the formula."""
        line, page, session = self.formula.value.strip(), self.page, self.session
        self.button.disabled = True
        if not line:
            return

        def draw(result: Any) -> None:
            if line == self.formula.value.strip():
                page.residuals.preview(result.curve)
                self.preview(result.summary)
                self.button.disabled = self.rows.busy

        page.worker.preview(lambda: session.preview("add", session.parse_formula(line)), draw)

    def _add_formula(self) -> None:
        self.page.act("add_formula", self.formula.value.strip())
        self.formula.value = ""

    def preview(self, text: str) -> None:
        """Show the preview of the candidate that is pointed at; without a text, the hint."""
        self.hint.object = text or HINT

    def set_busy(self, is_busy: bool) -> None:
        self.rows.busy = is_busy
        self.button.disabled = self.button.disabled or is_busy


def build_candidate_rows(discovery: bc.Discovery) -> list[dict[str, Any]]:
    """Return a row per candidate, in groups: findings, leads, others, undetectable ones and untestable ones."""
    by_name = {c.effect: c for c in discovery.candidates}
    rows, listed_names = [], set()
    for i, finding in enumerate(discovery.findings):
        heading = "Missing" if i == 0 else "Also missing"
        if len(finding.effects) > 1:
            heading = "One of these, which the readings do not distinguish"
        group = f"{heading}: probability {ws.probability(finding.probability)}"
        names = [n for n in finding.effects if n in by_name and n not in listed_names]
        rows += [_build_row(by_name[name], group, "found") for name in names]
        listed_names |= set(finding.effects)
    other_candidates = [c for c in discovery.candidates if c.effect not in listed_names]
    has_found = rows or any(c.kind == "lead" for c in other_candidates)
    kinds = {
        "lead": ("Leads", "lead"),
        None: ("The others" if has_found else "Nothing is found; the candidates", ""),
        "not visible": (NOT_VISIBLE, "quiet"),
        "not testable": (NOT_TESTABLE, "quiet"),
    }
    for kind, labels in kinds.items():
        group = [c for c in other_candidates if (c.kind if c.kind in kinds else None) == kind]
        rows += [_build_row(candidate, *labels) for candidate in group]
    return rows


def _build_row(c: Any, group: str, kind: str) -> dict[str, Any]:
    cells: list[dict[str, Any]] = [{"text": c.effect, "kind": "name"}]
    if c.probability is not None:
        text = ws.probability(c.probability)
        factor = f"log Bayes factor {ws.number(c.log_bayes_factor)} by {c.source}"
        bar = {"bar": c.probability, "kind": "value number"}
        if c.size is not None:
            size = f"{ws.format_value(c.size, c.size_sd or 0.0)} {ws.unit_label(c.unit)}"
            bar["text"] = f"{text} · {size}"
        cells.append({"text": text, "title": f"probability {text}; {factor}", **bar})
    add_action = {"id": "add", "label": "Add", "title": f"fit the model with {c.form or c.effect}"}
    note, confounded_names = c.reason, c.indistinguishable_from
    if c.kind in ("finding", "one of several", "lead") and confounded_names:
        more_text = f" and {len(confounded_names) - 3} more" if len(confounded_names) > 3 else ""
        note = f"confounded with {', '.join(confounded_names[:3])}{more_text}"
    actions = [] if c.kind == "not testable" else [add_action]
    row = {"group": group, "cells": cells, "note": note, "kind": kind}
    return {"id": c.effect, **row, "actions": actions}
