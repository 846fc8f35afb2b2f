"""Batches of simulated accelerometers: is the stated probability of being the best pair right, and what is it worth?

    python -m benchmarks differential_pair
    BAYESCAL_BATCHES=2000 python -m benchmarks differential_pair

Each batch is three outer and three inner devices. Every one is fitted, the pair of least expected residual is chosen,
and its true residual is set beside that of the pairs which source 3's rule picks: on records with steps of
acceleration, raw and after removing the commanded part, and on a raw record of the same devices at constant
acceleration. Resumable: a line per batch in results/differential_pair.jsonl. Batches with k̂ above 0.7 are counted
with the others, and their number is reported.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.environment import SHARED, order_names
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import devices_from
from bayescal_models.differential_pair.pairing.selection import judge
from benchmarks.accuracy.coverage import drawn_one_by_one
from benchmarks.intervals import by_stated, expected_counts
from benchmarks.record import RESULTS, add_line, read_lines, write

BATCHES = 600  # by default: about five minutes on one core
CHUNK = 20
FIRST_SEED = 70000
LINES = RESULTS / "differential_pair.jsonl"
STEPS = dp.Campaign(samples=20)
PLATEAU = dp.Campaign(samples=20, profile="plateau")
METHOD = bc.Marginal(promote=tuple(order_names(SHARED.name)), proposals=2048, rounds=2)
EDGES = (0.0, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
CHOICES = {
    "least expected residual": "bayes",
    "document's rule, commanded part removed": "document_removed",
    "document's rule, raw, steps": "document_raw_steps",
    "document's rule, raw, constant acceleration": "document_raw_plateau",
    "a pair at random": "random",
    "the true best": "oracle",
}


def chunk(seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Fit some batches, and judge their pairs."""
    made = [dp.simulate_batch(seed=seed, campaign=STEPS) for seed in seeds]
    readings = [one.readings for one in made]
    fitted, k_hats = drawn_one_by_one(dp.INSTRUMENT.baseline(), readings, METHOD, seeds[0])
    for one, (weights, samples), k_hat in zip(made, fitted, k_hats, strict=True):
        devices = devices_from(samples, one.readings, weights=weights)
        constant = dp.simulate_batch(seed=one.seed, campaign=PLATEAU).readings["output"]
        yield {"pareto_k": k_hat, **judged(one, devices, constant)}


def judged(one: dp.SimulatedBatch, devices: dp.Devices, constant: np.ndarray) -> dict[str, Any]:
    """What each rule picks in one batch, what that leaves in truth, and what was stated."""
    outer, found = one.outer, judge(devices)
    true = criteria.residual(one.environment, one.scale, found.calibrated)
    with_sums = criteria.residual(one.environment, one.scale, found.step2)
    ratios = criteria.ratio_variance(criteria.polynomial(devices.time, one.environment), outer)
    plateau = criteria.polynomial(devices.time, constant.reshape(len(one.names), -1))
    picks = {
        "bayes": found.expected,
        "document_removed": found.document["ratio-variance"],
        "document_raw_steps": found.document["ratio-variance-raw"],
        "document_raw_plateau": criteria.ratio_variance(plateau, outer),
    }
    at = {name: int(np.argmin(values)) for name, values in picks.items()}
    left = {name: float(true.flat[index]) for name, index in at.items()}
    flat_ratio = np.abs(np.log(one.sensitivity[:outer, None] / one.sensitivity[None, outer:]))
    return {
        "seed": one.seed,
        "left": {**left, "random": float(true.mean()), "oracle": float(true.min())},
        "document_throughout": float(with_sums.flat[at["document_removed"]]),
        "expected": float(found.expected.flat[at["bayes"]]),
        "unlike": {
            **{name: float(flat_ratio.flat[index]) for name, index in at.items()},
            "random": float(flat_ratio.mean()),
        },
        "stated": found.probability["residual"].ravel().tolist(),
        "best": int(np.argmin(true)),
        "stated_ratios": found.probability["ratio-variance"].ravel().tolist(),
        "best_ratios": int(np.argmin(ratios)),
    }


def reliability(stated: np.ndarray, happened: np.ndarray) -> list[dict[str, Any]]:
    """Stated probabilities against how often it was so, with the 95 % binomial band of the count."""
    rows = []
    for low, high, inside, seen in by_stated(stated, happened, EDGES):
        count, mean = len(inside), float(inside.mean())
        band = expected_counts(count, mean, level=0.05)
        rows.append(
            {
                "from": low,
                "to": high,
                "batches": count,
                "stated": mean,
                "seen": seen / count,
                "band95": [edge / count for edge in band],
                "inside": band[0] <= seen <= band[1],
            }
        )
    return rows


def summary(done: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over batches with their standard errors, and reliability tables of the likeliest pairs."""
    tables = {}
    for name, stated, best in (
        ("residual", "stated", "best"),
        ("ratio variance", "stated_ratios", "best_ratios"),
    ):
        chances = np.array([row[stated] for row in done])
        likeliest = np.argmax(chances, axis=1)
        tables[name] = {
            "rows": reliability(
                chances.max(axis=1), likeliest == np.array([row[best] for row in done])
            ),
            "mean_stated": float(chances.max(axis=1).mean()),
            "share_right": float(np.mean(likeliest == [row[best] for row in done])),
        }
    scale = np.sqrt(len(done))

    def mean(values: list[float]) -> dict[str, float]:
        return {"mean": float(np.mean(values)), "standard_error": float(np.std(values) / scale)}

    return {
        "batches": len(done),
        "k_hat_above_0.7": sum(row["pareto_k"] > 0.7 for row in done),
        "reliability": tables,
        "residual_ug": {
            title: mean([row["left"][key] for row in done]) for title, key in CHOICES.items()
        },
        "document_throughout_ug": {
            **mean([row["document_throughout"] for row in done]),
            "median": float(np.median([row["document_throughout"] for row in done])),
        },
        "expected_residual_ug": mean([row["expected"] for row in done]),
        "unlikeness": {
            title: mean([row["unlike"][key] for row in done])
            for title, key in CHOICES.items()
            if key != "oracle"
        },
        "better_than_document": float(
            np.mean([row["left"]["bayes"] <= row["left"]["document_removed"] for row in done])
        ),
    }


def show(found: dict[str, Any]) -> None:
    """The summary as tables."""
    print(f"{found['batches']} batches of 3 × 3 devices; k̂ > 0.7 in {found['k_hat_above_0.7']}")
    for name, table in found["reliability"].items():
        print(
            f"\nprobability of being best by {name}, of the likeliest pair: stated "
            f"{table['mean_stated']:.3f}, right {table['share_right']:.3f}"
        )
        for row in table["rows"]:
            print(
                f"  {row['stated']:.3f}  seen {row['seen']:.3f}  of {row['batches']:4d}  band "
                f"{row['band95'][0]:.3f} to {row['band95'][1]:.3f}{'' if row['inside'] else '  OUT'}"
            )
    print("\ntrue residual of the chosen pair, µg, and |log λ1d/λ2d|")
    for title, row in found["residual_ug"].items():
        other = found["unlikeness"].get(title)
        also = f"   {other['mean']:.3f}" if other else ""
        print(f"  {title:45s} {row['mean']:6.2f} ± {row['standard_error']:.2f}{also}")
    row = found["document_throughout_ug"]
    print(
        f"  document's rule and document's λbd: mean {row['mean']:.1f}, median {row['median']:.1f}"
    )
    print(f"  expected of the chosen pair: {found['expected_residual_ug']['mean']:.2f}")


def main() -> None:
    """Run what is missing of the batches, then write the summary."""
    wanted = int(os.environ.get("BAYESCAL_BATCHES", BATCHES))
    done = read_lines(LINES)
    seeds = {row["seed"] for row in done}
    missing = [s for s in range(FIRST_SEED, FIRST_SEED + wanted) if s not in seeds]
    for start in range(0, len(missing), CHUNK):
        own = missing[start : start + CHUNK]
        padded = own + list(range(FIRST_SEED - CHUNK + len(own), FIRST_SEED))  # one shape
        for row in list(chunk(padded))[: len(own)]:
            done.append(row)
            add_line(LINES, row)
        print(f"{len(done)} of {wanted}", end="\r", file=sys.stderr)
    found = summary(done)
    write("differential_pair", found)
    show(found)
