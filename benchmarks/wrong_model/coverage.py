"""What is stated after a search where effects of every size are hidden: intervals, probabilities, completeness.

    python -m benchmarks wrong_model

Campaigns of three instruments whose laws are none of the catalogue's, fitted by `calibrate` alone. A line a campaign in
results/wrong_model_INSTRUMENT.jsonl.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import bayescal as bc
import bayescal_models.inclinometer
from bayescal_models import mems_gyro, quartz_beam_accelerometer
from benchmarks.hidden_effects.resume import chosen, go_on
from benchmarks.record import RESULTS
from benchmarks.wrong_model import page
from benchmarks.wrong_model.worlds import World, gyro, inclinometer, quartz

COUNT = 200  # campaigns of each
WORLDS = {
    "mems_gyro": (mems_gyro.INSTRUMENT, gyro, {"bias": ("constant", "temperature")}),
    "quartz_beam_accelerometer": (
        quartz_beam_accelerometer.INSTRUMENT,
        quartz,
        {
            slot: ("constant_head", *(f"temperature_head{p}" for p in ("", "_quadratic", "_cubic")))
            for slot in ("bias", "scale")
        },
    ),
    "inclinometer": (
        bayescal_models.inclinometer.INSTRUMENT,
        inclinometer,
        {f"zero({axis})": ("constant", "placement") for axis in "xy"},
    ),
}
THERMOMETER = {
    "mems_gyro": "T0",
    "quartz_beam_accelerometer": "temperature_head_0",
    "inclinometer": "T0",
}
RADIAN = np.deg2rad(1.0)  # what a coefficient of sin ω adds to the slope, by degree
# What an average may hold beside a coefficient that is the same at ω = 0: their sum has the truth.
BESIDE = {
    "zero.constant": {
        "zero.projection[pendulum]": 1.0,
        "dividing.wobble[cos1]": 1.0,
        "dividing.wobble[cos2]": 1.0,
        "dividing.face": 1.0,
    },
    "zero.placement": {
        "zero.projection[door]": RADIAN,
        "zero.cross_axis": RADIAN,
        "dividing.wobble[sin1]": RADIAN,
        "dividing.wobble[sin2]": 2 * RADIAN,
    },
}
Z = 1.959964  # of a 95 % interval


def main() -> None:
    """Run what is missing, and render the page."""
    for name in chosen(WORLDS):
        path = RESULTS / f"wrong_model_{name}.jsonl"
        cases = (((seed,), (name, seed)) for seed in range(COUNT))
        go_on(path, ("seed",), cases, campaign)
    page.write()


def campaign(case: tuple[str, int]) -> tuple[dict[str, Any], str]:
    """One campaign as `calibrate` leaves it."""
    name, seed = case
    instrument, made, powers = WORLDS[name]
    world: World = made(seed)
    begun = time.perf_counter()
    path = bc.calibrate(instrument.baseline(), world.readings, method=bc.Marginal())
    used, best = path.calibration, path.final.calibration
    found = path.final.discovery
    shares = {s.effects: s.probability for s in path.shares} or {
        tuple(n for n in best.model.names if n not in instrument.baseline().names): 1.0
    }
    inclusion: dict[str, float] = {}
    for effects, probability in shares.items():
        for effect in effects:
            inclusion[effect] = inclusion.get(effect, 0.0) + probability
    row = {
        "seed": seed,
        "hidden": world.hidden,
        "final": [n for n in best.model.names if n not in instrument.baseline().names],
        "shares": [[list(e), p] for e, p in shares.items()],
        "inclusion": inclusion,
        "missing": {}
        if found is None
        else {c.effect: c.probability for c in found.candidates if c.probability},
        "unseen": [] if found is None else list(found.unseen),
        "sets": [] if found is None else [list(s.effects) for s in found.sets],
        "complete": None if found is None else found.nothing_missing,
        "open": path.gate.ok,
        "reason": path.gate.reason,
        "used": _covered(used, world, powers),
        "best": _covered(best, world, powers),
        "baseline": _covered(path.steps[0].calibration, world, powers),
        "seconds": time.perf_counter() - begun,
    }
    return row, f"{name} {seed} {sorted(world.hidden)} {row['final']} {row['used']['later']:.2f}"


def _covered(calibration: bc.Calibration, world: World, powers: Any) -> dict[str, Any]:
    """Shares of readings and of coefficients whose 95 % interval holds the truth, and the widths of the intervals."""
    row: dict[str, Any] = {}
    for kind, readings, truth in (
        ("fitted", None, world.truth),
        ("later", world.later, world.later_truth),
    ):
        p = bc.predict(calibration, readings)
        row[kind] = float(np.mean(np.abs(p.mean - truth) <= Z * p.model_sd))
        row[f"{kind}_sd"] = float(np.sqrt(np.mean(p.model_sd**2)))
        row[f"{kind}_error"] = float(np.sqrt(np.mean((p.mean - truth) ** 2)))
    reference = calibration.reference[THERMOMETER[calibration.model.instrument.name]]
    assert isinstance(reference, float)
    for slot, names in powers.items():
        for name, truth in zip(names, world.about(slot, reference, len(names)), strict=True):
            draws = _draws(calibration, slot, name)
            row[f"{slot}.{name}"] = [float(np.mean(draws)), float(np.std(draws)), float(truth)]
    return row


def _draws(calibration: bc.Calibration, slot: str, name: str) -> np.ndarray:
    """Draws of a baseline's coefficient; of "zero(x)" those of the axis x, with what is the same as they."""
    base, _, axis = slot.rstrip(")").partition("(")
    found = calibration.samples(f"{base}.{name}")
    for other, factor in BESIDE.get(f"{base}.{name}", {}).items():
        if other in calibration.posterior:
            values = factor * calibration.samples(other)
            found = found + (values if values.ndim == found.ndim else values[:, None])
    return found[:, calibration.levels["axis"].index(axis)] if axis else found
