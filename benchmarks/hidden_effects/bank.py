"""The bank of simulated campaigns: what is hidden in each, at sizes drawn at random, and the readings."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal._discovery import candidate_columns
from bayescal._discovery.discover import unknowns
from bayescal._model.model import testable
from bayescal_models import mems_gyro

SIZES = (1 / 3, 3.0)  # of the plausible size
# Campaigns of each kind for each instrument; single: turns through all candidates, and two more at the end.
COUNTS = {"single": 3, "empty": 60, "pair": 8, "outside": 8, "prior": 40, "law": 40}
FIRST_SEED = {
    "single": 1000,
    "empty": 2000,
    "pair": 3000,
    "outside": 4000,
    "prior": 5000,
    "law": 6000,
}
# What no catalogue has, and the placeholder that is nearest to it. A wave and a step have a form of their own among
# the placeholders; a shock that dies away has none.
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


class Case(NamedTuple):
    """One campaign: its kind, its seed, what is hidden and how large; `shape` of what no catalogue has."""

    kind: str
    seed: int
    hidden: dict[str, float]
    shape: str = ""


def instrument_named(name: str) -> bc.Instrument:
    """An instrument of this repository."""
    return import_module(f"bayescal_models.{name}").INSTRUMENT


def simulated(instrument: bc.Instrument, case: Case, later: bool = False) -> bc.Measurements:
    """The campaign's readings, or those of a second campaign with the same hidden effects, to be held out."""
    assert instrument.simulate is not None
    seed = case.seed + (500_000 if later else 0)
    readings = instrument.simulate(case.hidden, seed=seed, **CAMPAIGNS.get(instrument.name, {}))
    return outside(readings, instrument, case) if case.kind == "outside" else readings


def open_effects(model: bc.Model, readings: bc.Measurements) -> list[bc.Effect]:
    """Candidates that are not in the model and that these readings can show."""
    return [
        e
        for e in model.instrument.candidates
        if e.name not in model.names and testable(e, readings) is None
    ]


def plan(instrument: bc.Instrument) -> Iterator[Case]:
    """The bank, kinds in turn, so that a part of it is a fair sample."""
    empty = simulated(instrument, Case("empty", 0, {}))
    effects = open_effects(instrument.for_readings(empty).baseline(), empty)
    size = {e.name: e.coefficients[0].size for e in effects}
    names = list(size)
    rng = np.random.default_rng(20261121)
    for turn in range(max(COUNTS.values())):
        if turn < COUNTS["single"]:
            for i, name in enumerate(names):
                seed = FIRST_SEED["single"] + 100 * turn + i
                yield Case("single", seed, {name: _drawn(name, size[name], rng)})
        if turn < COUNTS["pair"] and len(names) > 1:
            pair = rng.choice(names, 2, replace=False)
            hidden = {str(n): _drawn(n, size[n], rng) for n in pair}
            yield Case("pair", FIRST_SEED["pair"] + turn, hidden)
        if turn < COUNTS["outside"]:
            shape = list(OUTSIDE)[turn % len(OUTSIDE)]
            yield Case("outside", FIRST_SEED["outside"] + turn, {}, shape)
        if turn < COUNTS["empty"]:
            yield Case("empty", FIRST_SEED["empty"] + turn, {})
        if turn < COUNTS["prior"]:
            yield Case("prior", FIRST_SEED["prior"] + turn, _from_prior(effects, rng))
        if turn < COUNTS["law"]:
            yield Case("law", FIRST_SEED["law"] + turn, {})
    for turn in (COUNTS["single"], COUNTS["single"] + 1):  # drawn last: what was drawn before stays
        for i, name in enumerate(names):
            seed = FIRST_SEED["single"] + 100 * turn + i
            yield Case("single", seed, {name: _drawn(name, size[name], rng)})


def _signed(name: str, value: float) -> float:
    """The spread of a group's deviations has no sign."""
    return abs(value) if name.endswith((".run", ".cell", ".device")) else value


def _drawn(name: str, size: float, rng: np.random.Generator) -> float:
    low, high = SIZES
    return _signed(name, float(size * low * (high / low) ** rng.random() * rng.choice([-1.0, 1.0])))


def _from_prior(effects: list[bc.Effect], rng: np.random.Generator) -> dict[str, float]:
    """Half of the time nothing; else one effect, each as probable, at a size from its own prior."""
    empty, at, normal = rng.random() < 0.5, int(rng.integers(len(effects))), rng.standard_normal()
    coefficient = effects[at].coefficients[0]
    value = coefficient.size * normal
    if coefficient.spread is not None:
        value = float(coefficient.spread.value(jnp.asarray(normal)))
    return {} if empty else {effects[at].name: _signed(effects[at].name, float(value))}


def by_law(instrument: bc.Instrument, case: Case) -> tuple[bc.Measurements, list[str]]:
    """Readings drawn from the search's own prior, and what is hidden in them.

    Half of the time nothing; else one candidate by its share of the prior, an unknown function among them, with its
    shapes, spread and coefficients from their priors, in the catalogue's own columns.
    """
    rng = np.random.default_rng([case.seed, 1])
    readings = simulated(instrument, case)
    if rng.random() < 0.5:
        return readings, []
    model = instrument.for_readings(readings).baseline()
    fit = bc.fit(model, readings, bc.LeastSquares(), strict=False)
    effects = open_effects(model, readings)
    effects += [e for e in unknowns(fit) if testable(e, readings) is None]
    effect = effects[int(rng.choice(len(effects), p=candidate_columns.prior_shares(effects)))]
    shapes = [float(s.prior.value(jnp.asarray(rng.standard_normal()))) for s in effect.shapes]
    hidden = np.zeros(len(readings))
    for (columns, size), c in zip(
        candidate_columns.columns_at(fit, effect, shapes), effect.coefficients, strict=True
    ):
        if c.spread is not None:
            size = float(c.spread.value(jnp.asarray(rng.standard_normal())))
        hidden += size * columns @ rng.standard_normal(columns.shape[1])
    return readings.with_column("output", readings["output"] + hidden), [effect.name]


def outside(readings: bc.Measurements, instrument: bc.Instrument, case: Case) -> bc.Measurements:
    """The same readings with something that no effect of the catalogue describes, one to six times the noise.

    `column`: the output follows a further recorded column, which wanders as the humidity of a laboratory does.
    `periodic`: it goes up and down with the time, three to eight times in the record. `step`: at a moment in the
    middle half of the record it jumps, and stays. `shock`: it jumps twice as far, and comes back within a tenth of
    the record.
    """
    strength, phase, place = np.random.default_rng(case.seed).random(3)
    strength = 1.0 + 5.0 * strength  # the same in both campaigns
    fit = bc.fit(
        instrument.for_readings(readings).baseline(), readings, bc.LeastSquares(), strict=False
    )
    noise = float(fit.samples("noise.white").mean())
    if case.shape == "column":
        own = int(1e6 * abs(readings["output"][0])) % 2**31
        rng = np.random.default_rng([case.seed, len(readings), own])
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
