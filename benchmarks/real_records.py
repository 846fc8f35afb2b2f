"""Public records of sensors: what is known of each, the effects found, and the errors on hold-out data.

A record of NIST's Statistical Reference Datasets has its own instrument: a constant and a line, with a parabola and a
cubic as candidates, and sizes from the range of the sensor. The channels of an inertial unit on a temperature ramp are
read as `still_sensor`. Every second block, in the order of the driving quantity, is hold-out data. The ramp is not in
the repository: it is looked for in `../shared/data`, or in `data` of the folder given by BAYESCAL_SHARED.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

import bayescal as bc
from bayescal import effects
from bayescal._annexes.validation import nist_strd
from bayescal_models import still_sensor
from benchmarks import pages
from benchmarks.record import REFERENCE_DATA, read, today, write

BLOCKS, BLOCK = 20, 300.0  # of equal numbers of readings, by what drives them; s, of the ramp
SOURCE = "plausible size, from the range of the instrument"
LAGS = np.log(np.geomspace(20.0, 3000.0, 25))  # log s
RAMP = "thermal_ramp/imu_thermal_ramp.csv"
AXES = {
    **dict.fromkeys(("gyro_x", "gyro_y", "gyro_z"), "rad/s"),  # deg/s, the record says: doubtful
    **dict.fromkeys(("acc_x", "acc_y", "acc_z"), "m/s^2"),
}


class PublicRecord(NamedTuple):
    """A record of NIST's, and what its owner knows before a calibration.

    Attributes:
        file: file name in the data folder.
        known: the certified model.
        driver, unit: quantity that drives the output, and its unit; "1" if NIST's data state no unit.
        output_unit: unit of the output.
        range: largest value of the driver.
        bias, slope: plausible sizes, in the output unit, and output unit per unit of the driver.
    """

    file: str
    known: str
    driver: str
    unit: str
    output_unit: str
    range: float
    bias: float
    slope: float


RECORDS = {
    "load cell": PublicRecord(
        "linear/pontius.csv",
        "a parabola, −3.161e-15 ± 0.049e-15 for each unit of load squared; residual standard deviation 2.05e-4",
        *("load", "1", "1", 3e6, 1.0, 1e-6),
    ),
    "ozone monitor": PublicRecord(
        "linear/norris.csv",
        "a line, intercept −0.26 ± 0.23, slope 1.00212 ± 0.00043; residual standard deviation 0.885",
        *("concentration", "ppb", "ppb", 1000.0, 10.0, 2.0),
    ),
    "ultrasonic reference block": PublicRecord(
        "nonlinear/Chwirut1.csv",
        "exp(−b₁x)/(b₂ + b₃x); residual standard deviation 3.36",
        *("distance", "1", "1", 6.0, 100.0, 100.0),
    ),
    "dilatometer": PublicRecord(
        "nonlinear/Hahn1.csv",
        "a cubic over a cubic; residual standard deviation 0.082",
        *("temperature", "K", "1", 900.0, 10.0, 0.1),
    ),
    "scanning electron microscope": PublicRecord(
        "nonlinear/Kirby2.csv",
        "a parabola over a parabola; residual standard deviation 0.164",
        *("width", "1", "1", 400.0, 100.0, 1.0),
    ),
}


def instrument_of(record: PublicRecord) -> bc.Instrument:
    """Return an instrument with a constant and a line, and a parabola and a cubic as candidates."""

    def power(name: str, order: int) -> bc.Effect:
        size = record.slope if order == 1 else 0.5 * record.slope * record.range ** (1 - order)
        over = "" if record.unit == "1" else f"/{record.unit}" + (f"^{order}" if order > 1 else "")
        return bc.Effect(
            f"response.{name}",
            "response",
            basis=lambda r: r[record.driver] ** order,
            coefficients=(bc.Coefficient(f"{record.output_unit}{over}", bc.Normal(0.0, size)),),
            columns=(record.driver,),
            source=SOURCE,
        )

    columns = (bc.Column(record.driver, record.unit), bc.Column("output", record.output_unit))
    constant = effects.constant("response", record.bias, record.output_unit, source=SOURCE)
    return bc.Instrument(
        name=record.driver,
        title=record.driver,
        columns=columns,
        slots=(bc.Slot("response", record.output_unit),),
        response=lambda slots, r: slots["response"],
        effects=(constant, power("line", 1)),
        candidates=(power("quadratic", 2), power("cubic", 3)),
        noise=bc.White(bc.HalfCauchy(0.1 * record.bias)),
    )


def measured() -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each available record's name with its results."""
    for title, record in RECORDS.items():
        path = nist_strd.FOLDER / record.file
        y, x = np.genfromtxt(path, delimiter=",", skip_header=1, unpack=True)
        holdout = (np.argsort(np.argsort(x, kind="stable")) * BLOCKS // x.size) % 2 == 1
        instrument = instrument_of(record)
        whole = bc.Measurements.from_arrays(instrument, **{record.driver: x, "output": y})
        row = calibrated(instrument, whole, holdout) | peers(x, y, holdout)
        yield title, {"known": record.known, "unit": record.output_unit, **row}
    path = REFERENCE_DATA / RAMP
    for axis, unit in AXES.items() if path.is_file() else ():
        columns = {"output": axis, "time": "t_s"}
        units = {axis: unit, "t_s": "s", "temperature": "degC"}
        readings = bc.read(path, still_sensor.INSTRUMENT, columns=columns, units=units)
        whole = bc.exclude_faults(readings)
        holdout = (whole["time"] // BLOCK).astype(int) % 2 == 1
        row = calibrated(still_sensor.INSTRUMENT.for_readings(whole), whole, holdout)
        row |= peers(whole["temperature"], whole["output"], holdout, whole["time"])
        yield f"chamber ramp, {axis}", {"known": "", "unit": whole.unit("output"), **row}


def calibrated(
    instrument: bc.Instrument, whole: bc.Measurements, holdout: np.ndarray
) -> dict[str, Any]:
    """Return the results of `calibrate` on a record, and its hold-out error, output unit."""
    start = time.process_time()
    later = whole.select(holdout)
    trail = bc.calibrate(instrument.baseline(), whole.select(~holdout), holdout=later)
    prediction, base = bc.predict(trail.calibration, later), instrument.baseline().names
    return {
        "found": [n for n in trail.final.calibration.model.names if n not in base],
        "ok": trail.ok,
        "reason": trail.gate.reason,
        "error": prediction.rmse,
        "inside": float(np.mean(np.abs(prediction.residual) < 2 * prediction.sd)),
        "seconds": time.process_time() - start,
        "day": today(),
    }


def peers(
    x: np.ndarray, y: np.ndarray, holdout: np.ndarray, clock: np.ndarray | None = None
) -> dict[str, Any]:
    """Return the errors of customary methods: a line, a cubic and, if there is a time, a cubic with one lag."""
    powers = ((x - x.mean()) / np.ptp(x))[:, None] ** np.arange(4)

    def error(columns: np.ndarray) -> tuple[float, float]:
        """Return the errors of fitted and hold-out readings."""
        e = y - columns @ np.linalg.lstsq(columns[~holdout], y[~holdout], rcond=None)[0]
        fitted, other = (float(np.sqrt(np.mean(e[rows] ** 2))) for rows in (~holdout, holdout))
        return fitted, other

    def with_lag(log_tau: float) -> np.ndarray:
        assert clock is not None
        share = np.exp(-float(np.median(np.diff(clock))) / np.exp(log_tau))
        behind, _ = lfilter([1 - share], [1, -share], x, zi=[share * x[0]])
        return np.column_stack([powers, behind - x, np.exp(-(clock - clock[0]) / np.exp(log_tau))])

    errors = {"line": error(powers[:, :2])[1], "cubic": error(powers)[1]}
    if clock is not None:
        best = int(np.argmin([error(with_lag(v))[0] for v in LAGS]))
        ends = LAGS[max(best - 1, 0)], LAGS[min(best + 1, len(LAGS) - 1)]
        at: Any = minimize_scalar(lambda v: error(with_lag(v))[0], bounds=ends, method="bounded")
        errors["cubic + lag"] = error(with_lag(at.x))[1]
    return {"peers": errors}


def main() -> None:
    """Measure the available records."""
    rows: dict[str, Any] = read("real_records").get("rows", {})
    for title, row in measured():
        rows[title] = row
        print(title, row, flush=True)
        write("real_records", {"rows": rows})


def render() -> pages.Texts:
    """Render the page from the stored results."""
    rows: Mapping[str, dict[str, Any]] = read("real_records")["rows"]
    head = ["record", "found besides a line", "hold-out error", "line", "cubic", "cubic + lag"]
    body = []
    for title, row in rows.items():
        others = (row["peers"].get(n) for n in ("line", "cubic", "cubic + lag"))
        errors = ["–" if e is None else f"{e:.3g}" for e in (row["error"], *others)]
        reliable = "yes" if row["ok"] else "no"
        name = f"{title} [{row['unit']}]" + (f": certified {row['known']}" if row["known"] else "")
        names = ", ".join(row["found"]) or "nothing"
        body.append([name, names, *errors, f"{100 * row['inside']:.0f} %", reliable])
    about = """
Public records of sensors that others have built and measured, calibrated as their owners would. Errors: root mean
square of the hold-out readings, every second of twenty blocks (on the ramp: of five minutes), in the record's unit.
*Within 2 u*: of these readings. *Reliable*: by the exit status of the command, from the fitted readings alone. The
chamber ramp is an inertial unit at rest for 71 minutes between −18 and 74 °C (repository tofupilot/examples, MIT
licence; the record labels the rates deg/s, they are read as rad/s here). Load cell (P.
Pontius), ozone monitor (J. Norris), ultrasonic block (D. Chwirut), dilatometer (T. Hahn) and electron microscope
(R. Kirby): [NIST's Statistical Reference Datasets](https://www.itl.nist.gov/div898/strd/), measured and in the
public domain.
"""
    table = pages.table([*head, "within 2 u", "reliable"], body)
    days = [row["day"] for row in rows.values()]
    return pages.page("records_of_others", "Public records", "real_records", days, about, table)
