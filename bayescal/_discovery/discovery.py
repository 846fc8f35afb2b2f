"""What a search says is missing from one model, how it stands, why it ended, and how that prints."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayescal._core.formatting import WIDTH, number, probability, table, with_error
from bayescal._discovery.candidate import Candidate
from bayescal._discovery.posterior import FOUND, Found, Posterior
from bayescal._discovery.structures import Structures, Weighed
from bayescal._engine.linear_model import linear_model
from bayescal._model.effect import Effect
from bayescal._readings.unit_conversion import unit_label

SHOWN = 20  # structures kept of a search


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


@dataclass(frozen=True)
class Shown:
    """A structure as a search leaves it: what it adds, its noise law, how probable it is.

    Attributes:
        rms: error as fitted, output unit; of the most probable structure alone.
    """

    effects: tuple[str, ...]
    wanders: bool
    log_evidence: float
    probability: float
    rms: float | None = None

    def __str__(self) -> str:
        parts = [*(["wandering noise"] if self.wanders else []), *self.effects]
        return "+ " + " + ".join(parts) if parts else "nothing to add"


@dataclass(frozen=True)
class Search:
    """How a search stands, or how it ended.

    Attributes:
        structures: the most probable ones; of an earlier search, they are the `seeds` of one that goes on.
        weighed: how many were.
        complete: whether it came to its end.
        stopped: why it did not, in words; empty where it did, or goes on.
        seconds: since it began.
        max_effects: most effects that it may add.
    """

    structures: tuple[Shown, ...]
    weighed: int
    complete: bool
    stopped: str = ""
    seconds: float = 0.0
    max_effects: int | None = None

    @classmethod
    def of(cls, structures: Structures, *, complete: bool, **told: Any) -> Search:
        """Of the structures weighed so far; `told` are the other fields."""
        weighed, shown = structures.visited.values(), ()
        if any(math.isfinite(w.total) for w in weighed):
            posterior = Posterior.of(structures)
            each = zip(posterior.weighed, posterior.probability, strict=True)
            shown = tuple(_shown(w, float(p), i == 0) for i, (w, p) in enumerate(each))
        return cls(shown[:SHOWN], len(weighed), complete, **told)


def _shown(w: Weighed, probability: float, with_error: bool) -> Shown:
    rms = None
    if with_error:
        rms = float(np.sqrt(np.mean(linear_model(w.assembly, w.mode).residual ** 2)))
    effects = tuple(sorted(w.structure.effects))
    return Shown(effects, w.structure.wanders, w.log_evidence, probability, rms)


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


def ending(found: Discovery | None, added: int, most: int | None, stopped: str) -> str:
    """Why a search ended where it did: time, a bound on the effects, or that nothing more is probable enough.

    Args:
        found: what is missing from the last model.
        added: effects that were added.
        most: effects that may be.
        stopped: why it ended early; empty where it did not.
    """
    if found is None:
        return stopped or "Nothing was looked for: the fit is not to be trusted."
    said = [stopped] if stopped else []
    if not stopped and most is not None and added >= most > 0:
        said.append(
            f"The search has added as many effects as it may, {most} (--max-effects, in Python max_effects): "
            "with more, more may be found."
        )
    tested = [c for c in found.candidates if c.probability is not None]
    if tested:
        said.append(_nearest(max(tested, key=lambda c: c.probability or 0.0), added))
    elif not said:
        said.append("These readings can test no further candidate.")
    return " ".join(said)


def _nearest(best: Candidate, added: int) -> str:
    """The most probable candidate that was not added."""
    it = f"{best.effect}, probability {probability(best.probability)}"
    if (best.probability or 0.0) >= FOUND:
        return f"Still missing: {it}."
    more = "Nothing more" if added else "Nothing"
    if best.kind == "lead":
        return f"{more} is found: {it}: a lead, below the {FOUND:g} asked for."
    return f"{more} is found: the most probable candidate is {it}, below the {FOUND:g} asked for."


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
