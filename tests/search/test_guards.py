"""Each guard is tripped by what it guards against, and by nothing ordinary."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._calibration import guards
from bayescal._calibration.guards import conflicts
from bayescal._discovery.search_path import gate
from bayescal_models import mems_gyro
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


def test_an_ordinary_fit_trips_none(line: bc.Calibration, runs: bc.Calibration) -> None:
    assert conflicts(line) == []
    assert conflicts(runs) == []


def write_off(path) -> Any:
    import pandas as pd

    table = pd.read_csv(TABLE)
    table[table.columns[1]] += OFFSET
    table.to_csv(path, index=False)
    return path


@needs_installation
def test_readings_against_the_prior_leave_with_1(tmp_path) -> None:
    done = run("fit", write_off(tmp_path / "off.csv"), *GYRO, *QUICK, "--json")
    assert done.status == 1
    assert done.data["verdict"]["ok"] is False
    (reason,) = done.data["verdict"]["reasons"]
    assert reason.startswith("bias.constant stands ")
    assert "times its plausible size from its prior's mean" in reason
    assert reason in done.said[-1]


ROW = {"name": "x", "effect": "e", "unit": "deg/s", "mean": 0.1, "contraction": 0.5}


def told_of(line: bc.Calibration, monkeypatch: pytest.MonkeyPatch, **row: Any) -> list[str]:
    """Conflicts of a fit whose summary has one spread more."""
    coefficients, spreads = guards.summary(line)
    more = [*spreads, {**ROW, **row}]
    monkeypatch.setattr(guards, "summary", lambda _: (coefficients, more))
    return conflicts(line)


def test_a_posterior_wider_than_its_prior(line, monkeypatch) -> None:
    (reason,) = told_of(line, monkeypatch, contraction=-1.5)
    assert reason.startswith("x is known worse than before the readings (contraction -1.5)")
    assert told_of(line, monkeypatch, contraction=-0.5)[1:] == []


def test_a_scale_larger_than_the_outputs_range(line, monkeypatch) -> None:
    reach = float(np.ptp(line.readings["output"]))
    (reason,) = told_of(line, monkeypatch, mean=1.1 * reach)
    assert reason.startswith("x is larger than the output's whole range")


def test_a_time_beyond_ten_records(runs, monkeypatch) -> None:
    record = float(np.ptp(runs.readings["time"]))
    (reason,) = told_of(runs, monkeypatch, unit="s", mean=11 * record)
    assert reason.startswith("x is longer than 10 records")


def steps(line: bc.Calibration, first: dict[str, Any], last: dict[str, Any]) -> list[Any]:
    """Two steps of a trail with these errors."""
    check = SimpleNamespace(fixed=None, autocorrelation=(0.0, 0.0))
    plain = {"rmse_fitted": 1.0, "left_out": None, "holdout_rmse": None, "title": "+ bias.x"}
    return [
        SimpleNamespace(calibration=line, check=check, **{**plain, **one}) for one in (first, last)
    ]


@pytest.mark.parametrize(
    ("first", "last", "said"),
    [
        ({}, {"rmse_fitted": 1.06}, "Step '+ bias.x' raises the error as fitted, 1 → 1.06 °/s"),
        ({"holdout_rmse": 1.0}, {"holdout_rmse": 1.06}, "predicts the readings kept apart worse"),
        (
            {"left_out": SimpleNamespace(rmse=1.0)},
            {"left_out": SimpleNamespace(rmse=1.06)},
            "predicts left-out groups worse than the first",
        ),
    ],
)
def test_a_step_that_does_harm_shuts_the_gate(line, first, last, said) -> None:
    found = gate(steps(line, first, last))
    assert not found.ok
    assert said in found.reason
    nearly = {
        k: 1.04 if not isinstance(v, SimpleNamespace) else SimpleNamespace(rmse=1.04)
        for k, v in last.items()
    }
    assert gate(steps(line, first, nearly)).ok


def test_the_gates_reasons_are_the_results(line: bc.Calibration) -> None:
    assert replace(line.verdict, ok=True).ok  # the fit itself converged
    off = line.readings.data.assign(output=line.readings.data["output"] + OFFSET)
    trail = bc.calibrate(
        INSTRUMENT.baseline(),
        replace(line.readings, data=off),
        method=bc.LeastSquares(draws=200),
        max_effects=1,
    )
    from bayescal._report.result_json import result

    verdict = result(trail)["verdict"]
    assert verdict["ok"] is False
    assert trail.gate.reason in verdict["reasons"]
    assert "times its plausible size" in trail.gate.reason
