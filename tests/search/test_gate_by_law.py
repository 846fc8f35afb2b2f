"""A gate compares errors as the noise law weighs them, and blocks by what can be known of them; simulated, with truth.

A pressure transducer that scatters in proportion to its reading, and a load cell that creeps under weights.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects

S = "ours"


def power(column: str, order: int, size: float, unit: str, name: str) -> bc.Effect:
    return bc.Effect(
        f"response.{name}",
        "response",
        basis=lambda r: r[column] ** order,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, size)),),
        columns=(column,),
        source=S,
    )


def meter(column: str, unit: str, more: tuple[bc.Column, ...], noise: float, candidates):
    return bc.Instrument(
        name="meter",
        title="a meter beside a standard",
        columns=(*more, bc.Column(column, unit), bc.Column("output", unit)),
        slots=(bc.Slot("response", unit),),
        response=lambda s, r: s["response"],
        effects=(
            effects.constant("response", 20.0, unit, source=S),
            power(column, 1, 2.0, "1", "line"),
        ),
        candidates=candidates,
        noise=bc.White(bc.HalfCauchy(noise)),
        use=bc.Use(column, unit),
        source=S,
    )


PRESSURE = meter(
    "pressure",
    "kPa",
    (),
    0.05,
    (
        power("pressure", 2, 1e-4, "kPa^-1", "quadratic"),
        power("pressure", 3, 1e-6, "kPa^-2", "cubic"),
    ),
)
TIMED = (bc.Column("run", None, required=False), bc.Column("time", "s"))
LOAD = meter(
    "load",
    "gram",
    TIMED,
    2.0,
    (
        power("load", 2, 1e-5, "gram^-1", "quadratic"),
        effects.thermal_lag(
            *("response", 0.01, "1"),
            **{"low": 30.0, "high": 3000.0, "start": 1000.0, "start_unit": "gram"},
            source=S,
            column="load",
            name="creep",
            bodies={},
        ),
        effects.drift("response", 5.0, "gram", source=S),
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_proportional_noise_is_no_loss(seed) -> None:
    """0.2 % of the reading and 2 Pa, points in rising order: the last block decides an error without weights."""
    random = np.random.default_rng(seed)
    pressure = np.repeat([1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0], 6)
    scatter = np.hypot(0.002 * pressure, 0.002)
    output = 0.02 + 1.0025 * pressure + scatter * random.standard_normal(pressure.size)
    readings = bc.Measurements.from_arrays(PRESSURE, pressure=pressure, output=output)
    found = bc.calibrate(PRESSURE.baseline(), readings)
    assert found.gate.ok, found.gate.reason
    line = found.calibration.samples("response.line")
    assert line.mean() == pytest.approx(1.0025, abs=4 * line.std())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_start_at_rest_is_no_ridge(seed) -> None:
    """Creep of 0.4 % with 300 s from rest: the spread of what a run begins with is at its edge of zero."""
    random, step = np.random.default_rng(seed), 10.0
    load = np.repeat([0.0, 1000, 0, 2000, 0, 500, 2000, 1000], 60).astype(float)
    behind, creep = 0.0, []
    for i, now in enumerate(load):
        if i:
            change = now - load[i - 1]
            x = step / 300.0
            behind = np.exp(-x) * behind + np.expm1(-x) / x * change
        creep.append(0.004 * behind)
    output = 12.0 + 1.0005 * load + np.array(creep) + 0.3 * random.standard_normal(load.size)
    readings = bc.Measurements.from_arrays(
        LOAD, time=step * np.arange(load.size), load=load, output=output
    )
    found = bc.calibrate(LOAD.baseline(), readings)
    assert found.final.calibration.model.names[-1] == "response.creep"
    assert found.gate.ok, found.gate.reason
    tau = found.calibration.samples("response.creep.tau")
    assert tau.mean() == pytest.approx(300.0, abs=4 * tau.std())


@pytest.mark.parametrize("method", [bc.LeastSquares(), bc.Marginal()])
def test_a_fit_says_that_readings_are_too_few(method) -> None:
    """As a search does: two readings determine two unknowns, and no noise."""
    readings = bc.Measurements.from_arrays(PRESSURE, pressure=[0.0, 200.0], output=[0.05, 199.65])
    found = bc.fit(PRESSURE.baseline(), readings, method, strict=False)
    assert [c.code for c in found.conflicts] == ["readings.too_few"]
    stated = bc.Measurements.from_arrays(
        PRESSURE, pressure=[0.0, 200.0], output=[0.05, 199.65], output_uncertainty=[0.1, 0.1]
    )
    known = bc.fit(PRESSURE.baseline().fix({"noise.white": 0.0}), stated, method, strict=False)
    assert known.conflicts == ()
