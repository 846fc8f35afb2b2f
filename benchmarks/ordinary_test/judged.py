"""Calibration of one campaign from its file, as by a user, and comparison of the result with the truth."""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from benchmarks.ordinary_test import naming
from benchmarks.ordinary_test.worlds import Campaign, Record, within_runs

INSTRUMENTS = {"mems_gyro": mems_gyro.INSTRUMENT, "still_sensor": still_sensor.INSTRUMENT}
LATER = 101  # label of the first hold-out run
ORDER = 20261126  # seed of every order, drawn before anything was measured


def in_order(cells: Sequence[Any]) -> list[Any]:
    """Return the campaigns of a plan in order of measurement."""
    shuffled = list(cells)
    random.Random(ORDER).shuffle(shuffled)
    return shuffled


def read(campaign: Campaign, record: Record, instrument: bc.Instrument, first: int = 1):
    """Read a file with a record."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        pd.DataFrame(campaign.file(record, first)).to_csv(path, index=False)
        return bc.read(path, instrument)


def calibrated(campaign: Campaign, instrument: bc.Instrument) -> tuple[bc.SearchPath, float]:
    """Run the search; return its path and processor seconds."""
    start = time.process_time()
    readings = read(campaign, campaign.fitted, instrument)
    model = instrument.for_readings(readings).baseline()
    return bc.calibrate(model, readings), time.process_time() - start


def judged(campaign: Campaign, name: str) -> dict[str, Any]:
    """Calibrate a campaign read as an instrument of this name; return the comparison with the truth."""
    instrument = INSTRUMENTS[name]
    path, seconds = calibrated(campaign, instrument)
    row = {"instrument": name, **outcome(path, campaign), "seconds": seconds}
    true, error_sets = campaign.errors_of_true(), {}
    for kind, record in campaign.later.items():
        later = read(campaign, record, instrument, LATER)
        prediction = bc.predict(path.calibration, later)
        errors = within_runs(prediction.residual, record.run), float(prediction.rmse)
        error_sets[kind] = {"tool": errors[0], "true": true[kind], "with_offsets": errors[1]}
    return {**row, "holdout": error_sets}


def outcome(path: bc.SearchPath, campaign: Campaign) -> dict[str, Any]:
    """Return the truth, the result of the search, and the coefficients."""
    answer = _search_answer(path)
    coefficients = _coefficients(path.calibration, campaign, answer["final"])
    return {**_true(campaign), **answer, "coefficients": coefficients}


def _true(campaign: Campaign) -> dict[str, Any]:
    sensor = campaign.sensor
    return {
        "hidden": list(campaign.hidden),
        "oracle": campaign.oracle(),
        "truth": {
            "noise": sensor.noise,
            "slope": sensor.slope,
            "share": sensor.share,
            "time": sensor.body.behind,
            "sizes": dict(sensor.sizes),
            "readings": len(campaign.fitted.time),
            "runs": len(np.unique(campaign.fitted.run)),
            "recorded": campaign.recorded,
        },
    }


def _search_answer(path: bc.SearchPath) -> dict[str, Any]:
    """Return the result of the search: names, probabilities and sentences."""
    final, base = path.final, {*path.steps[0].calibration.model.names}
    effects = [e for e in final.calibration.model.effects if e.name not in base]
    inclusion: dict[str, float] = {}
    for share in path.shares:
        for effect in share.effects:
            inclusion[effect] = inclusion.get(effect, 0.0) + share.probability
    discovery = final.discovery
    sets = {
        tuple(s.effects): s.probability
        for step in path.steps
        if step.discovery
        for s in step.discovery.findings
    }
    return {
        "final": [e.name for e in effects],
        "equations": {e.name: e.equation for e in effects},
        "noise_law": final.calibration.model.noise.law,
        "inclusion": inclusion,
        "missing": {}
        if discovery is None
        else {c.effect: c.probability for c in discovery.candidates if (c.probability or 0) > 0.01},
        "sets": [[list(members), p] for members, p in sets.items()],
        "complete": None if discovery is None else discovery.nothing_missing,
        "status": 0 if path.ok else 1,
        "reason": "" if path.ok else path.gate.reason,
        "notes": list(final.calibration.verdict.notes),
        "flags": list(final.calibration.readings.flags),
    }


def _coefficients(
    calibration: bc.Calibration, campaign: Campaign, final: Collection[str]
) -> dict[str, Any]:
    """Return each coefficient with a truth: mean, standard uncertainty, 95 % interval, and truth.

    The truth is the steady-state output as a power series about the calibration's T0: constant (mean of runs and
    supply), slope, quadratic; the sensitivity to the supply; the time constant of a single body; the size of an
    additional lag.
    """
    sensor, names = campaign.sensor, [str(n) for n in calibration.posterior]
    T0 = calibration.reference["T0"]
    assert isinstance(T0, float)
    step = np.linspace(-10.0, 10.0, 21)
    settled = np.polynomial.polynomial.polyfit(step, sensor.settled(T0 + step), 2)
    truths: dict[str, tuple[Iterable[str], float]] = {"slope": (["bias.temperature"], settled[1])}
    if "run" not in campaign.hidden and "supply" not in campaign.hidden:
        truths["constant"] = (["bias.constant"], settled[0])
    if "curve" in campaign.hidden:
        truths["quadratic"] = (["bias.temperature_quadratic"], settled[2])
    if "supply" in campaign.hidden:
        supply = [n for n in names if "supply" in n and "unknown" not in n and "." not in n[5:]]
        truths["supply"] = (supply, sensor.sizes["supply"])
    if sensor.structure in ("die", "added"):
        lags = [f"{n}.tau" for n in final if naming.family(n) == "lag"]
        truths["time"] = (lags, sensor.body.behind)
    if sensor.structure == "added":
        truths["lag"] = (["bias.thermal_lag"], sensor.share * sensor.slope)
    stated = {"bias.constant", "bias.temperature", *final, *(f"{n}.tau" for n in final)}
    rows = {}
    for what, (supply, true) in truths.items():
        present = [n for n in supply if n in names]
        if len(present) != 1:
            continue
        draws = calibration.samples(present[0])
        if (freed := f"{present[0]}.freed") in names:  # what its stated size does not reach
            draws = draws + calibration.samples(freed)
        low, high = np.quantile(draws, [0.025, 0.975]).tolist()
        rows[what] = {
            "name": present[0],
            "mean": float(np.mean(draws)),
            "sd": float(np.std(draws)),
            "low": low,
            "high": high,
            "true": float(true),
            "inside": bool(low <= true <= high),
            "stated": present[0] in stated,
        }
    return rows
