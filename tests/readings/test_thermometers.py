"""A thermometer is a measurement: what its column cannot have read of a body is said by name, row and run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS, mems_gyro, still_sensor
from benchmarks.hidden_effects.bank import instrument_named

Columns = dict[str, np.ndarray]
TEMPERATURE = "temperature"


def columns_of(readings: bc.Measurements) -> Columns:
    return {name: np.array(readings[name]) for name in readings.columns}


@pytest.fixture(scope="module")
def ramps() -> Columns:
    return columns_of(still_sensor.simulate(seed=1))


def oddities(columns: Columns) -> tuple[Any, ...]:
    warm = {n: "degC" for n in columns if n == "case" or n.endswith(TEMPERATURE)}
    labels = {n: None for n, values in columns.items() if values.dtype.kind in "OU"}
    return bc.Measurements(columns, dict.fromkeys(columns, "1") | warm | labels).anomalies


def said_of(columns: Columns, **changed: np.ndarray) -> list[str]:
    """What is odd, by column and kind."""
    return [f"{o.column} {o.code}" for o in oddities({**columns, **changed})]


def in_runs(columns: Columns, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    new = columns[TEMPERATURE].copy()
    for run in np.unique(columns["run"]):
        new[columns["run"] == run] = change(new[columns["run"] == run])
    return new


def test_temperatures_typed_in_as_they_were_set_are_not_held() -> None:
    """Plateaus at three set-points, half an hour apart, ten readings a minute at each."""
    time = (1800.0 * np.arange(9)[:, None] + 6.0 * np.arange(10)).ravel()
    plateaus = np.repeat(np.tile([-20.0, 20.0, 60.0], 3), 10)
    assert said_of({"time": time, TEMPERATURE: plateaus}) == []


def held(count: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: t[np.arange(len(t)) // count * count]


FAULTS = {
    "held for 3 readings": (held(3), "held"),
    "held for 10 readings": (held(10), "held"),
    "held for 30 readings": (held(30), "held"),
    "a converter at its maximum": (lambda t: np.minimum(t, 47.0), "stuck"),
    "a converter at its minimum": (lambda t: np.maximum(t, 3.0), "stuck"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_thermometer_is_named(ramps: Columns, fault: str) -> None:
    change, code = FAULTS[fault]
    assert said_of(ramps, temperature=in_runs(ramps, change)) == [f"temperature {code}"]


@pytest.mark.parametrize("name", sorted(INSTRUMENTS))
def test_simulated_thermometers_and_displays_of_few_digits_have_nothing_odd(name: str) -> None:
    for seed in (11, 12, 13):
        readings = instrument_named(name).simulate({}, seed=seed)
        assert readings.anomalies == ()
    warm = [n for n in readings.columns if readings.unit(n) == "degC"]
    for step in (0.01, 0.1, 0.5, 1.0):
        rounded = {n: step * np.rint(readings[n] / step) for n in warm}
        assert oddities({**columns_of(readings), **rounded}) == (), step


def test_a_loose_contact_and_set_points_are_no_other_level(ramps: Columns) -> None:
    """The search sees the one; set-points that are written down as they were set say nothing of a body."""
    noise = np.random.default_rng(2).normal(0, 0.3, len(ramps["time"]))
    assert said_of(ramps, temperature=ramps[TEMPERATURE] + noise) == []
    noisy, last = ramps[TEMPERATURE].copy(), ramps["run"] == "3"
    noisy[last] += np.random.default_rng(5).normal(0.0, 7.0, last.sum())
    assert said_of(ramps, temperature=noisy) == []
    plateaus = in_runs(ramps, lambda t: 10.0 * np.rint(t / 10.0))
    assert said_of(ramps, temperature=plateaus) == []


@pytest.mark.parametrize("readings", [2, 5, 20])
def test_an_output_that_was_held_is_taken_once(readings: int) -> None:
    record = still_sensor.simulate(seed=1)
    output = record["output"].copy()
    for run in np.unique(record["run"]):
        own = np.flatnonzero(record["run"] == run)
        output[own] = output[own[np.arange(len(own)) // readings * readings]]
    held = record.with_column("output", output)
    kept = bc.exclude_faults(held)
    runs = [int(np.sum(record["run"] == run)) for run in np.unique(record["run"])]
    assert len(kept) == sum(-(-n // readings) for n in runs)
    rounded = record.with_column("output", 10.0 * np.rint(record["output"] / 10.0))
    assert bc.exclude_faults(rounded) is rounded


def test_leaps_are_found_where_they_are_and_set_aside_by_name() -> None:
    readings = still_sensor.simulate(seed=3)
    rows = np.array([40, 200, 241, 300, 500, 700])  # one of them the first of a run
    warm = np.array(readings[TEMPERATURE])
    warm[rows] += np.where(np.arange(6) % 2, 40.0, -30.0)
    spoilt = readings.with_column(TEMPERATURE, warm)
    kept = bc.exclude_faults(spoilt)
    np.testing.assert_array_equal(kept["time"], np.delete(readings["time"], rows))
    assert len(bc.exclude_faults(spoilt, keep_spikes=True)) == len(readings)
    assert bc.exclude_faults(readings) is readings


def test_a_run_in_which_one_of_two_thermometers_was_different() -> None:
    columns = columns_of(mems_gyro.simulate(seed=1, campaign=mems_gyro.Campaign(average=60)))
    assert said_of(columns) == []
    columns[TEMPERATURE][columns["run"] == "3"] *= 1.1
    assert f"{TEMPERATURE} run" in said_of(columns)


def test_readings_of_a_wrong_thermometer_are_set_aside_where_the_model_needs_it() -> None:
    """Of a held one the first of each value stays."""
    record = mems_gyro.simulate(seed=1, campaign=mems_gyro.Campaign(average=60))
    columns, needed = columns_of(record), {TEMPERATURE}
    held = in_runs(columns, lambda t: t[np.arange(len(t)) // 5 * 5])
    kept = bc.exclude_faults(record.with_column(TEMPERATURE, held), needed=needed)
    runs = [int(np.sum(record["run"] == run)) for run in np.unique(record["run"])]
    assert len(kept) == sum(-(-n // 5) for n in runs)
    assert kept[TEMPERATURE] == pytest.approx(
        columns[TEMPERATURE][np.isin(record["time"], kept["time"])]
    )
    few = in_runs(columns, lambda t: t[np.arange(len(t)) // 20 * 20])
    held = record.with_column(TEMPERATURE, few)
    for whole in (bc.exclude_faults(held), bc.exclude_faults(held, True, needed=needed)):
        assert len(whole) == len(record)
