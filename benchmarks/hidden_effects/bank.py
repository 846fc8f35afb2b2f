"""The bank of simulated campaigns: hidden effects of random size, and the readings."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

import bayescal as bc
from bayescal._model.model import why_untestable
from bayescal_models import mems_gyro
from benchmarks.hidden_effects.drawn import by_law as drawn_by_law
from benchmarks.hidden_effects.searched import noise_of

# Three axes and the dividing head have banks of their own: `triads.py`, `dividing_head.py`.
INSTRUMENTS = (
    *("ng_accelerometer", "mems_gyro", "quartz_beam_accelerometer"),
    *("differential_pair", "inclinometer", "still_sensor"),
)
SIZES = (1 / 3, 3.0)  # of the plausible size
# Campaigns of each kind for each instrument; single: times each candidate; several: only where there is a long one.
KINDS = ("single", "empty", "pair", "outside", "prior", "law", "several")
COUNTS = dict(zip(KINDS, (5, 120, 24, 24, 60, 120, 12), strict=True))
PACE = dict(zip(KINDS, (25, 20, 6, 6, 10, 20, 3), strict=True))  # in turn
FIRST_SEED = dict(zip(KINDS, (1000, 2000, 3000, 4000, 5000, 6000, 8000), strict=True))
# What no catalogue has, and the placeholder nearest to it; a shock that dies away has no form of its own.
OUTSIDE = {
    "column": "unknown(humidity)",
    "periodic": "unknown(time, cycle)",
    "step": "unknown(time, jump)",
    "shock": "unknown(time)",
}
# Where an instrument's own standard campaign could show only a part of its effects.
CAMPAIGNS: dict[str, dict[str, Any]] = {
    "mems_gyro": {"campaign": mems_gyro.Campaign(rate_input=(0.0, 100.0, -100.0))}
}
# Several effects at once, on a longer record: three runs, 1,608 readings 20 s apart.
HOLDS: dict[str, Any] = {"temperatures": tuple(range(10, 81, 10)), "dwell": 1340.0, "average": 20.0}
SEVERAL = ("bias.run", "bias.thermal_lag", "bias.warm_up", "bias.temperature_quadratic")
LONG: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "mems_gyro": ({"campaign": mems_gyro.Campaign(**HOLDS)}, SEVERAL)
}


class Case(NamedTuple):
    """One campaign: its kind, its seed, hidden effects and their sizes; `shape` of an effect outside the catalogue."""

    kind: str
    seed: int
    hidden: dict[str, float]
    shape: str = ""


def instrument_named(name: str) -> bc.Instrument:
    """Return an instrument of this repository."""
    return import_module(f"bayescal_models.{name}").INSTRUMENT


def simulated(instrument: bc.Instrument, case: Case, later: bool = False) -> bc.Measurements:
    """Return the campaign's readings; if `later`, hold-out readings of a second campaign with its hidden effects."""
    assert instrument.simulate is not None
    seed = case.seed + (500_000 if later else 0)
    options = CAMPAIGNS.get(instrument.name, {})
    if case.kind == "several":
        options = LONG[instrument.name][0]
    readings = instrument.simulate(case.hidden, seed=seed, **options)
    return outside(readings, instrument, case) if case.kind == "outside" else readings


def open_effects(model: bc.Model, readings: bc.Measurements) -> list[bc.Effect]:
    """Return candidates that are not in the model and are testable by these readings, named forms before families."""
    effects = (
        form
        for e in model.instrument.candidates
        for form in (*(f for f in e.forms if not f.name.startswith(f"{e.name}.")), e)
    )
    return [e for e in effects if e.name not in model.names and why_untestable(e, readings) is None]


def plan(instrument: bc.Instrument) -> list[Case]:
    """Return the bank's cases, with kinds in turn, so that any initial part is a representative sample."""
    empty = simulated(instrument, Case("empty", 0, {}))
    effects = open_effects(instrument.for_readings(empty).baseline(), empty)
    cases = [
        (turn / PACE[kind], case)
        for kind in COUNTS
        for turn, case in enumerate(_of_kind(kind, instrument, effects))
    ]
    return [case for _, case in sorted(cases, key=lambda c: c[0])]


def _of_kind(kind: str, instrument: bc.Instrument, effects: list[bc.Effect]) -> Iterator[Case]:
    """Yield the campaigns of one kind; their random numbers do not depend on the number of campaigns."""
    size = {e.name: e.coefficients[0].size for e in effects}
    family = {e.name: e.family_name for e in effects}
    names, count, first = list(size), COUNTS[kind], FIRST_SEED[kind]
    rng = np.random.default_rng([20261121, first])
    if kind == "single":
        for turn in range(count):
            for i in rng.permutation(len(names)):
                name = names[i]
                yield Case(kind, first + 100 * turn + int(i), {name: _drawn(name, size[name], rng)})
        return
    for turn in range(count):
        if kind == "pair" and len(names) > 1:
            while True:  # of two forms of one family a model has one
                pair = rng.choice(names, 2, replace=False)
                if len({family[str(n)] for n in pair}) == 2:
                    break
            yield Case(kind, first + turn, {str(n): _drawn(n, size[n], rng) for n in pair})
        elif kind == "several" and instrument.name in LONG:
            several = LONG[instrument.name][1]
            yield Case(kind, first + turn, {n: _drawn(n, size[n], rng) for n in several})
        elif kind == "outside":
            yield Case(kind, first + turn, {}, list(OUTSIDE)[turn % len(OUTSIDE)])
        elif kind in ("empty", "law"):
            yield Case(kind, first + turn, {})
        elif kind == "prior":
            yield Case(kind, first + turn, _from_prior(effects, rng))


def _signed(name: str, value: float) -> float:
    """Give a size a random sign; a group's standard deviation stays positive."""
    return abs(value) if name.endswith((".run", ".cell", ".device")) else value


def _drawn(name: str, size: float, rng: np.random.Generator) -> float:
    low, high = SIZES
    return _signed(name, float(size * low * (high / low) ** rng.random() * rng.choice([-1.0, 1.0])))


def _from_prior(effects: list[bc.Effect], rng: np.random.Generator) -> dict[str, float]:
    """Draw no effect with probability one half; otherwise one of equally probable effects, its size from its prior."""
    empty, at, normal = rng.random() < 0.5, int(rng.integers(len(effects))), rng.standard_normal()
    value = effects[at].coefficients[0].size * normal
    return {} if empty else {effects[at].name: _signed(effects[at].name, float(value))}


def by_law(instrument: bc.Instrument, case: Case) -> tuple[bc.Measurements, dict[str, float], bool]:
    """Draw readings from the search's prior; return them, the hidden effects' contributions, whether noise wanders."""
    readings = simulated(instrument, case)
    return drawn_by_law(instrument.for_readings(readings).baseline(), readings, case.seed)


def outside(readings: bc.Measurements, instrument: bc.Instrument, case: Case) -> bc.Measurements:
    """Add to readings an effect outside the catalogue, of one to six times the noise.

    `column`: the output depends on a further recorded column that varies like the humidity of a laboratory. `periodic`:
    a sinusoid in time, three to eight periods in the record. `step`: a step in the middle half of the record. `shock`:
    a step of twice the size that returns within a tenth of the record.
    """
    strength, phase, place = np.random.default_rng(case.seed).random(3)
    strength = 1.0 + 5.0 * strength  # the same in both campaigns
    noise = noise_of(instrument.for_readings(readings).baseline(), readings)
    if case.shape == "column":
        seed_of_readings = int(1e6 * abs(readings["output"][0])) % 2**31
        rng = np.random.default_rng([case.seed, len(readings), seed_of_readings])
        knots = rng.standard_normal(max(4, len(readings) // 12))
        at = np.linspace(0, knots.size - 1, len(readings))
        wave = np.interp(at, np.arange(knots.size), knots)
        scaled = (wave - wave.mean()) / wave.std()
        changed = readings.with_column("output", readings["output"] + strength * noise * scaled)
        return changed.with_column("humidity", 0.5 + 0.1 * scaled, "1")
    time = readings["time"]
    part = (time - time.min()) / (time.max() - time.min())
    if case.shape == "periodic":
        wave = np.sin(2 * np.pi * ((3 + 5 * place) * part + phase))
    else:
        since = part - (0.25 + 0.5 * place)
        wave = np.where(since > 0, 0.5, -0.5)
        if case.shape == "shock":  # while readings are taken, or it has died away unseen
            since = part - np.quantile(part, 0.25 + 0.5 * place)
            wave = np.where(since > 0, 2 * np.exp(-np.maximum(since, 0.0) / 0.05), 0.0)
    return readings.with_column("output", readings["output"] + strength * noise * wave)
