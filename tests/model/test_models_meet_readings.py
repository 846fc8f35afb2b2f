"""A model is bound to readings: each unknown gets its one place, and what does not fit is refused with advice."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib import import_module

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import INSTRUMENTS, mems_gyro
from bayescal_models.mems_gyro import INSTRUMENT
from tests.support.inside import frame_of
from tests.support.made_up.humid_gyro import BASELINE, readings

QUICK = bc.LeastSquares(draws=10)


def test_a_group_effect_without_members_is_refused() -> None:
    cell = bc.Effect(
        "bias.cell",
        "bias",
        basis=lambda r: 1.0,
        coefficients=(bc.Coefficient("deg/s", per="cell"),),
    )
    with pytest.raises(bc.ModelError):
        bc.fit(BASELINE + cell, readings())
    with pytest.raises(bc.ModelError):
        bc.fit(BASELINE + "bias.run", readings())


def test_a_group_effect_has_one_coefficient_a_member() -> None:
    data = readings(run=np.repeat(["a", "b", "c"], 4))
    found = bc.fit(BASELINE + "bias.run", data, QUICK, strict=False)
    assert (found.samples("bias.run").shape[1], found.levels["run"]) == (3, ("a", "b", "c"))
    assert [h.name for h in found.layout.hypers] == ["noise.white", "bias.run.group_sd"]


def test_as_many_flat_coefficients_as_readings_are_refused() -> None:
    flat = bc.Model(
        INSTRUMENT,
        tuple(
            bc.Effect(
                f"bias.power{k}",
                "bias",
                basis=lambda r, k=k: r.centred() ** k,
                coefficients=(bc.Coefficient("deg/s", bc.Flat()),),
            )
            for k in range(3)
        ),
        bc.White(),
    )
    with pytest.raises(bc.ModelError):
        bc.fit(flat, readings(rows=3))
    assert bc.fit(flat, readings(rows=4), QUICK, strict=False).log_evidence is None
    # A fixed one is none.
    assert bc.fit(flat.fix({"bias.power2": 0.0}), readings(rows=3), QUICK, strict=False)


STATION = effects.deviation("bias", "station", 0.2, "deg/s", source="ours")
WITH_STATIONS = replace(
    mems_gyro.INSTRUMENT,
    columns=(*mems_gyro.INSTRUMENT.columns, bc.Column("station", None, required=False)),
)
BIASES = {"hall": 0.0, "cellar": 0.3, "roof": -0.2}  # °/s


def station_readings(stations: list[str]) -> bc.Measurements:
    noise = np.random.default_rng(1).standard_normal(len(stations))
    temperature = np.linspace(20.0, 60.0, len(stations))
    output = 0.02 * (temperature - 40) + [BIASES.get(s, 0.0) for s in stations] + 0.01 * noise
    columns = {"temperature": temperature, "station": stations, "output": output}
    return bc.Measurements.from_arrays(WITH_STATIONS, **columns)


def test_an_effect_of_an_unknown_group_is_refused_when_the_model_is_made() -> None:
    with pytest.raises(bc.ModelError):
        _ = mems_gyro.INSTRUMENT.baseline() + STATION


def test_each_member_of_a_declared_group_has_its_deviation(tmp_path) -> None:
    stations = [name for name in BIASES for _ in range(40)]
    model = WITH_STATIONS.baseline() + STATION
    fitted = bc.fit(model, station_readings(stations), bc.LeastSquares())
    means = fitted.posterior["bias.station"].mean(("chain", "draw"))
    found = {name: float(means.sel(station=name)) for name in BIASES}
    assert found["cellar"] - found["hall"] == pytest.approx(0.3, abs=0.03)
    assert found["roof"] - found["hall"] == pytest.approx(-0.2, abs=0.03)
    # a station that was not there has its own
    new = bc.predict(fitted, station_readings(["garden"] * 3))
    assert (np.asarray(new.sd) > 0.1).all()
    path = fitted.save(tmp_path / "c.nc")
    assert bc.load(path, effects=[STATION], instruments=[WITH_STATIONS]).levels["station"] == (
        "hall",
        "cellar",
        "roof",
    )


# The contract of every effect of every instrument: it reads only the columns that it names.


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


def test_an_effect_that_is_zero_in_all_readings_is_refused() -> None:
    coefficient = bc.Coefficient("deg/s", bc.Normal(0.0, 0.1))
    silent = bc.Effect("silent", "bias", lambda r: 0.0 * r["temperature"], (coefficient,))
    with pytest.raises(bc.ModelError, match="'silent' is zero in all 12 readings"):
        bc.fit(BASELINE + silent, readings(), QUICK)
