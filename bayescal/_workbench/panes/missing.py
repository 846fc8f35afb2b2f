"""What is missing: the candidates, how probable each is, what it would explain; *Add* adds it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayescal._core.formatting import number, probability, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._search.candidate import Candidate
from bayescal._search.discover import Discovery
from bayescal._workbench.parts.pieces import column, row, words
from bayescal._workbench.parts.rows import Rows

NOT_VISIBLE = "Not detectable in this experiment"
NOT_TESTABLE = "Not testable with these readings"
HINT = "Point at a candidate, with the pointer or with Tab and the arrows, to see its curve over the residuals."


class Missing:
    """The right of the page.

    Attributes:
        view: what Panel shows.
    """

    def __init__(
        self, add: Callable[[str], None], point: Callable[[str], None], look: Callable[[], None]
    ) -> None:
        self._add, self._look = add, look
        self.complete = words("")
        self.told = words(HINT, "small", min_height=36)
        self.rows = Rows(
            self._press,
            kind="pair",
            pointing=True,
            label="Candidates",
        )
        self.rows.param.watch(lambda event: point(event.new), "pointed")
        self.view = column(
            row(words("What is missing", "title")),
            self.complete,
            self.told,
            self.rows,
            kinds=("pane", "missing"),
        )

    def show(self, found: Discovery | None, looking: bool = True, reason: str = "") -> None:
        """Show what was found; None while it is looked for, or where it cannot be."""
        self.rows.pointed = ""
        self.told.object = HINT if found is not None else ""
        if found is None:
            self.complete.object = "Looking for what is missing …" if looking else reason
            self.rows.rows = []
            return
        self.complete.object = (
            f"Probability that the model is complete: {found.complete_in_words}"
            + (f"\n{found.stopped}" if found.stopped else "")
        )
        self.rows.rows = candidate_rows(found)

    def preview(self, told: str) -> None:
        """Say what the candidate that is pointed at would do."""
        self.told.object = told or HINT

    def busy(self, busy: bool) -> None:
        """Shut or open *Add*."""
        self.rows.busy = busy

    def _press(self, effect: str, _: str) -> None:
        self._add(effect)


def candidate_rows(found: Discovery) -> list[dict[str, Any]]:
    """Findings first, substitutes as "one of these"; then the others; what cannot be seen or tested in grey."""
    by_name = {c.effect: c for c in found.candidates}
    rows, placed = [], set()
    for i, one in enumerate(found.sets):
        many = len(one.effects) > 1
        which = (
            "One of these; these readings cannot tell which"
            if many
            else "Missing"
            if i == 0
            else "Also missing"
        )
        group = f"{which}: probability {probability(one.probability)}"
        rows += [
            _row(by_name[name], group, "found")
            for name in one.effects
            if name in by_name and name not in placed
        ]
        placed |= set(one.effects)
    rest = [c for c in found.candidates if c.effect not in placed]
    leads = [c for c in rest if c.kind == "lead"]
    rows += [_row(c, "Leads", "lead") for c in leads]
    other = "The others" if rows else "Nothing is found; the candidates"
    rows += [
        _row(c, other, "") for c in rest if c.kind not in ("lead", "not visible", "not testable")
    ]
    rows += [_row(c, NOT_VISIBLE, "quiet") for c in rest if c.kind == "not visible"]
    rows += [_row(c, NOT_TESTABLE, "quiet") for c in rest if c.kind == "not testable"]
    return rows


def _row(c: Candidate, group: str, kind: str) -> dict[str, Any]:
    cells: list[dict[str, Any]] = [{"text": c.effect, "kind": "name"}]
    if c.probability is not None:
        size = (
            "" if c.size is None else f"{with_error(c.size, c.size_sd or 0.0)} {unit_label(c.unit)}"
        )
        cells.append(
            {
                "text": " · ".join(filter(None, (probability(c.probability), size))),
                "bar": c.probability,
                "kind": "value number",
                "title": f"probability {probability(c.probability)}; log Bayes factor {number(c.log_bayes_factor)} "
                f"by {c.source}",
            }
        )
    testable = c.kind != "not testable"
    add = {"id": "add", "label": "Add", "title": f"fit the model with {c.effect}"}
    note = c.reason
    if c.kind in ("finding", "lead") and c.indistinguishable_from:
        others = ", ".join(c.indistinguishable_from[:3])
        more = len(c.indistinguishable_from) - 3
        note = f"confounded with {others}" + (f" and {more} more" if more > 0 else "")
    return {
        "id": c.effect,
        "group": group,
        "cells": cells,
        "note": note,
        "kind": kind,
        "actions": [add] if testable else [],
    }
