"""The budget splits the variance of a compensated value without remainder: by coefficient, and by its sources."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import run
from tests.support.made_up import bent_sensor, split_search

READINGS = "noise of the calibration's readings"


@pytest.fixture(scope="module")
def gyro() -> bc.Budget:
    return bc.budget(bent_sensor.gyro(), {"temperature": 70.0, "rate_input": 80.0})


def test_shares_add_up_and_the_sum_is_what_the_compensator_states(gyro) -> None:
    compensate = bc.compensator(bent_sensor.gyro())
    value = compensate(output=gyro.reading, temperature=70.0, method="first order", noise=False)
    np.testing.assert_allclose(value.value, 80.0, rtol=1e-9)
    np.testing.assert_allclose(gyro.uncertainty, value.uncertainty[0], rtol=1e-9)
    np.testing.assert_allclose(sum(c.share for c in gyro.coefficients), 1.0, rtol=1e-9)
    np.testing.assert_allclose(sum(s.share for s in gyro.sources), 1.0, rtol=1e-9)


def test_shares_count_correlations_by_hand() -> None:
    """u² of c₀ + c₁(T − T0) − reading, from the posterior's covariance alone."""
    fit = bent_sensor.gyro()
    found = bc.budget(fit, {"temperature": 70.0, "rate_input": 0.0})
    names = ["bias.constant", "bias.temperature"]
    covariance = np.cov(np.array([fit.samples(n) for n in names]))
    lever = np.array([1.0, 70.0 - float(fit.frame.reference["T0"])]) / (
        1 + 1e-6 * fit.samples("scale.constant").mean()
    )
    new_run = np.mean(fit.samples("bias.run.group_sd") ** 2) * lever[0] ** 2
    total = lever @ covariance @ lever + new_run
    np.testing.assert_allclose(found.uncertainty**2, total, rtol=1e-9)
    shares = {c.name: c.share for c in found.coefficients}
    for i, name in enumerate(names):
        by_hand = lever[i] * (covariance @ lever)[i] / found.uncertainty**2
        np.testing.assert_allclose(shares[name], by_hand, rtol=1e-9)


def test_a_nuisance_that_does_not_act_in_use_is_named_as_the_source() -> None:
    """The rig's constant, of prior sd 20 µg, is an alias of the bias: nearly all the width is its prior's."""
    found = bc.budget(
        bent_sensor.calibration(),
        {"acceleration": 0.0, "temperature": 30.0, "humidity": 30.0, "elapsed": 1e4},
    )
    assert not any(c.name.startswith("rig") for c in found.coefficients)
    largest = found.sources[0]
    assert (largest.name, largest.kind) == ("prior of rig.constant", "B")
    assert largest.share > 0.8 and 15 < largest.contribution < 21
    readings = next(s for s in found.sources if s.name == READINGS)
    assert readings.kind == "A" and readings.share < 0.1


def test_k_and_noise_are_said_and_multiply(gyro) -> None:
    assert gyro.k == 2.0 and gyro.expanded == 2.0 * gyro.uncertainty
    np.testing.assert_allclose(gyro.expanded_reading, 2 * np.hypot(gyro.uncertainty, gyro.noise))
    text = str(gyro)
    assert "scale.constant" in text and "ppm" in text
    np.testing.assert_allclose(np.diag(gyro.correlation), 1.0)


def test_of_few_runs_the_coverage_is_said_to_be_short_and_their_spread_is_type_a() -> None:
    readings = mems_gyro.simulate({"bias.run": 0.05}, seed=2, campaign=mems_gyro.Campaign(runs=3))
    model = mems_gyro.INSTRUMENT.baseline() + "bias.run"
    found = bc.budget(bc.fit(model, readings, bc.LeastSquares(draws=200)))
    spread = next(s for s in found.sources if s.name.startswith("bias.run"))
    assert spread.kind == "A"


def test_a_prior_that_matters_shows_in_its_sensitivity(tmp_path: Path) -> None:
    """Of the rig's constant and the bias the readings know the sum: priors decide. A well measured slope is its own."""
    saved = bent_sensor.calibration().save(tmp_path / "c.nc")
    own = ("--instrument", f"{bent_sensor.__file__}:SENSOR")
    found = run("budget", saved, *own, "--prior-sensitivity", "--json").data["prior_sensitivity"]
    assert found["rig.constant"]["prior"] > 0.05 > found["bias.temperature"]["prior"]
    assert "noise.white" not in found  # held at its estimate


@pytest.mark.slow
def test_not_to_know_the_structure_is_a_source() -> None:
    """The average's variance is what the compensator states; what structures add is half of it, and is named."""
    average = split_search.trail().calibration
    found, compensate = bc.budget(average, {"temperature": 70.0}), bc.compensator(average)
    given: dict[str, Any] = {n: v for n, v in found.at.items() if n != "rate_input"}
    value = compensate(output=found.reading, **given, method="first order", noise=False)
    np.testing.assert_allclose(found.uncertainty, value.uncertainty[0], rtol=1e-9)
    assert sum(s.share for s in found.sources) == pytest.approx(1)
    largest = max(found.sources, key=lambda s: s.share)
    assert largest.share > 0.3
    # Also where no effect is in more than half of the draws.
    assert min(s.share for s in found.sources) > -0.05
