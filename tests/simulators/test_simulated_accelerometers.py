"""The quartz beam accelerometer's simulated world: thermometers that hang together, effects as large as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayescal_models import ng_accelerometer as ng
from bayescal_models import quartz_beam_accelerometer as quartz
from bayescal_models.ng_accelerometer.model import CONSTITUENTS
from bayescal_models.ng_accelerometer.moon_and_sun import compute_tide, plumb_line_tilt
from bayescal_models.ng_accelerometer.simulator import simulate_arrays
from bayescal_models.quartz_beam_accelerometer.campaign import STEP_S
from bayescal_models.quartz_beam_accelerometer.world import COUPLING, SELF_HEATING, Conditions
from bayescal_models.simulated import HOUR, apply_low_pass

PLAIN = quartz.simulate(seed=3)


def test_uncompensated_change_is_what_the_source_names() -> None:
    for device in ("cubic", "beams"):
        true = quartz.true_values(quartz.Campaign(device=device))
        assert np.ptp(true.bias) > 5000  # µg: source 2, more than 5 mg
        assert np.ptp(true.scale) > 500  # ppm


def test_circuit_and_head_follow_the_chamber_and_each_other() -> None:
    plan = quartz.Campaign(thermometer_noise=0.0)
    world = Conditions(plan)
    soaked = world.cell >= 0
    t1, t2 = world.average(world.circuit), world.average(world.head)
    # Soaked: circuit warmer by its own heat, head by its share of that; both still.
    np.testing.assert_allclose(t1[soaked] - world.point[soaked], SELF_HEATING, atol=0.02)
    expected = COUPLING * SELF_HEATING
    np.testing.assert_allclose(t2[soaked] - world.point[soaked], expected, atol=0.02)
    assert np.abs(world.average(world.head_rate))[soaked].max() < 0.005
    # On ramps the head lags more than the circuit: the gradient goes with the rate, both ways.
    ramp = (world.run == 2) & ~soaked
    rate, gradient = world.average(world.head_rate)[ramp], (t1 - t2)[ramp]
    assert rate.max() > 1.8 and rate.min() < -1.8
    assert np.corrcoef(rate, gradient)[0, 1] > 0.8
    # Power-on: the circuit warms while the room does not.
    first = np.flatnonzero(ramp)[:10]
    assert t1[first[-1]] - t1[first[0]] > 2.0


def test_a_body_follows_a_ramp_behind_by_its_time_constant() -> None:
    ramp = 0.02 * STEP_S * np.arange(2000, dtype=np.float64)  # 0.02 °C/s
    assert ramp[-1] - apply_low_pass(ramp, 300.0, STEP_S)[-1] == pytest.approx(
        0.02 * 300.0, rel=1e-6
    )


def test_the_beams_lag_so_that_up_and_down_ramps_differ() -> None:
    plan = quartz.Campaign(repeats=0, attitudes=(0.0,), device="beams")
    true, head = quartz.true_values(plan).bias, Conditions(plan)
    t2, rate = head.average(head.head), head.average(head.head_rate)
    up, down = (true[(abs(t2) < 5) & (np.sign(rate) == s)].mean() for s in (1, -1))
    assert abs(up - down) > 100  # µg: hysteresis that temperature alone cannot tell


def test_correlated_noise_is_as_large_as_the_white() -> None:
    wander = quartz.simulate(seed=3, campaign=quartz.Campaign(noise_law="ornstein_uhlenbeck"))
    assert np.std(wander["output"] - PLAIN["output"]) == pytest.approx(5.0, rel=0.5)


PLAN = replace(ng.INSTRUMENT_A, alternate=True, runs=2, positions=4)


def test_groups_scatter_by_the_stated_spread() -> None:
    plan = replace(PLAN, runs=60, temperatures=(20.0, 40.0), pause=0.0, soak=600.0)
    made = simulate_arrays(seed=5, campaign=plan).conditions
    by_cell, by_run = made.cell_deviates["bias"], made.run_deviates["scale"]
    for draws, codes in ((by_cell, made.cell), (by_run, made.run)):
        own = np.array([draws[codes == k, 0] for k in np.unique(codes)])
        assert (np.ptp(own, axis=1) == 0).all()
        assert own[:, 0].std() == pytest.approx(1.0, abs=0.25)


def unexplained(component: np.ndarray, seconds: np.ndarray, stretch: float) -> float:
    """Share of a tide's variance that sines and cosines of the five periods, stretched, leave."""
    periods = [stretch * hours * HOUR for hours, _ in CONSTITUENTS.values()]
    waves = [wave(2 * np.pi * seconds / p) for p in periods for wave in (np.cos, np.sin)]
    basis = np.column_stack([*waves, np.ones_like(seconds)])
    fit = basis @ np.linalg.lstsq(basis, component, rcond=None)[0]
    return float(np.var(component - fit) / np.var(component))


def test_the_tide_is_the_five_constituents_and_little_else() -> None:
    seconds = np.arange(0.0, 60 * 86400.0, 1800.0)
    for component in compute_tide(seconds):
        assert unexplained(component, seconds, 1.0) < 0.1
        assert unexplained(component, seconds, 1.02) > 0.5
    east, north = plumb_line_tilt(7730.0 + seconds / 86400.0)
    assert 0.8e-7 < np.abs(east).max() < 1.5e-7  # 84 nrad of the Moon and 39 of the Sun, at most
    assert 0.3e-7 < np.abs(north).max() < 1.5e-7


def test_the_plan_is_the_document_s() -> None:
    readings = ng.simulate(seed=5)
    assert len(readings) == 12 * 5 * 3
    assert len(readings.groups("cell")[0]) == 15
    assert np.abs(readings["temperature"] - readings["temperature_point"]).max() < 0.3
    turned_over = replace(ng.INSTRUMENT_A, tilts=(0.45 * np.pi / 180, 179.55 * np.pi / 180))
    assert len(ng.simulate(seed=5, campaign=turned_over)) == 360
