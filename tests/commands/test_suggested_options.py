"""Options that a refusal suggests are pasted as they are printed, until the command ends well."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from bayescal_models.gyro_triad import MovesByHand, simulate_log
from tests.support.command_line import needs_installation, run
from tests.support.log_files import write_ulog_topics

OPTION = re.compile(r"""(--[a-z-]+)[ =]((?:'[^']*'|"[^"]*"|[^\s()'"])+)""")
ROWS = 80


def pasted(printed: str) -> list[str]:
    """The first that is suggested of each option and each of our columns; a unit that the file lacks is filled in."""
    found = {}
    for name, value in OPTION.findall(printed):
        (value,) = shlex.split(value)
        ours, _, theirs = value.partition("=")
        if name in ("--columns", "--accelerometers", "--gyroscopes"):
            found.setdefault((name, ours), value)
        elif name == "--unit" and theirs == "UNIT":
            found.setdefault((name, ours), f"{ours}={'s' if 'time' in ours else 'deg/s'}")
    return [word for (name, _), value in found.items() for word in (name, value)]


HEADERS = [
    "time [s],wx [rad/s],wy [rad/s]", "time [s],Gyro X (deg/s),Acc X (m/s^2)",
    "t_ms [ms],gyr_x (dps)", "timestamp (ms),x,y,z", "time,gx,gy,gz", "clock (s),rate (°/s)",
    "time [s],Rotation rate X [deg/s],Rotation rate Y [deg/s]",
    "time [s];My gyro, z axis [deg/s];Temp [degC]", "time [s],sensor A [ug],humidity [%]",
    "time [s],angle pitch [deg],temperature [degC],lab [degC]", "time [s],force [m/s^2],cell [g]",
    "Zeit [s],Ausgang [mV]", "time [s],it's odd [mg]",
]  # fmt: skip


@pytest.mark.parametrize("header", HEADERS)
@needs_installation
def test_options_that_are_printed_can_be_pasted(tmp_path: Path, header: str) -> None:
    separator = ";" if ";" in header else ","
    names = header.split(separator)
    random, time = np.random.default_rng(1), 0.01 * np.arange(ROWS)
    columns = [time] + [20 + random.standard_normal(ROWS) for _ in names[1:]]
    rows = (separator.join(f"{v:.4f}" for v in row) for row in zip(*columns, strict=True))
    path = tmp_path / "log.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    said: list[str] = []
    for _ in range(3):
        command = ("fit", path, "--instrument", "still_sensor", "--method", "least-squares")
        done = run(*command, *said)
        if done.status != 2:
            break
        said += pasted(done.err)
    assert done.status == 0, (said, done.err)


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
@needs_installation
def test_log_of_a_whole_unit_needs_no_options(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    log = simulate_log(seed=5, campaign=MovesByHand(poses=12, still=3.0, move=2.0))
    kinds = {"sensor_gyro": ("gyro", np.pi / 180), "sensor_accel": ("accel", 9.80665)}
    topics = {t: {a: s * log[f"{k}_{a}"] for a in "xyz"} for t, (k, s) in kinds.items()}
    path = write_ulog_topics(tmp_path / "unit.ulg", log["time"] + 1.0, topics)
    done = run("imu", path, "--baseline", "--out", tmp_path / "out")
    assert done.status == 0, done.err
    for name in ("accelerometer", "gyroscope"):
        assert (tmp_path / "out" / name / "correction.json").is_file()
