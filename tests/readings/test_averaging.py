"""Means of readings: what they hold, which readings they never mix, and the noise that they keep."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from tests.readings.test_measurements import SCALE

RNG = np.random.default_rng(3)


def log(n: int = 1000, **columns: Any) -> bc.Measurements:
    """Ten readings a second with noise of 2 µg."""
    held = {"time": 0.1 * np.arange(n), "output": RNG.normal(5.0, 2.0, n), **columns}
    return bc.Measurements.from_arrays(SCALE, **held)


def test_means_of_a_regular_log() -> None:
    data = log(run=np.repeat(["a", "b"], 500), angle=np.linspace(2, 3, 1000))
    means = data.average("1 s")
    assert len(means) == 100
    assert means.columns == data.columns
    assert "output_uncertainty" not in means  # all means have the same noise, which a fit finds
    for name in ("time", "angle", "output"):
        expected = data[name].reshape(100, 10).mean(axis=1)
        np.testing.assert_allclose(means[name], expected, rtol=1e-12)
    assert means["run"].tolist() == ["a"] * 50 + ["b"] * 50
    assert means.unit("angle") == "rad"


def test_the_noise_of_a_single_reading_is_told() -> None:
    ramp = log(20_000, output=RNG.normal(0.0, 2.0, 20_000) + 0.05 * np.arange(20_000))
    (flag,) = [f for f in ramp.average(1.0).flags if "averaged" in f]
    assert flag.startswith(
        "the given arrays: 20000 readings averaged over 1 s, to 2000 means of 10"
    )
    told = float(flag.split("noise of one reading: ")[1].split(" µg")[0])
    assert told == pytest.approx(2.0, rel=0.03)


def test_a_mean_of_fewer_readings_has_the_noise_of_fewer() -> None:
    data = log()
    kept = np.setdiff1d(np.arange(1000), [23, 24, 25, 26, 999])
    means = data.select(kept).average("1 s")
    counts = np.full(100, 10)
    counts[2], counts[99] = 6, 9
    own = means["output_uncertainty"]
    single = own[2] / np.sqrt(1 / 6 - 1 / 10)
    assert single == pytest.approx(2.0, rel=0.1)
    np.testing.assert_allclose(own, single * np.sqrt(1 / counts - 1 / 10), rtol=1e-9)
    assert "means of 6 to 10" in means.flags[-1]


def test_known_uncertainties_are_those_of_means() -> None:
    known = np.tile([1.0, 3.0], 500)
    means = log(output_uncertainty=known).average("1 s")
    np.testing.assert_allclose(means["output_uncertainty"], np.sqrt(5 * 1 + 5 * 9) / 10)
    assert "1.9" not in means.flags[-1]  # known is no noise to be found


def test_no_mean_reaches_across_runs_labels_points_or_gaps() -> None:
    n = 200
    time = 0.1 * np.arange(n)
    time[100:] += 5.03  # a gap, after which means go on from the run's first reading
    run = np.tile(["a", "b"], n // 2)  # two records that interleave
    point = np.where(np.arange(n) < 44, 20.0, np.nan)
    point[150:] = 30.0
    side = np.where(np.arange(n) < 77, "up", "down")
    data = log(n, time=time, run=run, temperature_point=point).with_column("side", side)
    means = data.average("1 s")
    rebuilt = 0
    for label in ("a", "b"):
        mine = means.select(means["run"] == label)
        assert (np.diff(mine["time"]) > 0).all()
        for i in range(len(mine)):
            same = (run == label) & (side == mine["side"][i])
            same &= np.isclose(point, mine["temperature_point"][i], equal_nan=True)
            same &= np.abs(time - mine["time"][i]) <= 0.5
            assert np.ptp(time[same]) < 1.0
            assert time[same].min() <= mine["time"][i] <= time[same].max()
            rebuilt += 1
    assert rebuilt == len(means)
    assert data["output"].min() <= means["output"].min()


def test_a_mean_ends_where_a_setting_changes() -> None:
    angle = np.repeat(np.arange(8) * 0.7, 125)  # held for 12.5 s each
    data = log(angle=angle)
    means = data.average("1 s")
    assert set(means["angle"]) == set(angle)
    noisy = data.with_column("angle", angle + RNG.normal(0.0, 1e-4, 1000)).average("1 s")
    assert np.min(np.abs(noisy["angle"][:, None] - angle[None, ::125]), axis=1).max() < 1e-3
    assert len(means) == len(noisy) == 104  # four of the seven steps fall within a second


def test_a_column_that_moves_or_toggles_is_averaged() -> None:
    for angle in (np.sin(np.arange(1000) / 30), RNG.integers(0, 2, 1000) * 1e-3):
        means = log(angle=angle).average("1 s")
        np.testing.assert_allclose(means["angle"], angle.reshape(100, 10).mean(axis=1))


def test_an_uneven_clock_moves_no_reading_across() -> None:
    data = log()
    late = data.with_column("time", data["time"] + RNG.uniform(-0.02, 0.02, 1000) + 1.7e9)
    assert "means of 10;" in late.average("1 s").flags[-1]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("1s", 1.0), ("1 s", 1.0), ("0.5s", 0.5), ("2min", 120.0), ("1 minute", 60.0), (3, 3.0)]
    + [("1e-3 s", 1e-3), (" 20 ms ", 0.02), ("1h", 3600.0)],
)
def test_times_are_read_as_people_write_them(text: str | float, seconds: float) -> None:
    data = bc.Measurements.from_arrays(SCALE, time=0.25 * seconds * np.arange(20), output=range(20))
    assert f"averaged over {seconds:g} s, to 5 means of 4" in data.average(text).flags[-1]


def test_averaging_that_cannot_be_is_refused() -> None:
    with pytest.raises(bc.InputError, match=r"no two readings .* within 0.05 s \(they are 0.1 s"):
        log().average("0.05 s")
    with pytest.raises(bc.InputError, match="averaging over 3600 s combines all 1000 readings"):
        log().average("1 h")
    timeless = bc.Measurements.from_arrays(SCALE, output=RNG.normal(size=30))
    with pytest.raises(bc.InputError, match="no column 'time'"):
        timeless.average("1 s")
