"""Fleets of the sensor at rest, whose unit and plausible sizes come from readings: logs, measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.log_files import write_ulog

GENERAL = still_sensor.INSTRUMENT
ROWS = 300
TIME = 5.0 + 0.5 * np.arange(ROWS)
TEMPERATURE = 20.0 + 30.0 * np.sin(np.linspace(0.0, 1.5, ROWS))


def lines(rng: np.random.Generator, devices: int) -> list[tuple[float, float]]:
    """Zero-rate output at 0 °C, rad/s, and its slope; constants differ by more than a record shows."""
    return [(rng.normal(0, 0.5), rng.normal(1e-4, 3e-5)) for _ in range(devices)]


def test_a_folder_of_logs_is_a_fleet(tmp_path: Path, rng: np.random.Generator) -> None:
    pytest.importorskip("pyulog", reason="pip install 'bayescal[logs]'")
    true = lines(rng, 4)
    for i, (constant, slope) in enumerate(true):
        rate = constant + slope * TEMPERATURE + 1e-4 * rng.standard_normal(ROWS)
        unit = {"gyro_x": rate}
        write_ulog(tmp_path / f"log{i}.ulg", TIME, TEMPERATURE, [unit], devices=(100 + i,))
    columns = {"columns": {"output": "gyro_x"}}
    found = bc.fit_batch(
        GENERAL.baseline(), tmp_path, reference={"T0": 0.0},
        columns=columns,
    )  # fmt: skip
    assert len(found) == found.fitted_count == 4
    rows = found.table().set_index(["device", "coefficient"])
    for i, (constant, slope) in enumerate(true):
        for name, value in (("bias.constant", constant), ("bias.temperature", slope)):
            one = rows.loc[str(100 + i), name]
            assert abs(one["mean"] - np.degrees(value)) < 4 * one["sd"]
    row = found.coefficients().set_index("coefficient").loc["bias.temperature"]
    assert row["median"] == pytest.approx(np.degrees(1e-4), rel=0.6)
