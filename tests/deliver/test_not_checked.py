"""A model that nobody checked is checked before it decides, certifies or is exported, whichever way it came."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import needs_installation, run
from tests.support.inside import identity_of
from tests.support.made_up import bent_sensor

LIMIT = "bias: 20..24 °/s"
DEPENDS = "residuals still depend on temperature"


@cache
def readings() -> bc.Measurements:
    """A gyroscope whose bias bends with temperature, which the baseline does not: log Bayes factor 99."""
    return mems_gyro.simulate({"bias.temperature_quadratic": 3e-4}, seed=1)


@pytest.fixture(scope="module")
def fit() -> bc.Calibration:
    return bc.fit(mems_gyro.INSTRUMENT.baseline(), readings(), bc.LeastSquares(draws=400))


@pytest.fixture(scope="module")
def saved(fit, tmp_path_factory) -> Path:
    return fit.save(tmp_path_factory.mktemp("unchecked") / "calibration.nc")


def test_a_fit_and_a_saved_fit_decide_nothing_where_their_check_fails(fit, saved) -> None:
    for one in (fit, bc.load(saved)):
        (found,) = bc.decide(one, LIMIT).decisions
        assert found.decision == "undecided" and found.probability > 0.99
        assert DEPENDS in found.why


def test_the_last_model_of_a_search_that_could_not_add_it_decides_nothing() -> None:
    alone = {"max_effects": 0, "widen_noise": False, "method": bc.LeastSquares(draws=400)}
    trail = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings(), **alone)
    (found,) = bc.decide(trail.calibration, LIMIT).decisions
    assert found.decision == "undecided" and DEPENDS in found.why


@needs_installation
@pytest.mark.parametrize(
    "asked", [("decide", "--limit", LIMIT), ("export", "--format", "c"), ("budget",)]
)
def test_commands_leave_with_1(saved, asked) -> None:
    command, *options = asked
    done = run(command, saved, *options)
    assert done.status == 1 and DEPENDS in " ".join(done.out.split()) + done.err


def test_what_passes_its_check_decides_and_keeps_its_identity() -> None:
    fit = bent_sensor.gyro()
    found = bc.decide(fit, LIMIT)
    assert found.conforms and found.calibration == identity_of(fit)


def test_a_calibration_that_was_checked_is_not_checked_again(fit, tmp_path) -> None:
    """What `calibrate` has judged, with conflicts that the user accepts, stays judged when it is loaded."""
    passed = fit.with_verdict(checked=True)
    again = bc.load(passed.save(tmp_path / "calibration.nc"))
    assert bc.decide(again, LIMIT).conforms
    assert not bc.decide(replace(fit), LIMIT).conforms
