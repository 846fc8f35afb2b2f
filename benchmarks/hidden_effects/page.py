"""The bank of hidden effects as a page: what was found, what was invented, against customary selections."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.hidden_effects.bank import COUNTS, OUTSIDE
from benchmarks.hidden_effects.customary import SELECTIONS

STRONG = 8.0  # oracle
ALIKE = 0.7  # correlation from which an effect outside the catalogue looks like one of it
MARKS = ("<!-- the bank in short -->", "<!-- end of it -->")
FAIR = 1.05  # held-out error of the true effect's catalogue form, in the final model's, up to which it is the truth
EDGES = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.01)
BINS = ((-np.inf, 5.0), (5.0, 8.0), (8.0, 15.0), (15.0, np.inf))
FATES = (
    "the right column in the final model",
    "a catalogue effect of the same set in its place",
    "said to be wandering noise, the column nearly as probable",
    "said to be wandering noise, and no more",
    "something else",
)
Rows = list[dict[str, Any]]


def write(banks: dict[str, Rows], spoilt: dict[str, Any], path: Path) -> None:
    """Render `docs/hidden_effects.md`; `spoilt` is what `false_discoveries` found, by instrument."""
    parts = [
        "# Hidden effects: found, or not\n",
        "Rendered by `python -m benchmarks hidden_effects` from `benchmarks/results/hidden_effects_*.jsonl`. Each "
        "campaign is simulated by its instrument's own physics with effects hidden in it, at sizes drawn at random "
        "between a third and three times the plausible one. *Oracle*: log Bayes factor of the true model against the "
        "baseline. Intervals are exact 95 % binomial ones.\n",
        _counts(banks),
        "Planned for each instrument: "
        + ", ".join(f"{kind} {count}" for kind, count in COUNTS.items())
        + " (single: for each candidate, and twice more at the end); what is missing of it goes on with the same "
        "command.\n",
        "## One hidden effect\n",
        _single(banks),
        _sets(banks),
        "## Nothing hidden\n",
        _empty(banks),
        "## Nothing hidden, and noise or priors that are not as the model takes them\n",
        "By `python -m benchmarks false_discoveries`.\n",
        _spoilt(spoilt),
        "## Two hidden effects, and effects outside the catalogue\n",
        _others(banks),
        "## Side by side with customary selections\n",
        "The same campaigns and candidates. *Hit*: the hidden effect is selected (oracle above 8). *False*: "
        "effects selected in campaigns with one hidden effect that are not it. *Invented*: empty campaigns in which "
        "something is selected. *Held out*: median error of a second campaign, in that of the true model's.\n",
        _customary(banks),
        "## Stated probabilities\n",
        f"{len(_all(banks, 'prior'))} further campaigns by the instruments' simulators: half with nothing hidden, half "
        "with one effect, each as probable, at a size from its own prior. The physics there departs from the "
        "catalogue's form, and where the readings show the departure, an unknown function is stated, which counts as "
        "wrong.\n",
        _reliability(_all(banks, "prior")),
        f"{len(_all(banks, 'law'))} campaigns drawn from the search's own prior: half with nothing hidden, half with "
        "one candidate by its share (unknown functions a tenth), in the catalogue's own columns. Here every statement "
        "should hold as often as it says.\n",
        _reliability(_all(banks, "law")),
    ]
    path.write_text("\n".join(parts), encoding="utf-8")


def in_readme(banks: dict[str, Rows], path: Path) -> None:
    """Put the bank in short between the marks in README.md."""
    strong = [r for r in _all(banks, "single") if r["oracle"] >= 15]
    first = sum(next(iter(r["hidden"])) in r["first_set"] for r in strong)
    final = sum(next(iter(r["hidden"])) in r["final"] for r in strong)
    empty = _all(banks, "empty")
    pairs = _strong_pairs(banks)
    outside = [r for shape in OUTSIDE for r in _strong_outside(banks, shape)]
    rows = [
        ["one effect hidden (log Bayes factor above 15): in the first credible set", first, strong],
        ["the same: in the final model", final, strong],
        [
            "two hidden: both in the final model",
            sum(set(r["hidden"]) <= set(r["final"]) for r in pairs),
            pairs,
        ],
        [
            "outside the catalogue (a column; a wave, step or shock in time): its column in the final model",
            sum(_named(r, "final") for r in outside),
            outside,
        ],
        ["nothing hidden: something added", sum(bool(r["final"]) for r in empty), empty],
    ]
    rows += [
        [
            f"the same, by {name}",
            sum(bool(r["customary"][name]["effects"]) for r in empty),
            empty,
        ]
        for name in SELECTIONS
    ]
    made = _table(["campaigns", "count"], [[c, interval(n, len(of))] for c, n, of in rows])
    text = path.read_text("utf-8")
    before, after = text.partition(MARKS[0])[0], text.partition(MARKS[1])[2]
    path.write_text(f"{before}{MARKS[0]}\n\n{made}\n{MARKS[1]}{after}", encoding="utf-8")


def _strong_pairs(banks: dict[str, Rows]) -> Rows:
    return [r for r in _all(banks, "pair") if min(r["oracle_of_each"]) >= STRONG]


def _strong_outside(banks: dict[str, Rows], shape: str) -> Rows:
    return [r for r in _all(banks, "outside") if r["shape"] == shape and r["oracle"] >= STRONG]


def interval(count: int, total: int) -> str:
    """A proportion with its exact (Clopper–Pearson) 95 % interval."""
    if total == 0:
        return "–"
    low, high = binomtest(count, total).proportion_ci(0.95, method="exact")
    return f"{count}/{total} ({100 * low:.0f}–{100 * high:.0f} %)"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(r) + " |" for r in rows)]) + "\n"


def _all(banks: dict[str, Rows], kind: str) -> Rows:
    return [row for rows in banks.values() for row in rows if row["kind"] == kind]


def _counts(banks: dict[str, Rows]) -> str:
    kinds = ("single", "empty", "pair", "outside", "prior", "law")
    rows = [
        [
            name,
            *(str(sum(r["kind"] == k for r in rows)) for k in kinds),
            f"{np.median([r['seconds'] for r in rows]):.1f}",
        ]
        for name, rows in banks.items()
        if rows
    ]
    return _table(
        [
            "instrument",
            "one hidden",
            "none",
            "two",
            "outside",
            "from the priors",
            "by the search's prior",
            "median s",
        ],
        rows,
    )


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
        (r, next(iter(r["hidden"])), r["held_out"][1] / r["held_out"][2])
        for r in _all(banks, "single")
        if r["oracle"] >= BINS[-1][0] and next(iter(r["hidden"])) not in r["final"]
    ]
    alike = sum(
        {name, *r["added"][:1]} <= set(r["first_set"]) and abs(ratio - 1) < 0.02
        for r, name, ratio in missed
    )
    better = sum(ratio < 0.98 for _, _, ratio in missed)
    listed = "; ".join(
        f"`{name}` ({r['oracle']:.0f}): {', '.join(r['final']) or 'nothing'}, {ratio:.2f}"
        for r, name, ratio in missed
    )
    told = (
        f"Missed above 15: {len(missed)}. In {alike} of these the hidden effect stands in the first set beside what "
        "was added, and the two predict the second campaign within 2 %: the readings do not tell them apart. In "
        f"{better} the final model predicts better than the catalogue's form of the hidden effect. Each, with its "
        "oracle, what was added instead, and the held-out error in that of the catalogue's form: "
        f"{listed or 'none'}.\n"
    )
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


def _spoilt(found: dict[str, Any]) -> str:
    rows = [
        [name, how, row["added"], ", ".join(row["what"])]
        for name, kinds in found.items()
        for how, row in kinds.items()
    ]
    return _table(["instrument", "spoilt by", "something added", "what"], rows)


def _others(banks: dict[str, Rows]) -> str:
    pairs = _strong_pairs(banks)
    both = sum(set(r["hidden"]) <= set(r["final"]) for r in pairs)
    one = sum(bool(set(r["hidden"]) & set(r["final"])) for r in pairs)
    rows = [
        ["two hidden, both oracles ≥ 8: both in the final model", interval(both, len(pairs))],
        ["the same: at least one", interval(one, len(pairs))],
    ]
    everything = [r for shape in OUTSIDE for r in _strong_outside(banks, shape)]
    rows += [
        [
            "outside the catalogue, all kinds: the right column in the final model",
            interval(sum(_named(r, "final") for r in everything), len(everything)),
        ],
        [
            "the same, or beside a catalogue effect of its set that was added",
            interval(sum(_fate(r) in FATES[:2] for r in everything), len(everything)),
        ],
    ]
    for shape in OUTSIDE:
        own = [_fate(r) for r in _strong_outside(banks, shape)]
        rows += [
            [f"{shape}: {fate}", interval(own.count(fate), len(own))]
            for fate in FATES
            if fate in own
        ]
    for words, chosen in (
        ("< 0.7", [r for r in everything if r["likeness"] < ALIKE]),
        ("≥ 0.7", [r for r in everything if r["likeness"] >= ALIKE]),
    ):
        away = sum(
            any(p > 0.9 for n, p in r["probabilities"].items() if not n.startswith("unknown("))
            for r in chosen
        )
        rows.append(
            [
                f"outside, correlation with a catalogue effect {words}: explained away by one (probability > 0.9)",
                interval(away, len(chosen)),
            ]
        )
    return _table(["claim", "count"], rows)


def _named(row: dict[str, Any], where: str) -> bool:
    """Whether the column outside the catalogue is named there, in whatever form."""
    column = OUTSIDE[row["shape"]].removesuffix(")").split(",")[0]
    return any(n.removesuffix(")").split(",")[0] == column for n in row[where])


def _fate(row: dict[str, Any]) -> str:
    """What became of something outside the catalogue."""
    if _named(row, "final"):
        return FATES[0]
    if _named(row, "first_set") and set(row["final"]) & set(row["first_set"]):
        return FATES[1]
    if row["noise"] != "white":
        return FATES[2] if _named(row, "undecided") else FATES[3]
    return FATES[4]


def _sets(banks: dict[str, Rows]) -> str:
    """Credible sets: false ones among all reported, and their size against exact enumeration's."""
    total = false = fair = fair_false = 0
    with_false: Rows = []
    for r in _all(banks, "single"):
        name = next(iter(r["hidden"]))
        ours = [name in names or name not in m for names, sets in r["reported"] for m in sets]
        total += len(ours)
        false += sum(ours)
        with_false += [r] if any(ours) else []
        if r["held_out"][2] <= FAIR * r["held_out"][1]:
            fair, fair_false = fair + len(ours), fair_false + sum(ours)
    better = sum(r["held_out"][1] < r["held_out"][2] for r in with_false)
    strong = [r for r in _all(banks, "single") if r["exact_set"] and r["first_set"]]
    ours = np.mean([len(r["first_set"]) for r in strong] or [np.nan])
    exact = np.mean([len(r["exact_set"]) for r in strong] or [np.nan])
    return (
        f"Sets reported in campaigns with one hidden effect that do not hold it: {interval(false, total)}, in "
        f"{len(with_false)} campaigns. In {better} of these the final model predicts the second campaign better than "
        "the catalogue's form of the hidden effect does: the simulated physics departs from that form by more than "
        "the noise, and the search finds what is left. Where it does not (that form predicts within "
        f"{100 * (FAIR - 1):.0f} % of the final model): {interval(fair_false, fair)}. Mean size of the first set "
        f"{ours:.2f}, of the exact one by the evidence of every single effect {exact:.2f} (ratio {ours / exact:.2f}, "
        f"{len(strong)} campaigns with an oracle above 8).\n"
    )


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


def _reliability(own: Rows) -> str:
    """Stated probabilities against how often they were right."""
    pairs = [(p, n in r["hidden"]) for r in own for n, p in r["probabilities"].items()]
    nothing = [(r["nothing"], not r["hidden"]) for r in own]
    rows = []
    for what, given in (("an effect is missing", pairs), ("nothing is missing", nothing)):
        for low, high in pairwise(EDGES):
            inside = [(p, hit) for p, hit in given if low <= p < high]
            if not inside:
                continue
            p = np.array([p for p, _ in inside])
            hits = sum(hit for _, hit in inside)
            # Poisson binomial: the number of hits if every stated probability were right, 95 %
            draws = np.random.default_rng(0).random((4000, p.size)) < p
            least, most = np.quantile(draws.sum(axis=1), [0.025, 0.975])
            rows.append(
                [
                    what,
                    f"{low:g} to {min(high, 1):g}",
                    f"{p.mean():.3f}",
                    f"{hits}/{p.size}",
                    f"{least:.0f} to {most:.0f}",
                    "yes" if least <= hits <= most else "no",
                ]
            )
    head = ["statement", "stated", "mean", "true", "expected, 95 %", "within"]
    return _table(head, rows)
