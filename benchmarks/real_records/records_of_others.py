"""Public records of others' sensors, each with an instrument of its own: what is known, what is found, does it hold?

Every second block of a record is held out, in the order of what drives it. Beside the result stand a line, a cubic, a
cubic with a lag where there is time, boosted trees, and the form that NIST certifies, with its constants fitted to the
same readings. Results go to `benchmarks/results/records_of_others.json`, and from there, with the chamber ramp's
(`thermal_ramp.py`), to `docs/records_of_others.md`.

The records are not part of this repository: see `thermal_ramp.py` for where they are looked for.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import bayescal as bc
from bayescal import effects
from benchmarks.real_records import records_page
from benchmarks.record import REFERENCE_DATA, write

SOURCE = "plausible size, from the range of the instrument"
BLOCKS = 20  # of equal numbers of readings, by what drives them; every second is held out
Form = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class PublicRecord:
    """A record of NIST's Statistical Reference Datasets, and what its owner knows before a calibration.

    Attributes:
        title, file, known: of the page, and the file in the folder of data.
        driver, unit: what drives the output; "1" where NIST's data states no unit.
        output_unit: of the output.
        range: of the driver, at most.
        bias, slope: plausible sizes, output unit, and output unit for each unit of the driver.
        form: what NIST certifies, of constants and driver; `start` for its constants.
    """

    title: str
    file: str
    known: str
    driver: str
    unit: str
    output_unit: str
    range: float
    bias: float
    slope: float
    form: Form
    start: tuple[float, ...]

    @property
    def instrument(self) -> bc.Instrument:
        """A constant and a line; a parabola and a cubic, of half a range at most, are candidates."""
        return bc.Instrument(
            name=self.driver,
            title=self.title,
            columns=(
                bc.Column(self.driver, self.unit),
                bc.Column("output", self.output_unit),
            ),
            slots=(bc.Slot("response", self.output_unit),),
            response=lambda slots, r: slots["response"],
            effects=(
                effects.constant("response", self.bias, self.output_unit, source=SOURCE),
                self._power("line", 1),
            ),
            candidates=(self._power("quadratic", 2), self._power("cubic", 3)),
            noise=bc.White(bc.HalfCauchy(0.1 * self.bias)),
        )

    def _power(self, name: str, order: int) -> bc.Effect:
        driver, whole = self.driver, self.slope * self.range
        over = f"/{self.unit}^{order}" if self.unit != "1" else ""
        size = self.slope if order == 1 else 0.5 * whole / self.range**order
        return bc.Effect(
            f"response.{name}",
            "response",
            basis=lambda r: r[driver] ** order,
            coefficients=(
                bc.Coefficient(f"{self.output_unit}{over}".replace("^1", ""), bc.Normal(0.0, size)),
            ),
            columns=(driver,),
            source=SOURCE,
        )


def _rational(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    over = b[0] + x * (b[1] + x * (b[2] + x * b[3]))
    return over / (1 + x * (b[4] + x * (b[5] + x * b[6])))


RECORDS = (
    PublicRecord(
        "load cell",
        "linear/pontius.csv",
        "deflection against load, 40 readings (P. Pontius, NIST). Certified: a parabola, "
        "−3.161e-15 ± 0.049e-15 for each unit of load squared; residual standard deviation 2.05e-4",
        *("load", "1", "1", 3e6, 1.0, 1e-6),
        lambda b, x: b[0] + b[1] * x + b[2] * x**2,
        (0.0, 7e-7, -3e-15),
    ),
    PublicRecord(
        "ozone monitor",
        "linear/norris.csv",
        "a customer's monitor against NIST's, 36 readings (J. Norris, NIST). Certified: a line, "
        "intercept −0.26 ± 0.23, slope 1.00212 ± 0.00043; residual standard deviation 0.885",
        *("concentration", "ppb", "ppb", 1000.0, 10.0, 2.0),
        lambda b, x: b[0] + b[1] * x,
        (0.0, 1.0),
    ),
    PublicRecord(
        "ultrasonic reference block",
        "nonlinear/Chwirut1.csv",
        "ultrasonic response against metal distance, 214 readings (D. Chwirut, NIST). Certified: "
        "exp(−b₁x)/(b₂ + b₃x); residual standard deviation 3.36",
        *("distance", "1", "1", 6.0, 100.0, 100.0),
        lambda b, x: np.exp(-b[0] * x) / (b[1] + b[2] * x),
        (0.15, 0.008, 0.010),
    ),
    PublicRecord(
        "dilatometer",
        "nonlinear/Hahn1.csv",
        "thermal expansion of copper against temperature, 236 readings (T. Hahn, NIST). Certified: a cubic over a "
        "cubic, seven constants; residual standard deviation 0.082",
        *("temperature", "K", "1", 900.0, 10.0, 0.1),
        _rational,
        (1.0, -0.1, 0.005, -1e-6, -0.005, 1e-4, -1e-7),
    ),
    PublicRecord(
        "scanning electron microscope",
        "nonlinear/Kirby2.csv",
        "line width standards, 151 readings (R. Kirby, NIST). Certified: a parabola over a parabola, "
        "five constants; residual standard deviation 0.164",
        *("width", "1", "1", 400.0, 100.0, 1.0),
        lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
        (1.5, -0.15, 0.0025, -0.0015, 2e-5),
    ),
)


def folder() -> Path | None:
    """That of NIST's data, if it is there."""
    own = os.environ.get("BAYESCAL_SHARED")
    path = (Path(own) / "data" if own else REFERENCE_DATA) / "nist_strd"
    return path if path.is_dir() else None


def main() -> None:
    """Measure every record, and render the page."""
    at = folder()
    if at is None:
        print("records_of_others: skipped, no nist_strd; BAYESCAL_SHARED may name its folder")
        return
    results = {}
    for record in RECORDS:
        print(f"records_of_others: {record.title}", flush=True)
        results[record.title] = {"known": record.known, "unit": record.output_unit} | measure(
            record, at / record.file
        )
        print(json.dumps(results[record.title]), flush=True)
    write("records_of_others", {"records": results})
    records_page.write(results)


def measure(record: PublicRecord, path: Path) -> dict[str, Any]:
    """What is found, and the errors of the held-out readings, output unit."""
    y, x = np.genfromtxt(path, delimiter=",", skip_header=1, unpack=True)
    rank = np.argsort(np.argsort(x, kind="stable"))
    held = (rank * BLOCKS // x.size) % 2 == 1
    fitted, kept = (
        bc.Measurements.from_arrays(
            record.instrument, **{record.driver: x[rows], "output": y[rows]}
        )
        for rows in (~held, held)
    )
    began = time.process_time()
    trail = bc.calibrate(record.instrument.baseline(), fitted, holdout=kept)
    seconds = time.process_time() - began
    final = trail.final
    predicted = bc.predict(final.calibration, kept)
    return {
        "added": [
            n for n in final.calibration.model.names if n not in record.instrument.baseline().names
        ],
        "coefficients": {
            n: [float(v.mean()), float(v.std())]
            for n in final.calibration.model.names
            if n.startswith("response.")
            for v in (final.calibration.samples(n),)
        },
        "noise": final.calibration.model.noise.law,
        "complete": None if final.discovery is None else final.discovery.nothing_missing,
        "ok": trail.ok,
        "reason": trail.gate.reason,
        "inside": float(np.mean(np.abs(predicted.residual) < 2 * predicted.sd)),
        "seconds": seconds,
        "errors": {"bayescal": _rms(predicted.residual)} | _others(record, x, y, held),
    }


def _others(
    record: PublicRecord, x: np.ndarray, y: np.ndarray, held: np.ndarray
) -> dict[str, float]:
    """Errors of what is customary, and of the form that NIST certifies."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    scaled, found = (x - x.mean()) / np.ptp(x), {}
    for name, order in (("line", 1), ("cubic", 3)):
        curve = np.polynomial.Polynomial.fit(scaled[~held], y[~held], order)
        found[name] = _rms(y[held] - curve(scaled[held]))
    trees = HistGradientBoostingRegressor(random_state=0).fit(x[~held, None], y[~held])
    found["boosted trees"] = _rms(y[held] - trees.predict(x[held, None]))
    fit = least_squares(
        lambda b: record.form(b, x[~held]) - y[~held], record.start, x_scale="jac", max_nfev=10**4
    )
    found["NIST's form"] = _rms(y[held] - record.form(fit.x, x[held]))
    return found


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
