"""The certificate of a reference: its correction, and an uncertainty that all readings share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro

CERTIFICATES = "tests/data/certificates"
THERMOMETER, TABLE = f"{CERTIFICATES}/thermometer.xml", f"{CERTIFICATES}/rate_table.xml"
GYRO, QUICK = mems_gyro.INSTRUMENT, bc.LeastSquares(draws=2000)
U, SLOPE = 0.1, 0.02  # °C, of the certificate; °/s/°C


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    """Of a thermometer that shows 0.1 °C + 0.1 % too much, as its certificate says, and of a turning table."""
    rng, time = np.random.default_rng(1), np.arange(0.0, 6000.0, 30.0)
    true, rate = 40 + 39 * np.sin(time / 900), 20 * np.sign(np.sin(time / 130))
    output = 0.5 + SLOPE * (true - 40) + 1.001 * rate + 1e-3 * rng.standard_normal(len(time))
    columns = {"time": time, "temperature": 1.001 * true + 0.1, "rate_input": rate}
    return bc.Measurements.from_arrays(GYRO, **columns, output=output)


@pytest.fixture(scope="module")
def calibration(readings) -> bc.Calibration:
    model = GYRO.baseline() + "scale.constant" + bc.read_dcc(THERMOMETER, GYRO)
    return bc.fit(model, readings, QUICK)


def test_the_readings_are_corrected_and_the_coefficients_carry_the_shared_error(
    calibration,
) -> None:
    table, u = calibration.to_pandas(), 0.5**0.5 * U / 40 * SLOPE
    assert abs(table.loc["bias.temperature", "mean"] - SLOPE) < 3 * u
    assert table.loc["bias.constant", "sd"] == pytest.approx(SLOPE * U, rel=0.1)
    assert table.loc["bias.temperature", "sd"] == pytest.approx(u, rel=0.1)


def test_the_budget_has_it_in_one_row_and_the_compensation_takes_true_temperatures(
    calibration, tmp_path
) -> None:
    used = bc.budget(calibration, {"temperature": 40.0})
    (row,) = (s for s in used.sources if "certificate" in s.name)
    assert (row.name, row.kind) == ("prior of temperature.certificate", "B")
    assert row.contribution == pytest.approx(SLOPE * U, rel=0.1)
    saved = bc.load(calibration.save(tmp_path / "c.nc"))
    assert str(bc.budget(saved, {"temperature": 40.0})) == str(used)
    inputs = {"temperature": np.array([60.0]), "output": np.array([0.5 + SLOPE * 20])}
    done = bc.compensator(saved)(**inputs, noise=False)
    assert abs(done.value[0]) < 3 * done.uncertainty[0]


def test_the_certificate_of_a_table_is_that_of_its_rate(readings, tmp_path) -> None:
    model = GYRO.baseline() + "scale.constant" + bc.read_dcc(TABLE, GYRO, "rate_input")
    found = bc.fit(model, readings, QUICK)
    assert str(bc.load(found.save(tmp_path / "c.nc"))) == str(found)
    found = found.to_pandas()
    u = np.rad2deg(1e-4)  # °/s, of 0.2 mrad/s with k = 2
    assert found.loc["bias.constant", "sd"] == pytest.approx(u, rel=0.1)


REFUSED = {
    "not a certificate": ("dcc:digitalCalibrationCertificate", "dcc:other"),
    "DOCTYPE": ("<dcc:digitalCalibrationCertificate", "<!DOCTYPE a []>\n<dcc:digital"),
    "no uncertainty": ("uncertaintyXMLList", "other"),
    "no table": ("basic_measurementError", "error"),
    "another dimension": (r"\kelvin", r"\volt"),
    "no coverage factor": ("coverageFactor", "factor"),
    "no number": ("0.10 0.14", "0.10 abc"),
    "other points": ("0.10 0.14", "0.10"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_use_is_refused_with_its_element(case, tmp_path) -> None:
    text = Path(THERMOMETER).read_text("utf-8")
    old, new = REFUSED[case]
    assert old in text
    text = text.replace(old, new).replace(" basic_measuredValue", "")
    if case in ("no table", "another dimension"):
        text = text.replace("basic_measuredValue", "shown").replace(r"\degreecelsius", r"\volt")
    spoilt = tmp_path / "spoilt.xml"
    spoilt.write_text(text, "utf-8")
    with pytest.raises(bc.InputError, match=r"spoilt\.xml', .+: .+; expected: "):
        bc.read_dcc(spoilt, GYRO)
