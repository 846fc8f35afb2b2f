"""A simulated test of the ng accelerometer: its plan, what differs by chance, and the tide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayescal_models import ng_accelerometer as ng
from bayescal_models.ng_accelerometer.model import TIDE
from bayescal_models.ng_accelerometer.moon_and_sun import plumb_line, tide
from bayescal_models.ng_accelerometer.simulator import simulate_arrays
from bayescal_models.simulated import HOUR

PLAN = replace(ng.INSTRUMENT_A, alternate=True, runs=2, positions=4)


def test_groups_scatter_by_the_stated_spread() -> None:
    plan = replace(PLAN, runs=60, temperatures=(20.0, 40.0), pause=0.0, soak=600.0)
    world = simulate_arrays(seed=5, campaign=plan).world
    for draws, codes in ((world.by_cell["bias"], world.cell), (world.by_run["scale"], world.run)):
        own = np.array([draws[codes == k, 0] for k in np.unique(codes)])
        assert (np.ptp(own, axis=1) == 0).all()
        assert own[:, 0].std() == pytest.approx(1.0, abs=0.25)


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
