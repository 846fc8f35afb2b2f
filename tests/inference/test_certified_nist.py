"""Regression data certified by NIST are met: 8 digits of parameters, 6 of standard deviations.

The data stand in `tests/data`, whose README names their source.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.accuracy import nist_linear, nist_nonlinear

PARAMETERS, DEVIATIONS = 8.0, 6.0  # digits
# Not to be met: of data without noise, standard deviations are rounding.
MEANINGLESS = ("Lanczos1", "wampler1", "wampler2")
# The hard ones; the others are slow only by their number.
FAST = ("MGH10", "MGH17", "Bennett5", "BoxBOD", "filip")


@pytest.fixture
def folder(certified_data: Path) -> Path:
    return certified_data / "nist_strd"


def some_fast(names):
    return [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in names]


@pytest.mark.parametrize("name", some_fast(nist_nonlinear.NONLINEAR))
def test_a_nonlinear_set_is_met_from_both_starts(name, folder) -> None:
    for row in nist_nonlinear.nonlinear_digits(name, folder):
        assert name in MEANINGLESS or row["converged"], row
        assert row["parameters"] >= PARAMETERS, row
        assert name in MEANINGLESS or row["sd"] >= DEVIATIONS, row


@pytest.mark.parametrize("name", some_fast(nist_linear.LINEAR))
def test_a_linear_set_is_met_through_the_public_api(name, folder) -> None:
    row = nist_linear.linear_digits(name, folder=folder)
    assert row["parameters"] >= PARAMETERS, row
    if name not in MEANINGLESS:
        assert row["converged"], row
        assert row["sd"] >= DEVIATIONS, row
        assert row["residual_sd"] >= DEVIATIONS, row


def test_all_sets_are_there(folder) -> None:
    assert len(nist_nonlinear.NONLINEAR) == 27
    assert len(nist_linear.LINEAR) == 11
    assert all(
        (folder / "nonlinear" / f"{name}.csv").is_file() for name in nist_nonlinear.NONLINEAR
    )
    assert all((folder / "linear" / f"{name}.csv").is_file() for name in nist_linear.LINEAR)
