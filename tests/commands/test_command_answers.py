"""Commands answer in text and in JSON, the same for the same seed, with columns and instruments of one's own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.command_line import GYRO, QUICK, TABLE, Ran, commands, needs_installation, run

pytestmark = needs_installation


def test_instruments_and_effects_as_json(folder: Path) -> None:
    assert run("instruments", "--json").data["mems_gyro"]["unit"] == "deg/s"
    run("instruments", "mems_gyro")
    own = ("--effects", folder / "my_effects.py")
    listed = {e["name"]: e for e in run("effects", *GYRO, *own, "--json").data}
    assert listed["bias.constant"]["kind"] == "baseline"
    assert listed["bias.thermal_lag"]["kind"] == "candidate"
    assert listed["bias.thermal_lag"]["columns"] == ["time", "temperature"]
    assert listed["bias.elbow"]["kind"] == "your own"


def test_fit_as_json() -> None:
    said = run("fit", TABLE, *GYRO, *QUICK, "--json").data
    slope = next(c for c in said["coefficients"] if c["name"] == "bias.temperature")
    assert slope["unit"] == "deg/s/degC"
    assert slope["mean"] == pytest.approx(0.0535, abs=2e-4)
    assert said["reference"]["T0"] == 57
    assert said["verdict"]["ok"] is True
    larger = ("--structure", "quadratic", "--add", "bias.temperature_cubic")
    said = run("fit", TABLE, *GYRO, *QUICK, *larger, "--json").data
    assert {"bias.temperature_quadratic", larger[-1]} <= {c["name"] for c in said["coefficients"]}


def test_saved_calibration_is_checked_discovered_and_predicted(saved: Path, tmp_path: Path) -> None:
    for name in ("check", "discover"):
        text = run(name, saved)
        assert text.status == 0, text.err
    entries = run("check", saved, "--json").data["check"]
    assert {"temperature", "order"} == {e["against"] for e in entries}
    missing = run("discover", saved, "--json").data
    assert "bias.temperature_quadratic" in {c["effect"] for c in missing["candidates"]}
    out = tmp_path / "predicted.csv"
    said = run("predict", saved, TABLE, "--out", out, "--json").data
    written = pd.read_csv(out)
    residual = written["residual [deg/s]"].to_numpy()
    assert said["rows"] == len(written) == 18
    assert said["rmse"] == pytest.approx(float(np.sqrt(np.mean(residual**2))))
    pd.read_csv(TABLE).iloc[[0, 0]].to_csv(out, index=False)  # at one temperature
    assert "2 readings: rms error" in run("predict", saved, out).out


def test_columns_and_units_can_be_named(saved: Path, tmp_path: Path) -> None:
    table = pd.read_csv(TABLE)
    table.columns = ["T", "gyro_x"]
    table["gyro_x"] = np.deg2rad(table["gyro_x"])
    file = tmp_path / "other.csv"
    table.to_csv(file, index=False)
    named = (
        *("--columns", "temperature=T", "--columns", "output=gyro_x"),
        *("--unit", "T=degC", "--unit", "gyro_x=rad/s"),
    )
    found = [
        run("fit", file, *GYRO, *QUICK, *named, "--json").data["coefficients"],
        run("fit", TABLE, *GYRO, *QUICK, "--json").data["coefficients"],
    ]
    means = [[c["mean"] for c in one] for one in found]
    assert means[0] == pytest.approx(means[1], rel=1e-6)
    assert run("predict", saved, file, *named).status == 0


def test_a_seed_gives_the_same_campaign_and_the_same_fit_again(tmp_path: Path) -> None:
    files, fits = [], []
    for i, seed in enumerate((1, 1, 3)):
        files.append(tmp_path / f"{i}.csv")
        effect = "bias.thermal_lag=0.05"
        run("simulate", *GYRO, "--effect", effect, "--seed", seed, "--out", files[-1])
        fits.append(run("fit", TABLE, *GYRO, *QUICK, "--seed", seed, "--json").out)
    for first, again, other in (fits, [f.read_bytes() for f in files]):
        assert first == again
        assert first != other


# Every command helps with an example, and its tables print on any terminal.


COMMANDS = (
    *("instruments", "effects", "simulate", "pairs", "demo", "calibrate"),
    *("fit", "check", "discover", "compare", "predict", "noise"),
    *("compensate", "export", "budget", "report"),
    *("batch", "triad", "imu", "decide", "validate", "workbench"),  # of annexes
)


def test_every_command_helps_with_an_example() -> None:
    assert tuple(commands()) == COMMANDS
    _, listed = run("--help").out.split("Commands:")
    assert all(f"  {name} " in listed for name in COMMANDS) and "..." not in listed
    for name in COMMANDS:
        done = run(name, "--help")
        assert done.status == 0 and f"Example: bayescal {name}" in " ".join(done.out.split())
        assert "--json" in done.out or name in ("export", "workbench")


# The whole loop finds what is missing, and writes what it says.


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
    assert any("were also fitted" in str(flag) for flag in with_them["flags"])
    for told in (with_them, without):  # others say that the hold-out data are a copy
        del told["search"]["seconds"], told["flags"], told["calibration"]
    assert with_them == without


@pytest.mark.slow
def test_the_demonstration(tmp_path: Path) -> None:
    done = run("demo", "--out", tmp_path / "demo", "--json")
    assert done.status == 0, done.err
    assert done.data["steps"][-1]["added"].startswith("bias.thermal_lag"), "in one of its forms"
    assert (tmp_path / "demo" / "loop.png").is_file()
