"""Noise of a sensor at rest: Q, N, B and K hold the truth, and a filter's file has them in its units."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._calibration import noise_at_rest
from bayescal._calibration.sensor_noise import NoiseFigure, _events, _for_filter
from bayescal._data.allan_deviation import even_runs
from bayescal_models import still_sensor
from tests.support.command_line import run

GYRO = still_sensor.instrument("deg/s", size=1.0, constant=10.0, span=0.0)
STEP, N, K = 0.1, 0.003, 0.002  # s; °/s/√Hz; °/s/√s


def still(seed: int, n: int = 6000, walk: float = K, **columns) -> bc.Measurements:
    random = np.random.default_rng(seed)
    rate = N / math.sqrt(STEP) * random.standard_normal(n)
    rate += walk * math.sqrt(STEP) * np.cumsum(random.standard_normal(n))
    return bc.Measurements.from_arrays(GYRO, time=STEP * np.arange(n), output=rate, **columns)


def symbol(found: bc.SensorNoise, name: str) -> NoiseFigure:
    return next(f for f in found.figures if f.symbol == name)


@pytest.fixture(scope="module")
def walking() -> bc.SensorNoise:
    return bc.noise(still(5))


@pytest.mark.slow
def test_density_and_random_walk_hold_the_truth_in_either_unit(walking) -> None:
    assert walking.law == "white + random walk"
    n, k = symbol(walking, "N"), symbol(walking, "K")
    assert n.unit == "deg/h^0.5" and n.low < 60 * N < n.high
    assert k.unit == "deg/h/h^0.5" and k.low < 3600 * 60 * K < k.high and not k.bound
    to_si = math.radians(1)
    assert n.si_unit == "rad/s/Hz^0.5" and n.si[1] < to_si * N < n.si[2]
    assert k.si_unit == "rad/s/s^0.5" and k.si[1] < to_si * K < k.si[2]
    inside = (walking.estimate_low < walking.measured.deviation) & (
        walking.measured.deviation < walking.estimate_high
    )
    assert inside.mean() >= 0.8
    assert (walking.low <= walking.expected).all() and (walking.expected <= walking.high).all()


@pytest.mark.slow
def test_rounding_of_an_angle_is_quantisation_noise() -> None:
    """Readings that are differences of an angle known to a grid L have Q = L/√12 (IEEE Std 952-1997, C.1.1)."""
    grid = 0.005  # degrees
    errors = grid * np.random.default_rng(10).uniform(-0.5, 0.5, 3001)
    readings = still(9, n=3000, walk=0.0)
    found = bc.noise(readings.with_column("output", readings["output"] + np.diff(errors) / STEP))
    assert found.law == "white + quantisation"
    n, q = symbol(found, "N"), symbol(found, "Q")
    assert q.unit == "arcsec" and q.si_unit == "rad"
    assert q.low < 3600 * grid / math.sqrt(12) < q.high < 1.1 * q.low
    assert n.low < 60 * N < n.high
    white, _ = found.for_filter()
    assert white**2 > STEP * found.measured.deviation[0] ** 2


@pytest.mark.slow
def test_the_sensors_own_averaging_is_no_slow_noise() -> None:
    """Means over 1.2 steps: two of twelve parts are in the next reading too, so neighbours are correlated by 1/6."""
    parts, n, size = 10, 3000, N * math.sqrt(10 / STEP)
    sums = np.cumsum(size * np.random.default_rng(11).standard_normal(parts * (n + 2)))
    ends = 12 + parts * np.arange(n)
    found = bc.noise(still(1, n=n).with_column("output", (sums[ends] - sums[ends - 12]) / 12))
    assert found.law == "white + averaging"
    # Eight of ten parts are in one reading and two in two, so that the density is that of (8·1 + 2·2²)/144 squares.
    density = size * math.sqrt(16 / 144 * STEP)
    n_, shared = symbol(found, "N"), next(f for f in found.figures if "neighbours" in f.name)
    assert n_.low < 60 * density < n_.high < 1.1 * n_.low
    assert shared.low < 1 / 6 < shared.high < shared.low + 0.1
    assert found.for_filter(0.5)[0] == pytest.approx(n_.value / 60, rel=0.01)


@pytest.mark.slow
def test_a_line_is_a_tone_and_no_density() -> None:
    readings, frequency = still(12, n=3000, walk=0.0), 2.31  # Hz
    line = 0.004 * math.sqrt(2) * np.cos(2 * math.pi * frequency * readings["time"])
    found = bc.noise(readings.with_column("output", readings["output"] + line))
    assert found.law == "white + tone"
    n = symbol(found, "N")
    size, at, _ = (f for f in found.figures if f.name.startswith("tone"))
    assert n.low < 60 * N < n.high and size.low < 3600 * 0.004 < size.high
    assert at.unit == "Hz" and at.value == pytest.approx(frequency, abs=0.003)


def test_lines_and_noise_of_neighbours_are_looked_for_where_they_are() -> None:
    random, n = np.random.default_rng(13), 4000
    runs = even_runs(still(1, n=n))
    white = random.standard_normal((20, n + 1))
    walks = white[:, 1:] + 0.1 * np.cumsum(random.standard_normal((20, n)), axis=1)
    line = np.cos(1.3 * np.arange(n))
    for one, walk in zip(white, walks, strict=True):
        assert noise_at_rest._line(walk, runs)[0] < 4.5
        sure, found = noise_at_rest._line(walk + 0.5 * line, runs)
        assert sure > 6 and found["noise.tone.frequency"] == pytest.approx(0.207, abs=0.01)
        named = [noise_at_rest._of_neighbours(one[1:] + s * one[:-1], runs) for s in (0.2, -0.2)]
        assert [name for name, _ in named] == ["averaging", "quantisation"]
        assert min(sure for _, sure in named) > 4
        assert noise_at_rest._of_neighbours(walk, runs)[1] < 4


@pytest.mark.slow
def test_a_walk_that_is_not_there_has_a_bound() -> None:
    found = bc.noise(still(6, walk=0.0))
    assert found.law == "white"
    k = symbol(found, "K")
    assert k.bound and 0 < k.high < 3600 * 60 * K
    assert "< " in str(found) and "not seen" in str(found)


@pytest.mark.slow
def test_means_of_blocks_say_what_single_readings_say(walking, monkeypatch) -> None:
    monkeypatch.setattr(noise_at_rest, "BLOCK_MEANS_READINGS", 1024)
    found = bc.noise(still(5))
    assert any("means of 8" in note for note in found.notes)
    for name, wider in (("N", 3.0), ("K", 1.5)):
        one, whole = symbol(found, name), symbol(walking, name)
        assert one.low < whole.value < one.high
        assert one.high - one.low < wider * (whole.high - whole.low)


@pytest.mark.slow
def test_means_and_stretches_weigh_a_random_walk_as_single_readings_do(monkeypatch) -> None:
    """From a third to three times its size; a level of each stretch must not speak of it."""
    data = still(4, n=16_384)
    profiles = []
    for longest in (1024, 20_000):
        monkeypatch.setattr(noise_at_rest, "BLOCK_MEANS_READINGS", longest)
        channel, _ = noise_at_rest._channel(data, even_runs(data))
        problem = channel.problem(("walk",))
        white = N / math.sqrt(STEP)
        sizes = [K * k for k in (1 / 3, 1.0, 3.0)]
        priors = problem.noise.parameters().values()
        at = [[p.coordinate(x) for p, x in zip(priors, (white, k), strict=True)] for k in sizes]
        found = noise_at_rest._density(problem).values(np.array(at))
        profiles.append(found - found[1])
    loss = profiles[1]
    assert (loss[[0, 2]] < -5).all()
    np.testing.assert_allclose(profiles[0], loss, rtol=0.15)


@pytest.mark.slow
def test_a_dependence_on_temperature_is_no_noise() -> None:
    plain = still(6, walk=0.0)
    temperature = 25 + 5 * np.sin(np.arange(len(plain)) / 900)
    output = plain["output"] + 0.02 * (temperature - 25) + 1e-3 * (temperature - 25) ** 2
    data = bc.Measurements.from_arrays(
        GYRO, time=plain["time"], output=output, temperature=temperature
    )
    assert bc.noise(data).law == "white"


def test_levels_and_the_curve_over_temperature_are_integrated_out() -> None:
    """Restricted likelihood of white noise: −(n − q)·log σ − squares/2σ², q levels and coefficients of a cubic."""
    temperature = 25 + 5 * np.sin(np.arange(200) / 30)
    data = still(7, n=200, temperature=temperature)
    output = data["output"] + 1e-3 * (temperature - 25) ** 2
    channel, _ = noise_at_rest._channel(data.with_column("output", output), even_runs(data))
    problem = channel.problem(())
    (prior,) = problem.noise.parameters().values()
    sizes = np.array([0.008, 0.012])
    v = np.array([[prior.coordinate(s)] for s in sizes])
    found = noise_at_rest._density(problem).values(v) - np.asarray(prior.log_density(v[:, 0]))
    design = np.vander((temperature - 25) / 5, 4)
    left = output - design @ np.linalg.lstsq(design, output, rcond=None)[0]
    exact = -(200 - 4) * np.log(sizes) - 0.5 * float(left @ left) / sizes**2
    assert found[1] - found[0] == pytest.approx(exact[1] - exact[0], rel=1e-8)


@pytest.mark.parametrize("longest", [16_384, pytest.param(512, marks=pytest.mark.slow)])
def test_lost_readings_are_missing_ones_of_the_filter(monkeypatch, longest) -> None:
    """Density and event of what is left, of single readings and of means of blocks of which some are not full."""
    monkeypatch.setattr(noise_at_rest, "BLOCK_MEANS_READINGS", longest)
    data, random = still(6, n=2000), np.random.default_rng(5)
    lost = random.random(2000) < 0.05
    lost[900:940] = True  # and a pause
    some = data.select(np.flatnonzero(~lost))
    found = bc.noise(some)
    n = symbol(found, "N")
    assert n.low < 60 * N < n.high and n.high < 1.15 * n.low
    (note,) = (note for note in found.notes if "lost" in note)
    assert float(note.split()[0]) == pytest.approx(100 * np.mean(lost), rel=0.02)
    output = some["output"] + 1.0 * (np.arange(len(some)) > 1000)
    (said,) = _events(some.with_column("output", output), even_runs(some))
    assert float(said.split()[1]) == pytest.approx(some["time"][1001], abs=4.0)


def test_what_cannot_be_told_is_refused() -> None:
    data = still(6)
    rounded = data.with_column("output", np.round(data["output"], 1))
    with pytest.raises(bc.InputError, match="rounded more coarsely than its noise"):
        bc.noise(rounded)
    uneven = data.select(np.flatnonzero(np.arange(len(data)) % 7 < 4))
    with pytest.raises(bc.InputError, match="evenly spaced"):
        bc.noise(uneven)


def test_an_event_is_told_from_noise() -> None:
    calm = still(6)
    knocked = np.where(np.arange(len(calm)) < 40, 0.1, 0.0) + calm["output"]
    (said,) = _events(calm.with_column("output", knocked), even_runs(calm))
    assert said.startswith("at 3.2 s the average over 3.2 s changes by 0.") and "warm-up" in said
    assert not any(_events(still(seed), even_runs(calm)) for seed in range(20))


# The file for a filter.


def test_noise_that_is_correlated_over_a_few_steps_is_density_to_a_filter() -> None:
    """As a walk it would have the variance of thousands of times its own after a second."""
    step, factors, size, time = 0.01, 2.0 ** np.arange(16), 0.2, 0.012
    law = bc.SummedNoise(step, 2.0**18 * step, ("correlated",))
    drawn = {
        "noise.white": np.full(2, 0.3),
        "noise.correlated1.diffusion": np.full(2, size * math.sqrt(2 / time)),
        "noise.correlated1.time": np.full(2, time),
    }
    one = noise_at_rest.RestNoise(law.terms, drawn, law)
    runs: Any = SimpleNamespace(factors=factors, step=step)
    found = noise_at_rest.WeighedNoise((one,), one, {}, (), runs)
    (density, _), (walk, _) = _for_filter(found)
    deviation = np.sqrt(
        density**2 / (step * factors) + walk**2 * step * (2 * factors**2 + 1) / (6 * factors)
    )
    ratio = deviation / np.sqrt(one.allan_variance(factors, step)[0])
    assert ratio.min() > 0.949 and ratio.max() < 1.4


@cache
def curve() -> bc.AllanDeviation:
    return bc.allan_deviation(still(1, n=100))


def told(unit: str, law: str = "white + random walk", **more) -> bc.SensorNoise:
    """A noise of N about 1 and K about 2, in a unit."""
    nothing = np.zeros(0)
    return bc.SensorNoise(
        file="a.csv",
        unit=unit,
        step=0.01,
        law=law,
        probabilities={law: 1.0},
        figures=(),
        measured=curve(),
        notes=(),
        expected=nothing,
        low=nothing,
        high=nothing,
        estimate_low=nothing,
        estimate_high=nothing,
        densities=(np.linspace(0.9, 1.1, 201), np.linspace(1.8, 2.2, 201)),
        horizon=100.0,
        **more,
    )


def numbers(text: str) -> dict[str, str]:
    rows = (line.split(": ") for line in text.splitlines() if not line.startswith("#"))
    return dict(rows)


def test_a_file_for_kalibr_has_the_noisiest_axis_in_si_units() -> None:
    louder = replace(told("deg/s"), densities=(np.full(9, 3.0), np.full(9, 0.1)))
    channels = {"gyro_x": told("deg/s"), "gyro_y": louder, "acc_x": told("ug")}
    found = numbers(bc.kalibr_yaml(channels, topic="/imu/raw", quantile=0.5))
    gravity = 9.80665e-6
    expected = {
        "gyroscope_noise_density": math.radians(3.0),
        "gyroscope_random_walk": math.radians(2.0),
        "accelerometer_noise_density": gravity,
        "accelerometer_random_walk": 2 * gravity,
        "update_rate": 100.0,
    }
    for name, value in expected.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-4)
    assert found["rostopic"] == "/imu/raw"


def test_a_higher_quantile_is_more_conservative() -> None:
    low, high = (numbers(bc.kalibr_yaml({"x": told("rad/s")}, quantile=q)) for q in (0.5, 0.95))
    assert float(high["gyroscope_noise_density"]) == pytest.approx(1.09, rel=1e-3)
    assert float(low["gyroscope_noise_density"]) == pytest.approx(1.0, rel=1e-3)


def test_what_is_left_out_is_said() -> None:
    text = bc.kalibr_yaml({"x": told("rad/s", "white + flicker"), "y": told("rad/s", "white")})
    assert "x: white + flicker. A random walk takes the place of the correlated terms" in text
    assert "y: white. No random walk is seen" in text
    assert "no accelerometer was given" in text


@pytest.mark.parametrize(
    ("channels", "quantile", "said"),
    [
        ({"x": told("rad/s")}, 1.0, "between 0 and 1"),
        ({"x": told("V")}, 0.9, "neither a gyroscope's nor an accelerometer's"),
        ({"x": told("rad/s"), "y": replace(told("ug"), step=0.02)}, 0.9, "one rate"),
    ],
)
def test_a_file_that_would_mislead_is_refused(channels, quantile, said) -> None:
    with pytest.raises(bc.InputError, match=said):
        bc.kalibr_yaml(channels, quantile=quantile)


def test_bad_input_on_the_command_line_is_status_two(tmp_path) -> None:
    file = tmp_path / "still.csv"
    file.write_text("time [s],gyro_x [deg/s]\n" + "".join(f"{i},{i % 3}\n" for i in range(50)))
    found = run("noise", file, "--columns", "output=gyro_x", "--quantile", "2")
    assert found.status == 2 and "between 0 and 1" in found.err


@pytest.mark.slow
def test_pictures_of_channels_stand_in_the_folder_whatever_their_names(tmp_path) -> None:
    file = tmp_path / "still.csv"
    drawn = np.random.default_rng(1).normal(size=(600, 2))
    rows = "".join(f"{0.01 * i:.2f},{a:.5f},{b:.5f}\n" for i, (a, b) in enumerate(drawn))
    file.write_text(f"time [s],a/b [deg/s],../c [deg/s]\n{rows}")
    folder = tmp_path / "in" / "out"
    yaml = ("--yaml", folder / "imu.yaml", "--out", folder)
    assert run("noise", file, "--channels", "a/b,../c", *yaml).status == 0
    names = ["imu.yaml", "manifest.json", "noise_a_b.png", "noise_c.png"]
    assert sorted(p.name for p in folder.iterdir()) == names
    assert [p.name for p in folder.parent.iterdir()] == ["out"]
