"""The self-check of an instrument says what came back, and what its author got wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro

SOURCE, PAGE = "made up", Path(__file__).parents[2] / "docs" / "own_instrument.md"
GOOD = bc.Instrument(
    name="barometer",
    title="a barometer in a chamber",
    columns=(
        bc.Column("time", "s", required=False),
        bc.Column("temperature", "degC", low=-20.0, high=60.0),
        bc.Column("pressure", "hPa", low=900.0, high=1100.0),
        bc.Column("mount", None, required=False, allowed=("up", "down")),
        bc.Column("output", "hPa"),
    ),
    slots=(bc.Slot("zero", "hPa"), bc.Slot("scale", "1")),
    response=lambda slots, r: slots["zero"] + (1 + slots["scale"]) * r["pressure"],
    effects=(
        effects.constant("zero", 5.0, "hPa", source=SOURCE),
        effects.constant("scale", 1000.0, "ppm", source=SOURCE),
    ),
    candidates=(effects.linear("zero", 0.1, "Pa/degC", source=SOURCE),),
    noise=bc.White(bc.HalfCauchy(0.001)),
    use=bc.Use("pressure", "hPa"),
)


def check(instrument: bc.Instrument) -> bc.InstrumentCheck:
    """The check, on four runs up and down in temperature."""
    run, random = np.repeat(np.arange(4), 60), np.random.default_rng(0)
    columns: dict[str, Any] = {
        "time": 20.0 * np.arange(run.size),
        "temperature": 20 + 20 * np.sin(2 * np.pi * np.arange(run.size) / 60 + run),
        "pressure": random.uniform(900, 1100, run.size),
        "mount": random.choice(["up", "down"], run.size),
        "output": random.standard_normal(run.size),
    }
    return bc.check_instrument(instrument, bc.Measurements.from_arrays(instrument, **columns))


def of(found: bc.InstrumentCheck, name: str):
    return next(row for row in found.rows if row.name == name)


def turned(label: str) -> bc.Effect:
    return bc.Effect(
        "zero.mount",
        "zero",
        basis=lambda r: r.has_label("mount", label),
        coefficients=(bc.Coefficient("hPa", bc.Normal(0.0, 0.1)),),
        columns=("mount",),
    )


@pytest.mark.slow
def test_declared_effects_are_recovered() -> None:
    found = check(replace(GOOD, candidates=(*GOOD.candidates, turned("down"))))
    assert found.ok and not found.errors
    names = [row.name for row in found.rows]
    assert names == ["zero.constant", "scale.constant", "zero.temperature", "zero.mount"]
    for row in found.rows:
        assert row.remark == "" and row.truth is not None and row.mean is not None
        assert row.mean == pytest.approx(row.truth, abs=4 * (row.sd or 0.0))
    temperature = of(found, "zero.temperature")
    assert temperature.unit == "Pa/degC" and temperature.kind == "candidate"
    # hPa, at 20 °C from the middle
    assert temperature.adds == pytest.approx(0.1 * 20 * 0.01, rel=0.1)
    assert list(found.to_pandas().index) == names


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"candidates": (turned("downwards"),)}, "zero.mount changes no reading"),
        (
            {"response": lambda slots, r: r["pressure"], "use": None},
            "zero.constant changes no reading",
        ),
        (
            {
                "response": lambda slots, r: jnp.log(slots["zero"] - 1e9) + r["pressure"],
                "use": None,
            },
            "the output is not finite in",
        ),
        (
            {"response": lambda slots, r: slots["zero"] + r["presure"], "use": None},
            "fails: KeyError: 'presure'",
        ),
        (
            {"candidates": (effects.linear("zero", 1e-12, "hPa/degC", source=SOURCE),)},
            "zero.temperature contributes at most",
        ),
    ],
    ids=["zero basis", "constant", "not finite", "fails", "off scale"],
)
def test_wrong_declaration_is_an_error(changed: dict, said: str) -> None:
    found = check(replace(GOOD, **changed))
    assert not found.ok
    assert any(said in error for error in found.errors), found.errors


def test_confounded_effects_are_noted() -> None:
    twice = replace(GOOD.effects[0], name="zero.again")
    found = check(replace(GOOD, effects=(*GOOD.effects, twice), candidates=()))
    assert of(found, "zero.again").remark == "not identifiable here"
    assert any("zero.again" in note and "not measured" in note for note in found.notes)


@pytest.mark.slow
def test_registered_instrument_passes() -> None:
    found = bc.check_instrument(mems_gyro.INSTRUMENT)
    assert found.ok, found.errors


def test_missing_simulator_requires_readings() -> None:
    with pytest.raises(bc.ModelError, match="readings="):
        bc.check_instrument(GOOD)
