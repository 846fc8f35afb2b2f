"""The command line: every command helps, answers in text and in JSON, and says how it went."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import typer

import bayescal as bc
from bayescal._cli import main
from bayescal_models import mems_gyro
from tests.support.command_line import (
    GYRO,
    OWN_INSTRUMENT,
    QUICK,
    TABLE,
    Ran,
    needs_installation,
    run,
    write_bent_table,
)

pytestmark = needs_installation
ROOT = Path(__file__).resolve().parents[2]
PRINTED_LINE = (
    *("--reference", "T0=0"),
    *("--fix", "bias.constant=19.80", "--fix", "bias.temperature=0.041"),
)
COMMANDS = (
    *("instruments", "effects", "simulate", "fit", "check", "discover"),
    *("compare", "predict", "calibrate", "pairs", "demo"),
    *("compensate", "export", "budget", "report", "batch"),
)

OWN_EFFECTS = """
import bayescal as bc

EFFECTS = (
    bc.Effect(
        "bias.elbow", "bias",
        basis=lambda r: (r["temperature"] - 60.0).clip(0.0),
        coefficients=(bc.Coefficient("deg/s/degC", bc.Normal(0.0, 0.05)),),
        columns=("temperature",),
        equation="c·max(T − 60 °C, 0)",
    ),
)
"""


def run_apart(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    path = os.pathsep.join((str(ROOT), str(ROOT / "models"), os.environ.get("PYTHONPATH", "")))
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "bayescal._cli.main", *arguments],
        env={**os.environ, "PYTHONPATH": path.rstrip(os.pathsep), **variables},
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved calibration of the table, and files of a user's own."""
    here = tmp_path_factory.mktemp("command_line")
    (here / "level.py").write_text(OWN_INSTRUMENT, encoding="utf-8")
    (here / "my_effects.py").write_text(OWN_EFFECTS, encoding="utf-8")
    fitted = run("fit", TABLE, *GYRO, *QUICK, "--out", here / "line")
    assert fitted.status == 0, fitted.err
    return here


@pytest.fixture(scope="module")
def saved(folder: Path) -> Path:
    return folder / "line" / "calibration.nc"


@pytest.fixture(scope="module")
def loop(folder: Path) -> Ran:
    """The whole loop on a table that a line does not fit, with readings kept apart."""
    bent, kept = (write_bent_table(folder / name) for name in ("bent.csv", "kept.csv"))
    return run(
        *("calibrate", bent, *GYRO, *QUICK, "--holdout", kept),
        *("--out", folder / "loop", "--json"),
    )


# Help


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(command: str) -> None:
    done = run(command, "--help")
    assert done.status == 0
    assert f"Example: bayescal {command}" in " ".join(done.out.split())


def test_every_command_is_tested_here() -> None:
    group: Any = typer.main.get_command(main.app)
    assert tuple(group.commands) == COMMANDS


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['bayescal', 'calibrate', '--help']\n"
        "from bayescal._cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as left:\n    assert left.code == 0\n"
        "print([n for n in ('jax', 'numpy', 'pandas', 'pint', 'matplotlib') if n in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_no_command_shows_the_commands() -> None:
    done = run()
    assert done.status == 2
    assert all(command in done.out for command in COMMANDS)
    assert done.said == ["bayescal: Give a command, such as: bayescal demo. See: bayescal --help"]


# Text


def test_a_narrow_terminal_breaks_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = []
    for columns in ("40", "300"):
        monkeypatch.setenv("COLUMNS", columns)
        printed.append(run("effects", *GYRO).out)
    assert printed[0] == printed[1]
    widths = [len(line) for line in printed[0].splitlines() if line.startswith("──")]
    assert widths
    assert max(widths) <= 120


def test_a_terminal_without_degree_signs_still_prints() -> None:
    done = run_apart("instruments", PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert done.returncode == 0, done.stderr
    assert "?/s" in done.stdout


def test_effects_lists_equation_size_columns_and_source(folder: Path) -> None:
    text = run("effects", *GYRO, "--effects", folder / "my_effects.py").out
    line = next(row for row in text.splitlines() if row.startswith("bias.temperature_quadratic"))
    assert line.split()[1:] == ["0.0005", "°/s/°C²", "temperature", "c·(T", "−", "T0)²"]
    assert "your own" in text
    assert "c·max(T − 60 °C, 0)" in text
    assert "source 1; size ours: bias.constant" in text


# JSON


def test_instruments_and_effects_as_json(folder: Path) -> None:
    assert run("instruments", "--json").data["mems_gyro"]["unit"] == "deg/s"
    own = ("--effects", folder / "my_effects.py")
    listed = {e["name"]: e for e in run("effects", *GYRO, *own, "--json").data}
    assert listed["bias.constant"]["kind"] == "baseline"
    assert listed["bias.thermal_lag"]["kind"] == "candidate"
    assert listed["bias.thermal_lag"]["columns"] == ["time", "temperature"]
    assert listed["bias.elbow"]["kind"] == "your own"


def test_simulate_as_json(tmp_path: Path) -> None:
    out = tmp_path / "s.parquet"
    said = run("simulate", *GYRO, "--effect", "bias.drift=0.2", "--out", out, "--json").data
    assert said["file"] == str(out)
    assert said["effects"] == {"bias.drift": 0.2}
    assert said["rows"] == len(bc.read(out, mems_gyro.INSTRUMENT))


def test_fit_as_json() -> None:
    said = run("fit", TABLE, *GYRO, *QUICK, "--json").data
    slope = next(c for c in said["coefficients"] if c["name"] == "bias.temperature")
    assert slope["unit"] == "deg/s/degC"
    assert slope["mean"] == pytest.approx(0.0535, abs=2e-4)
    assert said["reference"]["T0"] == 57
    assert said["verdict"]["ok"] is True


def test_a_saved_calibration_is_checked_discovered_and_predicted(
    saved: Path, tmp_path: Path
) -> None:
    for name, words in (
        ("check", "residuals 0.101 °/s rms"),
        ("discover", "nothing is missing: probability"),
    ):
        text = run(name, saved)
        assert text.status == 0, text.err
        assert words in text.out
    entries = run("check", saved, "--json").data
    assert {"temperature", "order"} == {e["against"] for e in entries}
    missing = run("discover", saved, "--json").data
    assert "bias.temperature_quadratic" in {c["effect"] for c in missing["candidates"]}
    out = tmp_path / "predicted.csv"
    said = run("predict", saved, TABLE, "--out", out, "--json").data
    written = pd.read_csv(out)
    residual = written["residual [deg/s]"].to_numpy()
    assert said["rows"] == len(written) == 18
    assert said["rmse"] == pytest.approx(float(np.sqrt(np.mean(residual**2))))
    text = run("predict", saved, TABLE).out
    assert text.startswith("18 readings: rms error 0.101 °/s, expected 0.1")


def test_compare_sets_structures_side_by_side() -> None:
    chosen = ("--structure", "line", "--structure", "line+bias.temperature_quadratic")
    text = run("compare", TABLE, *GYRO, *QUICK, *chosen)
    assert text.status == 0, text.err
    assert "line+bias.temperature_quadratic" in text.out
    said = run("compare", TABLE, *GYRO, *QUICK, *chosen, "--json").data
    assert {row["name"] for row in said["rows"]} == set(chosen[1::2])
    assert sum(row["weight"] for row in said["rows"]) == pytest.approx(1.0)


# The loop


def test_the_loop_finds_what_is_missing_and_writes_what_it_says(loop: Ran, folder: Path) -> None:
    assert loop.status == 0, loop.err
    said = loop.data
    assert said["steps"][-1]["added"] == "bias.temperature_quadratic"
    assert json.loads((folder / "loop" / "result.json").read_text("utf-8")) == said
    names = {p.name for p in (folder / "loop").iterdir()}
    assert names == {"result.json", "calibration.nc", "loop.png"}


def test_readings_kept_apart_change_nothing_but_their_own_error(loop: Ran, folder: Path) -> None:
    without = run("calibrate", folder / "bent.csv", *GYRO, *QUICK, "--json").data
    with_them = loop.data
    assert without["holdout"] is None
    assert with_them["holdout"]["rows"] == 18
    errors = [step.pop("holdout_rmse") for step in with_them["steps"]]
    assert [step.pop("holdout_rmse") for step in without["steps"]] == [None] * len(errors)
    assert errors[-1] < 0.6 * errors[0]
    with_them["holdout"] = None
    assert with_them == without


def test_the_last_model_of_the_loop_can_be_checked(loop: Ran, folder: Path) -> None:
    assert loop.status == 0
    checked = run("check", folder / "loop" / "calibration.nc", "--json").data
    last = [e for e in loop.data["check"] if e["step"] == len(loop.data["steps"]) - 1]
    assert [e["against"] for e in checked] == [e["against"] for e in last]


def test_the_printed_line_leaves_every_residual_positive() -> None:
    done = run("calibrate", TABLE, *GYRO, *QUICK, *PRINTED_LINE)
    assert "18 of 18 residuals are positive, mean 0.51 (0.19 to 0.93) °/s" in done.out
    assert "fixed: bias.constant = 19.8, bias.temperature = 0.041" in done.out
    assert done.status == 1, "a calibration on trial failed, and nothing is added to save it"
    assert "The fixed coefficients leave residuals of" in done.said[-1]


@pytest.mark.slow
def test_the_loop_finds_what_was_hidden_in_a_campaign(tmp_path: Path) -> None:
    lag = ("--effect", "bias.thermal_lag=0.05")
    for name, seed in (("lag.csv", 1), ("kept.csv", 2)):
        run("simulate", *GYRO, *lag, "--seed", seed, "--out", tmp_path / name)
    calibrate = ("calibrate", tmp_path / "lag.csv", *GYRO, "--json")
    alone = run(*calibrate).data
    kept = run(*calibrate, "--holdout", tmp_path / "kept.csv").data
    assert [s["added"] for s in kept["steps"]] == [s["added"] for s in alone["steps"]]
    assert [s["added"] for s in kept["steps"]] == [None, "bias.thermal_lag"]
    first, last = (step["holdout_rmse"] for step in kept["steps"])
    assert last < 0.3 * first


@pytest.mark.slow
def test_the_demonstration(tmp_path: Path) -> None:
    done = run("demo", "--out", tmp_path / "demo", "--json")
    assert done.status == 0, done.err
    assert done.data["steps"][-1]["added"] == "bias.thermal_lag"
    assert "AGAINST THE LINE ITS PAPER PRINTS" in done.err
    assert (tmp_path / "demo" / "loop.png").is_file()


def test_an_instrument_of_ones_own(folder: Path, tmp_path: Path) -> None:
    rows = "".join(f"{t},{3 + 0.1 * t + 0.05 * (-1) ** t}\n" for t in range(20, 40))
    file = tmp_path / "level.csv"
    file.write_text("temperature [degC],output [arcsec]\n" + rows, encoding="utf-8")
    own = ("--instrument", f"{folder / 'level.py'}:INSTRUMENT")
    done = run("fit", file, *own, *QUICK, "--out", tmp_path / "level", "--json")
    assert done.status == 0, done.err
    assert done.data["coefficients"][0]["unit"] == "arcsec"
    written = tmp_path / "level" / "calibration.nc"
    text = run("check", written, *own)
    assert text.status == 0
    assert "temperature" in text.out
    refused = run("check", written)
    assert refused.status == 2
    assert "'level', which is not installed" in refused.err


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


# Seeds


def test_a_seed_gives_the_same_campaign_again(tmp_path: Path) -> None:
    files = []
    for i, seed in enumerate((1, 1, 3)):
        files.append(tmp_path / f"{i}.csv")
        effect = "bias.thermal_lag=0.05"
        run("simulate", *GYRO, "--effect", effect, "--seed", seed, "--out", files[-1])
    first, again, other = (f.read_bytes() for f in files)
    assert first == again
    assert first != other


def test_a_seed_gives_the_same_fit_again() -> None:
    first, again, other = (
        run("fit", TABLE, *GYRO, *QUICK, "--seed", seed, "--json").out for seed in (5, 5, 6)
    )
    assert first == again
    assert first != other


# Exit status 1


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
    assert done.said == ["bayescal: not to be trusted as it is: It was told not to converge."]
    assert (tmp_path / "calibration.nc").is_file()


def test_a_gate_that_failed_leaves_with_1_and_its_result(tmp_path: Path) -> None:
    done = run("calibrate", TABLE, *GYRO, *QUICK, *PRINTED_LINE, "--out", tmp_path, "--json")
    assert done.status == 1
    assert done.data["gate"]["ok"] is False
    assert done.data["gate"]["reason"] in done.said[-1]
    assert done.data == json.loads((tmp_path / "result.json").read_text("utf-8"))
