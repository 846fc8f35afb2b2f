"""What the readings did not measure decides nothing, sets no date, and is said to be the prior's wherever it stands."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import needs_installation, run
from tests.support.inside import identity_of
from tests.support.made_up import bent_sensor
from tests.support.made_up.level import level

DAY, YEAR = 86400.0, 365.25 * 86400.0  # s
CANNOT = "cannot be determined from these readings"


def levelled(instrument: bc.Instrument, seed: int = 1) -> bc.Measurements:
    """Four runs over 200 days; the zero moves by 3.3 arcsec, and would pass 12 arcsec after 1.8 years."""
    random, runs, readings = np.random.default_rng(seed), 4, 6
    start = np.linspace(0, 200 * DAY, runs)
    time = (start[:, None] + 60.0 * np.arange(readings)).ravel()
    run = np.repeat(np.arange(runs), readings)
    zero = 1.0 + 3.3 * (time - time.mean()) / np.ptp(time)
    zero += (0.5 * random.standard_normal(runs))[run]
    return bc.Measurements.from_arrays(
        instrument,
        time=time,
        run=run.astype(str),
        output=zero + 0.3 * random.standard_normal(len(time)),
    )


@pytest.fixture(scope="module")
def untold() -> bc.Calibration:
    """A drift whose posterior is its prior: runs differ by more than it is taken for."""
    instrument = level(0.05)
    return bc.fit(instrument.baseline(), levelled(instrument), bc.LeastSquares())


@pytest.fixture(scope="module")
def unturned() -> bc.Calibration:
    """A gyroscope that was never turned, with a scale factor in its model: nothing measures it."""
    still = mems_gyro.simulate(seed=1, campaign=mems_gyro.Campaign(average=300, rate_input=(0.0,)))
    model = mems_gyro.INSTRUMENT.baseline() + "scale.constant"
    return bc.fit(model, still, bc.LeastSquares())


def test_no_date_follows_from_a_drift_that_was_not_measured(untold) -> None:
    (found,) = bc.decide(untold, "zero: ±12 arcsec").decisions
    again = found.recalibration
    assert again.after is None and again.date is None
    assert CANNOT in again.why_not and "zero.drift" in again.why_not
    assert found.decision == "accept"  # of today it can be said: runs differ, and that is measured


@pytest.mark.parametrize("rule", ["guarded", "simple"])
@pytest.mark.parametrize(
    "limit",
    [
        "scale: ±20000 ppm",
        "scale.constant: ±20000 ppm",
        "corrected reading: ±2 °/s at rate_input = 80 °/s",
        "corrected mean: ±2 °/s at rate_input = 80 °/s",
    ],
)
def test_nothing_is_decided_by_a_coefficient_that_is_its_prior(unturned, limit, rule) -> None:
    (found,) = bc.decide(unturned, limit, rule=rule).decisions
    assert found.decision == "undecided" and found.risk is None
    assert CANNOT in found.why and "scale.constant" in found.why


def test_quantities_independent_of_the_unmeasured_coefficient_are_decided(unturned) -> None:
    bias, reading = bc.decide(
        unturned, ["bias: 20..24 °/s", "corrected reading: ±1 °/s at rate_input = 0 °/s"]
    ).decisions
    assert bias.decision == reading.decision == "accept"


def test_two_coefficients_of_which_only_the_sum_is_measured_decide_nothing_by_themselves() -> None:
    """Two constants, as a bias and a hysteresis are in a record that only warms."""
    other = bc.Effect(
        "zero.other",
        "zero",
        basis=lambda r: r["time"] * 0 + 1.0,
        coefficients=(bc.Coefficient("arcsec", bc.Normal(0.0, 50.0)),),
        columns=("time",),
        source="made up",
    )
    instrument = replace(level(4.0), effects=(*level(4.0).effects, other))
    fit = bc.fit(instrument.baseline(), levelled(instrument), bc.LeastSquares())
    one, other, both = bc.decide(
        fit, ["zero.constant: ±500 arcsec", "zero.other: ±500 arcsec", "zero: ±12 arcsec"]
    ).decisions
    assert CANNOT in one.why and CANNOT in other.why
    assert CANNOT not in both.why


def test_in_an_average_over_structures_what_is_improbable_does_not_count(untold) -> None:
    """A drift that is not measured where it is: in 2 % of the draws it sets no date, in half of them it would."""
    (block,) = (b for b in untold.layout.x_blocks if b.name == "zero.drift")

    def with_share(share: float) -> bc.Calibration:
        x = untold.joint.x.copy()
        x[:, int(share * x.shape[1]) :, block.start] = 0.0
        return replace(untold, joint=replace(untold.joint, x=x))

    rare, common = (
        bc.decide(with_share(p), "zero: ±12 arcsec").decisions[0].recalibration for p in (0.02, 0.5)
    )
    assert CANNOT not in rare.why_not
    assert CANNOT in common.why_not


def test_the_spread_of_runs_is_measured_by_four_and_not_by_one() -> None:
    fit = bent_sensor.gyro()
    (found,) = bc.decide(bc.fit(fit.model, fit.readings), "bias.run.group_sd: ≤ 1 °/s").decisions
    assert CANNOT not in found.why
    one = fit.readings.select(np.flatnonzero(fit.readings.groups("run")[1] == 0))
    (found,) = bc.decide(bc.fit(fit.model, one), "bias.run.group_sd: ≤ 1 °/s").decisions
    assert CANNOT in found.why


# A model that nobody checked is checked before it decides, certifies or is exported, whichever way it came.


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


@needs_installation
@pytest.mark.parametrize(
    "asked", [("decide", "--limit", LIMIT), ("export", "--format", "c"), ("budget",)]
)
def test_commands_exit_with_status_1(saved, asked) -> None:
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
