"""The contract of every effect of every instrument: it reads only the columns that it names."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS
from tests.support.inside import frame_of


def instrument_effects() -> list:
    found = []
    for name in INSTRUMENTS:
        instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
        structural = [e for _, make in instrument.structures for e in make().effects]
        every = {e.name: e for e in (*instrument.effects, *instrument.candidates, *structural)}
        found += [pytest.param(instrument, e, id=f"{name}-{e.name}") for e in every.values()]
    return found


@cache
def made_up(instrument: bc.Instrument, rows: int = 12) -> bc.Measurements:
    """Readings of every column of an instrument, within its plausible ranges."""
    rng = np.random.default_rng(3)
    columns = {}
    for column in instrument.columns:
        if column.unit is None:
            columns[column.name] = np.resize(np.repeat(column.allowed or ["a", "b"], 3), rows)
        elif column.name == "time":
            columns[column.name] = np.cumsum(rng.uniform(20.0, 300.0, rows))
        elif column.name == "temperature_point":
            columns[column.name] = np.resize(np.repeat([20.0, 30.0, 40.0], 2), rows)
        else:
            low, high = (20.0, 50.0) if column.unit == "degC" else (0.05, 0.2)
            low = low if column.low is None else max(low, column.low)
            high = high if column.high is None else min(high, column.high)
            high = high if low < high else column.high or 2 * low
            columns[column.name] = rng.uniform(low, high, rows)
    free = {c.name: "ug" for c in instrument.columns if c.unit == "any"}  # the file's to say
    return bc.Measurements.from_arrays(instrument, units=free, **columns)


@pytest.mark.parametrize(("instrument", "effect"), instrument_effects())
def test_an_effect_reads_only_the_columns_it_names(instrument, effect) -> None:
    frame = frame_of(made_up(instrument))
    shapes = {s.name: jnp.asarray(0.5 * (s.low + s.high)) for s in effect.shapes}
    hidden = set(frame.columns) - set(effect.columns)
    if "time" in effect.columns:
        hidden.discard("elapsed")
    nothing = [jnp.full(frame.size, jnp.nan) for _ in hidden]
    frame = eqx.tree_at(lambda f: [f.columns[n] for n in sorted(hidden)], frame, nothing)
    basis = effect.evaluate(frame, shapes)
    assert basis.shape == (frame.size, len(effect.coefficients))
    assert np.isfinite(basis).all()
