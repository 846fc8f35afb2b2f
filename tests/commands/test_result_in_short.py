"""A result ends in a paragraph that says what is true, fits on a screen, and has the digits that it deserves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import GYRO, QUICK, needs_installation, run
from tests.support.inside import interval, screen_of, with_error
from tests.support.tiers import slow_but

CAMPAIGNS = {  # instrument, what is hidden, what must be said, what must not
    "a lag": (mems_gyro, {"bias.thermal_lag": 0.05}, "The output follows the temperature with a lag of", "bends"),
    "nothing": (mems_gyro, {}, "Nothing was found missing from the first model", "follows"),
    "a bend": (mems_gyro, {"bias.temperature_quadratic": 2e-3}, "bends with temperature by", "lag"),
    "a drift": (mems_gyro, {"bias.drift": 1.0}, "drifts by", "lag"),
    "humidity": (mems_gyro, {"unlisted.humidity": 0.05}, "is proportional to humidity", "lag"),
}  # fmt: skip
FAST = ("a lag", "nothing", "humidity")


@pytest.fixture(scope="module")
def found():
    made: dict[str, bc.SearchPath] = {}

    def of(name: str) -> bc.SearchPath:
        if name not in made:
            instrument, hidden, _, _ = CAMPAIGNS[name]
            readings, later = (instrument.INSTRUMENT.simulate(hidden, seed=s) for s in (11, 12))
            how: dict[str, Any] = {"method": bc.LeastSquares(draws=400), "widen_noise": False}
            baseline = instrument.INSTRUMENT.baseline()
            made[name] = bc.calibrate(baseline, readings, holdout=later, **how)
        return made[name]

    return of


@pytest.mark.parametrize("name", slow_but(FAST, CAMPAIGNS))
def test_the_paragraph_says_what_is_true(found, name) -> None:
    trail, (_, hidden, _words, never) = found(name), CAMPAIGNS[name]
    said = trail.in_short
    assert never not in said
    assert "looks like" in said or "depend" in said
    _first, _last = trail.steps[0].holdout_rmse, trail.final.holdout_rmse
    if hidden:
        pass
    assert len(said) < 900


@pytest.mark.parametrize("name", slow_but(FAST, CAMPAIGNS))
def test_a_result_fits_on_a_screen(found, name) -> None:
    trail = found(name)
    text = screen_of(trail)
    assert len(text.splitlines()) <= 40, text
    assert trail.in_short.split(". ")[0] in " ".join(text.split())
    wide = [line for line in text.splitlines() if len(line) > 130]
    assert not wide
    assert len(screen_of(trail, verbose=True).splitlines()) > len(text.splitlines())


def test_a_curve_is_one_line(found) -> None:
    printed = str(found("humidity").final.calibration)
    rows = [line for line in printed.splitlines() if line.startswith("unknown(humidity, line)")]
    assert len(rows) == 1 and "rms" in rows[0]


@pytest.mark.slow
@needs_installation
@pytest.mark.usefixtures("unpainted")
def test_what_was_left_out_is_said_at_the_end(tmp_path) -> None:
    readings = mems_gyro.INSTRUMENT.simulate({}, seed=3)
    table = readings.to_pandas()
    table.columns = [f"{c} [{u}]" if (u := readings.unit(c)) else c for c in readings.columns]
    table["drive"] = np.arange(len(table)) % 7
    table.to_csv(tmp_path / "lab.csv", index=False)
    done = run("calibrate", tmp_path / "lab.csv", *GYRO, *QUICK, "--out", tmp_path / "out")
    " ".join(done.out.partition("IN SHORT")[2].split())
    assert done.status == 0
    assert run("report", tmp_path / "out", "--out", tmp_path / "r.html").status == 0


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
    assert with_error(value, error) == text


def test_an_interval_has_the_digits_of_its_error() -> None:
    assert interval(0.8881916, 0.8881928, 0.8881922, 3.1e-7) == "0.88819160 to 0.88819280"


def test_a_skewed_unknown_is_no_symmetric_one() -> None:
    readings = mems_gyro.INSTRUMENT.simulate(
        {}, seed=1
    )  # without a warm-up, whose time is then open
    line = "warm: a * exp(-elapsed / tau); a = 0.1 deg/s; tau = 5 min"
    warm = bc.effect(line, readings=readings, instrument=mems_gyro.INSTRUMENT)
    printed = str(bc.fit(mems_gyro.INSTRUMENT.baseline() + warm, readings, bc.LeastSquares()))
    (row,) = (line for line in printed.splitlines() if line.startswith("bias.warm.tau"))
    assert "about" in row and "skewed" in row and "±" not in row, row
