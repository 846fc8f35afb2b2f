"""A package that jumps, or an adhesive that softens, at one temperature: forms of an unknown dependence on it."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.tiers import slow_but

AT = 52.3  # °C
WHAT = {"jump": lambda t: 0.4 * (t > AT), "kink": lambda t: 0.02 * np.maximum(0.0, t - AT)}


@pytest.mark.parametrize("form", slow_but(["jump"], WHAT))
def test_it_is_found_where_it_is(form: str) -> None:
    readings = mems_gyro.simulate({}, seed=5)
    output = readings["output"] + WHAT[form](readings["temperature"])
    readings = readings.with_column("output", output, readings.unit("output"))
    trail = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, method=bc.LeastSquares())
    name = f"unknown(temperature, {form})"
    assert [s.added for s in trail.steps] == [None, name]
    found = trail.steps[0].discovery
    assert found is not None
    assert [c.effect for c in found.candidates if c.probability and c.probability > 0.9] == [
        "unknown(temperature)"
    ], "a form speaks for its family"
    final = trail.final.calibration
    low, high = readings["temperature"].min(), readings["temperature"].max()
    places = low + final.samples(f"{name}.place") * (high - low)
    steps = np.diff(np.unique(np.round(readings["temperature"])))
    assert abs(places.mean() - AT) < max(3 * places.std(), steps.max())
    assert trail.final.rmse == pytest.approx(0.05, rel=0.15)
    assert trail.gate.ok
