"""The page *Where the model may be wrong*: what was stated, beside what was true."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.record import DOCS, RESULTS, cores_of, read_lines

Rows = list[dict[str, Any]]
BANDS = (0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)
SPLIT = 0.8  # probability of the best structure, below which it is not alone
Z = 1.959964
ONE = {"bias.rate": "bias.thermal_lag", "bias.rate_head": "bias.thermal_lag"} | {
    "scale.rate_head": "scale.thermal_lag"
}  # two names of one function to first order
HEAD = """# Where the model may be wrong

Rendered by `python -m benchmarks wrong_model holdout one_profile starts` from `benchmarks/results`.

Campaigns of three instruments whose laws are none of the catalogue's: a lag of two stages, a warm-up of two decays, a
logarithmic drift, saturating gradients and temperatures, a hysteresis that turns round over degrees, offsets of runs
that are not normal. None to two effects are hidden, at sizes from 0.05 to 5 times the plausible one, so that many are
too small to be seen. `calibrate` is given the readings alone.
"""


def write() -> None:
    """The page, from what was measured so far."""
    parts = [HEAD]
    for name in ("mems_gyro", "quartz_beam_accelerometer", "inclinometer"):
        if rows := read_lines(RESULTS / f"wrong_model_{name}.jsonl"):
            parts += [f"## {name}\n", cores_of(rows), _coverage(rows), _said(rows), _bands(rows)]
    for title, file, chapter in (
        ("Three runs of one profile", "one_profile", _profile),
        ("Hold-out data", "holdout", _holdout),
        ("One end from every start", "starts", _starts),
    ):
        if rows := read_lines(RESULTS / f"{file}.jsonl"):
            parts += [f"## {title}\n", cores_of(rows), chapter(rows)]
    (DOCS / "wrong_model.md").write_text("\n".join(parts), "utf-8")


def _coverage(rows: Rows) -> str:
    """How often intervals hold the truth."""
    split = [r for r in rows if max(p for _, p in r["shares"]) < SPLIT]
    body = []
    for words, some in (("all", rows), (f"best structure below {SPLIT:g}", split)):
        for which, label in (
            ("used", "average"),
            ("best", "best structure"),
            ("baseline", "baseline"),
        ):
            body.append([words, len(some), label, *_shares(some, which)])
    empty = [r for r in rows if not r["hidden"]]
    wider = [
        np.exp(np.mean([np.log(r["used"][k] / r["baseline"][k]) for r in empty]))
        for k in ("fitted_sd", "later_sd")
    ]
    return (
        "How often 95 % intervals hold the truth: of the expected output of the fitted readings and of hold-out runs, "
        "and of the baseline's coefficients.\n\n"
        + table(["campaigns", "", "used", "fitted", "hold-out", "coefficients"], body)
        + f"\nWhere nothing is hidden ({len(empty)}), averaging widens the interval of the expected output by "
        f"{wider[0]:.2f} times, of hold-out runs by {wider[1]:.2f}.\n"
    )


def _shares(rows: Rows, which: str) -> list[str]:
    held = [
        abs(v[0] - v[2]) <= Z * v[1] for r in rows for v in r[which].values() if isinstance(v, list)
    ]
    means = [np.mean([r[which][k] for r in rows]) for k in ("fitted", "later")]
    return [*(f"{m:.3f}" for m in means), proportion(sum(held), len(held))]


def _said(rows: Rows) -> str:
    """What was left out without a word."""
    lost = sum(
        p > 0.5 and not any(e in s for s in r["sets"])
        for r in rows
        for e, p in r["missing"].items()
    )
    silent = sum(
        r["complete"] is not None and r["complete"] < 0.05 and not r["sets"] and r["open"]
        for r in rows
    )
    return (
        f"An effect with an inclusion above one half that is neither used nor reported: {lost}. P(complete) below 0.05 "
        f"with nothing added, no set and the gate open: {silent}. Gate shut in {sum(not r['open'] for r in rows)} of "
        f"{len(rows)}.\n"
    )


def _bands(rows: Rows) -> str:
    """Stated probabilities of named effects, and of completeness, beside how often they were so."""
    effects, complete = [], []
    for r in rows:
        hidden, final = {_one(e) for e in r["hidden"]}, {_one(e) for e in r["final"]}
        stated: dict[str, float] = {}
        for name, p in r["inclusion"].items():
            stated[_one(name)] = min(1.0, stated.get(_one(name), 0.0) + p)
        for name, p in r["missing"].items():
            stated.setdefault(_one(name), p)
        effects += [(p, e in hidden) for e, p in stated.items() if "(" not in e]
        if r["complete"] is not None:
            seen = {_one(e) for e in r["hidden"] if e not in r["unseen"]}
            complete.append((r["complete"], seen <= final))
    return (
        "Stated probabilities beside how often they were so:\n\n"
        + _of_bands("an effect is there", effects)
        + "\n"
        + _of_bands("nothing that can be seen is missing", complete)
    )


def _one(name: str) -> str:
    return ONE.get(name, name)


def _of_bands(what: str, pairs: Iterable[tuple[float, bool]]) -> str:
    stated, so = np.array(list(pairs), dtype=float).T
    body = []
    for low, high in pairwise(BANDS):
        inside = (stated >= low) & ((stated < high) | (high == 1.0))
        if count := int(inside.sum()):
            mean = f"{stated[inside].mean():.2f}"
            body.append([f"{low:g} to {high:g}", mean, proportion(int(so[inside].sum()), count)])
    return table([f"P({what})", "mean", "was so"], body)


def _profile(rows: Rows) -> str:
    """Of `one_profile`."""
    kept = sum(not r["lost"] for r in rows)
    departures = sum(bool(r["departures"]) for r in rows)
    return (
        "Three runs that repeat one profile, with offsets of runs, a lag, a warm-up and a quadratic hidden. Every "
        f"hidden effect in the final model or in a set beside it: {kept} of {len(rows)}. A departure in the place of a "
        f"named effect: {departures}.\n"
    )


def _holdout(rows: Rows) -> str:
    """Of `holdout`."""
    right = [r for r in rows if r["right"]]
    shut = sum(not r["same"]["open"] for r in right)
    refused = sum(not r["other"]["open"] for r in rows)
    return (
        f"Runs with offsets of their own, right results: shut by hold-out data of the same device in "
        f"{proportion(shut, len(right))}. Hold-out data of another device: shut in {proportion(refused, len(rows))}.\n"
    )


def _starts(rows: Rows) -> str:
    """Of `starts`."""
    return (
        f"From the baseline and from up to four models on the way, `calibrate` ends at one set of effects in "
        f"{proportion(sum(r['same'] for r in rows), len(rows))} of campaigns.\n"
    )
