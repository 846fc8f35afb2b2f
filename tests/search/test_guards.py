"""Each guard is tripped by what it guards against, and by nothing ordinary."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._calibration import judgement
from bayescal._calibration.judgement import Subject
from bayescal._calibration.leave_group_out import leave_one_group_out
from bayescal._search.gate import assess_last
from bayescal.effects import deviation
from bayescal_models import mems_gyro, ng_accelerometer
from bayescal_models.mems_gyro import INSTRUMENT, TABLE
from tests.support.command_line import GYRO, QUICK, needs_installation, run

OFFSET = 1446.0  # °/s


def fitted(readings: bc.Measurements) -> bc.Calibration:
    return bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=200), strict=False)


@pytest.fixture(scope="module")
def line() -> bc.Calibration:
    return fitted(bc.read(TABLE, INSTRUMENT))


@pytest.fixture(scope="module")
def runs() -> bc.Calibration:
    readings = mems_gyro.simulate({}, seed=1, campaign=mems_gyro.Campaign(average=300))
    return fitted(readings)


def test_ordinary_fit_passes_all_guards(line: bc.Calibration, runs: bc.Calibration) -> None:
    assert judgement.conflicts(Subject(line)) == []
    assert judgement.conflicts(Subject(runs)) == []


def write_off(path) -> Any:
    import pandas as pd

    table = pd.read_csv(TABLE)
    table[table.columns[1]] += OFFSET
    table.to_csv(path, index=False)
    return path


@needs_installation
def test_conflict_with_the_prior_gives_exit_status_1(tmp_path) -> None:
    done = run("fit", write_off(tmp_path / "off.csv"), *GYRO, *QUICK, "--json")
    assert done.status == 1
    assert done.data["verdict"]["ok"] is False
    (reason,) = done.data["verdict"]["reasons"]
    assert reason in done.said[-1]


@pytest.mark.parametrize(("sign", "count"), [(1.0, 0), (-1.0, 1)])
def test_runs_that_differ_by_far_more_than_is_plausible(
    sign: float, count: int, runs: bc.Calibration
) -> None:
    """A spread that is learned takes up any difference: that one run has the other sign shows nowhere else."""
    given = runs.readings
    first = given.groups("run")[1] == 0
    columns: dict[str, Any] = {name: given[name] for name in ("time", "temperature", "run")}
    output = np.where(first, sign, 1.0) * given["output"]
    readings = bc.Measurements.from_arrays(INSTRUMENT, **columns, output=output)
    between = deviation("bias", "run", 0.3, "deg/s", source="ours")
    found = bc.fit(runs.model + between, readings, bc.LeastSquares(draws=200), strict=False)
    told = judgement.group_conflicts(Subject(found))
    assert len(told) == count
    assert all(said.numbers["member"].startswith("bias.run(") for said in told)
    assert set(told) <= set(found.conflicts)
    assert judgement.group_conflicts(Subject(found, ["bias.run"])) == []
    assert not set(told) & set(judgement.conflicts(Subject(found))), (
        "what is missing may be what they differ by"
    )


def test_members_that_follow_the_column_that_their_readings_deny() -> None:
    """A thermometer late by five readings changes within a cell as the output does not."""
    given = ng_accelerometer.simulate({}, seed=3)
    warm = np.array(given["temperature"])
    for one in np.unique(given["run"]):
        own = np.flatnonzero(given["run"] == one)
        warm[own] = np.interp(np.arange(len(own)) - 5.0, np.arange(len(own)), warm[own])
    model, told = ng_accelerometer.INSTRUMENT.for_readings(given).baseline(), []
    for readings in (given, given.with_column("temperature", warm)):
        found = bc.fit(model, readings, bc.LeastSquares(draws=200), strict=False)
        told.append(judgement.group_conflicts(Subject(found)))
    assert told[0] == []
    said = told[1][0]
    assert (said.code, said.subjects) == ("group.follows_column", ("bias.cell", "bias.temperature"))
    assert said in found.conflicts
    assert judgement.group_conflicts(Subject(found, ["bias.cell", "scale.cell"])) == []


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of overflow, on the way to no noise
def test_an_output_that_a_model_explains_to_the_last_digit() -> None:
    """Its noise is zero, which no check can divide by."""
    temperature = np.repeat([20.0, 30.0, 40.0], 6)
    readings = bc.Measurements.from_arrays(
        INSTRUMENT, time=60.0 * np.arange(18), temperature=temperature, output=temperature / 10 - 1
    )
    with pytest.raises(bc.InputError):
        bc.calibrate(INSTRUMENT.baseline(), readings, method=bc.LeastSquares(draws=200))


def groups_left_out(rmse: float, log_score: float) -> SimpleNamespace:
    """Three runs, each predicted from the others with this error and density."""
    return SimpleNamespace(
        rmse=rmse,
        variance=None,
        error=lambda _: rmse,
        residual=np.full(3, np.nan),  # of no reading
        group="run",
        count=3,
        error_ratio=np.ones(3),
        p_value=np.ones(3),
        log_score=np.full(3, log_score),
    )


def steps(line: bc.Calibration, first: dict[str, Any], last: dict[str, Any]) -> list[Any]:
    """Two steps of a trail with these errors."""
    passed = {"contradicts_fixed": False, "autocorrelation": (0.0, 0.0), "scatter_with": {}}
    passed |= {"pit_p": 0.5, "one_sided": 1.0, "excess_kurtosis": 0.0, "unit": "deg/s"}
    check = SimpleNamespace(**passed, **dict.fromkeys(("outliers", "entries", "pairs"), ()))
    plain = {
        **{"rmse_fitted": 1.0, "leave_one_group_out": None, "holdout_rmse": None},
        **{"holdout_test": None, "noise_floor": 1.0, "discovery": None, "title": "+ bias.x"},
        **{"failures": (), "outlying_groups": (), "multimodality": (), "added": "bias.x"},
    }
    fixed = {"calibration": line, "check": check}
    return [SimpleNamespace(**fixed, **plain | one) for one in (first, last)]


def codes(found: Any) -> set[str]:
    return {claim.code for claim in found.claims}


def test_indefinite_hessian_fails_acceptance(line) -> None:
    assert judgement.multimodality(line) == []
    mended = replace(line, mode=line.mode._replace(indefinite=True))
    (reason,) = judgement.multimodality(mended)
    assert reason.code == "mode.indefinite"
    assert not assess_last(steps(line, {}, {"multimodality": (reason,)})).ok


@pytest.mark.parametrize(
    ("first", "last", "code"),
    [
        ({}, {"rmse_fitted": 1.06}, "step.raises_error"),
        ({"holdout_rmse": 1.0}, {"holdout_rmse": 1.06}, "step.predicts_worse"),
        (
            {"leave_one_group_out": groups_left_out(1.0, 0.0)},
            {"leave_one_group_out": groups_left_out(1.06, -9.0)},
            "step.predicts_worse",
        ),
    ],
)
def test_harmful_step_fails_acceptance(line, first, last, code) -> None:
    assert code in codes(assess_last(steps(line, first, last)))
    nearly = {
        k: 1.04 if not isinstance(v, SimpleNamespace) else groups_left_out(1.04, -9.0)
        for k, v in last.items()
    }
    assert assess_last(steps(line, first, nearly)).ok


@pytest.mark.parametrize(
    ("score", "ok"), [(30, True), (-1.5, True), (-1.6, False), (np.nan, False)]
)
def test_groups_left_out_are_judged_by_their_density(line, score: float, ok: bool) -> None:
    """The odds of a hundred to one are 4.6 nats, of all three groups together."""
    first, last = groups_left_out(1.0, 0.0), groups_left_out(1.3, score)
    assert (
        assess_last(steps(line, {"leave_one_group_out": first}, {"leave_one_group_out": last})).ok
        is ok
    )


@pytest.mark.parametrize(("p", "ok"), [(0.02, True), (0.005, False)])
def test_hold_out_data_are_judged_by_a_test(line, p: float, ok: bool) -> None:
    nothing = SimpleNamespace(p=0.5, ratio=1.0, scatter=1.0, coefficient="")
    test = SimpleNamespace(paired_test=lambda _: p, contradiction=nothing)
    first, last = ({"holdout_rmse": rmse, "holdout_test": test} for rmse in (1.0, 1.3))
    assert assess_last(steps(line, first, last)).ok is ok


@pytest.mark.parametrize(
    ("what", "code"),
    [
        ({"scatter_with": {"temperature": 1e-6}}, "noise.scatter"),
        ({"pit_p": 1e-6}, "noise.tails"),
        ({"one_sided": 1e-6}, "noise.one_sided"),
        ({"entries": [SimpleNamespace(covariate="run", log_bayes_factor=11)]}, "residuals.depend"),
        ({"autocorrelation": (0.3, 5.0)}, "noise.correlated"),
    ],
)
def test_acceptance_uses_the_residual_check(line, what: dict[str, Any], code: str) -> None:
    (only, _) = steps(line, {}, {})
    only.check = SimpleNamespace(**{**vars(only.check), **what})
    assert code in codes(assess_last([only]))


@pytest.mark.parametrize("kurtosis", [2.0, -1.2])
def test_advice_names_a_missing_effect_first(line, kurtosis: float) -> None:
    (step, _) = steps(line, {}, {})
    misfit = {"pit_p": 1e-9, "excess_kurtosis": kurtosis, "autocorrelation": (0.9, 17.0)}
    step.check = SimpleNamespace(**vars(step.check) | misfit)
    assert ("--noise student_t" in assess_last([step]).reason) is (kurtosis > 0)
    step.check.entries = [SimpleNamespace(covariate="run", log_bayes_factor=140.0)]
    runs = {"error_ratio": np.array([1.0, 5.7, 1.0]), "p_value": np.array([1.0, 1e-9, 1.0])}
    step.leave_one_group_out = SimpleNamespace(
        **vars(groups_left_out(1.0, 0.0)) | runs, members=("1", "2", "3")
    )
    found = assess_last([step])
    order = ["residuals.depend", "noise.correlated", "noise.tails", "group.surprising"]
    assert [claim.code for claim in found.claims] == order
    assert "Student-t" not in found.reason
    assert "exclude" not in found.reason


def test_too_small_uncertainty_of_hold_out_data_fails_acceptance(line) -> None:
    found = SimpleNamespace(p=0.5, ratio=1.0, scatter=2.5, coefficient="bias.temperature")
    kept = {"holdout_rmse": 0.3, "holdout_test": SimpleNamespace(contradiction=found)}
    (_, step) = steps(line, {}, kept)
    shut = assess_last([step])
    assert codes(shut) == {"holdout.scatters"}
    found.p, found.ratio, found.scatter = 0.005, 3.0, 1.0
    assert codes(assess_last([step])) == {"holdout.contradicts"}
    found.p = 0.02
    assert assess_last([step]).ok


@pytest.mark.parametrize("between", [True, False])
def test_step_between_runs_fails_acceptance_and_one_within_a_run_does_not(between: bool) -> None:
    readings = mems_gyro.simulate({}, seed=1, campaign=mems_gyro.Campaign(average=60))
    time, later = readings["time"], readings["run"] != readings["run"][0]
    begins = time[later].min() if between else np.quantile(time[~later], 0.7)
    moved = readings.with_column("output", readings["output"] + 5.0 * (time >= begins))
    model = INSTRUMENT.for_readings(moved).baseline() + "unknown(time, jump)"
    stepped = bc.fit(model, moved, bc.LeastSquares(draws=200), strict=False)
    found = assess_last(steps(stepped, {}, {}))
    assert found.ok is not between, found.reason
    assert ("runs.apart" in codes(found)) is between


@pytest.mark.parametrize("named", [False, True])
def test_readings_of_two_devices_without_group_effect_fail_acceptance(named: bool) -> None:
    """A noise that wanders takes up how far they are apart, and so does the state in which a run begins."""
    readings = mems_gyro.simulate({}, seed=1, campaign=mems_gyro.Campaign(average=60))
    model = INSTRUMENT.for_readings(readings).baseline().with_noise(bc.OrnsteinUhlenbeck(60.0, 1e5))
    model += "bias.run" if named else "bias.thermal_lag"

    def judged(apart: float):
        other = readings["run"] == np.unique(readings["run"])[-1]
        mixed = readings.with_column("output", readings["output"] + apart * other)
        fitted = bc.fit(model, mixed, bc.LeastSquares(draws=200), strict=False)
        return assess_last(steps(fitted, {}, {"leave_one_group_out": leave_one_group_out(fitted)}))

    found = judged(4.0)
    assert ("runs.unlike" in {one.code for one in found.claims}) is not named, found.reason
    if not named:
        claim = next(one for one in found.claims if one.code == "runs.unlike")
        assert claim.numbers["apart"] == pytest.approx(4.0, abs=0.5)
        assert "runs.unlike" not in {one.code for one in judged(0.0).claims}


def test_an_input_of_the_wrong_sign_is_no_missing_effect() -> None:
    """A free curve along the input follows it; what is known of the gyroscope could not be as large."""
    campaign = mems_gyro.Campaign(rate_input=(0.0, 100.0, -100.0), nonlinearity=0.0)
    readings = mems_gyro.simulate({}, seed=1, campaign=campaign)
    model = mems_gyro.INSTRUMENT.baseline() + "unknown(rate_input)"
    turned = readings.with_column("output", -readings["output"], "deg/s")
    said = bc.fit(model, turned, bc.LeastSquares(), strict=False).conflicts
    assert ("curve.beyond_known", "unknown(rate_input)") in {(c.code, *c.subjects) for c in said}
    plain = bc.fit(model, readings, bc.LeastSquares(), strict=False).conflicts
    assert not any("unknown(rate_input)" in one.subjects for one in plain)
