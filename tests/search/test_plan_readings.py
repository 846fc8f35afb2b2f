"""Where to measure next: what a campaign is expected to leave of an uncertainty is what it leaves when it is made."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT, Campaign, simulate
from tests.support.command_line import run

SLOPE = "bias.temperature: ±1e-3 deg/s/degC"
CURVE = "corrected mean: ±0.1 deg/s over temperature 30..80 degC"
FEW = Campaign(runs=2, average=150)


def line(seed: int, campaign: Campaign = FEW) -> bc.Calibration:
    readings = simulate(seed=seed, campaign=campaign)
    return bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=4000), seed=seed)


def both(first: bc.Calibration, seed: int) -> bc.Calibration:
    """The fit of two campaigns."""
    a, b = first.readings, simulate(seed=seed, campaign=FEW)
    columns: dict[str, Any] = {c: np.append(a[c], b[c]) for c in a.columns if c != "run"}
    columns["run"] = np.append(a["run"], np.char.add("later ", b["run"].astype(str)))
    joined = bc.Measurements.from_arrays(INSTRUMENT, **columns)
    return bc.fit(first.model, joined, bc.LeastSquares(draws=4000), reference=first.reference)


def test_without_curvature_it_is_what_theory_says() -> None:
    """Of a line with white noise, half the variance is left by as many readings again, and its ends say most."""
    fitted = line(1)
    plan = bc.plan_readings(fitted, SLOPE, count=6)
    again = next(c for c in plan.campaigns if c.name == "the same again")
    assert again.u / plan.u == pytest.approx(0.5**0.5, rel=0.03)
    assert plan.u == pytest.approx(float(fitted.samples("bias.temperature").std()), rel=1e-9)
    assert plan.campaigns[0].u <= again.u
    ends = {round(p.at["temperature"], -1) for p in plan.picked}
    assert ends <= {30.0, 80.0}, ends
    assert all(a.u > b.u for a, b in zip(plan.picked, plan.picked[1:], strict=False))


def test_readings_that_say_nothing_are_not_worth_it() -> None:
    fitted = line(2)
    one = simulate(seed=3, campaign=Campaign(runs=1, average=150, temperatures=(54.5, 55.5)))
    plan = bc.plan_readings(fitted, SLOPE, {"at one temperature": one})
    assert plan.enough
    assert plan.gain < 0.01
    assert "Enough" in str(plan)
    assert not plan.data()["notes"]


@pytest.mark.slow
def test_beyond_what_was_calibrated_it_says_so() -> None:
    plan = bc.plan_readings(line(4), "bias: ±1 deg/s over temperature -20..20 degC", count=0)
    assert "the model is carried on" in str(plan)
    assert plan.picked == ()


@pytest.mark.parametrize(
    ("limit", "count", "words"),
    [
        ("nothing: ±1 deg/s", 3, "nothing is called 'nothing'"),
        ("bias.temperature", 3, "names no quantity"),
        (SLOPE, -1, "pick no reading or more"),
        ("noise.white: ≤ 1 deg/s", 3, "no uncertainty to shrink"),
    ],
)
def test_what_cannot_be_planned_is_refused(limit: str, count: int, words: str) -> None:
    with pytest.raises(bc.InputError, match=words):
        bc.plan_readings(line(1), limit, count=count)


@pytest.mark.slow
def test_the_command(tmp_path) -> None:
    line(5).save(tmp_path / "line.nc")
    ran = run("plan", str(tmp_path / "line.nc"), "--limit", SLOPE, "--count", "2", "--json")
    assert ran.status == 0, ran.err
    data = json.loads(ran.out)
    assert len(data["readings"]) == 2
    assert data["campaigns"][0]["standard_uncertainty"] < data["standard_uncertainty"]


@pytest.mark.slow
@pytest.mark.parametrize("limit", [SLOPE, CURVE])
def test_expected_gain_is_the_gain_that_is_made(limit: str) -> None:
    """Over 100 devices: the campaign is planned, then made, then both are fitted together."""
    ratios = []
    for seed in range(100):
        first = line(1000 + seed)
        plan = bc.plan_readings(first, limit, {"once more": first.readings}, count=0)
        second = bc.plan_readings(both(first, 5000 + seed), limit, {"-": first.readings}, count=0)
        ratios.append((1 - second.u / plan.u) / plan.gain)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)
