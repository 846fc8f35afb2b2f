"""The bank of hidden effects as a page: what was found, what was invented, against customary selections."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from benchmarks.customary import SELECTIONS

BINS = ((-np.inf, 3.0), (3.0, 8.0), (8.0, 15.0), (15.0, np.inf))
Rows = list[dict[str, Any]]


def write(banks: dict[str, Rows], path: Path) -> None:
    """Render `docs/hidden_effects.md`."""
    parts = [
        "# Hidden effects: found, or not\n",
        "Rendered by `python -m benchmarks hidden_effects` from `benchmarks/results/hidden_effects_*.jsonl`. Each "
        "campaign is simulated by its instrument's own physics with effects hidden in it, at sizes drawn at random "
        "between a third and three times the plausible one. *Oracle*: log Bayes factor of the true model against the "
        "baseline. Intervals are exact 95 % binomial ones.\n",
        _counts(banks),
        "## One hidden effect\n",
        _single(banks),
        "## Nothing hidden\n",
        _empty(banks),
        "## Two hidden effects, and effects outside the catalogue\n",
        _others(banks),
        "## Side by side with customary selections\n",
        "The same campaigns and candidates. *Hit*: the hidden effect is selected (oracle above 8). *False*: "
        "effects selected in campaigns with one hidden effect that are not it. *Invented*: empty campaigns in which "
        "something is selected. *Held out*: median error of a second campaign, in that of the true model's.\n",
        _customary(banks),
        "## Stated probabilities\n",
        _reliability(banks),
    ]
    path.write_text("\n".join(parts), encoding="utf-8")


def interval(count: int, total: int) -> str:
    """A proportion with its exact (Clopper–Pearson) 95 % interval."""
    if total == 0:
        return "–"
    low = 0.0 if count == 0 else float(beta.ppf(0.025, count, total - count + 1))
    high = 1.0 if count == total else float(beta.ppf(0.975, count + 1, total - count))
    return f"{count}/{total} ({100 * low:.0f}–{100 * high:.0f} %)"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(r) + " |" for r in rows)]) + "\n"


def _all(banks: dict[str, Rows], kind: str) -> Rows:
    return [row for rows in banks.values() for row in rows if row["kind"] == kind]


def _counts(banks: dict[str, Rows]) -> str:
    kinds = ("single", "empty", "pair", "outside")
    rows = [
        [
            name,
            *(str(sum(r["kind"] == k for r in rows)) for k in kinds),
            f"{np.median([r['seconds'] for r in rows]):.1f}",
        ]
        for name, rows in banks.items()
        if rows
    ]
    return _table(["instrument", "one hidden", "none", "two", "outside", "median s"], rows)


def _single(banks: dict[str, Rows]) -> str:
    rows = []
    for low, high in BINS:
        own = [r for r in _all(banks, "single") if low <= r["oracle"] < high]
        name = [next(iter(r["hidden"])) for r in own]
        in_set = sum(n in r["first_set"] for n, r in zip(name, own, strict=True))
        added = sum(n in r["final"] for n, r in zip(name, own, strict=True))
        wrong = sum(bool(set(r["final"]) - {n}) for n, r in zip(name, own, strict=True))
        size = np.mean([len(r["first_set"]) for r in own if r["first_set"]] or [np.nan])
        ratio = np.median([r["held_out"][1] / r["held_out"][2] for r in own] or [np.nan])
        worse = sum(r["held_out"][1] > 1.02 * r["held_out"][0] for r in own)
        label = (
            f"{low:g} to {high:g}"
            if np.isfinite(low) and np.isfinite(high)
            else (f"below {high:g}" if np.isfinite(high) else f"above {low:g}")
        )
        rows.append(
            [
                label,
                str(len(own)),
                interval(in_set, len(own)),
                f"{size:.2f}",
                interval(added, len(own)),
                interval(wrong, len(own)),
                f"{ratio:.2f}",
                str(worse),
            ]
        )
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
    missed = [
        f"`{next(iter(r['hidden']))}` ({r['oracle']:.0f}): {', '.join(r['final']) or 'nothing'}"
        for r in _all(banks, "single")
        if r["oracle"] >= 15 and next(iter(r["hidden"])) not in r["final"]
    ]
    told = "Missed above 15, with what was added instead: " + ("; ".join(missed) or "none") + ".\n"
    return _table(head, rows) + "\n" + told


def _empty(banks: dict[str, Rows]) -> str:
    rows = []
    for name, bank in banks.items():
        own = [r for r in bank if r["kind"] == "empty"]
        what = sorted({n for r in own for n in r["final"]})
        rows.append([name, interval(sum(bool(r["final"]) for r in own), len(own)), ", ".join(what)])
    every = _all(banks, "empty")
    rows.append(["all", interval(sum(bool(r["final"]) for r in every), len(every)), ""])
    return _table(["instrument", "something added", "what"], rows)


def _others(banks: dict[str, Rows]) -> str:
    pairs = _all(banks, "pair")
    both = sum(set(r["hidden"]) <= set(r["final"]) for r in pairs)
    strong = [r for r in _all(banks, "outside") if r["oracle"] >= 8]
    named = sum("unknown(humidity)" in r["final"] for r in strong)
    away = sum(
        any(
            p is not None and p > 0.9
            for n, p in r["probabilities"].items()
            if not n.startswith("unknown(")
        )
        for r in strong
    )
    rows = [
        ["two hidden: both in the final model (any oracle)", interval(both, len(pairs))],
        ["outside the catalogue, oracle ≥ 8: the column named", interval(named, len(strong))],
        [
            "the same, explained away by a named effect (probability > 0.9)",
            interval(away, len(strong)),
        ],
    ]
    return _table(["claim", "count"], rows)


def _customary(banks: dict[str, Rows]) -> str:
    single = _all(banks, "single")
    strong = [r for r in single if r["oracle"] >= 8]
    empty = _all(banks, "empty")

    def line(label, chosen, error) -> list[str]:
        hit = sum(next(iter(r["hidden"])) in chosen(r) for r in strong)
        false = np.mean([len(set(chosen(r)) - set(r["hidden"])) for r in single] or [np.nan])
        invented = sum(bool(chosen(r)) for r in empty)
        ratios = [error(r) / r["held_out"][2] for r in single if error(r) is not None]
        return [
            label,
            interval(hit, len(strong)),
            f"{false:.2f}",
            interval(invented, len(empty)),
            f"{np.median(ratios or [np.nan]):.2f}",
        ]

    rows = [line("bayescal", lambda r: r["final"], lambda r: r["held_out"][1])]
    rows += [
        line(
            n,
            lambda r, n=n: r["customary"][n]["effects"],
            lambda r, n=n: r["customary"][n]["held_out"],
        )
        for n in SELECTIONS
    ]
    return _table(["selection", "hit", "false per campaign", "invented", "held out"], rows)


def _reliability(banks: dict[str, Rows]) -> str:
    pairs = [
        (p, name in r["hidden"])
        for rows in banks.values()
        for r in rows
        if r["kind"] in ("single", "empty")
        for name, p in r["probabilities"].items()
        if p is not None and not name.startswith("unknown(")
    ]
    edges = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.01)
    rows = []
    for low, high in pairwise(edges):
        own = [(p, hit) for p, hit in pairs if low <= p < high]
        mean = np.mean([p for p, _ in own]) if own else np.nan
        rows.append(
            [
                f"{low:g} to {min(high, 1):g}",
                f"{mean:.3f}",
                interval(sum(h for _, h in own), len(own)),
            ]
        )
    return (
        "Probability of a named effect at the baseline, and how often it was hidden. (The bank hides effects more "
        "often than the prior says, and at sizes of its own: this is no calibration in the strict sense.)\n\n"
        + _table(["stated", "mean", "was hidden"], rows)
    )
