"""Rows at which a thermometer cannot be right: error values, a stuck value, a counter that wrapped."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor

STILL, SLOPE, ROWS = still_sensor.INSTRUMENT, 4e-3, 400
STEP = 1 / 16  # °C, of a DS18B20
NEEDED = {"temperature"}


@cache
def log(seed: int, low: float = 15.0, high: float = 45.0) -> tuple[np.ndarray, ...]:
    """Time, shown temperature and output of one slow run: 1 V + s·(T − 30 °C), white noise of 1 mV."""
    rng = np.random.default_rng([seed, 8])
    time = 30.0 * np.arange(ROWS)
    wave = np.sin(2 * np.pi * (1.5 * np.arange(ROWS) / ROWS + rng.random()))
    true = 0.5 * (low + high) + 0.5 * (high - low) * wave
    output = 1.0 + SLOPE * (true - 30.0) + 1e-3 * rng.standard_normal(ROWS)
    return time, STEP * np.rint(true / STEP), output


def readings_of(time: np.ndarray, warm: np.ndarray, output: np.ndarray) -> bc.Measurements:
    columns = {"time": time, "temperature": warm, "output": output}
    return bc.Measurements.from_arrays(STILL, units={"output": "V"}, **columns)


def file_of(folder: Path, time: np.ndarray, warm: np.ndarray, output: np.ndarray) -> Path:
    rows = (f"{t:g},{w:.4f},{y:.5f}" for t, w, y in zip(time, warm, output, strict=True))
    path = folder / "log.csv"
    path.write_text("\n".join(["time [s],temperature [degC],output [V]", *rows]) + "\n")
    return path


def slope_of(readings: bc.Measurements) -> float:
    """How far the fitted slope is from the true one, standard uncertainties."""
    model = STILL.for_readings(readings).baseline()
    slope = bc.fit(model, readings, bc.LeastSquares(draws=400)).samples("bias.temperature")
    return float(abs(slope.mean() - SLOPE) / slope.std())


REBOOTS = {  # two reboots of unlike length, a bus error, and the first and last rows
    "several": (
        np.r_[0:3, 90:96, 200:212, 300:302, 398:400],
        np.r_[[85.0] * 21, [0.0] * 2, [-127.0] * 2],
    )
}
RUNS = {
    f"{v} in {n}": (150 + np.arange(n), v)
    for n in (1, 2, 7, 25)
    for v in (85.0, 0.0, -127.0, -40.0)
}


@pytest.mark.parametrize("rows", [*RUNS, *REBOOTS])
def test_error_value_of_some_rows_is_set_aside(rows: str) -> None:
    wrong, values = {**RUNS, **REBOOTS}[rows]
    time, warm, output = log(1)
    spoilt = warm.copy()
    spoilt[wrong] = values
    kept = bc.exclude_faults(readings_of(time, spoilt, output), needed=NEEDED)
    np.testing.assert_array_equal(kept["time"], np.delete(time, wrong))
    assert slope_of(kept) < 4


def test_stuck_value_is_set_aside_where_it_ends_in_a_leap() -> None:
    time, warm, output = log(2)
    spoilt, wrong = warm.copy(), 100 + np.arange(40)
    spoilt[wrong] = spoilt[100]
    kept = bc.exclude_faults(readings_of(time, spoilt, output), needed=NEEDED)
    assert not np.isin(time[wrong[20:]], kept["time"]).any() and len(kept) > ROWS - 60
    assert slope_of(kept) < 4


def test_error_value_of_a_thermometer_that_no_model_needs_takes_few_rows() -> None:
    """Of a second thermometer a long error says nothing of the readings; a short one is left out all the same."""
    record = mems_gyro.simulate(seed=1)
    for count, gone in ((3, 3), (60, 0)):
        board = np.array(record["board_temperature"])
        board[150 : 150 + count] = -127.0
        spoilt = record.with_column("board_temperature", board)
        assert len(record) - len(bc.exclude_faults(spoilt, needed=NEEDED)) == gone


def test_chamber_that_steps_between_two_readings_is_kept() -> None:
    """The output takes part in each leap; so it was the body's."""
    rng, time = np.random.default_rng(3), 200.0 * np.arange(240.0)
    goal = np.repeat(rng.permutation(np.linspace(-20.0, 70.0, 12)), 20)
    warm = goal + 0.02 * rng.standard_normal(240)
    body = goal.copy()
    for i in range(1, 240):
        body[i] = goal[i] + (body[i - 1] - goal[i]) * np.exp(-200.0 / 300.0)
    output = 1.0 + SLOPE * (body - 30.0) + 1e-3 * rng.standard_normal(240)
    record = readings_of(time, warm, output)
    assert bc.exclude_faults(record, needed=NEEDED) is record and record.anomalies == ()


@pytest.mark.parametrize("gone", ["none", "those near the end of the counter", "every seventh"])
@pytest.mark.parametrize(
    ("period", "low", "high"),
    [(256.0, -15.0, 40.0), (6553.6, -15.0, 40.0), (655.36, -8.0, 30.0), (64.0, 18.0, 90.0)],
)
def test_counter_that_wrapped_is_said_with_the_option_that_undoes_it(
    tmp_path: Path, period: float, low: float, high: float, gone: str
) -> None:
    time, warm, output = log(4, low, high)
    wrapped = np.mod(warm, period)
    top = {"none": np.inf, "those near the end of the counter": period - 4.0}.get(gone, np.inf)
    kept = wrapped < top if gone != "every seventh" else np.arange(ROWS) % 7 > 0
    path = file_of(tmp_path, time[kept], wrapped[kept], output[kept])
    try:
        said = " ".join(bc.read(path, STILL).flags)
    except bc.InputError as error:  # beyond what is plausible
        said = str(error)
    assert "PERIODdegC" in said
    undone = bc.read(path, STILL, unwrap={"temperature": f"{period:g}degC"})
    np.testing.assert_allclose(undone["temperature"], warm[kept], atol=1e-3)


def test_counter_of_several_runs_is_undone_in_each(tmp_path: Path) -> None:
    """The second run begins at room temperature again, where the first ended beyond a wrap."""
    time = np.arange(0.0, 3000.0, 30.0)
    warm = 25.0 + 55.0 * time / time[-1]
    rows = [
        f"{run},{t + 9e3 * run:g},{w % 64.0:.4f},0.5"
        for run in (1, 2)
        for t, w in zip(time, warm, strict=True)
    ]
    path = tmp_path / "runs.csv"
    path.write_text("\n".join(["run,time [s],temperature [degC],output [V]", *rows]) + "\n")
    found = bc.read(path, STILL, unwrap={"temperature": "64degC"})
    np.testing.assert_allclose(found["temperature"], np.tile(warm, 2), atol=1e-3)


@pytest.mark.slow
def test_wrap_of_less_than_a_leap_leaves_the_slope_right_or_shuts_the_gate() -> None:
    """A step of the output in temperature stands for the wrap at 37 °C; of two, at 23 °C, it is a wave in time."""
    time, warm, output = log(7)
    once, twice = (readings_of(time, np.mod(warm, period), output) for period in (37.0, 23.0))
    model = STILL.for_readings(once).baseline()
    slope = bc.calibrate(model, once).calibration.samples("bias.temperature")
    assert abs(slope.mean() - SLOPE) < 3 * slope.std() < 0.01 * SLOPE
    assert not bc.calibrate(model, twice).ok


@pytest.mark.slow
def test_lost_sign_shuts_the_gate() -> None:
    readings = readings_of(*map(np.abs, log(5, -25.0, 40.0)))
    assert not bc.calibrate(STILL.for_readings(readings).baseline(), readings).ok
