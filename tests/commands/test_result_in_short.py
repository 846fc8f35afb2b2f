"""A result ends in a paragraph that says what is true, fits on a screen, and has the digits that it deserves."""

from __future__ import annotations

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import interval, with_error


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
