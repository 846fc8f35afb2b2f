"""A result that is not reliable is written, and its command leaves with 1."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import bayescal as bc
from bayescal_models import accelerometer_triad, magnetometer_triad
from tests.support.command_line import GYRO, PRINTED_LINE, QUICK, TABLE, needs_installation, run
from tests.support.made_up import bent_sensor

pytestmark = needs_installation


def test_a_fit_that_did_not_converge_leaves_with_1_and_its_result(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    real = bc.fit

    def never(*arguments: Any, **options: Any) -> bc.Calibration:
        found = real(*arguments, **options)
        return replace(found, verdict=bc.Verdict(False, ("It was told not to converge.",)))

    monkeypatch.setattr(bc, "fit", never)
    done = run("fit", TABLE, *GYRO, *QUICK, "--out", tmp_path, "--json")
    assert done.status == 1
    assert done.data["verdict"]["ok"] is False
    assert done.said == ["bayescal: result not reliable: It was told not to converge."]
    assert (tmp_path / "calibration.nc").is_file()


@pytest.mark.usefixtures("unpainted")
def test_what_a_gate_found_stays_with_the_result_wherever_it_is_taken(tmp_path: Path) -> None:
    done = run("calibrate", TABLE, *GYRO, *QUICK, *PRINTED_LINE, "--out", tmp_path, "--json")
    assert done.status == 1 and done.data["gate"]["ok"] is False
    reason = done.data["gate"]["reason"]
    assert reason in done.said[-1]
    assert done.data == json.loads((tmp_path / "result.json").read_text("utf-8"))
    file = tmp_path / "calibration.nc"
    loaded = bc.load(file)
    assert loaded.verdict.ok and not loaded.verdict.reliable
    assert loaded.verdict.why_not == reason and reason in " ".join(str(loaded).split())
    header = tmp_path / "gyro.h"
    for command in (
        ("export", file, "--out", header),
        ("export", file, "--out", tmp_path / "gyro.json"),
        ("budget", file, "--at", "temperature=60"),
        ("compensate", file, TABLE, "--out", tmp_path / "done.csv"),
        ("predict", file, TABLE),
        ("report", file, "--out", tmp_path / "report.html"),
    ):
        done = run(*command)
        assert done.status == 1, command
        assert reason in done.said[-1], command


# `bayescal export`: what a sensor is called, three axes and those of a unit, without uncertainty; what is refused.


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with saved calibrations of one output, and of two triads."""
    folder = tmp_path_factory.mktemp("saved")
    bent_sensor.gyro().save(folder / "gyro.nc")
    for triad in (accelerometer_triad, magnetometer_triad):
        model, readings = triad.INSTRUMENT.baseline(), triad.simulate(seed=3)
        bc.fit(model, readings, bc.LeastSquares()).save(folder / f"{triad.INSTRUMENT.name}.nc")
    return folder


@pytest.mark.slow
def test_without_uncertainty(saved: Path) -> None:
    for file in ("gyro.nc", "accelerometer_triad.nc"):
        for format in ("c", "python"):
            whole = run("export", saved / file, "--format", format).out
            plain = run("export", saved / file, "--format", format, "--without-uncertainty").out
            assert 0 < len(plain) < len(whole)


def test_triads_of_a_unit_in_one_file(saved: Path, tmp_path: Path) -> None:
    unit = [saved / f"{n}_triad.nc" for n in ("accelerometer", "magnetometer")]
    for file in ("imu.h", "imu.py"):
        done = run("export", *unit, "--out", tmp_path / file, "--name", "imu")
        assert done.status == 0, done.err
        for one in ("accelerometer", "magnetometer"):
            assert f"imu_{one}_triad_correct(" in (tmp_path / file).read_text("utf-8")


def test_options_that_a_triads_parameters_do_not_use_are_refused(saved: Path) -> None:
    for option in ("--axis=acc_x=a.nc", "--device-id=acc=1", "--local-gravity=9.8"):
        done = run("export", saved / "accelerometer_triad.nc", "--format", "px4-params", option)
        assert (done.status, option.partition("=")[0] in done.err) == (2, True)
