"""A sensor's own nominal scale and zero, as data sheets write them, turn raw outputs into the instrument's unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, ng_accelerometer, quartz_beam_accelerometer
from tests.support.inside import nominal_scale_of

G = 1e6  # µg


def test_raw_outputs_are_read_by_a_scale_and_a_zero(tmp_path: Path) -> None:
    raw = tmp_path / "raw.csv"
    raw.write_text("temperature [degC],output [mV]\n20,1210\n30,1454\n")
    said = {"nominal_scale": "2.44 mV/(°/s)", "nominal_zero": "1.21 V"}
    found = bc.read(raw, mems_gyro.INSTRUMENT, **said)
    np.testing.assert_allclose(found["output"], [0.0, 100.0], atol=1e-12)


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
