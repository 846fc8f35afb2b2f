"""Effects hidden in campaigns of three axes and of a dividing head: rates of detection and of false discovery.

Accelerometers in 14 poses at each of five temperatures, gyroscopes on a rate table at the same temperatures, and an
accelerometer on a dividing head in 24 positions. In every other campaign one effect is hidden, of log-uniform size
from hardly detectable to obvious. Each is searched as by `calibrate`, without its fits and checks.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bayescal._search.structures import Structure
from bayescal_models.accelerometer_triad import Campaign as Poses
from bayescal_models.gyro_triad.campaign import Campaign as Rates
from benchmarks.bank import Bank
from benchmarks.hidden_effects.bank import instrument_named
from benchmarks.hidden_effects.searched import Searched
from benchmarks.pages import Rows

CAMPAIGNS = {"triad": 800, "head": 200}  # half of them with an effect
SAMPLE = 60  # campaigns that a release measures anew
TEMPERATURES = (-20.0, 0.0, 25.0, 50.0, 70.0)  # °C
PLANS: dict[str, dict[str, Any]] = {
    "accelerometer_triad": {"campaign": Poses(poses=14, temperatures=TEMPERATURES)},
    "gyro_triad": {"campaign": Rates(temperatures=TEMPERATURES)},
    "accelerometer_dividing_head": {},
}
# Least and largest size, in the unit of the effect's coefficients: from hardly visible to plain at these campaigns.
SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "accelerometer_triad": {
        "square.constant": (1.0, 15.0),
        "misalignment.temperature": (0.01, 0.1),
        "bias.thermal_lag": (0.05, 1.0),
    },
    "gyro_triad": {
        "bias.g_sensitivity": (0.01, 0.2),
        "square.constant": (0.3, 10.0),
        "misalignment.temperature": (0.003, 0.06),
        "bias.thermal_lag": (5e-4, 0.03),
    },
    "accelerometer_dividing_head": {
        "second_order.constant": (2.0, 40.0),
        "third_order.constant": (4.0, 80.0),
        "zero.temperature": (0.03, 0.6),
    },
}


def cases() -> Iterator[tuple[tuple[str, int], tuple[str, int]]]:
    """Yield the campaigns, with instruments in turn."""
    *triads, head = PLANS
    pairs = [(triads[seed // 2 % 2], seed) for seed in range(CAMPAIGNS["triad"])]
    pairs += [(head, seed) for seed in range(CAMPAIGNS["head"])]
    return ((case, case) for case in pairs)


def measure(case: tuple[str, int]) -> dict[str, Any]:
    """Return the row of a campaign."""
    name, seed = case
    hidden: Any = {}
    triad, kind = name.endswith("_triad"), ""
    if seed % 2:
        turn, kinds = seed // (4 if triad else 2), tuple(SIZES[name])
        kind = kinds[turn % len(kinds)]
        random, (low, high) = np.random.default_rng([seed, 2]), np.log(SIZES[name][kind])
        size = float(np.exp(random.uniform(low, high)))
        size *= 1.0 if triad else random.choice([-1.0, 1.0])
        one_axis = tuple(size * np.roll([1.0, 0.0, 0.0], turn))
        hidden = {kind: one_axis if kind == "bias.thermal_lag" else size}
    instrument = instrument_named(name)
    readings = instrument.simulate(hidden, seed=seed, **PLANS[name])
    searched = Searched.of(instrument.for_readings(readings).baseline(), readings)
    row = {
        "hidden": hidden,
        "final": searched.reported_names(searched.chosen),
        "nothing": searched.posterior.completeness(),
        "sets": [[list(s.effects), s.probability] for s in searched.sets],
    }
    if hidden:
        truth = searched.structures.evaluate(Structure(frozenset({kind})), searched.base)
        row["oracle"] = truth.log_evidence - searched.base.log_evidence
    return row


BANKS = (Bank("triads", cases, measure, ("instrument", "seed")),)


def results() -> dict[str, Rows]:
    """Return the rows of each instrument, in the form of the bank of hidden effects."""
    rows = [{**r, "kind": "single" if r["hidden"] else "empty"} for r in BANKS[0].rows]
    return {name: [r for r in rows if r["instrument"] == name] for name in PLANS}
