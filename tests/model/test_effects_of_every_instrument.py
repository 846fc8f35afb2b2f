"""The contract of every effect of every instrument: affine, and reading only the columns that it names."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal._model import forward
from bayescal._model.parameters import Layout
from bayescal_models import INSTRUMENTS
from tests.support.inside import frame_of
from tests.support.made_up.rich_gyro import bound


def instrument_effects(compiled: bool) -> list:
    """Every effect; where each is compiled by itself, those of most instruments are slow."""
    found = []
    for name in INSTRUMENTS:
        instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
        structural = [e for _, make in instrument.structures for e in make().effects]
        every = {e.name: e for e in (*instrument.effects, *instrument.candidates, *structural)}
        slow = compiled and name not in ("mems_gyro", "magnetometer_triad")
        marks = [pytest.mark.slow] if slow else []
        found += [
            pytest.param(instrument, e, id=f"{name}-{e.name}", marks=marks) for e in every.values()
        ]
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


@pytest.mark.parametrize(("instrument", "effect"), instrument_effects(True))
def test_slots_are_affine_in_the_coefficients_of_an_effect(instrument, effect) -> None:
    data = made_up(instrument)
    b = bound(bc.Model(instrument, (effect,), instrument.noise), data)
    names = {block.slot for block in b.layout.blocks}
    slots = {s.name for s in instrument.slots}

    def total(x):
        """What the effect adds to its slots, or to the column it corrects."""

        def seen(filled, corrected):
            return sum(filled[n] if n in slots else corrected[n] for n in names)

        model = bc.Model(replaced(instrument, seen), (effect,), instrument.noise)
        return forward.mean(Layout(model, b.layout.counts), b.frame, x, b.hyper)

    other = b.x[::-1] + 1.0
    both = total(b.x + other) + total(0 * b.x)
    apart = total(b.x) + total(other)
    scale = np.abs(apart).max()
    np.testing.assert_allclose(both, apart, rtol=1e-10, atol=1e-10 * scale)
    assert effect.equation
    assert effect.source
    assert np.isfinite(both).all()


@pytest.mark.parametrize(("instrument", "effect"), instrument_effects(False))
def test_an_effect_reads_only_the_columns_it_names(instrument, effect) -> None:
    data = made_up(instrument)
    b = bound(bc.Model(instrument, (effect,), instrument.noise), data)
    shapes = {s.name: b.hyper[effect.shape_name(s)] for s in effect.shapes}
    hidden = set(b.frame.columns) - set(effect.columns)
    if "time" in effect.columns:
        hidden.discard("elapsed")
    frame = eqx.tree_at(
        lambda f: [f.columns[n] for n in sorted(hidden)],
        b.frame,
        [jnp.full(b.frame.size, jnp.nan) for _ in hidden],
    )
    basis = effect.evaluate(frame, shapes)
    assert basis.shape == (b.frame.size, len(effect.coefficients))
    assert np.isfinite(basis).all()


def replaced(instrument: bc.Instrument, response) -> bc.Instrument:
    """The instrument with another response."""
    fields = {name: getattr(instrument, name) for name in instrument.__dataclass_fields__}
    return bc.Instrument(**{**fields, "response": response})


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_each_reading_responds_to_its_own_slots_alone(name) -> None:
    instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
    data = made_up(instrument, rows=6)
    frame = frame_of(data)
    slots = {s.name: jnp.full(frame.size, 1e-3) for s in instrument.slots}
    moves = jax.jit(jax.jacfwd(lambda s: instrument.response(s, frame)))(slots)
    for slot, matrix in moves.items():
        off = np.asarray(matrix) - np.diag(np.diag(matrix))
        assert np.abs(off).max() == 0, slot
        assert np.isfinite(matrix).all(), slot
