"""An accelerometer on a dividing head: intervals cover, and K2, K3 and a fixture that tilts are found."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_dividing_head as head
from bayescal_models.accelerometer_dividing_head.simulator import BASELINE
from tests.support.tiers import slow_but

LS = bc.LeastSquares()
HIDDEN = {"second_order.constant": 20.0, "third_order.constant": 25.0, "zero.temperature": 5.0}


@pytest.mark.parametrize("name", slow_but(["second_order.constant"], list(HIDDEN)))
def test_hidden_effect_is_found(name: str) -> None:
    readings = head.simulate({name: HIDDEN[name]}, seed=3)
    found = bc.discover(bc.fit(head.INSTRUMENT.baseline(), readings, LS), widen_noise=False)
    assert name in {e.name for e in found.best}


def test_no_effect_is_found_where_none_is_hidden() -> None:
    line = bc.fit(head.INSTRUMENT.baseline(), head.simulate(seed=4), LS)
    found = bc.discover(line, widen_noise=False)
    assert not found.findings


def test_correction_in_use_returns_the_input_axis_acceleration() -> None:
    readings = head.simulate(HIDDEN, seed=1)
    fitted = bc.fit(head.INSTRUMENT.baseline() + [*HIDDEN], readings, LS)
    made, departure = bc.compensator(fitted)(readings), readings["temperature"] - 25.0
    zero = BASELINE["zero.constant"] + HIDDEN["zero.temperature"] * departure
    acting = 1e6 * np.sin(readings["position_angle"] + 1e-6 * zero)
    assert np.std(made.value - acting) < 8.0  # µg, of which 5 are noise
