"""The document's gyro table is what its provenance says, misprints included."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from bayescal_models.mems_gyro import TABLE, Campaign


def table(name: str) -> tuple[list[str], np.ndarray]:
    """Header and numbers of a file of the gyro's data folder."""
    with TABLE.with_name(name).open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, dtype=float)


def test_table_has_eighteen_rows_and_two_named_columns() -> None:
    header, rates = table("zero_rate_table.csv")
    header_volts, volts = table("zero_rate_table_volts.csv")
    assert header == ["temperature [degC]", "output [deg/s]"]
    assert header_volts == ["temperature [degC]", "output [V]"]
    assert rates.shape == volts.shape == (18, 2)
    np.testing.assert_array_equal(rates[:, 0], volts[:, 0])


def test_voltage_and_rate_agree_but_at_two_temperatures() -> None:
    _, rates = table("zero_rate_table.csv")
    _, volts = table("zero_rate_table_volts.csv")
    apart = np.abs(volts[:, 1] - (1.2 + 0.83e-3 * rates[:, 1]))
    rounding = 0.05e-3 + 0.83e-3 * 0.005
    assert set(rates[apart > rounding, 0]) == {60.0, 63.0}
    np.testing.assert_allclose(apart[apart > rounding], [0.12e-3, 0.09e-3], atol=0.005e-3)


def test_table_gives_its_own_line_and_not_the_printed_one() -> None:
    _, rates = table("zero_rate_table.csv")
    temperature, rate = rates.T
    (slope, intercept), covariance = np.polyfit(temperature, rate, 1, cov=True)
    assert slope == pytest.approx(0.0535, abs=0.00005)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.0017, abs=0.00005)
    assert intercept == pytest.approx(19.60, abs=0.005)
    # The slope of the simulated world is the table's within its uncertainty.
    assert Campaign().slope == pytest.approx(slope, abs=np.sqrt(covariance[0, 0]))
    above = rate - (0.041 * temperature + 19.80)
    assert above.min() == pytest.approx(0.19, abs=0.006)
    assert above.max() == pytest.approx(0.93, abs=0.006)
