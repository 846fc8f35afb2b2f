"""The page's chapter on one hidden effect: was it found, was something else, how large were the sets."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.hidden_effects.outcomes import CLEAR, STRONG, Banks, Rows, hidden_in, of_kind, said
from benchmarks.intervals import proportion
from benchmarks.markdown import table

BINS = ((-np.inf, 5.0), (5.0, STRONG), (STRONG, CLEAR), (CLEAR, np.inf))  # oracle
FAIR = 1.05  # held-out error of the true effect's catalogue form, in the final model's, up to which it is the truth
ALIKE = 0.02  # relative difference of held-out errors up to which two models predict alike
WORSE = 1.02  # held-out error, in the baseline's, from which the final model is worse


def chapter(banks: Banks) -> list[str]:
    """Its paragraphs."""
    single = of_kind(banks, "single")
    return [_found(single) + "\n" + _missed(single), _sets(single)]


def _found(single: Rows) -> str:
    head = [
        "oracle",
        "campaigns",
        "truth in the first set",
        "mean set",
        "truth in the final model",
        "something else in it",
        "held-out error, of the true model's",
        "worse than the baseline",
    ]
    rows = []
    for low, high in BINS:
        own = [r for r in single if low <= r["oracle"] < high]
        in_set = sum(hidden_in(r) in r["first_set"] for r in own)
        added = sum(hidden_in(r) in r["final"] for r in own)
        wrong = sum(bool(set(r["final"]) - {hidden_in(r)}) for r in own)
        size = _mean([len(r["first_set"]) for r in own if r["first_set"]])
        ratio = np.median([_of_true(r) for r in own] or [np.nan])
        worse = sum(r["held_out"][1] > WORSE * r["held_out"][0] for r in own)
        rows.append(
            [
                _label(low, high),
                len(own),
                proportion(in_set, len(own)),
                "–" if np.isnan(size) else f"{size:.2f}",
                proportion(added, len(own)),
                proportion(wrong, len(own)),
                f"{ratio:.2f}",
                worse,
            ]
        )
    return table(head, rows)


def _label(low: float, high: float) -> str:
    if not np.isfinite(low):
        return f"below {high:g}"
    return f"{low:g} to {high:g}" if np.isfinite(high) else f"above {low:g}"


def _of_true(row: dict[str, Any]) -> float:
    """The final model's held-out error in that of the hidden effect's catalogue form."""
    return row["held_out"][1] / row["held_out"][2]


def _mean(values: list[int]) -> float:
    return float(np.mean(values or [np.nan]))


def _missed(single: Rows) -> str:
    """What was added instead where the hidden effect was clear."""
    missed = [r for r in single if r["oracle"] >= CLEAR and hidden_in(r) not in r["final"]]
    alike = sum(hidden_in(r) in said(r) and abs(_of_true(r) - 1) < ALIKE for r in missed)
    better = sum(_of_true(r) < 1 - ALIKE for r in missed)
    listed = "; ".join(
        f"`{hidden_in(r)}` ({r['oracle']:.0f}): {', '.join(r['final']) or 'nothing'}, {_of_true(r):.2f}, {_why(r)}"
        for r in missed
    )
    return (
        f"Missed above {CLEAR:.0f}: {len(missed)}. In {alike} of these the hidden effect stands in a set "
        "beside what was added, and the two predict the second campaign within 2 %: the readings do not tell them "
        f"apart. In {better} the final model predicts better than the catalogue's form of the hidden effect. Each, "
        "with its oracle, what was added instead, the held-out error in that of the catalogue's form, and by how many "
        f"nats the true structure is less probable than the most probable one: {listed or 'none'}.\n"
    )


def _why(row: dict[str, Any]) -> str:
    """How the true structure compares with the most probable one."""
    against = row["truth"]
    if against is None:
        return "it is the most probable one"
    return f"{-against['total']:.1f}" + ("" if against["weighed"] else ", never weighed")


def _sets(single: Rows) -> str:
    """Credible sets: false ones among all reported, and their size against exact enumeration's."""
    total = false = fair = fair_false = 0
    with_false: Rows = []
    for r in single:
        name = hidden_in(r)
        ours = [name in at or name not in m for at, sets in r["reported"] for m in sets]
        total += len(ours)
        false += sum(ours)
        with_false += [r] if any(ours) else []
        if r["held_out"][2] <= FAIR * r["held_out"][1]:
            fair, fair_false = fair + len(ours), fair_false + sum(ours)
    better = sum(r["held_out"][1] < r["held_out"][2] for r in with_false)
    strong = [r for r in single if r["exact_set"] and r["first_set"]]
    own = _mean([len(r["first_set"]) for r in strong])
    exact = _mean([len(r["exact_set"]) for r in strong])
    return (
        f"Sets reported in campaigns with one hidden effect that do not hold it: {proportion(false, total)}, in "
        f"{len(with_false)} campaigns. In {better} of these the final model predicts the second campaign better than "
        "the catalogue's form of the hidden effect does: the simulated physics departs from that form by more than "
        "the noise, and the search finds what is left. Where it does not (that form predicts within "
        f"{100 * (FAIR - 1):.0f} % of the final model): {proportion(fair_false, fair)}. Mean size of the first set "
        f"{own:.2f}, of the exact one by the evidence of every single effect {exact:.2f} (ratio {own / exact:.2f}, "
        f"{len(strong)} campaigns, a quarter of those with an oracle above {STRONG:.0f}).\n"
    )
