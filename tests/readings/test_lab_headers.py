"""Headers as eight laboratories write them for one test of a gyroscope: the same numbers, at most one option each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._data.read import read
from bayescal._model.frame import build_frame, reference_of
from bayescal_models import mems_gyro
from tests.support.lab_files import RATE, TEMPERATURE, TIME, counted, spaced, text, when, with_cell

MILLI = [f"{1e3 * t:g}" for t in TIME]
LABORATORIES: dict[str, tuple[str | bytes, dict[str, Any]]] = {
    "by the book": (text(), {}),
    "underscores": (
        text(("t_s", "Temp_C", "gyro_z_dps")),
        {"columns": {"output": "gyro_z_dps"}},
    ),
    "round brackets": (
        text(("Time (s)", "Temp (°C)", "gz (deg/s)")),
        {"columns": {"output": "gz (deg/s)"}},
    ),
    "quantities over units": (
        text(("t/ms", "T/°C", "ω/(°/s)"), (MILLI, TEMPERATURE, RATE)),
        {"columns": {"output": "ω/(°/s)"}},
    ),
    "Windows, decimal commas": (
        text(("Time [s]", "Temperature [°C]", "Rate [°/s]"), separator=";", decimal=",").encode(
            "cp1252"
        ),
        {"columns": {"output": "Rate"}},
    ),
    "dates": (
        text(("Timestamp", "Temp (C)", "Output (°/s)"), (when(spaced), TEMPERATURE, RATE)),
        {},
    ),
    "microseconds since 1970": (
        counted(1_000_000, "timestamp").replace("temperature [degC]", "temp_degC"),
        {},
    ),
    "hours and radians": (
        text(("time [s]", "T [K]", "Output (rad/s)"), (TIME, TEMPERATURE + 273.15, np.radians(RATE))),
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LABORATORIES)
def test_the_readings_are_the_same(put, name):
    content, options = LABORATORIES[name]
    assert sum(map(len, options.values())) <= 1
    m = read(put(content), mems_gyro.INSTRUMENT, **options)
    assert m.columns == ("time", "temperature", "output")
    np.testing.assert_array_equal(m["time"], TIME)
    np.testing.assert_allclose(m["temperature"], TEMPERATURE, rtol=1e-14)
    np.testing.assert_allclose(m["output"], RATE, rtol=1e-14)


def test_and_so_is_the_calibration(put):
    noisy = RATE + 0.01 * np.sin(7 * TIME)
    head = ("t_s", "Temp_C", "gyro_z_dps")
    found = []
    files: tuple[tuple[str, dict[str, Any]], ...] = (
        (text(columns=(TIME, TEMPERATURE, noisy)), {}),
        (text(head, (TIME, TEMPERATURE, noisy)), {"columns": {"output": "gyro_z_dps"}}),
        (text(("Timestamp", "T/K", "output_rads"), (when(spaced), TEMPERATURE + 273.15, np.radians(noisy))), {}),
    )  # fmt: skip
    for content, options in files:
        readings = read(put(content), mems_gyro.INSTRUMENT, **options)
        line = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings, bc.LeastSquares())
        names = ("bias.constant", "bias.temperature", "noise.white")
        found.append([float(line.samples(name).mean()) for name in names])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    np.testing.assert_allclose(found[2], found[0], rtol=1e-6)


def test_a_dropped_row_is_a_gap_to_rates(put):
    spoilt = with_cell(5, 2, "", with_cell(6, 2, "NaN"))
    m = read(put(spoilt), mems_gyro.INSTRUMENT, missing="drop")
    assert len(m) == len(TIME) - 2
    frame = build_frame(m, reference_of(m))
    assert frame.step.tolist().count(30.0) == 1  # s, over the gap
    np.testing.assert_allclose(np.asarray(frame.rates["temperature"])[1:], 0.125, rtol=1e-9)
