"""Each effect hidden in a test of the ng accelerometer is there, as large as stated, and of its own physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayescal_models import ng_accelerometer as ng
from bayescal_models.ng_accelerometer.model import TIDE
from bayescal_models.ng_accelerometer.moon_and_sun import plumb_line, tide
from bayescal_models.ng_accelerometer.simulator import LAWS, simulate_arrays
from bayescal_models.simulated import HOUR, Simulated

PLAN = replace(ng.INSTRUMENT_A, alternate=True, runs=2, positions=4)
HIDDEN = [*[effect.name for effect in ng.INSTRUMENT.candidates], "bias.rate"]  # a form of the lag
PLAIN = simulate_arrays(seed=5, campaign=PLAN)


def hidden(name: str, size: float, plan: ng.Campaign = PLAN) -> Simulated:
    return simulate_arrays({name: size}, seed=5, campaign=plan)


def part(name: str, plan: ng.Campaign = PLAN) -> np.ndarray:
    """What one unit of an effect adds to its (first) slot, in the effect's unit, averaged over each reading."""
    (law, *_) = LAWS[name]
    made = hidden(name, 1.0, plan)
    return law.curve(made.world).mean(axis=1)


@pytest.mark.parametrize("name", HIDDEN)
def test_an_effect_changes_the_output_alone_and_in_proportion(name: str) -> None:
    size = ng.INSTRUMENT.effect(name).coefficients[0].size
    once, twice = hidden(name, size), hidden(name, 2 * size)
    change = once.noise_free - PLAIN.noise_free
    np.testing.assert_allclose(
        once.columns["output"] - PLAIN.columns["output"], change, atol=1e-9
    )  # the same noise
    for (slot, a), (_, b) in zip(once.contributions[name], twice.contributions[name], strict=True):
        assert np.ptp(a) > 0 or slot in ("second_order", "third_order", "cross_coupling")
        np.testing.assert_allclose(b, 2 * a)
    np.testing.assert_allclose(
        twice.noise_free - PLAIN.noise_free, 2 * change, atol=0.02 * np.abs(change).max()
    )
    expected = {
        "rotation.harmonic": 0.01,
        "base_tilt.tide": 0.01,
        "cross_coupling.temperature": 0.05,
    }
    assert np.abs(change).max() > expected.get(name, 0.1)  # µg


def test_hysteresis_follows_the_direction_and_begins_at_nothing() -> None:
    state, world = part("bias.hysteresis"), PLAIN.world
    for run, sign in ((0, 1), (1, -1)):
        own = world.run == run
        first = world.cell == world.cell[own][0]
        np.testing.assert_allclose(state[first], 0.0, atol=0.02)
        np.testing.assert_allclose(state[own & ~first], sign, atol=0.05)


def test_curves_lead_with_their_power_and_go_beyond_it() -> None:
    change = PLAIN.world.device.mean(axis=1) - PLAN.T0
    for name, power in (("bias.temperature_quadratic", 2), ("bias.temperature_cubic", 3)):
        curve = part(name)
        np.testing.assert_allclose(curve, change**power, rtol=0.01, atol=0.01)
        assert np.abs(curve - change**power).max() > 0.3


def test_lag_and_rate_fade_during_a_cell() -> None:
    world = PLAIN.world
    for name in ("bias.thermal_lag", "bias.rate"):
        curve = np.abs(part(name, replace(PLAN, soak=1200.0, chamber_wander=0.0)))
        own = (world.run == 0) & (world.cell > 0)
        for cell in np.unique(world.cell[own]):
            inside = curve[world.cell == cell]
            assert (np.diff(inside) < 0).all()
            assert inside[0] > 0.1
    soaked = part("bias.thermal_lag", replace(PLAN, soak=24 * HOUR, chamber_wander=0.0))
    np.testing.assert_allclose(soaked, 0.0, atol=1e-3)


def test_a_longer_test_drifts_no_further_and_warm_up_decays() -> None:
    for name in ("bias.drift", "base_tilt.drift"):
        curve = part(name)
        assert curve[0] == pytest.approx(0.0, abs=1e-3)
        assert curve[-1] == pytest.approx(1.0, abs=1e-3)
        assert (np.diff(curve) > 0).all()
    warmth = part("bias.warm_up")
    assert (np.diff(warmth[PLAIN.world.run == 0]) < 0).all()
    assert warmth[0] == pytest.approx(np.exp(-390 / 1800), rel=0.01)


def test_groups_scatter_by_the_stated_spread() -> None:
    plan = replace(PLAN, runs=60, temperatures=(20.0, 40.0), pause=0.0, soak=600.0)
    world = simulate_arrays(seed=5, campaign=plan).world
    for draws, codes in ((world.by_cell["bias"], world.cell), (world.by_run["scale"], world.run)):
        own = np.array([draws[codes == k, 0] for k in np.unique(codes)])
        assert (np.ptp(own, axis=1) == 0).all()
        assert own[:, 0].std() == pytest.approx(1.0, abs=0.25)


def test_base_follows_the_laboratory_and_the_chamber_late() -> None:
    world = PLAIN.world
    laboratory = world.laboratory.mean(axis=1) - 23.0
    follows = part("base_tilt.lab_temperature")
    assert 0.8 < np.corrcoef(laboratory, follows)[0, 1] < 1.0
    assert np.abs(laboratory).max() < 2.0
    chamber, base = world.device.mean(axis=1) - PLAN.T0, part("base_tilt.temperature")
    assert 0.95 < np.corrcoef(chamber, base)[0, 1] < 1.0


def unexplained(component: np.ndarray, seconds: np.ndarray, stretch: float) -> float:
    """Share of a tide's variance that sines and cosines of the five periods, stretched, leave."""
    periods = [stretch * hours * HOUR for hours, _ in TIDE.values()]
    waves = [wave(2 * np.pi * seconds / p) for p in periods for wave in (np.cos, np.sin)]
    basis = np.column_stack([*waves, np.ones_like(seconds)])
    fit = basis @ np.linalg.lstsq(basis, component, rcond=None)[0]
    return float(np.var(component - fit) / np.var(component))


def test_the_tide_is_the_five_constituents_and_little_else() -> None:
    seconds = np.arange(0.0, 60 * 86400.0, 1800.0)
    for component in tide(seconds, 7730.0, 30.5, 114.4):
        assert unexplained(component, seconds, 1.0) < 0.1
        assert unexplained(component, seconds, 1.02) > 0.5
    east, north = plumb_line(7730.0 + seconds / 86400.0, 30.5, 114.4)
    assert 0.8e-7 < np.abs(east).max() < 1.5e-7  # 84 nrad of the Moon and 39 of the Sun, at most
    assert 0.3e-7 < np.abs(north).max() < 1.5e-7


def test_the_plan_is_the_document_s() -> None:
    readings = ng.simulate(seed=5)
    assert len(readings) == 12 * 5 * 3
    assert len(readings.groups("cell")[0]) == 15
    assert np.abs(readings["temperature"] - readings["temperature_point"]).max() < 0.3
    turned_over = replace(ng.INSTRUMENT_A, tilts=(0.45 * np.pi / 180, 179.55 * np.pi / 180))
    assert len(ng.simulate(seed=5, campaign=turned_over)) == 360
