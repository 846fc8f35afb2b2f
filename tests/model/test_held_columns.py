"""A column that is set in steps stands between readings, and a lag follows it so; one that is measured goes between."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects

QUICK = bc.LeastSquares(draws=400)
AMOUNT, TAU, INTERVAL, NOISE = 0.004, 100.0, 60.0, 0.3  # creep of a load cell; s; s; gram


def line(slot: str, column: str, size: float, unit: str) -> bc.Effect:
    return bc.Effect(
        f"{slot}.line",
        slot,
        basis=lambda r: r[column],
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, size)),),
        columns=(column,),
        source="ours",
    )


LIMITS = {"low": 30.0, "high": 3000.0, "source": "ours"}
CELL = bc.Instrument(
    name="cell",
    title="load cell under weights",
    columns=(bc.Column("time", "s"), bc.Column("load", "gram"), bc.Column("output", "gram")),
    slots=(bc.Slot("response", "gram"),),
    response=lambda s, r: s["response"],
    effects=(
        effects.constant("response", 50.0, "gram", source="ours"),
        line("response", "load", 2.0, "1"),
    ),
    candidates=(
        effects.thermal_lag(
            *("response", 0.01, "1"),
            **LIMITS,
            start=1000.0,
            start_unit="gram",
            column="load",
            name="creep",
        ),
    ),
    noise=bc.White(bc.HalfCauchy(2.0)),
    source="ours",
)


def loads(seed: int, joined: bool = False) -> bc.Measurements:
    """Weights put on at a reading, each for ten; or a press that goes evenly from one reading to the next."""
    rng = np.random.default_rng([seed, 9])
    time = INTERVAL * np.arange(400.0)
    goal = rng.choice([0.0, 500.0, 1000.0, 2000.0], 41)
    load = np.interp(np.arange(400.0) / 10, np.arange(41), goal) if joined else np.repeat(goal, 10)
    load, behind = load[:400], np.zeros(400)
    fine = 600
    for i in range(1, 400):
        state = behind[i - 1] + load[i - 1]
        between = (np.arange(fine) + 0.5) / fine if joined else np.zeros(fine)
        for x in load[i - 1] + (load[i] - load[i - 1]) * between:
            state = x + (state - x) * np.exp(-INTERVAL / fine / TAU)
        behind[i] = state - load[i]
    output = 12.0 + 1.0005 * load + AMOUNT * behind + NOISE * rng.standard_normal(400)
    return bc.Measurements.from_arrays(CELL, time=time, load=load, output=output)


def off(found: bc.Calibration) -> float:
    amount = found.samples("response.creep")
    return float(abs(amount.mean() - AMOUNT) / amount.std())


@pytest.mark.parametrize("joined", [False, True])
def test_lag_of_a_column_that_was_set_or_measured(joined: bool) -> None:
    """The amount of creep, which the evidence cannot tell: a lag of a step differs by a factor alone."""
    readings = loads(1, joined)
    model = CELL.baseline() + "response.creep"
    found = bc.fit(model, readings, QUICK)
    assert found.reference["load_held"] == float(not joined)
    assert off(found) < 3
    otherwise = bc.fit(model, readings, QUICK, reference={"load_held": float(joined)})
    assert otherwise.reference["load_held"] == float(joined)
    assert off(otherwise) > 3


def test_held_column_is_held_in_predictions_and_saved_calibrations(tmp_path: Path) -> None:
    found = bc.fit(CELL.baseline() + "response.creep", loads(2), QUICK)
    again = bc.load(found.save(tmp_path / "cell.nc"), instruments=[CELL])
    later = loads(3)
    few = later.select(np.arange(35))  # too few steps to tell what the column is
    for calibration in (found, again):
        assert bc.predict(calibration, later).rmse < 1.1 * NOISE
        assert bc.predict(calibration, few).rmse < 1.4 * NOISE
    assert json.dumps(again.reference["load_held"]) == "1.0"
