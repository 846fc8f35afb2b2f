"""The document's gyro table is what its provenance says, misprints included."""

from __future__ import annotations

import csv

import numpy as np

from bayescal_models.mems_gyro import TABLE


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
