"""Public records of others' triads: an inertial unit in poses and moves, and magnetometers turned by hand.

    python -m benchmarks triads_of_others

* An Xsens MTi in 38 poses (D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014), of the repository Kyle-ak/imu_tk, BSD
  licence: `bin/test_data/xsens_acc.mat` and `xsens_gyro.mat`. The factory's sheet has the accelerometers' offsets.
* A QMC5883L at ±2 G turned by hand, of the repository tomisuarez2/MagnetometerCalibration, MIT licence:
  `calibration data/filtered_raw_data.csv`, and its own calibration in `optimization result data/paramters_mag.csv`.

These files are not part of this repository. They are looked for in `three_axes` of `../shared/data`, or of `data` in
the folder that BAYESCAL_SHARED names; where they are absent, nothing is done. Results go to
`benchmarks/results/triads_of_others.json`, and from there to `docs/records_of_others.md`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import accelerometer_triad, gyro_triad, magnetometer_triad
from benchmarks.real_records import records_page
from benchmarks.record import REFERENCE_DATA, read, write

FILES = ("xsens_acc.mat", "xsens_gyro.mat", "filtered_raw_data.csv", "paramters_mag.csv")
AXES = "xyz"
MIDDLE = 32768.0  # counts of a 16-bit converter at nothing
SHEET = (33123.0, 33276.0, 32360.0)  # the factory's offsets of the accelerometers, counts
PER_G = 415.0 * 9.81744  # counts, nominal; local gravity as imu_tk's example has it
PER_RATE = 6258.0 * np.pi / 180  # counts per °/s, as imu_tk's example has it, a quarter off
PER_FIELD = 120.0  # counts per µT: 12,000 per gauss, QMC5883L data sheet 1.0
FIELD = 23.6  # µT, about the field at Mendoza, where it was turned: a common factor of all scale factors
# A second calibration of the same magnetometers, which that repository's README prints: matrix by rows, bias.
PRINTED = np.array(
    [
        *(9.23963302e-04, -2.28276038e-05, -1.26491570e-05),
        *(-3.26463689e-05, 1.39419601e-03, -8.31640876e-05),
        *(9.24662679e-07, 5.04342440e-05, 6.25530654e-04),
        *(-5.6742573, 0.1399525, -2.19375634),
    ]
)
STILL = 3000  # samples of the first minute, in which the record rests
EVERY = 25  # of the samples after it is fitted, half a second apart; all are corrected


def main() -> None:
    """Measure what is there, and render the page."""
    own = os.environ.get("BAYESCAL_SHARED")
    folder = (Path(own) / "data" if own else REFERENCE_DATA) / "three_axes"
    if lacking := [name for name in FILES if not (folder / name).is_file()]:
        print(f"triads_of_others: skipped, no {', '.join(lacking)} in {folder.name}")
        return
    write("triads_of_others", {**inertial(folder), **magnetic(folder)})
    print(read("triads_of_others"))
    records_page.write(read("records_of_others")["records"])


def inertial(folder: Path) -> dict[str, Any]:
    """Accelerometers by their poses, and gyroscopes by the moves between these."""
    force, turns = accelerometer_triad.INSTRUMENT, gyro_triad.INSTRUMENT
    logs = []
    for instrument, name, scale in (
        (force, "xsens_acc.mat", PER_G),
        (turns, "xsens_gyro.mat", PER_RATE),
    ):
        table = np.loadtxt(folder / name)
        logs.append(_read(instrument, (table[:, 1:] - MIDDLE) / scale, table[:, 0]))
    began = time.process_time()
    poses = bc.poses(logs[0], force)
    found = bc.calibrate(force.baseline(), poses)
    correct = bc.vector_correction(found.calibration)
    offset, sd = MIDDLE + PER_G * correct.offset, PER_G * correct.uncertainty[0, :3]
    accelerometers = {
        "poses": len(poses),
        "offsets": [[float(o), float(s)] for o, s in zip(offset, sd, strict=True)],
        "from_sheet": (offset - SHEET).tolist(),
        "noise_ug": 1e6 * float(found.final.calibration.samples("noise.white").mean()),
        **_ending(found, time.process_time() - began),
    }
    began = time.process_time()
    rows = bc.moves(logs[1], turns, logs[0], correct)
    found = bc.calibrate(gyro_triad.moved(), rows)
    final = found.final.calibration
    names = [f"{a}{b}" for a in AXES for b in AXES]
    sensitivity = {
        n: [float(v.mean()), float(v.std())]
        for n in (names if "bias.g_sensitivity" in final.model.names else ())
        for v in (final.samples(f"bias.g_sensitivity[{n}]"),)
    }
    evidence = [s.calibration.log_evidence for s in (found.steps[0], found.final)]
    before, after = (float("nan") if one is None else float(one[0]) for one in evidence)
    gyroscopes = {
        "readings": len(rows),
        "g_sensitivity": sensitivity,
        "log_bayes_factor": after - before,
        **_ending(found, time.process_time() - began),
    }
    return {"accelerometers": accelerometers, "gyroscopes": gyroscopes}


def magnetic(folder: Path) -> dict[str, Any]:
    """Magnetometers by some of their samples, and the scatter of all beside that of their own calibration."""
    instrument = magnetometer_triad.INSTRUMENT
    raw = np.genfromtxt(folder / "filtered_raw_data.csv", delimiter=",", skip_header=3)
    own = np.loadtxt(folder / "paramters_mag.csv")
    some = raw[STILL::EVERY] / PER_FIELD
    readings = _read(instrument, some, np.arange(len(some)) * EVERY / 50.0, magnitude=FIELD)
    began = time.process_time()
    fitted = bc.fit(instrument.baseline(), readings)
    correct = bc.vector_correction(fitted)
    field = correct(raw / PER_FIELD, noise=0.0).vector / FIELD
    found = {
        "fitted": len(some),
        "corrected": len(raw),
        "offsets": (PER_FIELD * correct.offset).tolist(),
        "scatter": _scatter(field),
        "scatter_published": [
            _scatter(raw @ other[:9].reshape(3, 3).T + other[9:]) for other in (own, PRINTED)
        ],
        "seconds": time.process_time() - began,
    }
    searched = bc.calibrate(instrument.baseline(), readings)
    return {"magnetometers": {**found, "reason": searched.gate.reason, "ok": searched.ok}}


def _read(
    instrument: bc.Instrument, outputs: np.ndarray, at: np.ndarray, **more: float
) -> bc.Measurements:
    columns: dict[str, Any] = {f"output_{a}": outputs[:, i] for i, a in enumerate(AXES)}
    columns |= {name: np.full(len(at), value) for name, value in more.items()}
    return bc.Measurements.from_arrays(instrument, time=at, **columns)


def _ending(found: bc.SearchPath, seconds: float) -> dict[str, Any]:
    last, first = found.final.calibration.model.names, found.steps[0].calibration.model.names
    added = [n for n in last if n not in first]
    return {"added": added, "ok": found.ok, "reason": found.gate.reason, "seconds": seconds}


def _scatter(vectors: np.ndarray) -> float:
    """Standard deviation of the magnitude over its mean: the unit of the field does not matter."""
    size = np.linalg.norm(vectors, axis=1)
    return float(size.std() / size.mean())
