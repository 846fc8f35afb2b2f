"""What a search says is missing from one model, and how it prints."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

from bayescal._core.formatting import WIDTH, number, probability, table, with_error
from bayescal._discovery.candidate import Candidate
from bayescal._discovery.posterior import Found
from bayescal._model.effect import Effect
from bayescal._readings.unit_conversion import unit_label


@dataclass(frozen=True)
class Discovery:
    """The answer to "which effect is missing?".

    Attributes:
        nothing_missing: probability that none of the candidates is.
        sets: findings, the most probable first.
        candidates: every candidate, the most probable first.
        best: the effects to add, so that `model + discovery.best` is the model to use; empty for none.
        noise_wanders: probability that the noise wanders; None where the readings cannot tell.
        stopped: why the search ended before its end; empty where it did not.
        rivals: effects to tell apart by another experiment: the members of the first set; where it has one alone,
            with those that come nearest; without a set, the leads.
    """

    nothing_missing: float
    sets: tuple[Found, ...]
    candidates: tuple[Candidate, ...]
    best: tuple[Effect, ...]
    rivals: tuple[Effect, ...] = ()
    noise_wanders: float | None = None
    stopped: str = ""

    def __str__(self) -> str:
        return discovery_text(self)


def discovery_text(found: Discovery) -> str:
    """What is missing, and every candidate, the most probable first."""
    lines = [f"nothing is missing: probability {probability(found.nothing_missing)}"]
    for s in found.sets:
        names = " or ".join(s.effects)
        tail = "" if len(s.effects) == 1 else "  (one of these; these readings cannot tell which)"
        lines.append(f"missing: {names}, probability {probability(s.probability)}{tail}")
    if found.noise_wanders is not None:
        lines.append(f"the noise wanders: probability {probability(found.noise_wanders)}")
    if found.stopped:
        lines.append(found.stopped)
    quiet = (None, "not visible")  # an unknown dependence without evidence is not worth a line
    tested = [
        c
        for c in found.candidates
        if c.kind != "not testable" and not (c.unknown and c.kind in quiet)
    ]
    head = ["candidate", "probability", "log BF", "expected size", "detectable", "remark"]
    lines.append(table(head, [_candidate_row(c) for c in tested], fold=29) if tested else "")
    if any(c.source == "refit" for c in tested):
        lines.append("* log Bayes factor by refit; the others by score")
    lines += _alike(found) + _not_testable(found)
    return "\n".join(line for line in lines if line)


def _candidate_row(c: Candidate) -> list[str]:
    remark = "this experiment cannot see it" if c.kind == "not visible" else c.kind or ""
    factor = "–" if c.log_bayes_factor is None else f"{c.log_bayes_factor:z.1f}"
    return [
        c.effect,
        probability(c.probability),
        factor + ("*" if c.source == "refit" else " "),
        f"{with_error(c.size or 0.0, c.size_sd or 0.0)} {unit_label(c.unit)}".rstrip(),
        number(c.minimum_detectable, 2),
        remark,
    ]


def _alike(found: Discovery) -> list[str]:
    """One line for each group of candidates that these readings can hardly tell apart."""
    groups: dict[frozenset[str], str] = {}
    for c in found.candidates:
        if c.indistinguishable_from:
            members = (c.effect, *c.indistinguishable_from)
            if not any(frozenset(members) <= known for known in groups):
                groups[frozenset(members)] = ", ".join(members)
    return [
        textwrap.fill(f"hard to tell apart: {names}", WIDTH, subsequent_indent="  ")
        for names in groups.values()
    ]


def _not_testable(found: Discovery) -> list[str]:
    """One line for each reason, with the effects that it holds back."""
    by_reason: dict[str, list[str]] = {}
    for c in found.candidates:
        if c.kind == "not testable":
            by_reason.setdefault(c.reason, []).append(c.effect)
    return [
        textwrap.fill(f"not testable, {reason}: {', '.join(names)}", WIDTH, subsequent_indent="  ")
        for reason, names in by_reason.items()
    ]
