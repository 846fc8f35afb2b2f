"""The ordinary test's own worlds and oracle: energy is kept, steps are fine enough, evidences are exact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from benchmarks.ordinary_test.bodies import lump, slab, two_stages
from benchmarks.ordinary_test.oracle import least_squares, log_evidence
from benchmarks.ordinary_test.worlds import STRUCTURES, Campaign, drawn
from benchmarks.wrong_model.worlds import inclinometer
from tests.support.tiers import slow_but

BODIES = {
    "die": lump(300.0),
    "two stages": two_stages(200.0, 120.0, 0.3),
    "slab, its mean": slab(900.0, 5.0, True),
    "slab, its far face": slab(900.0, 20.0, False),
}


def outside(step: float, seconds: float = 3600.0) -> np.ndarray:
    """A ramp, a hold and a wave, °C."""
    t = np.arange(0.0, seconds + 0.5 * step, step)
    return np.interp(t, [0, 600, 1500, 2400, seconds], [25, 25, 70, 70, -10]) + np.sin(t / 200)


@pytest.mark.parametrize("name", BODIES)
def test_heat_that_enters_is_stored(name: str) -> None:
    body, face = BODIES[name], outside(1.0)
    cells = body.cells(face, 1.0, body.settled(face[0]))
    flow = body.conductance[0] * (face - cells[:, 0])  # W
    entered = np.cumsum(0.5 * (flow[1:] + flow[:-1]))
    stored = (cells[1:] - cells[0]) @ body.capacity
    np.testing.assert_allclose(entered, stored, rtol=1e-9, atol=1e-9 * np.ptp(stored))


def test_heat_of_a_heater_leaves_through_the_face() -> None:
    """In the end all of its power does, and the cells stand as far above the outside as `settled` says."""
    body, still = BODIES["slab, its far face"], np.zeros(40_000)
    last = body.cells(still, 1.0, 0 * body.capacity, power=3.0)[-1]
    assert body.conductance[0] * last[0] == pytest.approx(3.0, rel=1e-9)
    np.testing.assert_allclose(last, body.settled(0.0, 3.0), rtol=1e-9)


def test_a_slab_follows_the_series_of_its_eigenfunctions() -> None:
    """Its mean after a step of its face: 1 − Σ 8/(π²k²)·exp(−k²π²t/4τ), k odd (Carslaw & Jaeger, 1959, §3.3)."""
    tau, t = 900.0, np.arange(0.0, 2001.0)
    k = np.arange(1, 400, 2)[:, None]
    true = 1 - (8 / (np.pi * k) ** 2 * np.exp(-((k * np.pi) ** 2) * t / (4 * tau))).sum(axis=0)
    face = np.ones_like(t)
    body = slab(tau, 1e9, True)
    found = body.cells(face, 1.0, 0 * body.capacity) @ body.weight
    assert np.max(np.abs(found - true)[30:]) < 2e-3


def test_one_body_and_two_follow_their_exponentials() -> None:
    t = np.arange(0.0, 3000.0)
    face = np.ones_like(t)
    one = lump(300.0).cells(face, 1.0, np.zeros(1))[:, 0]
    np.testing.assert_allclose(one, 1 - np.exp(-t / 300.0), atol=1e-5)
    body = BODIES["two stages"]
    rates, modes = np.linalg.eig(body.between / body.capacity[:, None])
    parts = np.linalg.solve(modes, np.ones(2))
    true = 1 - (modes[1, :, None] * parts[:, None] * np.exp(rates[:, None] * t)).sum(axis=0)
    found = body.cells(face, 1.0, np.zeros(2))[:, 1]
    np.testing.assert_allclose(found, true, atol=1e-5)


@pytest.fixture(scope="module", params=slow_but({*STRUCTURES} - {"die", "two stages"}, STRUCTURES))
def campaign(request: pytest.FixtureRequest) -> Campaign:
    hidden = ("run", "warm-up", "curve", "supply")
    return drawn(np.random.default_rng(3), request.param, False, 200, hidden, recorded=True)


def test_true_columns_make_the_output(campaign: Campaign) -> None:
    """Their fit to the output without noise leaves next to nothing, in what is fitted and in what is held out."""
    for record in (campaign.fitted, *campaign.later.values()):
        columns, _, _ = campaign.design(record)
        left = record.clean - columns @ least_squares(record.clean, columns)
        assert np.max(np.abs(left)) < 0.3 * campaign.sensor.noise  # of the thermometer's noise


def test_the_true_model_predicts_to_the_noise(campaign: Campaign) -> None:
    for error in campaign.errors_of_true().values():
        assert 0.7 < error / campaign.sensor.noise < 1.4


def small_problem(k: int, n: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(k)
    columns, sd = rng.standard_normal((n, k)), rng.uniform(0.5, 3.0, k)
    return columns @ (sd * rng.standard_normal(k)) + 0.7 * rng.standard_normal(n), columns, sd


@pytest.mark.parametrize("k", [1, 3])
def test_evidence_is_that_of_the_whole_covariance(k: int) -> None:
    y, columns, sd = small_problem(k)

    def density(log_sigma: float) -> float:
        covariance = (columns * sd**2) @ columns.T + math.exp(2 * log_sigma) * np.eye(len(y))
        return math.exp(multivariate_normal(np.zeros(len(y)), covariance).logpdf(y))  # pyright: ignore[reportArgumentType]

    true = math.log(quad(density, -5, 5, epsabs=0, limit=400)[0])
    assert log_evidence(y, columns, sd) == pytest.approx(true, abs=1e-3)


# The worlds of *Where the model may be wrong*: what is called true of a coefficient is true of the readings.


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
