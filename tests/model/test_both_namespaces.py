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

CLOSE = 1e-12  # of a column's largest number


@cache
def fitted(name: str) -> bc.Calibration:
    instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
    readings = instrument.simulate(seed=1)
    model = instrument.for_readings(readings).baseline()
    return bc.fit(model, readings, bc.LeastSquares(draws=50), strict=False)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_effect(name: str) -> None:
    frame, instrument = fitted(name).frame, fitted(name).model.instrument
    there = {*frame.columns}
    for effect in (*instrument.effects, *instrument.known.values()):
        if not {*effect.columns} <= there:
            continue
        shapes = {s.name: float(s.prior.value(0.3)) for s in effect.shapes}
        on_host = effect.evaluate(frame, shapes)
        assert isinstance(on_host, np.ndarray), effect.name
        traced = jax.jit(effect.evaluate)(frame, shapes)
        largest = np.abs(traced).max(initial=1e-300)
        assert np.abs(on_host - traced).max(initial=0.0) <= CLOSE * largest, effect.name


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_response(name: str) -> None:
    frame, instrument = fitted(name).frame, fitted(name).model.instrument
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
