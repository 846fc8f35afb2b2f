"""A model is bound to readings: each unknown gets its one place, and what does not fit is refused with advice."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal._model.parameters import Layout, bind
from bayescal_models.mems_gyro import INSTRUMENT
from tests.support.made_up.humid_gyro import BASELINE, HUMIDITY, readings


def test_missing_columns_are_named_with_what_there_is() -> None:
    with pytest.raises(
        bc.ModelError,
        match=r"Effect 'bias.humidity' needs the column 'humidity', which .* lacks "
        r"\(it has: temperature, output\)\. Record it, or take the effect out: model - 'bias.humidity'",
    ):
        bc.fit(BASELINE + HUMIDITY, readings())
    with pytest.raises(bc.ModelError, match=r"'bias.thermal_lag' needs the column 'time'"):
        bc.fit(BASELINE + "bias.thermal_lag", readings())


def test_a_group_effect_without_members_is_refused() -> None:
    cell = bc.Effect(
        "bias.cell",
        "bias",
        basis=lambda r: 1.0,
        coefficients=(bc.Coefficient("deg/s", per="cell"),),
    )
    with pytest.raises(
        bc.ModelError,
        match=r"'bias.cell' has one coefficient for each cell, and .* has none: name them",
    ):
        bc.fit(BASELINE + cell, readings())
    with pytest.raises(bc.ModelError, match=r"'bias.run' needs the column 'run'"):
        bc.fit(BASELINE + "bias.run", readings())


def test_a_group_effect_has_one_coefficient_a_member() -> None:
    data = readings(run=np.repeat(["a", "b", "c"], 4))
    layout, levels = bind(BASELINE + "bias.run", data)
    block = layout.x_blocks[-1]
    assert (block.name, block.size, levels["run"]) == ("bias.run", 3, ("a", "b", "c"))
    assert [h.name for h in layout.hypers] == ["noise.white", "bias.run.spread"]


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
    with pytest.raises(
        bc.ModelError, match=r"has 3 readings for 3 coefficients with a flat prior: measure"
    ):
        bc.fit(flat, readings(rows=3))
    layout, _ = bind(flat, readings(rows=4))
    assert layout.improper
    # A fixed one is none.
    assert bind(flat.fix({"bias.power2": 0.0}), readings(rows=3))[0].size == 2


def test_promoting_what_is_not_there_is_refused() -> None:
    with pytest.raises(
        bc.ModelError,
        match=r"promote: nothing that could be promoted is called 'bias.temprature'.*bias.temperature",
    ):
        bc.fit(BASELINE, readings(), bc.Marginal(promote=("bias.temprature",)))


def test_every_unknown_stands_in_exactly_one_place() -> None:
    data = readings(
        run=np.repeat(["1", "2"], 6), time=np.tile(np.arange(6.0), 2) + np.repeat([0.0, 100.0], 6)
    )
    model = BASELINE + effects.thermometer(0.3, source="none") + ["bias.run", "bias.thermal_lag"]
    layout, _ = bind(model.fix({"bias.constant": 20.0}), data)
    layout = layout.promote("bias.temperature")
    places = {b.name: b.place for b in layout.blocks}
    assert places == {
        "bias.constant": "fixed",
        "bias.temperature": "phi",
        "temperature.reading": "row",
        "bias.run": "x",
        "bias.thermal_lag": "x",
        "bias.thermal_lag[start]": "x",
    }
    assert layout.size == 2 + 1 + 2
    assert [h.name for h in layout.hypers] == [
        "noise.white",
        "bias.run.spread",
        "bias.thermal_lag.tau",
        "bias.temperature",
    ]
    assert layout == Layout(layout.model, layout.counts, ("bias.temperature",))


def test_a_constant_that_no_basis_has_is_refused_with_those_there_are() -> None:
    with pytest.raises(bc.InputError, match=r"no basis has a constant T_0; .* T0"):
        bc.fit(BASELINE, readings(), reference={"T_0": 20.0})
