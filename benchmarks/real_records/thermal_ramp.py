"""One inertial unit at rest on a temperature ramp: what is found in each channel, and does it hold?

Each channel of a measured record is calibrated twice with `still_sensor`, as a user would: with its
last fifth held out, and with every second block of five minutes held out. Results go to
`benchmarks/results/thermal_ramp.json`, and from there to `docs/thermal_ramp.md`, a picture each.

The record is not part of this repository. It is looked for in `../shared/data`, or in `data` of the
folder that BAYESCAL_SHARED names; where it is absent, nothing is done. BAYESCAL_AXES="acc_x gyro_z"
measures some channels only, and leaves the others' results as they are; BAYESCAL_AXES=unit the six together.
"""

from __future__ import annotations

import os
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._data.set_aside import set_aside
from bayescal_models import still_sensor
from benchmarks.real_records import ramp_recipes, thermal_ramp_page
from benchmarks.record import DOCS, REFERENCE_DATA, read, write

RECORD = Path("thermal_ramp") / "imu_thermal_ramp.csv"
AXES = {
    **dict.fromkeys(("gyro_x", "gyro_y", "gyro_z"), "rad/s"),  # deg/s, the record says: doubtful
    **dict.fromkeys(("acc_x", "acc_y", "acc_z"), "m/s^2"),
}
BLOCK = 300.0  # s
UNIT = "unit"  # all six channels together
SPLITS = ("last fifth", "alternate blocks")
Z = 1.959964  # of a 95 % interval
LAST = 0.8  # share of the record that is fitted where the end is held out


def record_file() -> Path | None:
    """The record, if it is there."""
    own = os.environ.get("BAYESCAL_SHARED")
    path = (Path(own) / "data" if own else REFERENCE_DATA) / RECORD
    return path if path.is_file() else None


def main() -> None:
    """Measure the channels asked for, and render the page."""
    path = record_file()
    if path is None:
        print(f"thermal_ramp: skipped, no {RECORD}; BAYESCAL_SHARED may name its folder")
        return
    asked = os.environ.get("BAYESCAL_AXES", "").split() or [*AXES, UNIT]
    if unknown := set(asked) - {*AXES, UNIT}:
        raise SystemExit(
            f"thermal_ramp: no channel {', '.join(unknown)}; there are {', '.join(AXES)}"
        )
    results = {"channels": {}, "alone": {}, **read("thermal_ramp")}
    results["recipes"] = recipes(path)
    if asked == [*AXES, UNIT]:  # remarks are of rows that were measured otherwise
        results.pop("remarks", None)
    _keep(results)
    for axis in asked:
        if axis == UNIT:
            for split in SPLITS:
                results[UNIT] = {**results.get(UNIT, {}), split: as_unit(path, split)}
                _keep(results)
            continue
        measured = measure(path, axis)
        results["channels"][axis] = measured
        for split, found in measured.items():
            error = found["steps"][-1]["held_out_in_record"]
            results["alone"].setdefault(split, {})[axis] = error
            results.setdefault("going_on", {}).setdefault(split, {})[axis] = found["going_on"]
        _keep(results)


def _keep(results: dict[str, Any]) -> None:
    channels = results["channels"]
    results["channels"] = {name: channels[name] for name in AXES if name in channels}
    write("thermal_ramp", results)
    thermal_ramp_page.write(results)


def splits(seconds: np.ndarray) -> dict[str, np.ndarray]:
    """Which readings are held out, of each split."""
    return {
        "last fifth": np.arange(seconds.size) >= LAST * seconds.size,
        "alternate blocks": (seconds // BLOCK).astype(int) % 2 == 1,
    }


def recipes(path: Path) -> dict[str, Any]:
    """Held-out errors of what is customary: split → recipe → channel, in the unit that bayescal keeps."""
    outputs = {}
    for axis in AXES:
        readings = _read(path, axis)
        spikes = ~np.isin(readings["time"], set_aside(readings)["time"])
        outputs[axis] = np.where(spikes, np.nan, readings["output"])
    time_, temperature = readings["time"], readings["temperature"]
    return {
        name: ramp_recipes.errors(time_, temperature, outputs, held)
        for name, held in splits(time_).items()
    }


def measure(path: Path, axis: str) -> dict[str, Any]:
    """Both calibrations of one channel, as plain data; draws its picture."""
    lines = path.read_text("utf-8").splitlines(keepends=True)
    seconds = np.array([float(line.split(",")[-1]) for line in lines[1:]])
    results = {}
    for name, held in splits(seconds).items():
        print(f"thermal_ramp: {axis}, {name} held out", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            fitted, held_out_file = Path(folder) / "fitted.csv", Path(folder) / "held_out.csv"
            for part, rows in ((fitted, ~held), (held_out_file, held)):
                kept = (line for line, keep in zip(lines[1:], rows, strict=True) if keep)
                part.write_text(lines[0] + "".join(kept), "utf-8")
            trail, times = calibrated(fitted, held_out_file, axis)
        results[name] = {**summary(trail, _read(path, axis, trail)), **times}
        if name == "alternate blocks":
            bc.plot.save(bc.plot.loop(trail), DOCS / f"thermal_ramp_{axis}.png")
    return results


def as_unit(path: Path, split: str) -> dict[str, Any]:
    """The six channels calibrated together: held-out errors, what was found, and what it took."""
    print(f"thermal_ramp: as one unit, {split} held out", flush=True)
    whole = {axis: _read(path, axis) for axis in AXES}
    held = splits(whole["gyro_x"]["time"])[split]
    fitted = {axis: readings.select(~held) for axis, readings in whole.items()}
    kept = {axis: readings.select(held) for axis, readings in whole.items()}
    models = {
        axis: still_sensor.INSTRUMENT.for_readings(readings).baseline()
        for axis, readings in fitted.items()
    }
    wall, cpu = time.perf_counter(), time.process_time()
    found = bc.calibrate_channels(models, fitted, holdout=kept)
    taken = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    results: dict[str, Any] = {"errors": {}, "inside": {}, "steps": {}, "added": {}, **taken}
    for axis, trail in found.trails.items():
        assert trail.holdout is not None
        outside = np.isin(whole[axis]["time"], trail.holdout["time"])
        predicted = [bc.predict(s.calibration, whole[axis], same_record=True) for s in trail.steps]
        errors = [float(np.sqrt(np.mean(p.residual[outside] ** 2))) for p in predicted]
        last = predicted[-1]
        wander = 0.0 if last.correlated_noise is None else np.nan_to_num(last.correlated_noise)
        results["errors"][axis] = errors[-1]
        inside = (last.residual - wander)[outside]
        results["inside"][axis] = float(np.sqrt(np.mean(inside**2)))
        results["steps"][axis] = dict(zip((s.title for s in trail.steps), errors, strict=True))
        results["added"][axis] = list(trail.final.calibration.model.names[2:])
        results.setdefault("gate", {})[axis] = [trail.ok, trail.gate.reason]
    results["shared"] = [
        [s.effect, s.probability, *s.posterior, {n: s.evidence(n) for n in s.says}]
        for s in found.shared
    ]
    return results


def calibrated(fitted: Path, held_out: Path, axis: str) -> tuple[bc.SearchPath, dict[str, float]]:
    """The loop on one file with another held out, and what it took, s."""
    wall, cpu = time.perf_counter(), time.process_time()
    readings = _read(fitted, axis)
    instrument = still_sensor.INSTRUMENT.for_readings(readings)
    holdout = bc.read(held_out, instrument, **_names(axis))
    trail = bc.calibrate(instrument.baseline(), readings, holdout=holdout)
    taken = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    return trail, taken


def summary(trail: bc.SearchPath, whole: bc.Measurements) -> dict[str, Any]:
    """What the page says of a trail.

    Args:
        trail: of a calibration with readings held out.
        whole: the undivided record. Held-out errors of a lag or a rate depend on the temperature's
            past; `held_out_in_record` has it, `held_out` starts anew where the held-out file does.
    """
    assert trail.holdout is not None
    held = np.isin(whole["time"], trail.holdout["time"])
    steps = []
    for step in trail.steps:
        residual = bc.predict(step.calibration, whole).residual[held]
        evidence = step.calibration.log_evidence
        steps.append(
            {
                "step": step.title,
                "added": step.added,
                "noise": step.calibration.model.noise.law,
                "fitted": step.rmse,
                "held_out": step.holdout_rmse,
                "held_out_in_record": float(np.sqrt(np.mean(residual**2))),
                "noise_floor": step.noise_floor,
                "log_evidence": None if evidence is None else evidence[0],
                "nothing_missing": None
                if step.discovery is None
                else step.discovery.nothing_missing,
            }
        )
    final = trail.final.calibration
    used = bc.predict(trail.calibration, trail.holdout)
    return {
        "going_on": used.rmse,
        "covered": float(np.mean(np.abs(used.residual) <= Z * used.sd)),
        "unit": final.unit,
        "rows": [len(final.readings), len(trail.holdout)],
        "effects": list(final.model.names),
        "steps": steps,
        "raised_held_out_error": raising(steps),
        "ok": trail.ok,
        "gate": trail.gate.reason,
        "flags": [f for f in (*final.readings.flags, *trail.holdout.flags) if "spike" in f],
        "coefficients": {
            name: [float(np.mean(values)), float(np.std(values))]
            for name, values in ((n, final.samples(n)) for n in final.model.unknowns)
        },
    }


def raising(steps: list[dict[str, Any]]) -> list[str]:
    """Steps that raised the error of the held-out readings by more than 1 %."""
    return [b["step"] for a, b in pairwise(steps) if b["held_out"] > 1.01 * a["held_out"]]


def _names(axis: str) -> dict[str, Any]:
    return {
        "columns": {"output": axis, "time": "t_s"},
        "units": {axis: AXES[axis], "t_s": "s", "temperature": "degC"},
    }


def _read(path: Path, axis: str, trail: bc.SearchPath | None = None) -> bc.Measurements:
    instrument = (
        still_sensor.INSTRUMENT if trail is None else trail.final.calibration.model.instrument
    )
    return bc.read(path, instrument, **_names(axis))
