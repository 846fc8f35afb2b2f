"""Each effect hidden in a gyro campaign is as large as stated, and zero where it should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bayescal_models.mems_gyro import INSTRUMENT
from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.simulated import Simulated
from tests.simulators.test_gyro_campaign import DEFAULT, RATES, in_run, simulated

SIZES = {e.name: e.coefficients[0].size for e in INSTRUMENT.candidates}
SIZES["bias.rate"] = INSTRUMENT.effect("bias.rate").coefficients[0].size  # a form of the lag
UNLISTED = {"unlisted.periodic": 0.1, "unlisted.step": 0.2, "unlisted.humidity": 0.02}
ALL = {**SIZES, **UNLISTED}
HIDDEN = list(ALL)


def hidden(name: str, campaign: Campaign = DEFAULT, seed: int = 1) -> Simulated:
    """One effect of its plausible size, hidden alone."""
    return simulated(campaign, {name: ALL[name]}, seed=seed)


@pytest.mark.parametrize("name", HIDDEN)
def test_an_effect_changes_the_output_by_its_contribution_alone(name: str) -> None:
    turning = replace(DEFAULT, rate_input=RATES)
    without, with_it = simulated(turning, seed=5), hidden(name, turning, seed=5)
    change = with_it.columns["output"] - without.columns["output"]
    np.testing.assert_allclose(change, with_it.contributions[name], atol=1e-10)
    np.testing.assert_allclose(sum(with_it.contributions.values()), with_it.noise_free)
    twice = simulated(turning, {name: 2 * ALL[name]}, seed=5)
    np.testing.assert_allclose(twice.contributions[name], 2 * with_it.contributions[name])
    assert np.ptp(change) > 0.02


@pytest.mark.parametrize(("degree", "name"), [(2, "quadratic"), (3, "cubic")])
def test_curvature_leads_with_its_coefficient(degree: int, name: str) -> None:
    name = f"bias.temperature_{name}"
    sim = hidden(name)
    change = sim.columns["temperature"] - 55.0
    leading, part = ALL[name] * change**degree, sim.contributions[name]
    np.testing.assert_allclose(part, leading, atol=0.1 * np.abs(leading).max())
    assert np.abs(part - leading).max() > 0.02 * np.abs(leading).max()
    near = np.abs(change) < 5.1
    np.testing.assert_allclose(part[near], leading[near], rtol=0.03, atol=4e-4)
    exact = hidden(name, replace(DEFAULT, nonlinearity=0.0))
    # A mean of powers is not the power of a mean: they part a little where a reading spans a step.
    np.testing.assert_allclose(exact.contributions[name], leading, atol=5e-4)


def test_rate_integrates_to_the_change_of_temperature() -> None:
    sim = hidden("bias.rate")
    part = sim.contributions["bias.rate"]
    for run, change in (("1", 50), ("2", -50), ("3", 50)):
        in_minutes = in_run(sim, run, part).sum() * DEFAULT.average / 60.0
        assert in_minutes == pytest.approx(0.1 * change, rel=0.01)
    np.testing.assert_allclose(in_run(sim, "1", part)[:10], 0.0, atol=1e-9)


def test_lag_integrates_to_its_time_constant_and_turns_with_the_ramp() -> None:
    sim = hidden("bias.thermal_lag")
    part = sim.contributions["bias.thermal_lag"]
    for run, change in (("1", 50), ("2", -50)):
        behind = change + in_run(sim, run, part)[-1] / 0.05  # what the die has gone through
        seconds = in_run(sim, run, part).sum() * DEFAULT.average
        assert seconds == pytest.approx(-0.05 * 300 * behind, rel=0.03)
    np.testing.assert_allclose(in_run(sim, "1", part)[:10], 0.0, atol=1e-9)


def test_reference_follows_the_board_which_heats_itself() -> None:
    sim = hidden("bias.reference_voltage")
    board = sim.columns["board_temperature"]
    expected = 0.02 * (board - 55.0)
    np.testing.assert_allclose(sim.contributions["bias.reference_voltage"], expected, atol=1e-9)
    held = simulated(replace(DEFAULT, temperatures=(40.0,), dwell=6000.0, runs=1), seed=1)
    np.testing.assert_allclose(held.columns["board_temperature"][[0, -1]], [40, 42], atol=0.1)
    np.testing.assert_allclose(held.columns["temperature"], 40.0, atol=1e-9)


def test_warm_up_starts_cold_in_every_run() -> None:
    sim = hidden("bias.warm_up")
    for run in "123":
        part = in_run(sim, run, sim.contributions["bias.warm_up"])
        assert part[0] == pytest.approx(0.5 * np.exp(-17.5 / 600), rel=0.01)
        assert part[-1] == pytest.approx(0.5 * np.exp(-3287.5 / 600), rel=0.02)
    hurried = hidden("bias.warm_up", replace(DEFAULT, pause=60.0))
    still_warm = in_run(hurried, "2", hurried.contributions["bias.warm_up"])
    assert still_warm[0] < 0.1


def test_drift_adds_up_over_the_test() -> None:
    part = hidden("bias.drift").contributions["bias.drift"]
    assert part[0] == pytest.approx(0.0, abs=1e-3)
    assert part[-1] == pytest.approx(0.1, rel=0.01)
    assert (np.diff(part) > 0).all()


def test_turn_on_is_one_offset_per_run_of_the_stated_spread() -> None:
    offsets = []
    for seed in range(40):
        sim = hidden("bias.run", replace(DEFAULT, dwell=30.0), seed=seed)
        for run in ("1", "2", "3"):
            offset, *same = in_run(sim, run, sim.contributions["bias.run"])
            np.testing.assert_allclose(same, offset)
            offsets.append(offset)
    assert np.std(offsets) == pytest.approx(0.05, rel=0.2)


def test_scale_shows_only_under_a_rate() -> None:
    assert not hidden("scale.temperature").contributions["scale.temperature"].any()
    soaked = replace(DEFAULT, temperatures=(30.0, 80.0), dwell=3000.0, rate_input=(100.0,), runs=1)
    part = hidden("scale.temperature", soaked).contributions["scale.temperature"]
    np.testing.assert_allclose(part[[0, 99, -1]], [-0.75, -0.75, 0.75], rtol=1e-3)
    sim = hidden("scale.temperature", replace(DEFAULT, rate_input=RATES))
    at_rest = sim.columns["rate_input"] == 0.0
    assert 0.2 < at_rest.mean() < 0.5
    assert not sim.contributions["scale.temperature"][at_rest].any()


def test_rates_are_cycled_over_the_steps_of_all_runs() -> None:
    rate = simulated(replace(DEFAULT, rate_input=RATES), seed=1).columns["rate_input"]
    steps = rate.reshape(-1, 10)
    np.testing.assert_array_equal(steps, np.resize(RATES, 33)[:, None] * np.ones(10))


# The naive basis is near, but not what the world does.


def naive_lag(time: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Lag of 300 s behind the readings, °C, linear between them."""
    lagged = [temperature[0]]
    for k, step in enumerate(np.diff(time)):
        decay = np.exp(-step / 300.0)
        slope = (temperature[k + 1] - temperature[k]) / step
        behind = temperature[k] - 300.0 * slope
        lagged.append(behind + slope * step + (lagged[-1] - behind) * decay)
    return np.array(lagged) - temperature


def naive_rate(time: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Causal least-squares slope over 60 s of readings, °C/min."""
    rates = [0.0]
    for k in range(1, len(time)):
        window = slice(max(k - 2, 0), k + 1)
        rates.append(60.0 * np.polyfit(time[window], temperature[window], 1)[0])
    return np.array(rates)


NAIVE: dict[str, tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], float]] = {
    "bias.thermal_lag": (naive_lag, 1e-5),
    "bias.rate": (naive_rate, 0.005),
    "bias.temperature_quadratic": (lambda _, T: (T - 55.0) ** 2, 0.002),
    "bias.temperature_cubic": (lambda _, T: (T - 55.0) ** 3, 0.001),
    "bias.drift": (lambda t, _: t, 0.0005),
    "bias.warm_up": (lambda t, _: np.exp(-(t - t[0]) / 600.0), 1e-6),
}


@pytest.mark.parametrize("name", NAIVE)
def test_naive_basis_is_near_but_not_the_truth(name: str) -> None:
    basis_of, least_apart = NAIVE[name]
    sim = hidden(name)
    columns, part = sim.columns, sim.contributions[name]
    if name == "bias.drift":
        basis = basis_of(columns["time"], columns["temperature"])
    else:
        basis = np.concatenate(
            [
                basis_of(*(in_run(sim, run, columns[c]) for c in ("time", "temperature")))
                for run in "123"
            ]
        )
    assert np.corrcoef(basis, part)[0, 1] > 0.9
    fit = np.polyval(np.polyfit(basis, part, 1), basis)
    assert least_apart < np.abs(part - fit).max() < 0.5 * np.ptp(part)
