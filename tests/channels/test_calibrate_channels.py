"""Channels of one unit together: one body for all, structures of their own, results that can be kept; the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor
from bayescal_models.still_sensor.simulator import LAG_TAU_S
from tests.support.command_line import needs_installation, run

LAG, QUADRATIC = "bias.thermal_lag", "bias.temperature_quadratic"
HIDDEN = {"strong": {LAG: 8.0}, "weak": {LAG: 3.0}, "none": {QUADRATIC: 0.05}}


@pytest.fixture(scope="module")
def unit() -> bc.Channels:
    readings = {
        name: still_sensor.simulate(effects, seed=20 + i, runs=1, interval=20)
        for i, (name, effects) in enumerate(HIDDEN.items())
    }
    models = {n: still_sensor.INSTRUMENT.for_readings(r).baseline() for n, r in readings.items()}
    return bc.calibrate_channels(models, readings, method=bc.LeastSquares(draws=400))


@pytest.mark.slow
def test_what_one_channel_shows_helps_another_and_none_gets_what_it_has_not(unit) -> None:
    models = {n: t.final.calibration.model for n, t in unit.search_paths.items()}
    assert LAG in models["strong"].names and LAG in models["weak"].names
    assert LAG not in models["none"].names and QUADRATIC in models["none"].names
    shape = {n: models[n].effect(LAG).shared_shape for n in ("strong", "weak")}
    assert shape["weak"].high / shape["weak"].low < 2  # by what the strong one says
    assert shape["strong"].high / shape["strong"].low > shape["weak"].high / shape["weak"].low


@pytest.mark.slow
def test_the_unit_has_one_time_and_it_is_the_true_one(unit) -> None:
    lag = next(s for s in unit.shared if s.effect == LAG)
    _, low, high = lag.posterior
    assert lag.probability > 0.95
    assert low < LAG_TAU_S < high
    paths = unit.search_paths
    tau = {n: paths[n].final.calibration.samples(f"{LAG}.tau") for n in ("strong", "weak")}
    for (
        draws
    ) in tau.values():  # each channel's own readings, with what the others say: one posterior
        middle, spread = np.log(draws).mean(), np.log(draws).std()
        assert middle == pytest.approx(np.log(lag.posterior[0]), abs=0.5 * spread)
        assert spread == pytest.approx(np.log(high / low) / 3.92, rel=0.3)


@pytest.mark.slow
def test_a_unit_is_saved_channel_by_channel_and_each_is_loaded_as_it_was(unit, tmp_path) -> None:
    unit.save(tmp_path)
    data = json.loads((tmp_path / "channels.json").read_text("utf-8"))
    assert set(data["channels"]) == set(HIDDEN)
    for name, told in data["channels"].items():
        kept = bc.load(tmp_path / told["folder"] / "calibration.nc")
        now = unit.search_paths[name].final.calibration
        assert kept.model.names == now.model.names
        assert [e.shapes for e in kept.model.effects] == [e.shapes for e in now.model.effects]
        np.testing.assert_array_equal(kept.samples("bias.constant"), now.samples("bias.constant"))
    lag = next(s for s in data["shared"] if s["effect"] == LAG)
    assert lag["low"] < LAG_TAU_S < lag["high"]


@pytest.mark.slow
def test_results_of_removed_channels_are_deleted_and_user_files_kept(unit, tmp_path) -> None:
    unit.save(tmp_path)
    (tmp_path / "weak" / "notes.txt").write_text("mine", encoding="utf-8")
    bc.Channels({"strong": unit.search_paths["strong"]}, unit.shared).save(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        "strong",
        "weak",
        "channels.json",
        "manifest.json",
    }
    assert [p.name for p in (tmp_path / "weak").iterdir()] == ["notes.txt"]


NAMES = ("gyro_x", "gz (deg/s)/2")


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
@needs_installation
def test_the_command_calibrates_saves_and_reports(tmp_path: Path) -> None:
    """A unit of two channels over a ramp, one bent."""
    time = np.arange(60) * 30.0
    temperature = 25 + 30 * np.sin(time / 400)
    noise = 0.02 * np.random.default_rng(5).standard_normal((2, time.size))
    first = 0.5 + 0.04 * temperature + noise[0]
    second = -1.0 + 0.02 * temperature + 1e-3 * (temperature - 25) ** 2 + noise[1]
    table = np.column_stack([time, temperature, first, second])
    head = f"time [s],temperature [degC],{NAMES[0]} [deg/s],{NAMES[1]} [deg/s]"
    path, out = tmp_path / "unit.csv", tmp_path / "result"
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    how = ("--instrument", "still_sensor", "--method", "least-squares")
    ran = run("calibrate", path, *how, "--channels", ",".join(NAMES), "--out", out)
    assert ran.status == 0, ran.err
    told = json.loads((out / "channels.json").read_text("utf-8"))
    assert set(told["channels"]) == set(NAMES)
    # Whatever a channel's name holds.
    assert all((out / c["folder"]).parent == out for c in told["channels"].values())
    assert QUADRATIC in told["channels"][NAMES[1]]["effects"]
    assert QUADRATIC not in told["channels"][NAMES[0]]["effects"]
    reported = run("report", out, "--out", tmp_path / "unit.html")
    assert reported.status == 0, reported.err
    assert (tmp_path / "unit.html").is_file()
