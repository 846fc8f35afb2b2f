"""Bases and responses give the same numbers by NumPy on the host as by JAX in a program."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import jax
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS
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
