"""A known constant that the readings contradict is a finding: the constant is wrong, or an effect is missing."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects

SOURCE, KNOWN = "made up", 9.81  # m/s²
QUICK = bc.LeastSquares(draws=300)
FALL = bc.Effect(
    "height.gravity",
    "height",
    basis=lambda r: -0.5 * r["time"] ** 2,
    coefficients=(bc.Coefficient("m/s^2", bc.Normal(KNOWN, 0.002)),),
    columns=("time",),
    equation="−g·t²/2",
    source=SOURCE,
)
DRAG = bc.Effect(
    "height.drag",
    "height",
    basis=lambda r: r["time"] ** 4 / 12,
    coefficients=(bc.Coefficient("m/s^4", bc.Normal(0.0, 1.0)),),
    columns=("time",),
    equation="k·g²·t⁴/12, drag in the square of the speed at its first order",
    source=SOURCE,
)
BALL = bc.Instrument(
    name="ball",
    title="the height of a falling ball",
    columns=(bc.Column("time", "s"), bc.Column("output", "m")),
    slots=(bc.Slot("height", "m"),),
    response=lambda slots, r: slots["height"],
    effects=(effects.constant("height", 5.0, "m", source=SOURCE), FALL),
    candidates=(DRAG, effects.drift("height", 0.1, "m", source=SOURCE)),
    noise=bc.White(bc.HalfCauchy(0.01)),
)


@cache
def searched(gravity: float, drag: float) -> bc.SearchPath:
    random, time = np.random.default_rng(7), np.linspace(0.0, 1.0, 120)
    height = 5 - 0.5 * gravity * time**2 + drag * time**4 / 12 + 0.002 * random.standard_normal(120)
    readings = bc.Measurements.from_arrays(BALL, time=time, output=height)
    return bc.calibrate(BALL.baseline(), readings, method=QUICK, widen_noise=False)


def test_a_missing_effect_that_bends_a_constant_is_found_and_the_constant_kept() -> None:
    path = searched(KNOWN, 2.0)
    assert path.steps[0].failures[0].subjects[0] == "height.gravity"
    assert [step.added for step in path.steps] == [None, "height.drag"]
    assert path.ok, path.gate.reason
    g = path.final.calibration.samples("height.gravity")
    assert g.mean() == pytest.approx(KNOWN, abs=0.006)


def test_a_wrong_constant_is_said_to_be_wrong_and_the_result_is_not_used(tmp_path: Path) -> None:
    path = searched(9.6, 0.0)
    assert [step.added for step in path.steps] == [None, "height.gravity.freed"]
    assert "value.freed" in {claim.code for claim in path.gate.claims}
    freed = path.final.calibration.samples("height.gravity.freed")
    assert freed.mean() + KNOWN == pytest.approx(9.6, abs=0.02)
    saved = path.final.calibration.save(tmp_path / "c.nc")
    again = bc.load(saved, instruments=[BALL])
    assert again.model == path.final.calibration.model
