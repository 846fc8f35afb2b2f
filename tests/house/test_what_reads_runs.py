"""The model that reads is the model that runs: broken, the composition breaks every command on every instrument."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import optimistix
import pytest

import bayescal as bc
from bayescal._model import composition
from tests.support import references

TRIADS = "accelerometer_triad", "gyro_triad", "magnetometer_triad"
DOCUMENTS = "mems_gyro", "ng_accelerometer", "quartz_beam_accelerometer", "differential_pair"
INSTRUMENTS = (
    *DOCUMENTS,
    *("inclinometer", "still_sensor", "accelerometer_dividing_head"),
    *TRIADS,
)
FAST = "mems_gyro"


class Broken(Exception):
    """In place of what a function computes."""


def breaking(monkeypatch: pytest.MonkeyPatch, old: Any) -> None:
    """Break a function wherever the product, or the library that has it, knows it."""
    import_module("bayescal._use.operating_equation")  # what is loaded meanwhile would stay broken

    def broken(*args: object, **kwargs: object) -> None:
        raise Broken(old.__name__)

    for name, module in list(sys.modules.items()):
        if name.startswith(("bayescal.", "numpyro", "optimistix")):
            for own in [n for n, value in vars(module).items() if value is old]:
                monkeypatch.setattr(module, own, broken)
    jax.clear_caches()  # what was traced before would go on


def _triad(instrument: str) -> bool:
    return instrument.endswith("_triad")


def _model(instrument: str) -> tuple[bc.Model, bc.Measurements]:
    problem = import_module(f"bayescal_models.{instrument}.reference_problem")
    return problem.model(), problem.readings(seed=0)


COMMANDS: dict[str, Callable[[bc.Calibration, bc.Model, bc.Measurements], Any]] = {
    "fit": lambda c, m, r: bc.fit(m, r),
    "LeastSquares": lambda c, m, r: bc.fit(m, r, bc.LeastSquares()),
    "NUTS": lambda c, m, r: bc.fit(m, r, bc.NUTS(warmup=2, draws=2, chains=1), strict=False),
    "check": lambda c, m, r: bc.check(c),
    "predict": lambda c, m, r: bc.predict(c, r),
    "discover": lambda c, m, r: bc.discover(c),
    "calibrate": lambda c, m, r: bc.calibrate(m, r, max_effects=1),
    "fit_batch": lambda c, m, r: bc.fit_batch(m, {"a": r, "b": r}, method=bc.LeastSquares()),
    "use": lambda c, m, r: (
        bc.vector_correction(c) if c.model.instrument.vector is not None else bc.compensator(c)
    ),
    "budget": lambda c, m, r: bc.budget(c, at=float(r["temperature"].mean())),
}
# A sensor at rest and a pair are not compensated; a budget is one output's, at one temperature.
WITHOUT = {
    "use": ("still_sensor", "differential_pair"),
    "budget": ("still_sensor", "differential_pair", "quartz_beam_accelerometer", *TRIADS),
}
CASES = [
    pytest.param(i, command, marks=() if i == FAST else pytest.mark.slow, id=f"{i}-{command}")
    for i in INSTRUMENTS
    for command in COMMANDS
    if i not in WITHOUT.get(command, ())
]


@pytest.mark.parametrize(("instrument", "command"), CASES)
def test_a_broken_composition_breaks_every_command(monkeypatch, instrument, command) -> None:
    fresh = pickle.loads(pickle.dumps(references.calibration(instrument)))  # nothing computed of it
    asked = fresh, *_model(instrument)
    breaking(monkeypatch, composition.compose)
    with pytest.raises(Broken):
        COMMANDS[command](*asked)
    jax.clear_caches()


@pytest.mark.parametrize(
    "instrument",
    [
        i if i == FAST else pytest.param(i, marks=pytest.mark.slow)
        for i in INSTRUMENTS
        if i != "inclinometer"  # everything of it is linear: one QR
    ],
)
def test_a_broken_optimistix_breaks_least_squares(monkeypatch, instrument) -> None:
    # of what is not linear: with a shape, where the baseline has none
    model, readings = _model(instrument)
    shaped = [e.name for e in model.instrument.candidates if e.column_shapes and not e.open]
    model += [n for n in shaped if (model + n).columns <= set(readings.columns)][:1]
    breaking(monkeypatch, optimistix.least_squares)
    with pytest.raises(Broken):
        bc.fit(model, readings, bc.LeastSquares())
    jax.clear_caches()


@pytest.mark.parametrize(
    "instrument",
    [i if i == FAST else pytest.param(i, marks=pytest.mark.slow) for i in INSTRUMENTS],
)
def test_broken_chains_break_nuts(monkeypatch, instrument) -> None:
    from numpyro.infer import NUTS

    model, readings = _model(instrument)

    def broken(*args: object, **kwargs: object) -> None:
        raise Broken("NUTS")

    monkeypatch.setattr(NUTS, "sample", broken)
    with pytest.raises(Broken):
        bc.fit(model, readings, bc.NUTS(warmup=2, draws=2, chains=1), strict=False)
