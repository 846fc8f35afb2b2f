"""Bases and responses give the same numbers by NumPy on the host as by JAX in a program."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS, mems_gyro
from tests.support.inside import frame_of

CLOSE = 1e-12  # of a column's largest number


@cache
def simulated(name: str) -> tuple[bc.Frame, bc.Instrument]:
    instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
    readings = instrument.simulate(seed=1)
    return frame_of(readings), instrument.for_readings(readings)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_effect(name: str) -> None:
    frame, instrument = simulated(name)
    every = {e.name: e for e in (*instrument.effects, *instrument.known.values())}
    there = [e for e in every.values() if {*e.columns} <= {*frame.columns}]
    shapes = {e.name: {s.name: float(s.prior.value(0.3)) for s in e.shapes} for e in there}

    @jax.jit  # one program for all of them
    def traced(frame, shapes):
        return {e.name: e.evaluate(frame, shapes[e.name]) for e in there}

    for effect, column in zip(there, map(traced(frame, shapes).get, shapes), strict=True):
        on_host = effect.evaluate(frame, shapes[effect.name])
        assert isinstance(on_host, np.ndarray), effect.name
        largest = np.abs(column).max(initial=1e-300)
        assert np.abs(on_host - column).max(initial=0.0) <= CLOSE * largest, effect.name


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_response(name: str) -> None:
    frame, instrument = simulated(name)
    random = np.random.default_rng(2)
    slots = {s.name: 1e-3 * random.standard_normal(frame.size) for s in instrument.slots}
    on_host = instrument.response(slots, frame)
    assert isinstance(on_host, np.ndarray) or instrument.vector is not None
    traced = jax.jit(instrument.response)(slots, frame)
    np.testing.assert_allclose(on_host, traced, rtol=CLOSE, atol=CLOSE * np.abs(traced).max())


def test_a_basis_in_jax_alone() -> None:
    """It is found, fitted and predicted as one that is written with `bc.xp`."""

    def effect(module: object) -> bc.Effect:
        return bc.Effect(
            "bias.own",
            "bias",
            basis=lambda r, width: module.tanh(r.centred() / width),  # type: ignore[attr-defined]
            coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 1.0)),),
            shapes=(bc.Shape("width", "degC", 1.0, 20.0),),
            columns=("temperature",),
        )

    readings = mems_gyro.simulate({}, seed=1)
    values = readings["output"] + 0.4 * np.tanh((readings["temperature"] - 55) / 5)
    readings = readings.with_column("output", values)
    model = mems_gyro.INSTRUMENT.baseline()
    found = [bc.calibrate(model, readings, effects=[effect(m)]) for m in (jnp, bc.xp)]
    assert found[0].final.calibration.model.names == found[1].final.calibration.model.names
    assert "bias.own" in found[0].final.calibration.model.names
    rms = [path.final.rmse_fitted for path in found]
    assert rms[0] == pytest.approx(rms[1], rel=1e-6)
