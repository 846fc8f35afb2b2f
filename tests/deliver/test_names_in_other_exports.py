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
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from tests.deliver.test_names_are_data import BY_HAND, of_any_name, shape_of, tokens_of_c
from tests.deliver.test_noise_at_rest import told
from tests.support import references
from tests.support.export_check import COMPILER, FLAGS, needs_compiler
from tests.support.inside import dcc_of, text_of

yaml = pytest.importorskip("yaml")


def corrected(name: str, unit: str = "g") -> bc.VectorCorrection:
    """Three axes whose every text is a name."""
    terms = np.r_[0.01, -0.02, 0.03, np.eye(3).ravel(), np.zeros(9)][None]
    return bc.VectorCorrection(
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
        instrument=name,
    )


@cache
def plain_export(language: str, unit: str = "g") -> str:
    return text_of(corrected("plain", unit), language, name="sensor")


@cache
def plain_header() -> str:
    return tokens_of_c(plain_export("c"))


def keys_of(text: str) -> Any:
    """What a reader of YAML takes."""
    return yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def code_lines(text: str) -> list[str]:
    """What a reader of YAML or of parameters takes: lines that are no comment, as it splits them."""
    return [line for line in text.splitlines() if not line.startswith("#")]


@pytest.mark.slow
@of_any_name
def test_a_name_of_an_axis_is_no_code(name: str) -> None:
    """The same code, numbers and keys whatever the texts say; JSON and Python give them back."""
    made = corrected(name)
    code = ast.parse(text_of(made, "python", name="sensor"))
    assert shape_of(code) == shape_of(plain_export("python"))
    assert name in {n.value for n in ast.walk(code) if isinstance(n, ast.Constant)}
    for unit in ("g", "deg/s"):
        text = text_of(corrected(name, unit), "yaml")
        assert keys_of(text) == keys_of(plain_export("yaml", unit))
    for autopilot in ("px4-params", "ardupilot-params"):
        assert code_lines(text_of(made, autopilot)) == code_lines(plain_export(autopilot))


@needs_compiler
@pytest.mark.parametrize("name", BY_HAND)
def test_a_name_of_an_axis_is_no_c(name: str) -> None:
    assert tokens_of_c(text_of(corrected(name), "c", name="sensor")) == plain_header()
    text = text_of(corrected(name), "c")  # called after its instrument
    assert COMPILER is not None
    command = [COMPILER, *FLAGS, "-fsyntax-only", "-x", "c", "-"]
    assert subprocess.run(command, input=text.encode("ascii"), check=False).returncode == 0


@pytest.mark.parametrize("name", BY_HAND)
def test_three_axes_come_back_from_json(name: str, tmp_path: Path) -> None:
    path = bc.export_vector(corrected(name), tmp_path / "sensor.json")
    back = bc.load_vector_correction(path)
    assert back.data() == corrected(name).data()


@pytest.mark.parametrize(
    "text",
    [
        *("[" * 100_000, '{"a":' * 100_000, "\x00", "[]", "{}"),
        *('{"terms": [[NaN]]}', "unit", "terms", "noise", "notes", "made_by", "more"),
    ],
)
def test_a_hostile_file_of_three_axes_is_refused(text: str, tmp_path: Path) -> None:
    found = json.loads(json.dumps(corrected("x").data()))
    wrong = {"unit": 3, "terms": [["1"]], "noise": 1e400, "notes": ["\ud800"], "made_by": None}
    if text.isalpha():
        text = json.dumps({**found, text: wrong.get(text, 1)})
    path = tmp_path / "sensor.json"
    path.write_text(text, "utf-8")
    with pytest.raises(bc.InputError, match=r"sensor\.json is (no correction|not JSON|damaged)"):
        bc.load_vector_correction(path)


@cache
def noise_of(name: str) -> str:
    return bc.kalibr_yaml({name: told("rad/s"), f"{name}y": told("m/s^2")})


@of_any_name
def test_a_name_of_a_channel_is_no_key_for_kalibr(name: str) -> None:
    text, plain = noise_of(name), noise_of("plain")
    assert code_lines(text) == code_lines(plain)
    assert keys_of(text) == keys_of(plain)


@pytest.mark.parametrize(
    "topic", ["/imu0\nupdate_rate: 1", "", "a b", "!!python/object:x", "/ä", "/"]
)
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(bc.InputError, match="no name of ROS"):
        bc.kalibr_yaml({"x": told("rad/s")}, topic=topic)


@of_any_name
def test_no_note_is_a_parameter(name: str) -> None:
    made = bc.FirmwareParameters("px4-params", {"TC_G_ENABLE": 1}, {}, {"gyro_x": "00ff"}, (name,))
    assert made.text().isascii()
    assert code_lines(made.text()) == code_lines(replace(made, notes=("plain",)).text())


@cache
def device() -> tuple[bc.Calibration, bc.Decisions]:
    calibration = references.calibration("still_sensor")
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
    text = dcc_of(calibration, {**stated, "conditions": {name: name}}, decided)
    return ET.fromstring(text.encode("utf-8"))


@cache
def plain_certificate() -> ET.Element:
    return certificate_of("plain")


@pytest.mark.slow
@of_any_name
def test_a_name_on_a_certificate_is_no_markup(name: str) -> None:
    """The same elements whatever the texts say, and none of them lost."""
    made, plain = certificate_of(f"a{name}"), plain_certificate()
    assert [e.tag for e in made.iter()] == [e.tag for e in plain.iter()]
    assert [e.attrib for e in made.iter()] == [e.attrib for e in plain.iter()]
