"""`bayescal export`: what a sensor is called, three axes and those of a unit, without uncertainty; what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

import bayescal as bc
from bayescal_models import accelerometer_triad
from tests.deliver.test_one_program import triad
from tests.support.command_line import needs_installation, run
from tests.support.made_up import bent_sensor

pytestmark = needs_installation


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a saved calibration of one output and of three axes, and corrections of a unit as JSON."""
    folder = tmp_path_factory.mktemp("saved")
    bent_sensor.gyro().save(folder / "gyro.nc")
    readings = accelerometer_triad.simulate(seed=3)
    model = accelerometer_triad.INSTRUMENT.baseline()
    bc.fit(model, readings, bc.LeastSquares()).save(folder / "triad.nc")
    for name in ("accelerometer_triad", "gyro_triad", "magnetometer_triad"):
        bc.export_vector(triad(name), folder / f"{name}.json")
    return folder


def text_of(path: Path) -> str:
    return path.read_text("utf-8")


def test_a_name_is_that_of_everything_in_c(saved: Path, tmp_path: Path) -> None:
    done = run("export", saved / "gyro.nc", "--name", "left", "--out", tmp_path / "a.h")
    assert done.status == 0, done.err
    assert "left_compensate(" in text_of(tmp_path / "a.h")
    assert "mems_gyro_" not in text_of(tmp_path / "a.h")
    done = run("export", saved / "triad.nc", "--name", "up", "--format", "c")
    assert done.status == 0


@pytest.mark.slow
def test_without_uncertainty(saved: Path) -> None:
    for file in ("gyro.nc", "triad.nc"):
        for format in ("c", "python"):
            whole = run("export", saved / file, "--format", format).out
            plain = run("export", saved / file, "--format", format, "--without-uncertainty").out
            assert 0 < len(plain) < len(whole)


def test_triads_of_a_unit_in_one_file(saved: Path, tmp_path: Path) -> None:
    unit = [saved / f"{n}_triad.json" for n in ("accelerometer", "gyro", "magnetometer")]
    for file in ("imu.h", "imu.py"):
        done = run("export", *unit, "--out", tmp_path / file, "--name", "imu")
        assert done.status == 0, done.err
        for one in ("accelerometer", "gyro", "magnetometer"):
            assert f"imu_{one}_triad_correct(" in text_of(tmp_path / file)
    assert run("export", *unit[:2], "--out", tmp_path / "imu.yaml").status == 0
    assert "gyroscopes:" in text_of(tmp_path / "imu.yaml")
