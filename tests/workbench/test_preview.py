"""A preview says what the fit with the effect would say, before it is made."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, ng_accelerometer, quartz_beam_accelerometer
from tests.support.inside import Preview, preview

QUICK = bc.LeastSquares(draws=500)
GYRO = mems_gyro.INSTRUMENT


def fitted(instrument: bc.Instrument, hidden: dict[str, float], seed: int) -> bc.Calibration:
    readings = instrument.simulate(hidden, seed=seed)
    instrument = instrument.for_readings(readings)
    return bc.fit(instrument.baseline(), readings, QUICK, strict=False)


@pytest.fixture(scope="module")
def gyro() -> bc.Calibration:
    return fitted(GYRO, {"bias.thermal_lag": 0.05}, 4)


def residuals(calibration: bc.Calibration) -> np.ndarray:
    return bc.check(calibration).residuals


def agrees(before: bc.Calibration, name: str, *, within: float = 1e-6) -> Preview:
    """The preview, after it was compared with a fit of the model with the effect."""
    found = preview(before, name)
    after = bc.fit(before.model + name, before.readings, QUICK, strict=False)
    noise = float(np.std(residuals(after)))
    np.testing.assert_allclose(
        residuals(before) - found.curve, residuals(after), atol=within * noise
    )
    assert found.rms == pytest.approx(np.sqrt(np.mean(residuals(after) ** 2)), rel=within)
    assert found.rms_before == pytest.approx(np.sqrt(np.mean(residuals(before) ** 2)))
    if found.log_bayes_factor is not None:
        assert after.log_evidence is not None and before.log_evidence is not None
        told = after.log_evidence[0] - before.log_evidence[0]
        assert found.log_bayes_factor == pytest.approx(told, abs=max(0.2, 1e-6 * abs(told)))
    return found


@pytest.mark.parametrize(
    "name", ["bias.thermal_lag", "bias.warm_up", "bias.temperature_quadratic", "bias.drift"]
)
def test_size_and_uncertainty_are_those_of_the_fit(gyro: bc.Calibration, name: str) -> None:
    """Effects with and without shapes, and one with a coefficient for each run beside its own."""
    found = agrees(gyro, name)
    after = bc.fit(gyro.model + name, gyro.readings, QUICK, strict=False).samples(name)
    assert found.size == pytest.approx(after.mean(), rel=1e-6)
    assert found.size_sd == pytest.approx(after.std(), rel=1e-2)
    assert set(found.shape) == {s.name for s in GYRO.effect(name).shapes}


def test_of_a_group_it_is_the_spread(gyro: bc.Calibration) -> None:
    found = agrees(gyro, "bias.run")
    after = bc.fit(gyro.model + "bias.run", gyro.readings, QUICK, strict=False)
    assert found.size == pytest.approx(after.samples("bias.run.group_sd").mean(), rel=1e-6)
    assert found.size_sd is not None and found.size_sd > 0


def test_an_unknown_dependence_is_nearly_that_of_the_fit(gyro: bc.Calibration) -> None:
    """It is taken at its marginal mode: its curve within a tenth of the noise."""
    found = agrees(gyro, "unknown(board_temperature)", within=0.1)
    assert found.size is not None and found.size > 0


@pytest.mark.parametrize(
    "instrument", [ng_accelerometer.INSTRUMENT, quartz_beam_accelerometer.INSTRUMENT]
)
def test_other_instruments(instrument: bc.Instrument) -> None:
    before = fitted(instrument, {}, 2)
    able = []
    for effect in instrument.candidates:
        try:
            agrees(before, effect.name, within=1e-3)
        except bc.ModelError:  # these readings cannot test it
            continue
        able.append(effect.name)
        if len(able) == 2:
            break
    assert able
