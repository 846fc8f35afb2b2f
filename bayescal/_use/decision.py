"""Decisions about limits as a result: what each says, as text and as JSON."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from typing import Any

from bayescal._core.as_json import as_json
from bayescal._core.formatting import WIDTH, Printed, number, table, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._use.conformity import GlobalRisks, Limits
from bayescal._use.recalibration import Recalibration

ACCEPT, REJECT, UNDECIDED = "accept", "reject", "undecided"


@dataclass(frozen=True)
class Decision:
    """What is decided about one limit.

    Attributes:
        limit: as it was written.
        quantity, unit: what is limited, and the unit of all its numbers.
        tolerance: its limits; infinite where there is none.
        estimate: posterior mean, its lowest and highest value over the range of the limit.
        uncertainty: standard uncertainty of the estimate; over a range, the largest of its two ends.
        scatter: standard deviation of single readings; zero where the quantity does not scatter.
        probability: of conformity.
        probability_error: its Monte-Carlo standard error.
        guard_bands: below and above; None where no estimate would be accepted.
        accepted: estimates that are accepted, by the rule.
        decision: "accept", "reject" or "undecided".
        why: in words.
        risk: the specific risk: that the decision is wrong; None where none was made.
        at: name → lowest value, highest value, unit of the operating point.
        population: mean and standard deviation of the devices; None where none is given, and over a range.
        global_risks: over the devices of a population; None where none is given.
        recalibration: when to calibrate again.
        notes: what to know, each a sentence.
    """

    limit: str
    quantity: str
    unit: str
    tolerance: Limits
    estimate: tuple[float, float]
    uncertainty: float
    scatter: float
    probability: float
    probability_error: float
    guard_bands: tuple[float, float] | None
    accepted: Limits | None
    decision: str
    why: str
    risk: float | None
    at: dict[str, tuple[float, float, str]]
    population: tuple[float, float] | None
    global_risks: GlobalRisks | None
    recalibration: Recalibration
    notes: tuple[str, ...]

    def data(self) -> dict[str, Any]:
        """As JSON; a limit that there is not is null."""
        return as_json(self)


@dataclass(frozen=True, repr=False)
class Decisions(Printed):
    """Decisions about the limits of one device.

    Attributes:
        rule: "simple", "guarded" or "shared-risk".
        rule_in_words: as a certificate states it.
        false_accept: the probability of a false acceptance that is allowed.
        decisions: one of each limit, in their order.
        calibration: identity of the calibration.
        notes: what to know of all of them, each a sentence.
    """

    rule: str
    rule_in_words: str
    false_accept: float
    decisions: tuple[Decision, ...]
    calibration: str
    notes: tuple[str, ...] = ()

    @property
    def conforms(self) -> bool:
        """Whether every limit is met, by the rule."""
        return all(d.decision == ACCEPT for d in self.decisions)

    def data(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "schema": "bayescal.decisions/1",
            "calibration": self.calibration,
            "rule": self.rule,
            "rule_in_words": self.rule_in_words,
            "false_accept": self.false_accept,
            "conforms": self.conforms,
            "decisions": as_json(self.decisions),
            "notes": list(self.notes),
        }

    def _brief(self) -> str:
        said = ", ".join(f"{d.quantity} {d.decision}" for d in self.decisions)
        return f"{'conforms' if self.conforms else 'not shown to conform'}: {said}"

    def _columns(self) -> dict[str, list[Any]]:
        each = self.decisions
        return {
            "limit": [d.limit for d in each],
            "estimate": [worst(d) for d in each],
            "uncertainty": [d.uncertainty for d in each],
            "unit": [d.unit for d in each],
            "probability": [d.probability for d in each],
            "decision": [d.decision for d in each],
        }

    def __str__(self) -> str:
        return _text(self)


def worst(d: Decision) -> float:
    """The end of the estimate that is nearer to its limit."""
    low, high = d.estimate
    return high if d.tolerance.high - high <= low - d.tolerance.low else low


def decision_cells(d: Decision) -> list[str]:
    """Limit, estimate, probability of conformity, accepted estimates and decision, as people read them."""
    return [
        d.limit,
        f"{with_error(worst(d), d.uncertainty)} {unit_label(d.unit)}".strip(),
        percent(d.probability, d.probability_error),
        _accepted(d),
        d.decision,
    ]


def _text(found: Decisions) -> str:
    rows = [decision_cells(d) for d in found.decisions]
    head = ["limit", "estimate", "p(conforms)", "accepted from … to", "decision"]
    parts = [_fill(f"Decision rule: {found.rule_in_words}."), table(head, rows)]
    parts += ["\n".join(_fill(line) for line in statement_lines(d)) for d in found.decisions]
    of_each = (note for d in found.decisions for note in (*d.recalibration.notes, *d.notes))
    parts += [_fill(note) for note in dict.fromkeys((*of_each, *found.notes))]
    return "\n\n".join(parts)


def _fill(text: str) -> str:
    indent = "    " if text.startswith("  ") else "  "
    return textwrap.fill(text, WIDTH, subsequent_indent=indent)


def _accepted(d: Decision) -> str:
    if d.accepted is None:
        return "none"
    low, high = d.accepted
    unit = unit_label(d.unit)
    if math.isinf(low):
        return f"≤ {number(high, 4)} {unit}".strip()
    if math.isinf(high):
        return f"≥ {number(low, 4)} {unit}".strip()
    return f"{number(low, 4)} … {number(high, 4)} {unit}".strip()


def statement_lines(d: Decision) -> list[str]:
    """Each in a line: the decision and its risk, where it holds, the population's risks, when to calibrate again."""
    said = [f"{d.limit}: {d.decision}; {d.why}."]
    if d.at:
        scatter = f"; single readings scatter by {number(d.scatter)} {unit_label(d.unit)}" * (
            d.scatter > 0
        )
        said.append(
            f"  at {', '.join(_place(name, *place) for name, place in d.at.items())}{scatter}"
        )
    if (g := d.global_risks) is not None:
        which = f" {with_error(*d.population)} {unit_label(d.unit)}" if d.population else ""
        said.append(
            f"  of devices{which or ' calibrated so'}: {percent(g.conforming)} conform, "
            f"{percent(g.accepted)} would be accepted; consumer's risk (accepted, does not conform) "
            f"{percent(g.consumer)}, producer's risk (conforms, not accepted) {percent(g.producer)}"
        )
    return [*said, f"  next calibration: {d.recalibration}"]


def _place(name: str, low: float, high: float, unit: str) -> str:
    if unit == "rad":
        low, high, unit = math.degrees(low), math.degrees(high), "deg"
    values = number(low, 4) if low == high else f"{number(low, 4)} to {number(high, 4)}"
    return f"{name} = {values} {unit_label(unit)}".strip()


def percent(p: float, error: float = 0.0) -> str:
    """A probability as people read it; no finer than its Monte-Carlo error, nor than a hundredth of a per cent."""
    least = max(3 * error if p in (0.0, 1.0) else 0.0, 1e-4)
    if p < least:
        return f"< {100 * least:.2g} %"
    if p > 1 - least:
        return f"> {100 - 100 * least:.4g} %"
    return f"{100 * p:.2f} %" if p < 0.1 or p > 0.9 else f"{100 * p:.1f} %"
