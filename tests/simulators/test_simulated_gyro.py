"""The simulated gyro campaigns keep their promises, and the resonance its physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayescal_models.mems_gyro import TABLE
from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.resonance import (
    compute_amplitude_law,
    compute_denominator,
    compute_force_law,
)
from bayescal_models.mems_gyro.simulator import NOISE_LAWS, simulate_arrays
from bayescal_models.simulated import SimulatedTest

DEFAULT = Campaign()
RATES = (0.0, 100.0, -100.0)


def simulated(campaign: Campaign, effects: dict | None = None, **options) -> SimulatedTest:
    return simulate_arrays(effects, campaign=campaign, **options)


def in_run(sim: SimulatedTest, run: str, values: np.ndarray) -> np.ndarray:
    """The values of one run."""
    return values[sim.columns["run"] == run]


def test_default_campaign_goes_up_down_up_in_330_readings() -> None:
    sim = simulated(DEFAULT, seed=0)
    assert len(sim.columns["output"]) == DEFAULT.readings == 330
    assert list(sim.columns) == ["run", "time", "temperature", "board_temperature", "output"]
    for run, first, last in (("1", 30, 80), ("2", 80, 30), ("3", 30, 80)):
        temperature = in_run(sim, run, sim.columns["temperature"])
        np.testing.assert_allclose(temperature[[0, -1]], [first, last], atol=0.1)
    time = sim.columns["time"]
    assert (np.diff(time) >= DEFAULT.average).all()
    assert in_run(sim, "2", time)[0] - in_run(sim, "1", time)[-1] == 3600 + DEFAULT.average


def test_without_effects_the_output_is_the_line_and_noise() -> None:
    sim = simulated(DEFAULT, seed=4)
    line = 21.5 + 0.0535 * (sim.columns["temperature"] - 55.0)
    np.testing.assert_allclose(sim.noise_free, line, atol=1e-10)
    noise = sim.columns["output"] - line
    assert noise.std() == pytest.approx(0.05, rel=0.15)


def test_readings_are_averages_of_the_logger_samples() -> None:
    effects = {"bias.rate": 0.1, "bias.thermal_lag": 0.05, "unlisted.humidity": 0.02}
    short = simulated(DEFAULT, effects, seed=2)
    long = simulated(replace(DEFAULT, average=60.0), effects, seed=2)
    for values, longer in (
        (short.noise_free, long.noise_free),
        (short.columns["time"], long.columns["time"]),
        (short.columns["board_temperature"], long.columns["board_temperature"]),
    ):
        np.testing.assert_allclose(values.reshape(-1, 2).mean(axis=1), longer)
    assert short.columns["time"][0] == 17.5  # samples at 5, 10 … 30 s


def test_noise_laws() -> None:
    many = replace(DEFAULT, runs=12)
    noise = {}
    for law in NOISE_LAWS:
        sim = simulated(many, seed=3, noise_law=law)
        noise[law] = sim.columns["output"] - sim.noise_free

    def follow(values: np.ndarray) -> float:
        return float(np.corrcoef(values[1:], values[:-1])[0, 1])

    def kurtosis(values: np.ndarray) -> float:
        return float(np.mean(values**4) / np.mean(values**2) ** 2)

    assert noise["white"].std() == pytest.approx(0.05, rel=0.1)
    assert noise["student_t"].std() == pytest.approx(0.05, rel=0.2)
    assert noise["ornstein_uhlenbeck"].std() == pytest.approx(0.05 * np.sqrt(2), rel=0.2)
    assert kurtosis(noise["student_t"]) > 4.5 > 3.5 > kurtosis(noise["white"])
    assert abs(follow(noise["white"])) < 0.1 and follow(noise["ornstein_uhlenbeck"]) > 0.3


def test_thermometer_errs_without_touching_the_gyro() -> None:
    good = simulated(DEFAULT, seed=1)
    bad = simulated(replace(DEFAULT, thermometer_noise=0.29), seed=1)
    error = bad.columns["temperature"] - good.columns["temperature"]
    assert error.std() == pytest.approx(0.29, rel=0.15)
    np.testing.assert_array_equal(bad.columns["output"], good.columns["output"])


def test_resonance_denominator_at_match_is_the_damping() -> None:
    assert compute_denominator(0.0, 8e-5, 8e-5, 1.0, 250.0) == pytest.approx(1 / 250)
    apart = compute_denominator(np.array([-25.0, 25.0]), 8e-5, 8e-5, 1.1, 1e9)
    np.testing.assert_allclose(apart, 0.21 * np.array([1.002, 0.998]))


CHANGE = np.linspace(-25.0, 25.0, 101)  # °C


@pytest.mark.parametrize("gain", [compute_amplitude_law, compute_force_law])
@pytest.mark.parametrize("ratio", [1.0, 1.001, 1.05])
def test_all_of_the_offset_as_quadrature_is_17_times_too_flat(gain, ratio: float) -> None:
    slope = 21.4 * np.ptp(gain(CHANGE[[0, -1]], 1e-4, 1e-4, ratio, 1000.0)) / 50.0
    assert 0.001 < slope < 0.00325


def test_resonance_of_the_table_s_slope_is_nearly_straight() -> None:
    rate = 669.0 * compute_amplitude_law(CHANGE, 8e-5, 8e-5, 1.05, 1000.0)
    slope, middle = np.polyfit(CHANGE, rate, 1)
    assert slope == pytest.approx(0.0535, rel=0.01) and middle == pytest.approx(0.0, abs=0.01)
    bend = rate - np.polyval([slope, middle], CHANGE)
    assert 1e-4 < np.abs(bend).max() < 0.003


# The document's gyro table is what its provenance says, misprints included.


def table(name: str) -> np.ndarray:
    """Numbers of a file of the gyro's data folder."""
    return np.loadtxt(TABLE.with_name(name), delimiter=",", skiprows=1)


def test_voltage_and_rate_agree_but_at_two_temperatures() -> None:
    rates = table("zero_rate_table.csv")
    volts = table("zero_rate_table_volts.csv")
    apart = np.abs(volts[:, 1] - (1.2 + 0.83e-3 * rates[:, 1]))
    rounding = 0.05e-3 + 0.83e-3 * 0.005
    assert set(rates[apart > rounding, 0]) == {60.0, 63.0}
    np.testing.assert_allclose(apart[apart > rounding], [0.12e-3, 0.09e-3], atol=0.005e-3)


def test_rates_are_cycled_over_the_steps_of_all_runs() -> None:
    rate = simulated(replace(DEFAULT, rate_input=RATES), seed=1).columns["rate_input"]
    steps = rate.reshape(-1, 10)
    np.testing.assert_array_equal(steps, np.resize(RATES, 33)[:, None] * np.ones(10))
