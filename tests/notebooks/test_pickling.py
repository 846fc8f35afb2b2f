"""Models and calibrations go to other processes: equal on arrival, nothing compiled twice, or refused in a sentence."""

from __future__ import annotations

import multiprocessing
import pickle
from importlib import import_module

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS, mems_gyro
from tests.support.compilations import compiled
from tests.support.inside import identity_of

QUICK = bc.LeastSquares(draws=400)
GYRO = mems_gyro.INSTRUMENT


def again(value):
    return pickle.loads(pickle.dumps(value))


def instrument_of(name: str) -> bc.Instrument:
    return import_module(f"bayescal_models.{name}").INSTRUMENT


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_models_and_effects_of_every_instrument(name) -> None:
    instrument = instrument_of(name)
    assert again(instrument) is instrument
    for effect in (*instrument.effects, *instrument.candidates):
        copy = again(effect)
        assert copy == effect
        assert (copy.basis, hash(copy.basis)) == (effect.basis, hash(effect.basis))
        assert repr(copy.coefficients) == repr(effect.coefficients)
    model = instrument.baseline()
    assert again(model) == model
    assert again(model + instrument.candidates) == model + instrument.candidates


@pytest.fixture(scope="module")
def calibration() -> bc.Calibration:
    readings = mems_gyro.simulate({"bias.thermal_lag": 0.03}, seed=1)
    return bc.fit(GYRO.baseline() + "bias.thermal_lag" + "unknown(temperature)", readings, QUICK)


def test_a_calibration_is_the_same(calibration) -> None:
    assert calibration.tree is not None  # what was computed from it does not travel
    copy = again(calibration)
    assert identity_of(copy) == identity_of(calibration)
    assert str(copy) == str(calibration)
    for name in calibration.posterior:
        np.testing.assert_array_equal(copy.samples(name), calibration.samples(name))
    np.testing.assert_array_equal(bc.predict(copy).mean, bc.predict(calibration).mean)
    with pytest.raises(ValueError, match="read-only"):
        copy.readings["output"][0] = 0.0


def test_nothing_is_compiled_again(calibration) -> None:
    def same() -> None:
        copy = again(calibration)
        bc.predict(copy)
        bc.fit(copy.model, copy.readings, QUICK)

    assert compiled(same) == []


def summary_of(content: bytes) -> tuple[str, str, int]:
    arrived = pickle.loads(content)
    fitted = bc.fit(arrived.model, arrived.readings, QUICK)
    return identity_of(arrived), identity_of(fitted), len(bc.predict(arrived).mean)


@pytest.mark.slow
def test_results_unpickle_in_a_new_process(calibration) -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there, fitted, size = pool.apply(summary_of, (pickle.dumps(calibration),))
    assert there == identity_of(calibration)
    assert fitted == identity_of(bc.fit(calibration.model, calibration.readings, QUICK))
    assert size == len(calibration.readings)
