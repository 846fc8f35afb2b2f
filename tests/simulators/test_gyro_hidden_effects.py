"""Each effect hidden in a gyro campaign is as large as stated, and zero where it should be."""

from __future__ import annotations

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


def test_reference_follows_the_board_which_heats_itself() -> None:
    sim = hidden("bias.reference_voltage")
    board = sim.columns["board_temperature"]
    expected = 0.02 * (board - 55.0)
    np.testing.assert_allclose(sim.contributions["bias.reference_voltage"], expected, atol=1e-9)
    held = simulated(replace(DEFAULT, temperatures=(40.0,), dwell=6000.0, runs=1), seed=1)
    np.testing.assert_allclose(held.columns["board_temperature"][[0, -1]], [40, 42], atol=0.1)
    np.testing.assert_allclose(held.columns["temperature"], 40.0, atol=1e-9)


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
