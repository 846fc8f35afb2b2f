"""Noise of a sensor at rest: Q, N, B and K hold the truth."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.command_line import run
from tests.support.tiers import slow_but

GYRO = still_sensor.instrument("deg/s", size=1.0, constant=10.0, span=0.0)
STEP, N, K = 0.1, 0.003, 0.002  # s; °/s/√Hz; °/s/√s


def still(seed: int, n: int = 6000, walk: float = K, **columns) -> bc.Measurements:
    random = np.random.default_rng(seed)
    rate = N / math.sqrt(STEP) * random.standard_normal(n)
    rate += walk * math.sqrt(STEP) * np.cumsum(random.standard_normal(n))
    return bc.Measurements.from_arrays(GYRO, time=STEP * np.arange(n), output=rate, **columns)


def symbol(found: bc.SensorNoise, name: str):
    return next(f for f in found.figures if f.symbol == name)


def codes(found: bc.SensorNoise) -> list[str]:
    return [claim.code for claim in found.claims]


@pytest.fixture(scope="module")
def walking() -> bc.SensorNoise:
    return bc.noise(still(5))


@pytest.mark.slow
def test_density_and_random_walk_hold_the_truth_in_either_unit(walking) -> None:
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
    assert found.for_filter()[0] ** 2 > STEP * found.measured.deviation[0] ** 2


@pytest.mark.slow
def test_spectral_line_is_a_tone_and_not_a_density() -> None:
    readings, frequency = still(14, n=3000, walk=0.0), 2.31  # Hz
    line = 0.004 * math.sqrt(2) * np.cos(2 * math.pi * frequency * readings["time"])
    found = bc.noise(readings.with_column("output", readings["output"] + line))
    assert found.law == "white + tone"
    n = symbol(found, "N")
    size, at, _ = (f for f in found.figures if f.name.startswith("tone"))
    assert n.low < 60 * N < n.high and size.low < 3600 * 0.004 < size.high
    assert at.unit == "Hz" and at.value == pytest.approx(frequency, abs=0.003)


@pytest.mark.slow
def test_a_bound_of_a_walk_is_that_of_all_sums_by_their_probability() -> None:
    """By chance an Ornstein–Uhlenbeck process is the most probable: beside it a walk would be less than this one."""
    found = bc.noise(still(5210, n=10_000))
    assert found.law == "white + Ornstein–Uhlenbeck" and symbol(found, "K").bound
    assert K < symbol(found, "K").high / (3600 * 60) < 1.2 * K


def test_absent_random_walk_has_an_upper_bound() -> None:
    found = bc.noise(still(6, walk=0.0))
    k = symbol(found, "K")
    assert found.law == "white" and k.bound and 0 < k.high < 3600 * 60 * K


@pytest.mark.slow
def test_a_dependence_on_temperature_is_no_noise() -> None:
    plain = still(6, walk=0.0)
    temperature = 25 + 5 * np.sin(np.arange(len(plain)) / 900)
    output = plain["output"] + 0.02 * (temperature - 25) + 1e-3 * (temperature - 25) ** 2
    data = bc.Measurements.from_arrays(
        GYRO, time=plain["time"], output=output, temperature=temperature
    )
    found = bc.noise(data)
    assert found.law == "white" and "noise.outside" not in codes(found)
    assert symbol(found, "N").low < 60 * N < symbol(found, "N").high  # not hidden by the drift


def records(count: int) -> np.ndarray:
    """Whether the intervals of N and K hold the truth, of white noise and a walk; and of B, beside flicker noise."""
    held, n, size = [], 10_000, 7e-4
    frequency = np.fft.rfftfreq(2 * n)[1:]
    for seed in range(count):
        random = np.random.default_rng([31, seed])
        walking = bc.noise(still(1000 + seed, n=n))
        drawn = random.standard_normal((len(frequency), 2)) @ [1, 1j]
        shape = np.append(0.0, size * drawn * np.sqrt(n / (2 * np.pi * frequency)))
        flicker = np.fft.irfft(shape, 2 * n)[:n]  # of the spectrum B²/(2πf), IEEE 952
        data = still(2000 + seed, n=n, walk=0.0)
        flickering = bc.noise(data.with_column("output", data["output"] + flicker))
        pairs = (
            (walking, "N", 60 * N),
            (walking, "K", 3600 * 60 * K),
            (flickering, "B", 3600 * size),
        )
        found = [(next((f for f in r.figures if f.symbol == s), None), t) for r, s, t in pairs]
        held.append([np.nan if f is None or f.bound else f.low < t < f.high for f, t in found])
    return np.array(held)


@pytest.mark.parametrize("count", [2, pytest.param(60, marks=pytest.mark.slow)])
def test_intervals_hold_the_truth(count) -> None:
    held = records(count)
    assert np.mean(np.isnan(held)) < 0.2
    share = np.nanmean(held, axis=0)
    assert (share >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / count)).all()


@pytest.mark.slow
def test_noise_figures_equal_those_of_the_filter() -> None:
    """White noise and a walk under the same priors, fitted by the Kalman filter."""
    data = still(5)
    found, changes = bc.noise(data), np.diff(data["output"])
    scale = bc.HalfCauchy(1.4826 * float(np.median(np.abs(changes))) / math.sqrt(2))
    law = bc.SummedNoise(STEP, STEP * 8192, ("walk",), scale, scale)
    fit = bc.fit(GYRO.baseline().with_noise(law), data, strict=False)
    posterior = fit.tree["posterior"]
    for name, own, unit in (
        ("N", "noise.white", 60 * math.sqrt(STEP)),
        ("K", "noise.walk", 3600 * 60),
    ):
        values, one = unit * posterior[own].values, symbol(found, name)
        assert one.value == pytest.approx(float(np.median(values)), rel=0.01)


def test_lost_readings_are_drawn_from_the_law() -> None:
    data, random = still(6, n=2000), np.random.default_rng(5)
    lost = random.random(2000) < 0.05
    lost[900:940] = True  # and a pause
    some = data.select(np.flatnonzero(~lost))
    found = bc.noise(some)
    n = symbol(found, "N")
    assert n.low < 60 * N < n.high and n.high < 1.15 * n.low
    (claim,) = found.claims
    assert claim.code == "noise.lost"
    assert claim.numbers["share"] == pytest.approx(np.mean(lost), rel=0.02)


FINE = 16  # steps of the noise in one of the readings


def behind(
    kind: str, seed: int, n: int = 2000, density: float = N, step: float = 0.01
) -> np.ndarray:
    """Readings of white noise behind a low-pass, a mean, an interpolation or a hold of several steps, °/s."""
    random = np.random.default_rng(seed)
    fine = density * math.sqrt(FINE / step) * random.standard_normal(FINE * (n + 400))
    rare = density / math.sqrt(3.2 * step) * random.standard_normal(n)
    at = np.arange(n) / 3.2
    if kind == "hold":
        return rare[at.astype(int)]
    if kind == "interpolation":
        return np.interp(at, np.arange(n), rare)
    if kind == "mean":
        return np.convolve(fine, np.ones(6 * FINE) / (6 * FINE), "valid")[::FINE][:n]
    order = {"first order": 1, "Butterworth": 2, "Butterworth of fourth order": 4}[kind]
    passed = np.asarray(sosfilt(butter(order, 8.0, fs=FINE / step, output="sos"), fine))
    return passed[400 * FINE :: FINE][:n]


KINDS = (
    "first order",
    "Butterworth",
    "Butterworth of fourth order",
    "mean",
    "interpolation",
    "hold",
)


@pytest.mark.parametrize("kind", slow_but(KINDS[:1], KINDS))
def test_density_behind_a_filter_is_the_level_that_averages_fall_along(kind) -> None:
    output = behind(kind, 21)
    data = bc.Measurements.from_arrays(GYRO, time=0.01 * np.arange(len(output)), output=output)
    found = bc.noise(data)
    n = symbol(found, "N")
    # within four standard uncertainties; that 95 % intervals hold is the nightly test's
    assert 2 * n.low - n.value < 60 * N < 2 * n.high - n.value and n.high < 2 * n.low
    assert "noise.means" in codes(found) and "noise.outside" not in codes(found)
    # a filter is told the same
    assert 60 * found.for_filter(0.5)[0] == pytest.approx(n.value, rel=0.03)


@pytest.mark.nightly
def test_intervals_of_density_behind_filters_hold_the_truth() -> None:
    held = []
    for kind in KINDS:
        for seed in range(12):
            output = behind(kind, 100 + seed)
            time = 0.01 * np.arange(len(output))
            found = bc.noise(bc.Measurements.from_arrays(GYRO, time=time, output=output))
            n = symbol(found, "N")
            held += [] if n.bound else [n.low < 60 * N < n.high]
    assert len(held) > 0.9 * 12 * len(KINDS) and np.mean(held) > 0.88


@pytest.mark.slow
def test_density_below_a_low_pass_is_not_seen() -> None:
    """Of a time constant of a third of the record."""
    random, output = np.random.default_rng(3), np.zeros(1500)
    for i in range(1, 1500):
        output[i] = output[i - 1] * (1 - 1 / 500) + random.standard_normal() / 500
    data = bc.Measurements.from_arrays(GYRO, time=0.01 * np.arange(1500), output=output)
    found = bc.noise(data)
    assert symbol(found, "N").bound and "noise.no_level" in codes(found)


def log(path: Path, output: np.ndarray, labels=None, name: str = "device") -> Path:
    """A log of a gyroscope at 100 Hz; of several in turn, if there are labels."""
    labels = [] if labels is None else labels
    count, more = max(1, len(labels)), f",{name}" if len(labels) else ""
    rows = (
        f"{0.01 * (i // count):.2f},{y:.6f}" + (f",{labels[i % count]}" if len(labels) else "")
        for i, y in enumerate(output)
    )
    path.write_text(f"time [s],gyro_x [deg/s]{more}\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.slow
def test_law_that_its_own_record_leaves_is_status_one(tmp_path) -> None:
    output = 0.02 * np.random.default_rng(4).standard_normal(2000)
    output += 0.05 * np.sin(2 * np.pi * np.arange(2000) / 90)
    path = log(tmp_path / "still.csv", output)
    done = run("noise", path, "--columns", "output=gyro_x", "--json")
    assert done.status == 1
    (found,) = json.loads(done.out).values()
    assert "noise.outside" in [claim["code"] for claim in found["claims"]]


def test_each_device_of_a_file_has_its_own_table(tmp_path) -> None:
    sizes = np.array([N, 5 * N]) / math.sqrt(0.01)
    output = np.random.default_rng(8).standard_normal(1600) * np.tile(sizes, 800)
    path = log(tmp_path / "two.csv", output, "AB")
    done = run("noise", path, "--columns", "output=gyro_x", "--json")
    assert done.status == 0, done.err
    found = json.loads(done.out)
    assert ["A" in name or "B" in name for name in found] == [True, True]
    for (name, one), size in zip(found.items(), (N, 5 * N), strict=True):
        (n,) = (f for f in one["figures"] if f["symbol"] == "N")
        assert n["low"] < 60 * size < n["high"], name
    still = bc.read(path, GYRO, columns={"output": "gyro_x"})
    with pytest.raises(bc.InputError, match="device"):
        bc.noise(still)


def test_sensors_of_two_kinds_in_one_column_are_refused(tmp_path) -> None:
    output = np.random.default_rng(8).standard_normal(400)
    path = log(tmp_path / "phone.csv", output, ["accelerometer", "gyroscope"], "sensor")
    done = run("noise", path, "--columns", "output=gyro_x")
    assert done.status == 2 and "accelerometer" in done.err and not done.out


def test_unusable_time_stamps_are_refused(tmp_path) -> None:
    random, path = np.random.default_rng(8), tmp_path / "six.csv"
    rows = (f"1.73234e+09,{y:.6f}" for y in random.standard_normal(300))
    path.write_text("time [s],gyro_x [deg/s]\n" + "\n".join(rows))
    done = run("noise", path, "--columns", "output=gyro_x")
    assert done.status == 2 and "time" in done.err and "Traceback" not in done.err
