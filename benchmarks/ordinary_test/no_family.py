"""Effects that no family describes, hidden in the ordinary test: are they reported as unknown, or by a wrong name?

A further recorded column that the output depends on; a resonance in the temperature of the die; a step in time; a
function of the time within a run that is not a warm-up.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np

from benchmarks.bank import Bank
from benchmarks.ordinary_test.judged import INSTRUMENTS, in_order, judged
from benchmarks.ordinary_test.worlds import STRUCTURES, Array, Further, Record, drawn

SAMPLE = 12  # campaigns that a release measures anew
COUNT = 21  # campaigns, the first of the order
READINGS = (200, 1600)
SEEDS = 15
BESIDE = ("run", "warm-up", "curve")  # each hidden beside it in one campaign of four
STRENGTHS = (0.3, 5.0)  # rms, in parts of the noise; log-uniform


class Cell(NamedTuple):
    """One campaign of the plan."""

    shape: str
    repeats: bool
    readings: int
    seed: int


def plan() -> list[Cell]:
    """Return the measured campaigns, in order."""
    cells = [Cell(*c) for c in product(SHAPES, (True, False), READINGS, range(SEEDS))]
    return in_order(cells)[:COUNT]


def column(rng: np.random.Generator, bare: Record) -> Further:
    """Add a saturating dependence of the output on a recorded fan speed, which the catalogue does not have."""
    seed, bend = int(rng.integers(2**31)), rng.uniform(0.3, 2.0)

    def wave(record: Record) -> Array:
        rng_of_record = np.random.default_rng([seed, int(record.time[0])])
        knots = np.arange(0.0, np.ptp(record.time) + 900.0, 900.0)
        values = rng_of_record.standard_normal(len(knots))
        return np.interp(record.time - record.time[0], knots, values)

    return Further(
        lambda record: np.tanh(bend * wave(record)) / bend,
        {"fan_speed [Hz]": lambda record: np.round(50 + 5 * wave(record), 3)},
    )


def resonance(rng: np.random.Generator, bare: Record) -> Further:
    """Add a Lorentz curve of the output over the die's temperature, as of two modes that cross at one temperature."""
    low, high = np.quantile(bare.inner, [0.2, 0.8])
    at, width = rng.uniform(low, high), rng.uniform(1.0, 4.0)
    return Further(lambda record: 1 / (1 + ((record.inner - at) / width) ** 2))


def step(rng: np.random.Generator, bare: Record) -> Further:
    """Add a permanent step of the output at one moment within a run."""
    at = float(rng.choice(np.quantile(bare.time, np.linspace(0.25, 0.75, 50))))
    return Further(lambda record: (record.time > at).astype(float))


def elapsed(rng: np.random.Generator, bare: Record) -> Further:
    """Add a decaying oscillation after each power-on, which no warm-up resembles."""
    longest = float(bare.since.max())
    period, dies = longest * rng.uniform(0.25, 0.7, 2)
    phase = rng.uniform(0.0, 2 * np.pi)
    return Further(lambda r: np.sin(2 * np.pi * r.since / period + phase) * np.exp(-r.since / dies))


SHAPES = {"column": column, "resonance": resonance, "step": step, "elapsed": elapsed}


def measured(cell: Cell) -> dict[str, Any]:
    """Return the row of one campaign."""
    shape = list(SHAPES).index(cell.shape)
    rng = np.random.default_rng([54, shape, cell.repeats, cell.readings, cell.seed])
    structure = str(rng.choice(("none", *STRUCTURES)))
    hidden = tuple(f for f in BESIDE if rng.random() < 0.25)
    low, high = np.log(STRENGTHS)
    strength = float(np.exp(rng.uniform(low, high)))

    def further(rng: np.random.Generator, bare: Record, noise: float) -> Further:
        shape = SHAPES[cell.shape](rng, bare)
        assert shape.law is not None
        law, spread = shape.law, float(np.std(shape.law(bare)))
        return Further(lambda record: strength * noise / spread * law(record), shape.columns)

    whole = (structure, cell.repeats, cell.readings, hidden)
    campaign = drawn(rng, *whole, recorded=False, further=further)
    instrument = sorted(INSTRUMENTS)[int(rng.integers(2))]
    return {"structure": structure, "strength": strength, **judged(campaign, instrument)}


BANKS = (Bank("no_family", lambda: ((tuple(c), c) for c in plan()), measured, Cell._fields),)
