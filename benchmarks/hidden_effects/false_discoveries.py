"""False discoveries: how often is an effect added to an empty campaign whose noise or priors violate the model?

Empty campaigns of every instrument, each modified in seven ways, are searched as by `calibrate`, without its fits and
checks; with correlated noise also under white noise alone, which shows the cost of ignoring the correlation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

import bayescal as bc
from benchmarks.bank import Bank
from benchmarks.hidden_effects.bank import INSTRUMENTS, instrument_named
from benchmarks.hidden_effects.searched import Searched, noise_of
from benchmarks.pages import Claim, Rows, share

CAMPAIGNS = 40  # of each kind for each instrument
FIRST_SEED = 7000
SAMPLE = 30  # campaigns of each instrument that a release measures anew


def cases(name: str) -> Iterator[tuple[tuple[str, int], tuple[str, str, int]]]:
    """Yield the campaigns of an instrument."""
    seeds = range(FIRST_SEED, FIRST_SEED + CAMPAIGNS)
    return (((how, seed), (name, how, seed)) for seed in seeds for how in SPOILT)


def measure(case: tuple[str, str, int]) -> dict[str, Any]:
    """Return the row of a campaign."""
    name, how, seed = case
    readings = instrument_named(name).simulate({}, seed=seed)
    instrument = instrument_named(name).for_readings(readings)
    noise = noise_of(instrument.baseline(), readings)
    random = np.random.default_rng([seed, len(readings)])
    instrument, readings = SPOILT[how](instrument, readings, noise, random)
    searched = Searched.of(instrument.baseline(), readings)
    row = {
        "added": sorted(searched.chosen.effects),
        "sets": [[list(s.effects), s.probability] for s in searched.sets],
        "law": searched.structures.noise_law(searched.chosen).in_words,
        "nothing": searched.posterior.completeness(),
    }
    if how == "wandering noise":
        white = Searched.of(instrument.baseline(), readings, widen_noise=False)
        row["if_white"] = sorted(white.chosen.effects)
    return row


Spoilt = tuple[bc.Instrument, bc.Measurements]
Spoil = Callable[[bc.Instrument, bc.Measurements, float, np.random.Generator], Spoilt]


def _wandering(instrument, readings, noise, random) -> Spoilt:
    """Add correlated noise of the record's noise size in each run, with a correlation time of a tenth of the run."""
    runs, at = readings.records.names, readings.records.codes
    wander = np.zeros(len(readings))
    for run in range(len(runs)):
        rows = np.flatnonzero(at == run)
        time_ = readings["time"][rows]
        memory = 0.1 * (time_.max() - time_.min())
        value = random.standard_normal()
        wander[rows[0]] = value
        for before, now in pairwise(rows):
            decay = np.exp(-(readings["time"][now] - readings["time"][before]) / memory)
            value = decay * value + np.sqrt(1 - decay**2) * random.standard_normal()
            wander[now] = value
    return instrument, readings.with_column("output", readings["output"] + noise * wander)


def _heavy_tails(instrument, readings, noise, random) -> Spoilt:
    """Multiply the error of one reading in fifty by ten."""
    far = random.random(len(readings)) < 0.02
    error = 10 * noise * random.standard_normal(len(readings)) * far
    return instrument, readings.with_column("output", readings["output"] + error)


def _student(instrument, readings, noise, random) -> Spoilt:
    """Add Student-t noise of three degrees of freedom."""
    error = noise * random.standard_t(3, len(readings))
    return instrument, readings.with_column("output", readings["output"] + error)


def _missing(instrument, readings, noise, random) -> Spoilt:
    """Drop a third of the rows."""
    rows = np.sort(random.choice(len(readings), 2 * len(readings) // 3, replace=False))
    return instrument, readings.select(rows)


def _uneven(instrument, readings, noise, random) -> Spoilt:
    """Thin readings to bursts: drop the rows after a random one of every ten, then the second half of the rows."""
    count = random.permutation(np.resize(np.arange(2, 11), len(readings) // 10 + 1))
    place = np.arange(len(readings))
    rows = np.flatnonzero(place % 10 < count[place // 10])
    return instrument, readings.select(rows[: len(readings) // 2])


def _scaled(factor: float) -> Spoil:
    def spoil(instrument, readings, noise, random) -> Spoilt:
        effects = tuple(_with_prior(e, factor) for e in instrument.candidates)
        return replace(instrument, candidates=effects), readings

    return spoil


def _with_prior(effect: bc.Effect, factor: float) -> bc.Effect:
    """Return an effect with prior standard deviations `factor` times as large."""
    scaled = []
    for c in effect.coefficients:
        if c.group_sd is not None:
            scaled.append(replace(c, group_sd=replace(c.group_sd, scale=factor * c.group_sd.scale)))
        elif isinstance(c.prior, bc.Normal):
            scaled.append(replace(c, prior=replace(c.prior, sd=factor * c.prior.sd)))
        else:
            scaled.append(c)
    return replace(effect, coefficients=tuple(scaled))


SPOILT: dict[str, Spoil] = {
    "wandering noise": _wandering,
    "outliers": _heavy_tails,
    "Student-t noise": _student,
    "a third of rows missing": _missing,
    "bursts": _uneven,
    "priors ten times wider": _scaled(10.0),
    "priors ten times narrower": _scaled(0.1),
}


BANKS = tuple(
    Bank(f"false_discoveries_{name}", partial(cases, name), measure, ("how", "seed"))
    for name in INSTRUMENTS
)


def _added(rows: Rows, how: str, field: str = "added") -> str:
    return share(bool(row[field]) for row in rows if row["how"] == how)


CLAIMS: tuple[Claim, ...] = (
    *((how, partial(_added, how=how)) for how in SPOILT),
    (
        "wandering noise, searched as white",
        partial(_added, how="wandering noise", field="if_white"),
    ),
)


def results() -> dict[str, Rows]:
    """Return the rows of each instrument."""
    return dict(zip(INSTRUMENTS, (bank.rows for bank in BANKS), strict=True))
