"""Three hundred records without faults: how often is a result not reliable, or a thermometer questioned?

Fifty campaigns of each of six instruments, from its own simulator, in chambers that step within seconds, ramp and
hold; half of them have effects of the bank of hidden effects, at its sizes. Every second campaign of the two
instruments at rest is one of the ordinary test.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

import bayescal as bc
from bayescal_models import (
    differential_pair,
    inclinometer,
    mems_gyro,
    ng_accelerometer,
    quartz_beam_accelerometer,
)
from benchmarks.bank import Bank
from benchmarks.hidden_effects.bank import Case, instrument_named
from benchmarks.hidden_effects.bank import plan as bank
from benchmarks.ordinary_test.judged import INSTRUMENTS, calibrated, in_order
from benchmarks.ordinary_test.measurement import FURTHER
from benchmarks.ordinary_test.worlds import STRUCTURES, drawn

SAMPLE = 24  # records that a release measures anew
COUNT = 60  # records, the first of the order
PER_INSTRUMENT = 50
KINDS = ("single", "pair")  # of the bank's campaigns, from which hidden effects are
READINGS = (200, 1600)  # of the ordinary test's worlds
DOUBT = re.compile("thermometer|[Cc]olumn '?temperature|column temperature")

_Gyro, _Quartz, _Ng = mems_gyro.Campaign, quartz_beam_accelerometer.Campaign, ng_accelerometer
TURNED = (0.0, 100.0, -100.0)
CAMPAIGNS: Mapping[str, Sequence[dict[str, Any]]] = {
    "mems_gyro": [
        {"campaign": _Gyro(rate_input=TURNED)},
        {"campaign": _Gyro(rate_input=TURNED, chamber_time=3.0, chamber_ramp=600.0)},
        {"campaign": _Gyro(rate_input=TURNED, dwell=1200.0, average=60.0)},
        {"campaign": _Gyro(rate_input=TURNED, chamber_ramp=1.0, dwell=600.0)},
    ],
    "still_sensor": [
        {},
        {"interval": 60},
        {"runs": 2, "interval": 30},
        {"runs": 5, "interval": 60},
    ],
    "quartz_beam_accelerometer": [
        {},
        {"campaign": _Quartz(chamber_speed=60.0, air_time=5.0)},
        {"campaign": _Quartz(hold=7200.0, interval=120.0, average=120.0)},
        {"campaign": _Quartz(ramp_speeds=(0.5, 4.0), interval=120.0, average=120.0)},
    ],
    "ng_accelerometer": [
        {},
        {"campaign": _Ng.Campaign(ramp=60.0, soak=600.0)},
        {"campaign": _Ng.Campaign(alternate=True)},
        {"campaign": _Ng.Campaign(temperatures=(0.0, 20.0, 40.0, 60.0), soak=3 * 3600.0)},
    ],
    "inclinometer": [
        {},
        {"campaign": inclinometer.Campaign(swing=8.0)},
        {"campaign": inclinometer.Campaign(runs=4)},
        {"campaign": inclinometer.Campaign(interval=600.0)},
    ],
    "differential_pair": [
        {},
        {"campaign": differential_pair.Campaign(samples=80)},
        {"campaign": differential_pair.Campaign(warming=15.0)},
        {"campaign": differential_pair.Campaign(ramp=5.0)},
    ],
}


class Cell(NamedTuple):
    """One campaign of the plan."""

    instrument: str
    seed: int


def plan() -> list[Cell]:
    """Return the measured campaigns, in order."""
    cells = [Cell(name, seed) for name in CAMPAIGNS for seed in range(PER_INSTRUMENT)]
    return in_order(cells)[:COUNT]


def measured(cell: Cell) -> dict[str, Any]:
    """Return the row of one campaign."""
    rng = np.random.default_rng([56, list(CAMPAIGNS).index(cell.instrument), cell.seed])
    ordinary = cell.instrument in INSTRUMENTS and cell.seed % 2
    world, search = (_of_the_ordinary_test if ordinary else _of_its_simulator)(rng, cell)
    path, seconds = search()
    names, base = path.final.calibration.model.names, path.steps[0].calibration.model.names
    verdict, readings = path.final.calibration.verdict, path.final.calibration.readings
    record = {
        "reason": "" if path.ok else path.gate.reason,
        "flags": " ".join(readings.flags),
        "notes": " ".join(verdict.notes),
    }
    return {
        **world,
        "final": [n for n in names if n not in base],
        "status": 0 if path.ok else 1,
        **record,
        "doubted": [where for where, words in record.items() if DOUBT.search(words)],
        "seconds": seconds,
    }


Calibration = tuple[dict[str, Any], Callable[[], tuple[bc.SearchPath, float]]]


def _of_the_ordinary_test(rng: np.random.Generator, cell: Cell) -> Calibration:
    """Simulate and calibrate a campaign of `worlds.py`."""
    structure, repeats = str(rng.choice(("none", *STRUCTURES))), bool(rng.integers(2))
    hidden = tuple(f for f in FURTHER if rng.random() < 0.25)
    whole = (structure, repeats, int(rng.choice(READINGS)), hidden)
    campaign = drawn(rng, *whole, recorded=bool(rng.integers(2)) or "supply" in hidden)
    world = {"world": "ordinary test", "hidden": list(campaign.hidden)}
    return world, lambda: calibrated(campaign, INSTRUMENTS[cell.instrument])


def _of_its_simulator(rng: np.random.Generator, cell: Cell) -> Calibration:
    """Simulate a campaign by the instrument's own simulator, in one of its chambers, and calibrate it."""
    instrument = instrument_named(cell.instrument)
    at = int(rng.integers(len(CAMPAIGNS[cell.instrument])))
    hidden = _hidden(rng, instrument) if rng.random() < 0.5 else {}
    assert instrument.simulate is not None
    options = CAMPAIGNS[cell.instrument][at]
    readings = instrument.simulate(hidden, seed=700_000 + cell.seed, **options)

    def calibrate() -> tuple[bc.SearchPath, float]:
        start = time.process_time()
        path = bc.calibrate(instrument.for_readings(readings).baseline(), readings)
        return path, time.process_time() - start

    return {"world": f"its own, {at}", "hidden": list(hidden)}, calibrate


def _hidden(rng: np.random.Generator, instrument: bc.Instrument) -> dict[str, float]:
    """Draw the effects of one of the bank's campaigns."""
    cases: list[Case] = [c for c in bank(instrument) if c.kind in KINDS]
    return cases[int(rng.integers(len(cases)))].hidden


BANKS = (Bank("good_records", lambda: ((tuple(c), c) for c in plan()), measured, Cell._fields),)
