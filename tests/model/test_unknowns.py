"""The table of a model's unknowns: their names, places and values."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal._model.parameters import Unknowns, bind
from tests.support import references

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
