"""All that is exported of a unit goes into one program, in C and in Python, and each sensor is corrected by its own."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from tests.support.export_check import needs_compiler, run_c
from tests.support.made_up import bent_sensor

UNITS = {"accelerometer_triad": "g", "gyro_triad": "deg/s", "magnetometer_triad": "uT"}
AT = {"accelerometer_triad": 1.0, "gyro_triad": 50.0, "magnetometer_triad": 48.0}
WARM, NOISE = 31.0, 2e-3
GRAVITY = np.array([0.1, -0.4, 0.9])


@cache
def triad(instrument: str, order: int = 1, powers: int = 1) -> bc.VectorCorrection:
    """A correction with numbers of its own; gyroscopes that sense gravity."""
    random = np.random.default_rng(len(instrument) + order)
    beside = ("gravity_x", "gravity_y", "gravity_z") if instrument == "gyro_triad" else ()
    terms = 1e-3 * random.standard_normal((powers, {1: 12, 2: 30, 3: 33}[order] + 3 * len(beside)))
    terms[0, 3:12] += np.eye(3).ravel()
    terms[:, 12:] /= AT[instrument]
    root = 1e-4 * random.standard_normal((terms.size, terms.size))
    return bc.VectorCorrection(
        outputs=("output_x", "output_y", "output_z"),
        unit=UNITS[instrument],
        reference=25.0,
        low=-20.0,
        high=70.0,
        terms=terms,
        covariance=root @ root.T,
        noise=1e-3,
        source=f"{instrument} {order} {powers}",
        secondary_columns=beside,
        instrument=instrument,
    )


@cache
def scalar(name: str) -> bc.Compensator:
    """One that remembers its past, and a straight line."""
    made = {"bent": bent_sensor.calibration, "line": bent_sensor.gyro}
    return bc.compensator(made[name]())


PROGRAM = """
#include "bent.h"
#include "first/gyro_x.h"
#include "second/correction.h"
#include "unit.h"
#include "spare.h"
#include "spare.h"
#include "unit.h"
#include <stdio.h>

int main(void)
{
    double row[8];
    while (fread(row, sizeof(double), 8, stdin) == 8) {
        double f[3], c[3][3], found[13];
        const bent_input bent = {BENT};
        const gyro_x_input x = {LINE};
        const gyro_y_input y = {LINE};
        int outside = accelerometer_triad_correct(row, row[3], row[4], f, c);
        fwrite(f, sizeof(double), 3, stdout);
        outside += gyro_triad_correct(row, row + 5, row[3], row[4], f, c);
        fwrite(f, sizeof(double), 3, stdout);
        outside += magnetometer_triad_correct(row, row[3], row[4], f, c);
        fwrite(f, sizeof(double), 3, stdout);
        fwrite(c, sizeof(double), 9, stdout);
        outside += spare_correct(row, row[3], f);
        fwrite(f, sizeof(double), 3, stdout);
        found[0] = (double)bent_compensate(&bent).value;
        found[1] = (double)gyro_x_compensate(&x).value;
        found[2] = (double)gyro_y_compensate(&y).value;
        found[3] = (double)outside;
        fwrite(found, sizeof(double), 4, stdout);
    }
    return 0;
}
"""


def inputs_of(compensator: bc.Compensator) -> dict[str, Any]:
    """Each in the middle of its range."""
    return {i.name: i.middle for i in compensator.inputs}


@needs_compiler
@pytest.mark.parametrize("real", ["double", "float"])
def test_all_headers_in_one_program(real: str, tmp_path: Path) -> None:
    """Two scalars of one instrument, one with a past, a unit of three triads, one triad more without covariance."""
    bent, line = scalar("bent"), scalar("line")
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
    bent.export(tmp_path / "bent.h", name="bent")
    line.export(tmp_path / "first" / "gyro_x.h", name="gyro_x")
    line.export(tmp_path / "second" / "correction.h", name="gyro_y")
    unit = [triad("accelerometer_triad", 3, 2), triad("gyro_triad", 2), triad("magnetometer_triad")]
    bc.export_vector(unit[0], tmp_path / "unit.h", others=unit[1:])
    spare = triad("accelerometer_triad")
    bc.export_vector(spare, tmp_path / "spare.h", name="spare", uncertainty=False)
    source = PROGRAM
    for word, one in (("BENT", bent), ("LINE", line)):
        values = ", ".join(
            f"(BAYESCAL_REAL){v}" for v in ("row[0]", *map(repr, inputs_of(one).values()))
        )
        source = source.replace(word, values)
    y = np.array([0.3, -0.5, 0.8])
    found = run_c(source, np.r_[y, WARM, NOISE, GRAVITY], tmp_path, real)
    pairs = zip(unit, (None, GRAVITY, None), strict=True)
    force, rate, field = (c(y, WARM, noise=NOISE, secondary_input=g) for c, g in pairs)
    wanted = [force.vector, rate.vector, field.vector, field.covariance, spare(y).vector]
    assert found[:21] == pytest.approx(np.concatenate([w.ravel() for w in wanted]), rel=1e-9)
    exact = 1e-9 if real == "double" else 1e-4
    for k, one in enumerate((bent, line, line)):
        inputs = inputs_of(one)
        value = one(output=y[0], method="first order", warn=False, **inputs).value[0]
        assert found[21 + k] == pytest.approx(value, rel=exact)
    assert found[24] == 0
