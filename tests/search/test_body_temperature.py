"""An output at the temperature of a body behind the thermometer: line and curve at one T̃, of whatever form."""

from __future__ import annotations

import itertools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import bayescal as bc
from bayescal._model.frame import reference_of
from bayescal._search.discover import enumerate_structures
from bayescal._search.structures import Structure
from bayescal._search.walk import FORM_NATS
from bayescal.effects.thermal import BODIES
from bayescal_models import mems_gyro, still_sensor
from tests.support.inside import frame_of

GYRO = mems_gyro.INSTRUMENT
RUNS, HOURS, STEP, FINE = 3, 4, 60.0, 5.0  # s
LINE, QUADRATIC, DRIFT, NOISE = 0.05, 5e-4, 0.1, 0.05  # °/s/°C, °/s/°C², °/s over the record, °/s


def campaign(seed: int) -> tuple[bc.Measurements, float, float]:
    """Random profiles of temperature, the time constant of the die, s, and the quadratic's coefficient."""
    random = np.random.default_rng(seed)
    tau, quadratic = random.uniform(200.0, 700.0), QUADRATIC * random.choice([-1.0, 1.0])
    time = np.arange(0.0, HOURS * 3600, STEP)
    fine = np.arange(0.0, time[-1] + FINE, FINE)
    air, die = [], []
    for _ in range(RUNS):
        air.append(np.interp(fine, np.linspace(0, fine[-1], 9), random.uniform(-20.0, 70.0, 9)))
        behind = [air[-1][0]]
        for t in 0.5 * (air[-1][1:] + air[-1][:-1]):
            behind.append(behind[-1] + (t - behind[-1]) * (1 - np.exp(-FINE / tau)))
        die.append(np.interp(time, fine, behind))
    clock = np.concatenate([time + i * (HOURS + 1) * 3600 for i in range(RUNS)])
    above = np.concatenate(die) - 25.0
    drift = DRIFT * (clock - clock.mean()) / np.ptp(clock)
    output = 1 + LINE * above + quadratic * above**2 + drift
    readings = bc.Measurements.from_arrays(
        GYRO,
        temperature=np.concatenate([np.interp(time, fine, a) for a in air]),
        output=output + random.normal(0, NOISE, clock.size),
        time=clock,
        run=np.repeat([f"run {i + 1}" for i in range(RUNS)], time.size),
    )
    return readings, tau, quadratic


BODY = "bias.thermal_lag.body"


@pytest.mark.slow
def test_block_means_tell_a_better_form_as_all_readings_do(monkeypatch) -> None:
    monkeypatch.setitem(globals(), "STEP", 15.0)
    readings = campaign(3)[0]
    structures, _ = enumerate_structures(GYRO.baseline(), readings, reference_of(readings))
    body = structures.evaluate(Structure(frozenset({BODY, "bias.temperature_quadratic"})))
    for to in structures.other_forms(body.structure, BODY):
        exact = structures.evaluate(to, body).log_posterior - body.log_posterior
        low, high = sorted((structures.change_on_means(to, body), exact))
        assert high - low < 2.0 or low > FORM_NATS or high < -FORM_NATS, to


def told(trail: bc.SearchPath, seed: int) -> tuple[bool, bool, bool]:
    """Whether it is found in the campaign of this seed, and τ and the curvature lie inside their 95 % intervals."""
    _, tau, quadratic = campaign(seed)
    last = trail.final.calibration
    if BODY not in last.model.names:
        return False, False, False
    low, high = np.quantile(last.samples(f"{BODY}.tau"), [0.025, 0.975])
    below, above = np.quantile(last.samples("bias.temperature_quadratic"), [0.025, 0.975])
    return True, low <= tau <= high, below <= quadratic <= above


@pytest.fixture(scope="module")
def trail() -> bc.SearchPath:
    """In the campaign of seed 2. The noise is white, as it is; the slow test weighs the other laws too."""
    short: dict[str, Any] = {"method": bc.LeastSquares(draws=400), "max_effects": 2}
    return bc.calibrate(GYRO.baseline(), campaign(2)[0], widen_noise=False, **short)


def test_it_is_found_with_its_time_constant_and_curvature(trail) -> None:
    assert told(trail, 2) == (True, True, True)


@pytest.mark.parametrize("form", BODIES)
def test_a_body_comes_to_rest_at_what_is_around_it_and_is_behind_a_ramp_by_tau(form: str) -> None:
    body = BODIES[form]
    for values in itertools.product(*((s.low, s.high) for s in body.shapes)):
        modes = body.modes(*values)
        assert math.fsum(w for _, w in modes) == pytest.approx(1.0)
        assert math.fsum(m * w for m, w in modes) == pytest.approx(1.0)


def test_two_stages_are_one_body_behind_another() -> None:
    """T̃ as Σ wₖ·T̃ₖ, against two bodies integrated one after the other by small steps."""
    time = np.arange(0.0, 3600.0, 10.0)
    air = 20.0 + 15.0 * np.sin(time / 400.0)
    readings = bc.Measurements.from_arrays(
        GYRO, temperature=air, output=np.zeros(time.size) + air, time=time
    )
    frame, tau = frame_of(readings), 300.0
    modes = BODIES["two_stages"].modes()
    found = sum(w * frame.recorded_lag(jnp.asarray(m * tau)) for m, w in modes) + air
    fine, steps = 0.02, int(10 / 0.02)
    first = second = air[0]
    expected = [second]
    for here, there in itertools.pairwise(air):
        for k in range(steps):
            outside = here + (there - here) * (k + 0.5) / steps
            first += fine * (outside - first) / (2 * tau / 3)
            second += fine * (first - second) / (tau / 3)
        expected.append(second)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def side_by_side(seed: int, interval: int = 30) -> bc.Measurements:
    """A sensor at rest of which half follows the temperature with 300 s and half with 1,500 s; slope 40 µg/°C."""
    fine, wanted = (still_sensor.simulate(seed=seed, interval=i) for i in (1, interval))
    warm, noise = np.array(fine["temperature"]), []
    for tau in (300.0, 1500.0):
        body = np.concatenate(
            [
                lfilter([1 - np.exp(-1 / tau)], [1, -np.exp(-1 / tau)], one - one[0]) + one[0]
                for one in np.split(warm, 3)
            ]
        )
        noise.append(20.0 * (body - warm))
    behind = sum(noise).reshape(3, -1)[:, ::interval].ravel()
    return wanted.with_column("output", wanted["output"] + behind)


@pytest.mark.parametrize("seed", [306])
def test_two_bodies_side_by_side_are_one_of_the_forms(seed: int) -> None:
    """Of one body the slope is forty of its standard uncertainties off, and less probable."""
    readings = side_by_side(seed)
    baseline = still_sensor.INSTRUMENT.for_readings(readings).baseline()
    paths, one = (
        bc.fit(baseline + f"bias.thermal_lag.{form}", readings) for form in ("paths", "body")
    )
    slope, alone = (f.samples("bias.temperature") for f in (paths, one))
    assert abs(slope.mean() - 40.0) < 3 * slope.std() and slope.std() < 5
    assert abs(alone.mean() - 40.0) > 10 * alone.std()
    assert paths.log_evidence is not None and one.log_evidence is not None
    assert paths.log_evidence[0] > one.log_evidence[0]


def test_an_average_over_forms_is_that_of_its_structures(trail) -> None:
    """Draws in which a body's temperature is that of the column are those of structures without it; saved or not."""
    used = trail.calibration
    mean = bc.predict(used, draws=400).mean
    assert np.sqrt(np.mean((used.readings["output"] - mean) ** 2)) < 1.2 * NOISE + DRIFT
    assert all(e.constant_indices == () or e.name in used.model.names for e in used.model.effects)


def test_a_form_is_as_large_as_the_search_found_it() -> None:
    """Ten times what is plausible: the search averages over sizes, and so must what is fitted of a form."""
    readings = mems_gyro.simulate({"bias.drift": 1.0}, seed=11)
    short: dict[str, Any] = {"method": bc.LeastSquares(), "max_effects": 1, "widen_noise": False}
    trail = bc.calibrate(GYRO.baseline(), readings, **short)
    assert [s.added for s in trail.steps] == [None, "bias.drift.logarithmic"]
    assert trail.search is not None and trail.final.calibration.log_evidence is not None
    likeliest = trail.search.structures[0].log_evidence
    assert trail.final.calibration.log_evidence[0] == pytest.approx(likeliest, abs=5.0)
