"""Names may hold anything: of axes as C, Python, YAML and JSON, of noise for Kalibr, of parameters, certificates."""

from __future__ import annotations

import ast
import json
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import date
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given

import bayescal as bc
from bayescal._report.certificate import Certificate
from bayescal._report.dcc import dcc_text
from bayescal._use.firmware_parameters import FirmwareParameters
from bayescal._use.vector_correction import VectorCorrection
from bayescal._use.vector_export import as_text, data
from bayescal_models import still_sensor
from tests.deliver.test_names_are_data import BY_HAND, MANY, TEXT, tokens_of_c
from tests.deliver.test_noise_at_rest import told
from tests.support.export_check import COMPILER, FLAGS, needs_compiler

yaml = pytest.importorskip("yaml")


def corrected(name: str, unit: str = "g") -> VectorCorrection:
    """Three axes whose every text is a name."""
    terms = np.r_[0.01, -0.02, 0.03, np.eye(3).ravel(), np.zeros(9)][None]
    return VectorCorrection(
        outputs=(name, f"{name}y", f"{name}z"),
        unit=unit,
        reference=25.0,
        low=0.0,
        high=50.0,
        terms=terms,
        covariance=1e-6 * np.eye(terms.size),
        noise=1e-3,
        notes=(name, f"note of {name}"),
        source=name,
        beside=(name, f"{name}b", f"{name}c"),
    )


@cache
def plain_header() -> str:
    return tokens_of_c(as_text(corrected("plain"), "c"))


def code_lines(text: str) -> list[str]:
    """What a reader of YAML or of parameters takes: lines that are no comment, as it splits them."""
    return [line for line in text.splitlines() if not line.startswith("#")]


def check_three_axes(name: str) -> None:
    """The same code, numbers and keys whatever the texts say; JSON and Python give them back."""
    made, plain = corrected(name), corrected("plain")
    code = ast.parse(as_text(made, "python"))
    shape = [type(node).__name__ for node in ast.walk(ast.parse(as_text(plain, "python")))]
    assert [type(node).__name__ for node in ast.walk(code)] == shape
    assert name in {n.value for n in ast.walk(code) if isinstance(n, ast.Constant)}
    for unit in ("g", "deg/s"):
        text = as_text(corrected(name, unit), "yaml")
        assert yaml.safe_load(text) == yaml.safe_load(as_text(replace(plain, unit=unit), "yaml"))
    for autopilot in ("px4-params", "ardupilot-params"):
        assert as_text(made, autopilot) == as_text(plain, autopilot)


@pytest.mark.parametrize("name", BY_HAND)
def test_a_name_of_an_axis_is_no_code(name: str) -> None:
    check_three_axes(name)


@MANY
@given(TEXT)
def test_no_name_of_an_axis_is_code(name: str) -> None:
    check_three_axes(name)


@needs_compiler
@pytest.mark.parametrize("name", BY_HAND)
def test_a_name_of_an_axis_is_no_c(name: str) -> None:
    text = as_text(corrected(name), "c")
    assert tokens_of_c(text) == plain_header()
    assert COMPILER is not None
    command = [COMPILER, *FLAGS, "-Wno-unused-function", "-fsyntax-only", "-x", "c", "-"]
    assert subprocess.run(command, input=text.encode("ascii"), check=False).returncode == 0


@pytest.mark.parametrize("name", BY_HAND)
def test_three_axes_come_back_from_json(name: str, tmp_path: Path) -> None:
    path = bc.export_vector(corrected(name), tmp_path / "sensor.json")
    back = bc.load_vector_correction(path)
    assert data(back) == data(corrected(name))


@pytest.mark.parametrize(
    "text",
    [
        *("[" * 100_000, '{"a":' * 100_000, "\x00", "[]", "{}"),
        *('{"terms": [[NaN]]}', "unit", "terms", "noise", "notes", "made_by", "more"),
    ],
)
def test_a_hostile_file_of_three_axes_is_refused(text: str, tmp_path: Path) -> None:
    found = json.loads(json.dumps(data(corrected("x"))))
    wrong = {"unit": 3, "terms": [["1"]], "noise": 1e400, "notes": ["\ud800"], "made_by": None}
    if text.isalpha():
        text = json.dumps({**found, text: wrong.get(text, 1)})
    path = tmp_path / "sensor.json"
    path.write_text(text, "utf-8")
    with pytest.raises(bc.InputError, match=r"sensor\.json is no correction of three axes"):
        bc.load_vector_correction(path)


def check_noise(name: str) -> None:
    text = bc.kalibr_yaml({name: told("rad/s"), f"{name}y": told("m/s^2")})
    plain = bc.kalibr_yaml({"plain": told("rad/s"), "plainy": told("m/s^2")})
    assert code_lines(text) == code_lines(plain)
    assert yaml.safe_load(text) == yaml.safe_load(plain)


@pytest.mark.parametrize("name", BY_HAND)
def test_a_name_of_a_channel_is_no_key_for_kalibr(name: str) -> None:
    check_noise(name)


@MANY
@given(TEXT)
def test_no_name_of_a_channel_is_a_key_for_kalibr(name: str) -> None:
    check_noise(name)


@pytest.mark.parametrize(
    "topic", ["/imu0\nupdate_rate: 1", "", "a b", "!!python/object:x", "/ä", "/"]
)
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(bc.InputError, match="no name of ROS"):
        bc.kalibr_yaml({"x": told("rad/s")}, topic=topic)


@MANY
@given(TEXT)
def test_no_note_is_a_parameter(name: str) -> None:
    made = FirmwareParameters("px4-params", {"TC_G_ENABLE": 1}, {}, {"gyro_x": "00ff"}, (name,))
    assert made.text().isascii()
    assert code_lines(made.text()) == code_lines(replace(made, notes=("plain",)).text())


@cache
def device() -> tuple[bc.Calibration, bc.Decisions]:
    readings = still_sensor.simulate(seed=3, runs=2, interval=60)
    model = still_sensor.INSTRUMENT.for_readings(readings).baseline()
    calibration = bc.fit(model, readings, bc.LeastSquares(draws=200))
    return calibration, bc.decide(calibration, "bias.temperature: ±1 g/°C")


def certificate_of(name: str) -> ET.Element:
    """A certificate whose every text is a name, as a tree."""
    calibration, found = device()
    (one,) = found.decisions
    at = {name: (0.0, 1.0, "g")}
    one = replace(one, limit=name, quantity=name, why=name, notes=(name,), at=at)
    texts = ("number", "remarks", "name", "serial", "model", "manufacturer", "owner_number")
    section = dict.fromkeys((*texts, "responsible", "operator", "procedure", "city", "email"), name)
    stated = {
        "certificate": section,
        "device": section,
        "calibration": {**section, "begin": date(2026, 11, 20), "end": date(2026, 11, 21)},
        "laboratory": {**section, "country": "DE"},
        "customer": {**section, "country": "GB"},
        "standards": [{**section, "certificate": name, "traceable_to": name}],
    }
    decided = replace(found, rule_in_words=name, decisions=(one,))
    text = dcc_text(
        calibration, Certificate({**stated, "conditions": {name: name}}), decisions=decided
    )
    return ET.fromstring(text.encode("utf-8"))


def check_certificate(name: str) -> None:
    """The same elements whatever the texts say, and none of them lost."""
    made, plain = certificate_of(f"a{name}"), certificate_of("plain")
    assert [e.tag for e in made.iter()] == [e.tag for e in plain.iter()]
    assert [e.attrib for e in made.iter()] == [e.attrib for e in plain.iter()]


@pytest.mark.parametrize("name", BY_HAND)
def test_a_name_on_a_certificate_is_no_markup(name: str) -> None:
    check_certificate(name)


@MANY
@given(TEXT)
def test_no_name_on_a_certificate_is_markup(name: str) -> None:
    check_certificate(name)
