"""The report takes what a certificate needs, from a file that nobody has to write; one identity in every artefact."""

from __future__ import annotations

import json
import re
from decimal import Decimal
from xml.etree import ElementTree

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.command_line import run
from tests.support.stated import STATED


@pytest.fixture(scope="module")
def calibration() -> bc.Calibration:
    """Of arrays, with a label, so that there is no file whose hash could stand for the readings."""
    made = still_sensor.simulate(seed=3, runs=2, interval=60)
    instrument = still_sensor.INSTRUMENT.for_readings(made)
    return bc.fit(instrument.baseline() + "bias.run", made, bc.LeastSquares(draws=200))


@pytest.fixture
def saved(calibration, tmp_path):
    path = tmp_path / "calibration.nc"
    calibration.save(path)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "[device\n",
        "",
        "[devices]\n",
        '[device]\nserial_number = "1"\n',
        "[device]\nserial = []\n",
        '[calibration]\nbegin = "May"\n',
        "[calibration]\nbegin = 2026-02-02\nend = 2026-02-01\n",
        "[standards]\n",
        "device = 1\n",
    ],
)
def test_what_a_certificate_cannot_state_is_refused_before_loading(text, tmp_path) -> None:
    stated = tmp_path / "stated.toml"
    stated.write_text(text, "utf-8")
    ran = run("report", tmp_path / "none.nc", "--certificate", stated)
    assert ran.status == 2 and len(ran.said) == 1


@pytest.mark.usefixtures("unpainted")
def test_one_identity_and_hash_of_readings_in_every_artefact(calibration, saved, tmp_path) -> None:
    compensator = bc.compensator(calibration)
    header = compensator.export(tmp_path / "c.h").read_text()
    exported = json.loads(compensator.export(tmp_path / "c.json").read_text())
    page = bc.report(calibration, tmp_path / "r.html").read_text("utf-8")
    (identity,) = re.findall(r"Of the calibration (\w{64})", header)
    (readings,) = re.findall(r"Calibrated on .*SHA-256 (\w{64})", header)
    assert identity != readings
    assert exported["about"]["calibration"] == identity
    assert exported["about"]["sources"] == [["arrays (hash of their values)", readings]]
    assert identity in page and readings in page
    assert set(re.findall(r"\b[0-9a-f]{64}\b", page)) == {identity, readings}
    loaded = bc.load(saved)
    again = bc.compensator(loaded).export(tmp_path / "again.h").read_text()
    assert identity in again and readings in again
    np.testing.assert_array_equal(loaded.readings["output"], calibration.readings["output"])


LIMIT = "bias.temperature: ±1 g/°C"


@pytest.fixture
def written(saved, tmp_path):
    """A digital certificate, as text."""
    stated, out = tmp_path / "stated.toml", tmp_path / "dcc.xml"
    stated.write_text(STATED, "utf-8")
    asked = ("--limit", LIMIT, "--limit", "bias.temperature: ±1e-9 g/°C", "--local-gravity", "9.81")
    ran = run("export", saved, "--format", "dcc", "--certificate", stated, "--out", out, *asked)
    assert ran.status == 0, ran.err
    return out.read_text("utf-8")


def test_a_digital_certificate_states_coefficients_in_si(calibration, written) -> None:
    root = ElementTree.fromstring(written)
    space = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
    found = {}
    for quantity in root.iterfind(".//dcc:result//dcc:quantity", space):
        name = quantity.findtext("dcc:name/dcc:content", namespaces=space)
        real = quantity.find("si:real", space)
        assert real is not None
        paths = ("si:value", "si:expandedUnc/si:uncertainty")
        said = [real.findtext(path, "nan", space) for path in paths]
        found[name] = (said, real.findtext("si:unit", "", space))
    slope = calibration.samples("bias.temperature")  # µg/°C
    micro_g = 9.81e-6
    (value, expanded), unit = found["bias.temperature"]
    assert unit == "\\metre\\second\\tothe{-2}\\kelvin\\tothe{-1}"
    u = 2 * micro_g * slope.std()
    assert float(value) == pytest.approx(micro_g * slope.mean(), abs=0.05 * u)
    assert float(expanded) == pytest.approx(u, rel=0.05)
    # Two significant digits of the uncertainty, and the value's decimals (JCGM 100, 7.2.6).
    assert len(Decimal(expanded).as_tuple().digits) == 2
    assert Decimal(value).as_tuple().exponent == Decimal(expanded).as_tuple().exponent
    assert float(found["T0, to which coefficients refer"][0][0]) == calibration.reference["T0"]
    for said in ("2026-0117", "4711", "R. Weiss", "90125", "(23.0 ± 0.5) °C", "M. Kern"):
        assert said in written


@pytest.mark.parametrize(
    "change", [("serial = 4711\n", ""), ('country = "GB"', 'country = "Britain"')]
)
def test_a_digital_certificate_without_what_it_needs_is_refused(change, saved, tmp_path) -> None:
    stated = tmp_path / "stated.toml"
    stated.write_text(STATED.replace(*change), "utf-8")
    out = tmp_path / "dcc.xml"
    asked = ("--limit", LIMIT, "--limit", "bias.temperature: ±1e-9 g/°C")
    ran = run("export", saved, "--format", "dcc", "--certificate", stated, "--out", out, *asked)
    assert ran.status == 2 and not out.exists()
    ran = run("export", saved, "--format", "dcc")
    assert ran.status == 2
