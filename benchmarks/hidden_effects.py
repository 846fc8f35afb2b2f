"""Effects hidden in simulated campaigns: found, told apart, not invented; and what other selections make of them.

    python -m benchmarks hidden_effects            every instrument that can be searched
    BAYESCAL_ONLY=inclinometer python -m benchmarks hidden_effects

A bank of campaigns for each instrument, by its own simulator: each candidate hidden in turn at sizes drawn at random
(a third to three times the plausible one), two at once, none, and effects outside the catalogue, which only follow
a further recorded column. Every campaign is searched by `calibrate` with least squares (Laplace) fits, and by three
customary selections on the same candidate columns. The oracle is the log Bayes factor of the true model against the
baseline. One JSON line a campaign in results/hidden_effects_NAME.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._model import testable
from bayescal._verification import laplace_evidence
from bayescal_models import INSTRUMENTS
from benchmarks import hidden_effects_page
from benchmarks.customary import SELECTIONS, select
from benchmarks.record import ROOT

RESULTS = ROOT / "benchmarks" / "results"
SEARCHED = tuple(name for name in INSTRUMENTS if name != "differential_pair")
SIZES = (1 / 3, 3.0)  # of the plausible size
DEFAULT = {
    "single": 2,
    "empty": 24,
    "pair": 4,
    "outside": 4,
}  # campaigns; single: for each candidate
SECONDS = 3300.0  # of one instrument's part, after which it stops; run again to go on
METHOD = bc.LeastSquares(draws=200)


def main() -> None:
    """Run what is missing of each instrument's bank, then render the page."""
    only = os.environ.get("BAYESCAL_ONLY", "").split()
    for name in only or SEARCHED:
        run(name, float(os.environ.get("BAYESCAL_SECONDS", SECONDS)))
    banks = {p.stem.removeprefix("hidden_effects_"): read(p) for p in lines_of()}
    hidden_effects_page.write(banks, ROOT / "docs" / "hidden_effects.md")


def lines_of() -> list[Path]:
    return sorted(RESULTS.glob("hidden_effects_*.jsonl"))


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def instrument_named(name: str) -> bc.Instrument:
    module = __import__(f"bayescal_models.{name}", fromlist=["INSTRUMENT"])
    return module.INSTRUMENT


def run(name: str, seconds: float) -> None:
    """One instrument's bank, resumed."""
    instrument = instrument_named(name)
    path = RESULTS / f"hidden_effects_{name}.jsonl"
    path.parent.mkdir(exist_ok=True)
    done = {row["seed"] for row in read(path)} if path.is_file() else set()
    begun = time.perf_counter()
    with path.open("a", encoding="utf-8") as out:
        for kind, seed, hidden in plan(instrument):
            if seed in done:
                continue
            if time.perf_counter() - begun > seconds:
                print(f"{name}: stopped after {seconds:.0f} s; run again to go on")
                return
            row = campaign(instrument, kind, seed, hidden)
            out.write(json.dumps(row) + "\n")
            out.flush()
            print(f"{name} {seed} {kind} {list(hidden)} -> {row['added']}", file=sys.stderr)


def plan(instrument: bc.Instrument) -> Iterator[tuple[str, int, dict[str, float]]]:
    """(kind, seed, hidden effects with their sizes), kinds in turn so that a part of it is a fair sample."""
    readings = instrument.simulate(seed=0)
    own = instrument.for_readings(readings)
    model, catalogue = own.baseline(), own.candidates
    names = [
        e.name for e in catalogue if testable(e, readings) is None and e.name not in model.names
    ]
    sizes = {e.name: plausible(e) for e in catalogue}
    rng = np.random.default_rng(20261121)
    for round_ in range(max(DEFAULT.values())):
        if round_ < DEFAULT["single"]:
            for i, name in enumerate(names):
                yield "single", 1000 + 100 * round_ + i, {name: drawn(sizes[name], rng)}
        if round_ < DEFAULT["pair"] and len(names) > 1:
            a, b = rng.choice(names, 2, replace=False)
            yield "pair", 3000 + round_, {a: drawn(sizes[a], rng), b: drawn(sizes[b], rng)}
        if round_ < DEFAULT["outside"]:
            yield "outside", 4000 + round_, {}
        if round_ < DEFAULT["empty"]:
            yield "empty", 2000 + round_, {}


def plausible(effect: bc.Effect) -> float:
    return effect.coefficients[0].size


def drawn(size: float, rng: np.random.Generator) -> float:
    low, high = SIZES
    return float(size * low * (high / low) ** rng.random() * rng.choice([-1.0, 1.0]))


def campaign(
    instrument: bc.Instrument, kind: str, seed: int, hidden: dict[str, float]
) -> dict[str, Any]:
    """One campaign, searched."""
    hidden = {
        n: abs(v) if n.endswith((".run", ".cell", ".device")) else v for n, v in hidden.items()
    }
    readings = instrument.simulate(hidden, seed=seed)
    later = instrument.simulate(hidden, seed=seed + 500_000)
    if kind == "outside":
        readings, later = (outside(r, instrument, seed) for r in (readings, later))
    model = instrument.for_readings(readings).baseline()
    begun = time.perf_counter()
    trail = bc.calibrate(model, readings, holdout=later, method=METHOD)
    taken = time.perf_counter() - begun
    first = trail.steps[0]
    truth = model + list(hidden) if hidden else model
    if kind == "outside":
        truth = model + "unknown(humidity)"
    true = first.calibration if truth is model else bc.fit(truth, readings, METHOD, strict=False)
    base = laplace_evidence(model, first.calibration)
    found = first.discovery
    return {
        "seed": seed,
        "kind": kind,
        "hidden": hidden,
        "oracle": laplace_evidence(truth, first.calibration) - base if truth is not model else 0.0,
        "nothing": None if found is None else found.nothing_missing,
        "first_set": list(found.sets[0].effects) if found and found.sets else [],
        "probabilities": {}
        if found is None
        else {c.effect: c.probability for c in found.candidates if c.probability is not None},
        "added": [s.added for s in trail.steps if s.added],
        "final": [n for n in trail.final.calibration.model.names if n not in model.names],
        "noise": trail.final.calibration.model.noise.law,
        "gate": trail.gate.ok,
        "held_out": [first.holdout_rmse, trail.final.holdout_rmse, bc.predict(true, later).rmse],
        "customary": {n: select(n, first.calibration, later) for n in SELECTIONS},
        "seconds": taken,
    }


def outside(readings: bc.Measurements, instrument: bc.Instrument, seed: int) -> bc.Measurements:
    """The same readings with a further recorded column that the output follows, which no effect of the catalogue knows.

    The column wanders from reading to reading group by group, as the humidity of a laboratory does; the output
    follows its departure from the mean, by one to six times the noise of a reading.
    """
    strength = np.random.default_rng(seed).uniform(1.0, 6.0)  # the same for both campaigns
    rng = np.random.default_rng(
        [seed, len(readings), int(1e6 * abs(readings["output"][0])) % 2**31]
    )
    count = len(readings)
    knots = rng.standard_normal(max(4, count // 12))
    humidity = np.interp(np.linspace(0, knots.size - 1, count), np.arange(knots.size), knots)
    fit = bc.fit(instrument.for_readings(readings).baseline(), readings, METHOD, strict=False)
    noise = float(fit.samples("noise.white").mean())
    scaled = (humidity - humidity.mean()) / humidity.std()
    output = readings["output"] + strength * noise * scaled
    return readings.with_column("output", output).with_column("humidity", 0.5 + 0.1 * scaled, "1")
