"""The worlds of *Where the model may be wrong*: what is called true of a coefficient is true of the readings."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.wrong_model.worlds import inclinometer


def test_an_inclinometers_axis_is_its_line_where_nothing_is_hidden() -> None:
    world = inclinometer(3, {})
    for axis in "xy":
        own = world.readings["axis"] == axis
        degrees = np.rad2deg(world.readings["placement_angle"][own])
        runs = (
            world.readings["run"][own][:, None] == np.unique(world.readings["run"][own])
        ).astype(float)
        found = np.linalg.lstsq(np.c_[runs, degrees], world.truth[own], rcond=None)[0]
        constant, slope = world.about(f"zero({axis})", 20.0, 2)
        assert found[-1] == pytest.approx(slope, abs=1e-9)
        assert np.all(np.abs(found[:-1] - constant) <= 2.0 * np.sqrt(3.0) + 1e-9)  # offsets of runs


@pytest.mark.parametrize(
    "name", ["zero.placement_quadratic", "zero.temperature", "base_tilt.drift"]
)
def test_a_hidden_effect_moves_what_is_true_at_zero(name: str) -> None:
    """By its mean over the readings if it is of time, by its value at T0 if it is of temperature, else not."""
    bare, made = (inclinometer(3, hidden) for hidden in ({}, {name: 2.0}))
    moved = [made.about(f"zero({a})", 21.0, 2) - bare.about(f"zero({a})", 21.0, 2) for a in "xy"]
    assert np.allclose([m[1] for m in moved], 0.0, atol=1e-6)
    if name == "zero.placement_quadratic":
        assert np.allclose([m[0] for m in moved], 0.0, atol=1e-6)
    else:
        assert min(abs(m[0]) for m in moved) > 0.1
