"""The commands that run the whole loop find what is missing, and write what they say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.command_line import GYRO, QUICK, Ran, needs_installation, run

pytestmark = needs_installation


def test_the_loop_finds_what_is_missing_and_writes_what_it_says(loop: Ran, folder: Path) -> None:
    assert loop.status == 0, loop.err
    said = loop.data
    assert said["steps"][-1]["added"] == "bias.temperature_quadratic"
    assert json.loads((folder / "loop" / "result.json").read_text("utf-8")) == said
    names = {p.name for p in (folder / "loop").iterdir()}
    assert names == {"result.json", "calibration.nc", "averaged.nc", "loop.png", "manifest.json"}


def test_readings_kept_apart_change_nothing_but_their_own_error(loop: Ran, folder: Path) -> None:
    without = run("calibrate", folder / "bent.csv", *GYRO, *QUICK, "--json").data
    with_them = loop.data
    assert without["holdout"] is None
    assert with_them["holdout"]["rows"] == 18
    errors = [step.pop("holdout_rmse") for step in with_them["steps"]]
    assert [step.pop("holdout_rmse") for step in without["steps"]] == [None] * len(errors)
    assert errors[-1] < 0.6 * errors[0]
    with_them["holdout"] = None
    for told in (with_them, without):
        del told["search"]["seconds"]  # differs from one time to the next
        del told["flags"], told["calibration"]  # say that the hold-out data are a copy
    assert with_them == without


@pytest.mark.slow
def test_the_demonstration(tmp_path: Path) -> None:
    done = run("demo", "--out", tmp_path / "demo", "--json")
    assert done.status == 0, done.err
    assert done.data["steps"][-1]["added"].startswith("bias.thermal_lag"), "in one of its forms"
    assert (tmp_path / "demo" / "loop.png").is_file()
