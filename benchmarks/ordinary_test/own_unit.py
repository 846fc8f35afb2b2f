"""Hold-out data of the same unit, whose runs have offsets, and of another unit: when is the gate shut?

    python -m benchmarks own_unit

The ordinary test with run offsets of 0.1 to 1 standard deviations of the noise. The gate is asked three times: of the
readings alone, with hold-out runs of the same unit (the same kind of profile, and another), and with those of a unit of
the same make. A line a campaign in results/own_unit.jsonl.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from benchmarks.ordinary_test import page
from benchmarks.ordinary_test.judged import INSTRUMENTS, LATER, calibrated, outcome, read
from benchmarks.ordinary_test.planned import go_through, in_order
from benchmarks.ordinary_test.worlds import STRUCTURES, Campaign, drawn
from benchmarks.record import RESULTS
from benchmarks.wrong_model.holdout import judged_by
from benchmarks.wrong_model.worlds import OF_DEVICES

PATH = RESULTS / "own_unit.jsonl"
READINGS = {200: 150, 1600: 50}  # campaigns of each length
OFFSETS = (0.1, 1.0)  # of the noise, log-uniform
BESIDE = ("warm-up", "curve", "supply")  # each hidden in every second campaign
UNITS = 0.1 * OF_DEVICES, 0.02  # standard deviations between units: °/s, °/s/°C


class Cell(NamedTuple):
    """One campaign of the plan."""

    readings: int
    seed: int


def plan() -> list[Cell]:
    """All cells, in their order."""
    return in_order([Cell(n, seed) for n, count in READINGS.items() for seed in range(count)])


def measured(cell: Cell) -> dict[str, Any]:
    """One campaign's row."""
    rng = np.random.default_rng([55, *cell])
    structure, repeats = str(rng.choice(STRUCTURES)), bool(rng.integers(2))
    hidden = ("run", *(f for f in BESIDE if rng.random() < 0.5))
    low, high = np.log(OFFSETS)
    offsets = float(np.exp(rng.uniform(low, high)))
    made = drawn(rng, structure, repeats, cell.readings, hidden, recorded=True, offsets=offsets)
    name = sorted(INSTRUMENTS)[int(rng.integers(2))]
    instrument = INSTRUMENTS[name]
    path, seconds = calibrated(made, instrument)
    row = {"structure": structure, "repeats": repeats, "instrument": name, "offsets": offsets}
    row |= {**outcome(path, made), "seconds": seconds}
    other = _other(rng, made)
    for kind, record in (*made.later.items(), ("unit", other.later["same"])):
        row[f"held_{kind}"] = judged_by(path.steps, read(made, record, instrument, LATER))
    return row


def _other(rng: np.random.Generator, campaign: Campaign) -> Campaign:
    """The same hold-out runs of another unit: another zero and another slope."""
    zero, slope = rng.normal(0.0, UNITS)
    middle = campaign.sensor.middle
    later = {
        kind: replace(r, output=r.output + zero + slope * (r.inner - middle))
        for kind, r in campaign.later.items()
    }
    return replace(campaign, later=later)


def main(arguments: Sequence[str] = ()) -> None:
    """Run what is missing, and render the page."""
    if go_through(plan(), measured, PATH, arguments) == PATH:
        page.write()


if __name__ == "__main__":
    main(sys.argv[1:])
