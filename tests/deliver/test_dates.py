"""A calibration's clock: dated readings of another day are corrected for what the date changes; others are asked."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import run

GYRO, QUICK = mems_gyro.INSTRUMENT, bc.LeastSquares(draws=200)
BEGAN = datetime(2026, 5, 4, 10, 14, 20, tzinfo=UTC)
DAY, STEP, ROWS, NOISE = 86400.0, 60.0, 60, 0.02  # s, s, readings of a run, °/s
DRIFT, WARM_UP, TAU = 0.03, 0.4, 600.0  # °/s a day, °/s, s
LATER = 9.0  # days after the first reading


def columns(day: float, seed: int) -> dict[str, np.ndarray]:
    """A run of a gyroscope that begins on a day: its bias drifts by the date, and warms up in each run."""
    random, elapsed = np.random.default_rng(seed), STEP * np.arange(ROWS)
    temperature = 25 + 15 * np.sin(elapsed / 700 + seed)
    rate = 50 * np.sin(2 * np.pi * np.arange(ROWS) / 7)
    bias = 0.1 + 0.01 * (temperature - 25) + DRIFT * (day + elapsed / DAY)
    output = rate + bias + WARM_UP * np.exp(-elapsed / TAU) + NOISE * random.standard_normal(ROWS)
    time = day * DAY + elapsed
    return {"time": time, "temperature": temperature, "rate_input": rate, "output": output}


def file(
    folder: Path, name: str, day: float, seed: int, clock: str = "dates", run: str = ""
) -> Path:
    """A run as a file; its times are dates, seconds since the first run, or seconds since its own beginning."""
    made = columns(day, seed)
    times = [repr(float(t)) for t in made["time"] - (made["time"][0] if clock == "own" else 0.0)]
    if clock == "dates":
        times = [f"{BEGAN + timedelta(seconds=t):%Y-%m-%d %H:%M:%S}" for t in made["time"]]
    head = "time" if clock == "dates" else "time [s]"
    lines = [f"{head},temperature [degC],rate_input [deg/s],output [deg/s]" + ",run" * bool(run)]
    rest = zip(times, made["temperature"], made["rate_input"], made["output"], strict=True)
    lines += [",".join(map(str, row)) + f",{run}" * bool(run) for row in rest]
    path = folder / name
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


def fitted(folder: Path, clock: str = "dates", run: str = "") -> bc.Calibration:
    names = [file(folder, f"{d}.csv", d, d, clock, f"{run}{d}" if run else "") for d in (0, 1, 3)]
    readings = bc.read(names, GYRO)
    return bc.fit(
        GYRO.baseline() + "scale.constant" + "bias.warm_up" + "bias.drift", readings, QUICK
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("dates")


@pytest.fixture(scope="module")
def dated(folder: Path) -> bc.Calibration:
    return fitted(folder)


@pytest.fixture(scope="module")
def undated(tmp_path_factory: pytest.TempPathFactory) -> bc.Calibration:
    return fitted(tmp_path_factory.mktemp("undated"), "since the first run")


def error(value: np.ndarray, uncertainty: np.ndarray, day: float = LATER) -> float:
    """The largest error of compensated readings, in standard uncertainties."""
    off = value - columns(day, 7)["rate_input"]
    assert np.sqrt(np.mean(off**2)) < 1.5 * NOISE
    return float(np.max(abs(off) / uncertainty))


def compensated(fit: bc.Calibration, readings: bc.Measurements, day: float = LATER) -> float:
    found = bc.compensator(fit)(readings, warn=False)
    return error(found.value, found.uncertainty, day)


@pytest.mark.parametrize("day", [0, 3, LATER])
def test_dated_readings_are_compensated_on_the_clock_of_the_calibration(
    dated: bc.Calibration, tmp_path: Path, day: float
) -> None:
    readings = bc.read(file(tmp_path, "used.csv", day, 7), GYRO)
    assert compensated(dated, readings, day) < 4
    assert bc.predict(dated, readings).rmse < 1.5 * NOISE


def test_hold_out_data_of_another_day_are_on_the_clock_of_the_readings(
    dated: bc.Calibration, tmp_path: Path
) -> None:
    how = {"method": QUICK, "max_effects": 0, "widen_noise": False}
    without = bc.read(file(tmp_path, "undated.csv", LATER, 7, "own"), GYRO)
    with pytest.raises(bc.InputError, match=r"undated\.csv"):
        bc.calibrate(dated.model, dated.readings, holdout=without, **how)
    kept = bc.read(file(tmp_path, "kept.csv", LATER, 7), GYRO)
    path = bc.calibrate(dated.model, dated.readings, holdout=kept, **how)
    assert path.steps[0].holdout_rmse is not None
    assert path.steps[0].holdout_rmse < 1.5 * NOISE


def test_a_run_of_the_same_name_on_another_day_warms_up_anew(tmp_path: Path) -> None:
    calibration = fitted(tmp_path, run="r")
    again = bc.read(file(tmp_path, "again.csv", LATER, 7, run="r3"), GYRO)
    assert bc.predict(calibration, again).rmse < 1.5 * NOISE


def test_exports_state_the_epoch(dated: bc.Calibration, tmp_path: Path) -> None:
    correct = bc.compensator(dated)
    correct.export(tmp_path / "gyro.json")
    about = json.loads((tmp_path / "gyro.json").read_text("utf-8"))["about"]
    assert about["epoch"] == BEGAN.timestamp()
    readings = bc.read(file(tmp_path, "used.csv", LATER, 7), GYRO)
    found = correct(readings, method="first order", warn=False)
    assert error(found.value, found.uncertainty) < 4
    header = correct.export(tmp_path / "gyro.h").read_text("utf-8")
    assert f"#define MEMS_GYRO_EPOCH {BEGAN.timestamp()!r}" in header
    assert "2026-05-04 10:14:20" in header
    script: dict = {}
    exec(correct.export(tmp_path / "gyro.py").read_text("utf-8"), script)
    assert script["EPOCH"] == BEGAN.timestamp()


def test_readings_without_dates_are_refused_until_their_begin_is_said(
    dated: bc.Calibration, undated: bc.Calibration, tmp_path: Path
) -> None:
    alone = file(tmp_path, "alone.csv", LATER, 7, "own")
    with pytest.raises(bc.InputError, match=r"alone\.csv"):
        bc.compensator(dated)(bc.read(alone, GYRO))
    with pytest.raises(bc.InputError, match=r"alone\.csv"):
        bc.predict(dated, bc.read(alone, GYRO))
    for begin in ("2026-05-13 10:14:20", "9 days", {"alone.csv": "9 days"}):
        readings = bc.read(alone, GYRO, like=dated.readings, begin=begin)
        assert compensated(dated, readings) < 4
    with_dates = file(tmp_path, "dated.csv", LATER, 7)
    with pytest.raises(bc.InputError, match=r"dated\.csv"):
        bc.compensator(undated)(bc.read(with_dates, GYRO))
    readings = bc.read(with_dates, GYRO, like=undated.readings, begin="9 days")
    assert compensated(undated, readings) < 4
    for begin in ("in spring", "10:14", "9 kg"):
        with pytest.raises(bc.InputError, match="begin"):
            bc.read(alone, GYRO, begin=begin)


def status(calibration: bc.Calibration, path: Path, *more: str) -> int:
    """The status of `bayescal compensate`; what it writes is right."""
    saved, out = path.with_name("saved.nc"), path.with_name("out.csv")
    calibration.save(saved)
    ran = run("compensate", saved, path, "--out", out, *more)
    assert "Traceback" not in ran.err
    assert (ran.status == 2) == (path.name in ran.err.splitlines()[-1])
    if ran.status == 0:
        value, sd = np.genfromtxt(out, delimiter=",", skip_header=1).T[-2:]
        assert error(value, sd) < 4
    return ran.status


def test_dates_are_columns_of_a_compensator(dated: bc.Calibration) -> None:
    made, correct = columns(LATER, 7), bc.compensator(dated)
    start = np.datetime64(BEGAN.replace(tzinfo=None))
    made["time"] = start + np.round(made["time"]).astype("timedelta64[s]")
    found = correct(**made, warn=False)
    assert error(found.value, found.uncertainty) < 4
    assert correct.about.epoch == BEGAN.timestamp()


def test_readings_without_dates_pass_where_nothing_changes_with_them(
    dated: bc.Calibration, tmp_path: Path
) -> None:
    calibration = bc.fit(dated.model - "bias.drift", dated.readings, QUICK, strict=False)
    alone, same = (
        bc.predict(calibration, bc.read(file(tmp_path, "used.csv", LATER, 7, clock), GYRO))
        for clock in ("own", "dates")
    )
    np.testing.assert_allclose(alone.mean, same.mean, atol=1e-9)


def test_files_without_dates_are_joined_to_others_by_their_begin(tmp_path: Path) -> None:
    files = [file(tmp_path, "a.csv", 0, 0), file(tmp_path, "b.csv", 1, 1, "own")]
    with pytest.raises(bc.InputError, match=r"b\.csv"):
        bc.read(files, GYRO)
    found = bc.read(files, GYRO, begin={"b.csv": "2026-05-05 10:14:20"})
    assert found["time"][ROWS] == DAY and found.since == BEGAN.timestamp()


@pytest.mark.slow
def test_the_command_asks_when_a_file_begins(undated: bc.Calibration, tmp_path: Path) -> None:
    alone = file(tmp_path, "own.csv", LATER, 7, "own")
    assert status(undated, alone) == 2
    assert status(undated, alone, "--begin", f"{alone.name}=9 days") == 0
    assert status(undated, file(tmp_path, "later.csv", LATER, 7, "since the first run")) == 0


def test_written_readings_keep_their_dates(tmp_path: Path) -> None:
    readings = bc.read(file(tmp_path, "used.csv", LATER, 7), GYRO)
    back = bc.read(readings.write(tmp_path / "written.csv"), GYRO)
    assert back.since == readings.since
    np.testing.assert_allclose(back["time"], readings["time"], atol=1e-6)
