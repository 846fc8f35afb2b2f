"""In a notebook: a result is one line as `repr`, a table in HTML with everything escaped, and numbers in pandas."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from bayescal_models.mems_gyro import INSTRUMENT, simulate
from tests.support.golden import assert_golden
from tests.support.inside import format_interval, format_value

SCRIPT = "<img src=x onerror=alert(1)>"
QUICK = bc.LeastSquares(draws=400)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    readings = simulate({"bias.thermal_lag": 0.03}, seed=1)
    readings = bc.read(readings.write(tmp_path_factory.mktemp("x") / f"{SCRIPT}.csv"), INSTRUMENT)
    short: dict[str, Any] = {"method": QUICK, "max_effects": 1, "widen_noise": False}
    trail = bc.calibrate(INSTRUMENT.baseline(), readings, **short)
    first, last = trail.steps[0].calibration, trail.final.calibration
    plan: Any = {"runs": 1, "interval": 60}
    unit = {n: still_sensor.simulate({}, seed=i, **plan) for i, n in enumerate("xy")}
    models = {n: still_sensor.INSTRUMENT.for_readings(r).baseline() for n, r in unit.items()}
    return {
        "readings": readings,
        "model": last.model,
        "calibration": last,
        "check": trail.steps[0].check,
        "discovery": trail.steps[0].discovery,
        "comparison": bc.compare({SCRIPT: first, "with it": last}),
        "trail": trail,
        "channels": bc.calibrate_channels(models, unit, **short),
        "budget": bc.budget(last),
        "next experiment": bc.next_experiment(
            first,
            ["bias.thermal_lag", "bias.temperature_quadratic"],
            {"the same again": readings, "half of it": readings.select(np.arange(0, 330, 2))},
        ),
    }


NAMES = ["readings", "model", "calibration", "check", "discovery", "comparison", "trail"]
NAMES += ["channels", "budget", "next experiment"]


@pytest.mark.parametrize("name", NAMES)
def test_repr_is_one_short_line(results, name) -> None:
    said = repr(results[name])
    assert said.startswith(f"<{type(results[name]).__name__}: ")
    assert len(said) < 250


def test_results_are_printed_as_in_the_golden_text(results) -> None:
    last = results["calibration"]
    devices = {f"D{i}": simulate(seed=i) for i in range(3)}
    rest = {
        "decide": bc.decide(last, ["bias: ±25 °/s", "bias.temperature: ±0.2 °/s/°C"]),
        "batch": bc.fit_batch(INSTRUMENT.baseline(), devices, method=QUICK),
        "noise": bc.noise(still_sensor.simulate({}, seed=1, runs=1, interval=5)),
    }
    told = {name: str(result) for name, result in {**results, **rest}.items()}
    assert_golden(Path(__file__).with_name("printed.txt"), told)


@pytest.mark.parametrize("name", NAMES)
def test_html_holds_every_word_of_the_text_and_nothing_unescaped(results, name) -> None:
    found = results[name]._repr_html_()
    assert "<table>" in found
    assert SCRIPT not in found
    tags = {*re.findall(r"</?(\w+)", found)}
    assert tags <= {*["table", "thead", "tbody", "tr", "th", "td", "p", "br"]}
    plain = re.sub(r"&\w+;|&#x?\w+;|<[^>]*>|\s", "", found)
    text = re.sub(r"[\s─<>&'\"]", "", str(results[name]))
    assert sorted(plain) == sorted(text)  # a wide table is folded in text alone
    assert max(map(len, str(results[name]).splitlines())) <= 110


def test_former_names_warn_and_are_the_new_ones(results) -> None:
    with pytest.warns(DeprecationWarning, match="findings"):
        assert results["discovery"].sets is results["discovery"].findings
    with pytest.warns(DeprecationWarning, match="keep_excluded"):
        results["readings"].without_causes((), others=False)


def test_names_of_files_models_and_effects_are_escaped() -> None:
    effect = bc.Effect(
        f"bias.{SCRIPT}", "bias", lambda r: 1.0, (bc.Coefficient("deg/s"),), equation="<b>c</b> & d"
    )
    found = (INSTRUMENT.baseline() + effect)._repr_html_()
    assert SCRIPT not in found
    assert "&lt;b&gt;c&lt;/b&gt; &amp; d" in found


@pytest.mark.parametrize("name", NAMES)
def test_numbers_come_as_pandas_and_xarray(results, name) -> None:
    frame, dataset = results[name].to_pandas(), results[name].to_xarray()
    assert isinstance(frame, pd.DataFrame)
    assert isinstance(dataset, xr.Dataset)
    assert len(frame) > 1
    assert set(frame.columns) == set(map(str, dataset.data_vars))
    assert dataset.sizes == {frame.index.name: len(frame)}


def test_numbers_are_those_that_are_printed(results) -> None:
    calibration = results["calibration"]
    frame = calibration.to_pandas()
    draws = calibration.samples("bias.thermal_lag")
    assert frame.loc["bias.thermal_lag", "mean"] == pytest.approx(draws.mean())
    assert frame.loc["bias.thermal_lag", "high"] == pytest.approx(np.quantile(draws, 0.975))
    assert frame.loc["bias.thermal_lag", "unit"] == "deg/s/degC"
    discovery = results["discovery"]
    assert discovery.to_pandas()["probability"].idxmax() == discovery.candidates[0].effect
    assert results["trail"].to_pandas().loc["baseline", "new run"] == results["trail"].steps[0].rmse
    assert results["comparison"].to_pandas().loc["with it", "log_evidence"] == pytest.approx(
        calibration.log_evidence[0]
    )
    readings = results["readings"]
    np.testing.assert_array_equal(readings.to_pandas()["output"], readings["output"])
    assert readings.to_xarray()["output"].attrs["units"] == "deg/s"


# A comparison: its first row, its sentences and its errors say one thing, however few groups there are.


LINE = INSTRUMENT.baseline()
CURVE = LINE + "bias.temperature_quadratic"


def campaign(runs: int, bend: float) -> bc.Measurements:
    """Runs over one range of temperatures, each with the same line and the same bend; seed 0."""
    random = np.random.default_rng(0)
    temperature = np.tile(np.linspace(30.0, 80.0, 20), runs)
    output = 20.0 + 0.05 * temperature + bend * (temperature - 55.0) ** 2
    return bc.Measurements.from_arrays(
        INSTRUMENT,
        run=np.repeat([f"{i}" for i in range(runs)], 20),
        temperature=temperature,
        output=output + 0.05 * random.standard_normal(output.size),
    )


def test_table_of_many_channels_is_split_to_fit_the_page(results) -> None:
    printed = str(bc.Channels({f"channel_{i}": results["trail"] for i in range(9)}, ()))
    assert max(map(len, printed.splitlines())) <= 110
    assert printed.count("noise floor") == 3


def both(readings: bc.Measurements) -> list[bc.Calibration]:
    return [bc.fit(LINE, readings, QUICK), bc.fit(CURVE, readings, QUICK)]


def evidence_gap(found: bc.Comparison) -> float:
    first, second = (row.log_evidence for row in found.rows)
    assert first is not None
    assert second is not None
    return first - second


def test_over_three_groups_the_evidence_ranks_and_no_error_is_given() -> None:
    fits = both(campaign(3, bend=2e-4))
    found = bc.compare(fits)
    assert [r.name for r in found.rows] == ["+ bias.temperature_quadratic", "model 1"]
    assert found.chosen_by == "log evidence"
    assert [r.group_error for r in found.rows] == [None, None]
    assert evidence_gap(found) > 3


def test_a_small_difference_in_evidence_tells_nothing_apart() -> None:
    found = bc.compare(dict(zip(("line", "curve"), both(campaign(3, bend=4e-5)), strict=True)))
    assert evidence_gap(found) < 3


def test_over_many_groups_their_scores_rank() -> None:
    found = bc.compare(both(campaign(12, bend=2e-4)))
    assert found.chosen_by == "leave-one-group-out"
    assert found.rows[1].group_error


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.88819219, 3.1e-7, "0.88819219(31)"),
        (1.25012, 1.3e-9, "1.2501200000(13)"),
        (21.5023, 0.0031, "21.5023 ± 0.0031"),
        (5.3e-5, 1.2e-6, "(5.30 ± 0.12)e-5"),
        (1234567.0, 2.1, "1234567.0 ± 2.1"),
        (4.0, 0.0, "4"),
        (0.0, 0.0, "0"),
        (-3.66e-6, 1.1e-7, "(-3.66 ± 0.11)e-6"),
    ],
)
def test_digits_follow_the_uncertainty(value, error, text) -> None:
    assert format_value(value, error) == text


def test_an_interval_has_the_digits_of_its_error() -> None:
    assert format_interval(0.8881916, 0.8881928, 0.8881922, 3.1e-7) == "0.88819160 to 0.88819280"


def test_a_skewed_unknown_is_no_symmetric_one() -> None:
    # without a warm-up, whose time is then open
    readings = mems_gyro.INSTRUMENT.simulate({}, seed=1)
    line = "warm: a * exp(-elapsed / tau); a = 0.1 deg/s; tau = 5 min"
    warm = bc.effect(line, readings=readings, instrument=mems_gyro.INSTRUMENT)
    printed = str(bc.fit(mems_gyro.INSTRUMENT.baseline() + warm, readings, bc.LeastSquares()))
    (row,) = (line for line in printed.splitlines() if line.startswith("bias.warm.tau"))
    assert "skewed" in row and "±" not in row, row
