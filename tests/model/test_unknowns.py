"""The table of a model's unknowns: their names, places and values."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal._model.parameters import bind
from bayescal._model.unknowns import Unknowns
from tests.support import references
from tests.support.made_up.humid_gyro import BASELINE, readings

INSTRUMENTS = ("mems_gyro", "inclinometer", "ng_accelerometer")


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_unknowns_and_draws_are_in_one_order(instrument: str) -> None:
    found = references.calibration(instrument)
    unknowns = found.unknowns
    assert len({*unknowns.names}) == len(unknowns) == found.values.shape[-1]
    for i, u in enumerate(unknowns):
        assert unknowns.index[u.name] == i
        assert np.array_equal(found.samples(u.name), found.values[..., i].reshape(-1))
        assert (u.x is None) != (u.v is None)
    for key in map(str, found.posterior):
        members = [u.name for u in unknowns if u.key == key]
        draws = np.stack([found.samples(name) for name in members], axis=-1)
        assert np.array_equal(found.samples(key).reshape(draws.shape), draws)


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_values_add_the_origin_and_undo_priors(instrument: str) -> None:
    found = references.calibration(instrument)
    x, v = found.joint.x, found.joint.v
    values = found.unknowns.values(x, v)
    for i, u in enumerate(found.unknowns):
        if u.x is not None:
            assert np.array_equal(values[..., i], u.block.origin + x[..., u.x])
        elif u.block is None:
            assert np.array_equal(values[..., i], u.prior.value(v[..., u.v]))


def test_promoted_members_are_in_units_of_their_spread() -> None:
    found = references.calibration("mems_gyro")
    layout, levels = bind(found.model + "bias.run", found.readings)
    layout = layout.promote("bias.run")
    unknowns = Unknowns.of(layout, levels)
    random = np.random.default_rng(1)
    x, v = (random.normal(size=(5, n)) for n in (layout.size, len(layout.hypers)))
    values = unknowns.values(x, v)
    spread = unknowns.select(values, "bias.run.group_sd")
    members = unknowns.select(values, "bias.run")
    places = [layout.index_in_phi[f"bias.run({i})"] for i in range(members.shape[-1])]
    assert members.shape[-1] > 1
    assert np.array_equal(members, spread[:, None] * v[:, places])


def test_a_name_that_is_no_unknown_is_refused() -> None:
    with pytest.raises(bc.InputError, match="run"):
        references.calibration("mems_gyro").samples("run")


def test_every_unknown_stands_in_exactly_one_place() -> None:
    data = readings(
        run=np.repeat(["1", "2"], 6), time=np.tile(np.arange(6.0), 2) + np.repeat([0.0, 100.0], 6)
    )
    model = BASELINE + effects.thermometer(0.3, source="none") + ["bias.run", "bias.thermal_lag"]
    layout = bind(model.fix({"bias.constant": 20.0}), data)[0].promote("bias.temperature")
    places = {b.name: b.place for b in layout.blocks}
    assert places == {
        "bias.constant": "fixed",
        "bias.temperature": "phi",
        "temperature.reading": "input",
        "bias.run": "x",
        "bias.thermal_lag": "x",
        "bias.thermal_lag[start]": "x",
    }
    assert layout.size == 2 + 1 + 2
    assert [h.name for h in layout.hypers] == [
        "noise.white",
        "bias.run.group_sd",
        "bias.thermal_lag[start].group_sd",
        "bias.thermal_lag.tau",
        "bias.temperature",
    ]
