"""`bayescal calibrate --channels`: a folder for each channel, a report of all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.command_line import needs_installation, run

pytestmark = needs_installation
NAMES = ("gyro_x", "gz (deg/s)/2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A unit of two channels over a ramp, one bent."""
    path = tmp_path_factory.mktemp("unit")
    time = np.arange(60) * 30.0
    temperature = 25 + 30 * np.sin(time / 400)
    noise = 0.02 * np.random.default_rng(5).standard_normal((2, time.size))
    first = 0.5 + 0.04 * temperature + noise[0]
    second = -1.0 + 0.02 * temperature + 1e-3 * (temperature - 25) ** 2 + noise[1]
    table = np.column_stack([time, temperature, first, second])
    head = f"time [s],temperature [degC],{NAMES[0]} [deg/s],{NAMES[1]} [deg/s]"
    np.savetxt(path / "unit.csv", table, delimiter=",", header=head, comments="", fmt="%.9g")
    return path


def command(folder: Path) -> tuple[object, ...]:
    return ("calibrate", folder / "unit.csv", "--instrument", "still_sensor")


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_channels_are_calibrated_saved_and_reported(folder: Path) -> None:
    channels = ("--channels", ",".join(NAMES), "--method", "least-squares")
    ran = run(*command(folder), *channels, "--out", folder / "result")
    assert ran.status == 0, ran.err
    told = json.loads((folder / "result" / "channels.json").read_text("utf-8"))
    assert set(told["channels"]) == set(NAMES)
    folders = [folder / "result" / c["folder"] for c in told["channels"].values()]
    assert all(f.parent == folder / "result" for f in folders)  # whatever a channel's name holds
    bent = told["channels"][NAMES[1]]["effects"]
    assert "bias.temperature_quadratic" in bent
    assert "bias.temperature_quadratic" not in told["channels"][NAMES[0]]["effects"]
    reported = run("report", folder / "result", "--out", folder / "unit.html")
    assert reported.status == 0, reported.err
    (folder / "unit.html").read_text("utf-8")
