"""Nothing is hidden, and the noise or the priors are not what the model takes them for: how often is an effect added?

    python -m benchmarks false_discoveries
    BAYESCAL_ONLY=mems_gyro BAYESCAL_PART=0/2 python -m benchmarks false_discoveries     one process of two

Empty campaigns of every instrument, each spoilt in seven ways, searched as `calibrate` does, without its fits and
checks; for wandering noise also under white noise alone, which shows what ignoring it costs. One JSON line a campaign
in results/false_discoveries_NAME.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._data.time_in_runs import run_codes
from benchmarks.hidden_effects.bank import INSTRUMENTS, instrument_named
from benchmarks.hidden_effects.resume import chosen, go_on
from benchmarks.hidden_effects.searched import Searched, noise_of
from benchmarks.intervals import proportion
from benchmarks.record import RESULTS, lines_of, write

CAMPAIGNS = 40  # of each kind for each instrument
FIRST_SEED = 7000


def main() -> None:
    """Run what is missing, then write and print the table."""
    for name in chosen(INSTRUMENTS):
        _run(name)
    summarise()


def summarise() -> None:
    """Write and print the table of the results that stand."""
    lines = lines_of("false_discoveries")
    lines["all"] = [line for own in lines.values() for line in own]
    summary = {name: _summary(own) for name, own in lines.items()}
    write("false_discoveries", summary)
    for name, rows in summary.items():
        for how, row in rows.items():
            print(f"{name:14s} {how:26s} added in {row['added']}; {row['what']}")


def _summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for how in dict.fromkeys(line["how"] for line in lines):
        own = [line for line in lines if line["how"] == how]
        laws = [line["law"] for line in own]
        found[how] = {
            "campaigns": len(own),
            "added": proportion(sum(bool(line["added"]) for line in own), len(own)),
            "what": sorted({name for line in own for name in line["added"]}),
            "noise law at the end": {law: laws.count(law) for law in sorted(set(laws))},
        }
        if "if_white" in own[0]:
            count = sum(bool(line["if_white"]) for line in own)
            found[how]["added if the noise is taken for white"] = proportion(count, len(own))
    return found


def _run(name: str) -> None:
    """One instrument's campaigns, resumed."""
    path = RESULTS / f"false_discoveries_{name}.jsonl"
    part, parts = map(int, os.environ.get("BAYESCAL_PART", "0/1").split("/"))
    instrument = instrument_named(name)

    def measure(case: tuple[str, int]) -> tuple[dict[str, Any], str]:
        row = _one(instrument, *case)
        return row, f"{row['seed']} {row['how']}: {row['added']}"

    cases = (
        ((how, seed), (how, seed))
        for seed in range(FIRST_SEED, FIRST_SEED + CAMPAIGNS)
        for how in SPOILT
        if seed % parts == part
    )
    go_on(path, ("how", "seed"), cases, measure)


def _one(instrument: bc.Instrument, how: str, seed: int) -> dict[str, Any]:
    readings = instrument.simulate({}, seed=seed)
    instrument = instrument.for_readings(readings)
    noise = noise_of(instrument.baseline(), readings)
    random = np.random.default_rng([seed, len(readings)])
    instrument, readings = SPOILT[how](instrument, readings, noise, random)
    begun = time.perf_counter()
    found = Searched.of(instrument.baseline(), readings)
    row = {
        "how": how,
        "seed": seed,
        "added": sorted(found.chosen.effects),
        "sets": [[list(s.effects), s.probability] for s in found.sets],
        "law": found.structures.noise(found.chosen).in_words,
        "nothing": found.posterior.complete(found.structures),
        "seconds": time.perf_counter() - begun,
    }
    if how == "wandering noise":
        white = Searched.of(instrument.baseline(), readings, widen_noise=False)
        row["if_white"] = sorted(white.chosen.effects)
    return row


Spoilt = tuple[bc.Instrument, bc.Measurements]
Spoil = Callable[[bc.Instrument, bc.Measurements, float, np.random.Generator], Spoilt]


def _wandering(instrument, readings, noise, random) -> Spoilt:
    """A wander of the noise's own size in each run, remembered for a tenth of the run."""
    runs, at = run_codes(readings)
    wander = np.zeros(len(readings))
    for one in range(len(runs)):
        rows = np.flatnonzero(at == one)
        time_ = readings["time"][rows]
        memory = 0.1 * (time_.max() - time_.min())
        value = random.standard_normal()
        wander[rows[0]] = value
        for before, now in pairwise(rows):
            kept = np.exp(-(readings["time"][now] - readings["time"][before]) / memory)
            value = kept * value + np.sqrt(1 - kept**2) * random.standard_normal()
            wander[now] = value
    return instrument, readings.with_column("output", readings["output"] + noise * wander)


def _heavy_tails(instrument, readings, noise, random) -> Spoilt:
    """One reading in fifty has an error ten times as large."""
    far = random.random(len(readings)) < 0.02
    error = 10 * noise * random.standard_normal(len(readings)) * far
    return instrument, readings.with_column("output", readings["output"] + error)


def _student(instrument, readings, noise, random) -> Spoilt:
    """Noise with Student's t on three degrees of freedom beside the simulator's own."""
    error = noise * random.standard_t(3, len(readings))
    return instrument, readings.with_column("output", readings["output"] + error)


def _missing(instrument, readings, noise, random) -> Spoilt:
    """A third of the rows is lost."""
    kept = np.sort(random.choice(len(readings), 2 * len(readings) // 3, replace=False))
    return instrument, readings.select(kept)


def _uneven(instrument, readings, noise, random) -> Spoilt:
    """Readings come in bursts: of every ten, those after a random one are lost; then the end, to half of the rows."""
    count = random.permutation(np.resize(np.arange(2, 11), len(readings) // 10 + 1))
    place = np.arange(len(readings))
    kept = np.flatnonzero(place % 10 < count[place // 10])
    return instrument, readings.select(kept[: len(readings) // 2])


def _scaled(factor: float) -> Spoil:
    def spoil(instrument, readings, noise, random) -> Spoilt:
        effects = tuple(_with_prior(e, factor) for e in instrument.candidates)
        return replace(instrument, candidates=effects), readings

    return spoil


def _with_prior(effect: bc.Effect, factor: float) -> bc.Effect:
    """The same effect with prior standard deviations `factor` times as large."""
    made = []
    for c in effect.coefficients:
        if c.group_sd is not None:
            made.append(replace(c, group_sd=replace(c.group_sd, scale=factor * c.group_sd.scale)))
        elif isinstance(c.prior, bc.Normal):
            made.append(replace(c, prior=replace(c.prior, sd=factor * c.prior.sd)))
        else:
            made.append(c)
    return replace(effect, coefficients=tuple(made))


SPOILT: dict[str, Spoil] = {
    "wandering noise": _wandering,
    "outliers": _heavy_tails,
    "Student-t noise": _student,
    "a third of rows missing": _missing,
    "bursts": _uneven,
    "priors ten times wider": _scaled(10.0),
    "priors ten times narrower": _scaled(0.1),
}
