"""A sensor's own nominal scale and zero, said on the command line, give the answers that its own unit gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bayescal_models import mems_gyro, ng_accelerometer, quartz_beam_accelerometer
from tests.support.command_line import QUICK, needs_installation, run
from tests.support.inside import nominal_scale_of

pytestmark = needs_installation
G = 1e6  # µg
SENSORS = {  # instrument: unit of its output, raw unit, raw per output, raw at zero, and how they are said
    "ng_accelerometer": ("ug", "V", 250 / G, 0.0, "250 V/g", None),
    "mems_gyro": ("deg/s", "mV", 2.44, 1210.0, "2.44 mV/(°/s)", "1.21 V"),
    "quartz_beam_accelerometer": ("ug", "Hz", 37 / G, 35_000.0, "37 Hz/g", "35 kHz"),
}


def raw_file(tmp_path: Path, instrument: str) -> tuple[Path, Path]:
    """A simulated file, and the same with its output as the sensor gives it."""
    unit, raw, gain, zero, _, _ = SENSORS[instrument]
    own, in_raw = tmp_path / "own.csv", tmp_path / "raw.csv"
    assert run("simulate", "--instrument", instrument, "--out", own, "--seed", 3).status == 0
    table = pd.read_csv(own)
    table[f"output [{raw}]"] = zero + gain * table.pop(f"output [{unit}]")
    table.to_csv(in_raw, index=False)
    return own, in_raw


def said(instrument: str) -> tuple[str, ...]:
    scale, zero = SENSORS[instrument][4:]
    return ("--nominal-scale", scale, *(("--nominal-zero", zero) if zero else ()))


@pytest.mark.slow
@pytest.mark.parametrize("instrument", SENSORS)
def test_the_raw_file_gives_the_answers_of_the_file_in_its_unit(instrument, tmp_path) -> None:
    own, raw = raw_file(tmp_path, instrument)
    how = ("--instrument", instrument, *QUICK, "--json")
    right, found = run("fit", own, *how), run("fit", raw, *how, *said(instrument))
    assert right.status == found.status == 0, found.err
    for near, of in zip(found.data["coefficients"], right.data["coefficients"], strict=True):
        assert near["name"] == of["name"]
        assert abs(near["mean"] - of["mean"]) < 1e-3 * of["sd"] + 1e-6 * abs(of["mean"]), of


@pytest.mark.parametrize(
    ("instrument", "scale", "gain"),
    [
        (ng_accelerometer.INSTRUMENT, "250 V/g", 250 / G),
        (ng_accelerometer.INSTRUMENT, "25.4929 V/(m/s^2)", 25.4929 * 9.80665 / G),
        (ng_accelerometer.INSTRUMENT, "4 mg/V", 1 / 4e3),
        (mems_gyro.INSTRUMENT, "2.44 mV/°/s", 2.44),
        (mems_gyro.INSTRUMENT, "2.44mV/dps", 2.44),
        (mems_gyro.INSTRUMENT, "-131 LSB/(deg/s)", -131.0),
        (quartz_beam_accelerometer.INSTRUMENT, "37 Hz/g", 37 / G),
    ],
)  # fmt: skip
def test_it_is_read_as_data_sheets_write_it(instrument, scale, gain) -> None:
    made = nominal_scale_of(instrument, scale)
    assert made is not None and made.offset == 0
    np.testing.assert_allclose(made.gain, gain, rtol=1e-12)
