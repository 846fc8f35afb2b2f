"""The bank of hidden effects as a page: what was found, what was invented, against customary selections."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hidden_effects import page_single
from benchmarks.hidden_effects.bank import COUNTS, OUTSIDE
from benchmarks.hidden_effects.customary import SELECTIONS
from benchmarks.hidden_effects.outcomes import (
    CLEAR,
    FATES,
    STRONG,
    Banks,
    Rows,
    fate,
    hidden_in,
    names_outside,
    of_kind,
    said,
    strong_outside,
    strong_pairs,
)
from benchmarks.intervals import by_stated, proportion
from benchmarks.markdown import table
from benchmarks.record import cores_of

ALIKE = 0.7  # correlation from which an effect outside the catalogue looks like one of it
HIDDEN = ("single", "pair", "several", "outside")
SURE = 0.9  # probability from which a catalogue effect explains it away
MARKS = ("<!-- the bank in short -->", "<!-- end of it -->")
EDGES = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)  # of stated probabilities


def write(banks: Banks, spoilt: dict[str, Any], path: Path) -> None:
    """Render `docs/hidden_effects.md`; `spoilt` is what `false_discoveries` found, by instrument."""
    prior, law = of_kind(banks, "prior"), of_kind(banks, "law")
    parts = [
        "# Hidden effects: found, or not\n",
        "Rendered by `python -m benchmarks hidden_effects` from `benchmarks/results/hidden_effects_*.jsonl`. Each "
        "campaign is simulated by its instrument's own physics with effects hidden in it, at sizes drawn at random "
        "between a third and three times the plausible one, and searched as `calibrate` does: the posterior over "
        "structures, without the fits and checks around it. *Final*: the structure chosen. *Oracle*: log evidence of "
        "the true structure less the baseline's, both under white noise. Intervals are exact 95 % binomial ones.\n",
        _counts(banks),
        cores_of(row for rows in banks.values() for row in rows),
        "Planned for each instrument: "
        + ", ".join(f"{kind} {count}" for kind, count in COUNTS.items())
        + " (single: for each candidate; several: where there is a long record). Kinds are measured in turn; what is "
        "missing goes on with the same command. Seconds are of the search alone, with other work on the machine.\n",
        "## One hidden effect\n",
        *page_single.chapter(banks),
        "## Nothing hidden\n",
        _empty(banks),
        "## Nothing hidden, and noise or priors that are not as the model takes them\n",
        "By `python -m benchmarks false_discoveries`.\n",
        _spoilt(spoilt),
        "## Two hidden effects, several, and effects outside the catalogue\n",
        _others(banks),
        "## Side by side with customary selections\n",
        "The same campaigns and candidates. *Hit*: the hidden effect is selected (oracle above 8). *False*: "
        "effects selected in campaigns with one hidden effect that are not it. *Invented*: empty campaigns in which "
        "something is selected. *Held out*: median error of a second campaign, in that of the true model's.\n",
        _customary(banks),
        "## Stated probabilities\n",
        f"{len(prior)} further campaigns by the instruments' simulators: half with nothing hidden, half "
        "with one effect, each as probable, at a size from its own prior. The physics there departs from the "
        "catalogue's form, and where the readings show the departure, an unknown function is stated, which counts as "
        "wrong.\n",
        _reliability(prior),
        f"{len(law)} campaigns drawn from the search's own prior: each candidate in or out by its odds, unknown "
        "functions among them, its size times 1, 3 or 10, in the catalogue's own columns; white or correlated noise, "
        "by the odds of the two laws. Here every statement should hold as often as it says, but for the noise: its "
        "white part stays the simulator's, so that correlated noise of short time often passes for white noise of "
        "another size.\n",
        _reliability(law),
    ]
    path.write_text("\n".join(parts), encoding="utf-8")


def in_readme(banks: Banks, path: Path) -> None:
    """Put the bank in short between the marks in README.md."""
    clear = [r for r in of_kind(banks, "single") if r["oracle"] >= CLEAR]
    empty, pairs = of_kind(banks, "empty"), strong_pairs(banks)
    outside = [r for shape in OUTSIDE for r in strong_outside(banks, shape)]
    claims: list[tuple[str, list[bool]]] = [
        (
            "one effect hidden (log Bayes factor above 15): in the final model, or in a set beside what is",
            [hidden_in(r) in said(r) for r in clear],
        ),
        ("the same: in the final model", [hidden_in(r) in r["final"] for r in clear]),
        (
            "two hidden: both in the final model",
            [set(r["hidden"]) <= set(r["final"]) for r in pairs],
        ),
        (
            "outside the catalogue (a column; a wave, step or shock in time): its column in the final model",
            [names_outside(r, "final") for r in outside],
        ),
        ("nothing hidden: something added", [bool(r["final"]) for r in empty]),
    ]
    claims += [
        (f"the same, by {name}", [bool(r["customary"][name]["effects"]) for r in empty])
        for name in SELECTIONS
    ]
    made = table(["campaigns", "count"], _counted(claims))
    text, cores = path.read_text("utf-8"), cores_of(row for rows in banks.values() for row in rows)
    before, after = text.partition(MARKS[0])[0], text.partition(MARKS[1])[2]
    path.write_text(f"{before}{MARKS[0]}\n\n{made}\n{cores}\n{MARKS[1]}{after}", encoding="utf-8")


def _counted(claims: list[tuple[str, list[bool]]]) -> list[list[str]]:
    """Rows of claims: how often each holds, of how many."""
    return [[claim, proportion(sum(holds), len(holds))] for claim, holds in claims]


def _counts(banks: Banks) -> str:
    kinds = {
        "single": "one hidden",
        "empty": "none",
        "pair": "two",
        "several": "several",
        "outside": "outside",
        "prior": "from the priors",
        "law": "by the search's prior",
    }
    rows = [
        [
            name,
            *(sum(r["kind"] == kind for r in bank) for kind in kinds),
            f"{np.median([r['seconds'] for r in bank]):.1f}",
        ]
        for name, bank in banks.items()
        if bank
    ]
    return table(["instrument", *kinds.values(), "median s"], rows)


def _empty(banks: Banks) -> str:
    rows = []
    for name, bank in banks.items():
        own = of_kind({name: bank}, "empty")
        what = sorted({n for r in own for n in r["final"]})
        added = proportion(sum(bool(r["final"]) for r in own), len(own))
        rows.append([name, added, ", ".join(what)])
    every = of_kind(banks, "empty")
    rows.append(["all", proportion(sum(bool(r["final"]) for r in every), len(every)), ""])
    return table(["instrument", "something added", "what"], rows)


def _spoilt(found: dict[str, Any]) -> str:
    rows = [
        [name, how.replace("wandering", "correlated"), row["added"], ", ".join(row["what"])]
        for name, kinds in found.items()
        for how, row in kinds.items()
    ]
    return table(["instrument", "spoilt by", "something added", "what"], rows)


def _others(banks: Banks) -> str:
    pairs = strong_pairs(banks)
    by_shape = {shape: strong_outside(banks, shape) for shape in OUTSIDE}
    every = [r for rows in by_shape.values() for r in rows]
    claims: list[tuple[str, list[bool]]] = [
        (
            "two hidden, both oracles ≥ 8: both in the final model",
            [set(r["hidden"]) <= set(r["final"]) for r in pairs],
        ),
        ("the same: at least one", [bool(set(r["hidden"]) & set(r["final"])) for r in pairs]),
        (
            "any hidden, probability of a complete model below 0.05: no effect chosen all the same",
            [
                not r["final"]
                for kind in HIDDEN
                for r in of_kind(banks, kind)
                if r["nothing"] < 0.05
            ],
        ),
        (
            "four hidden on a long record (`mems_gyro`): each in the final model or in a set",
            [set(r["hidden"]) <= said(r) for r in of_kind(banks, "several")],
        ),
        (
            "outside the catalogue, all kinds: the right column in the final model",
            [names_outside(r, "final") for r in every],
        ),
        (
            "the same, or beside a catalogue effect of its set that was added",
            [fate(r) in FATES[:2] for r in every],
        ),
    ]
    for shape, rows in by_shape.items():
        own = [fate(r) for r in rows]
        claims += [(f"{shape}: {one}", [f == one for f in own]) for one in FATES if one in own]
    for words, chosen in (
        ("< 0.7", [r for r in every if r["likeness"] < ALIKE]),
        ("≥ 0.7", [r for r in every if r["likeness"] >= ALIKE]),
    ):
        claim = f"outside, correlation with a catalogue effect {words}: explained away by one (probability > 0.9)"
        claims.append((claim, [explained_away_by_one(r) for r in chosen]))
    return table(["claim", "count"], _counted(claims))


def explained_away_by_one(row: dict[str, Any]) -> bool:
    """Whether an effect of the catalogue is said to be there that is not."""
    stated = row["probabilities"].items()
    return any(p > SURE for name, p in stated if not name.startswith("unknown("))


def _customary(banks: Banks) -> str:
    single, empty = of_kind(banks, "single"), of_kind(banks, "empty")
    strong = [r for r in single if r["oracle"] >= STRONG]

    def line(
        label: str,
        chosen: Callable[[dict[str, Any]], list[str]],
        error: Callable[[dict[str, Any]], float | None],
    ) -> list[str]:
        hit = sum(hidden_in(r) in chosen(r) for r in strong)
        false = np.mean([len(set(chosen(r)) - set(r["hidden"])) for r in single] or [np.nan])
        invented = sum(bool(chosen(r)) for r in empty)
        ratios = [e / r["held_out"][2] for r in single if (e := error(r)) is not None]
        return [
            label,
            proportion(hit, len(strong)),
            f"{false:.2f}",
            proportion(invented, len(empty)),
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
    return table(["selection", "hit", "false per campaign", "invented", "held out"], rows)


def _reliability(own: Rows) -> str:
    """Stated probabilities against how often they were right."""
    pairs = [(p, n in r["hidden"]) for r in own for n, p in r["probabilities"].items()]
    nothing = [(r["nothing"], not r["hidden"]) for r in own]
    wanders = [(r["stated_wanders"], r["wanders"]) for r in own]
    given_of = {
        "an effect is missing": pairs,
        "the model is complete": nothing,
        "the noise is correlated": wanders,
    }
    rows = []
    for what, given in given_of.items():
        stated = np.array([p for p, _ in given])
        true = np.array([holds for _, holds in given], bool)
        for low, high, p, hits in by_stated(stated, true, EDGES):
            # Poisson binomial: the number of hits if every stated probability were right, 95 %
            draws = np.random.default_rng(0).random((4000, p.size)) < p
            least, most = np.quantile(draws.sum(axis=1), [0.025, 0.975])
            rows.append(
                [
                    what,
                    f"{low:g} to {high:g}",
                    f"{p.mean():.3f}",
                    f"{hits}/{p.size}",
                    f"{least:.0f} to {most:.0f}",
                    "yes" if least <= hits <= most else "no",
                ]
            )
    head = ["statement", "stated", "mean", "true", "expected, 95 %", "within"]
    return table(head, rows)
