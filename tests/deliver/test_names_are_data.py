"""Names of files, columns, devices and effects may hold anything: nothing that leaves takes them for code or markup."""

from __future__ import annotations

import ast
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from functools import cache, cached_property
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import bayescal as bc
from tests.support import references
from tests.support.export_check import COMPILER, FLAGS, needs_compiler
from tests.support.hostile_names import CODE, PIECES
from tests.support.inside import CompensationProgram, dcc_of, text_of, validate

HOSTILE = st.lists(st.sampled_from(PIECES) | st.text(max_size=3), max_size=6).map("".join)
TEXT = HOSTILE.map(lambda name: name.replace("\ud800", "?"))  # what a file can hold
MANY = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def of_any_name(test: Callable[..., None]) -> Callable[..., None]:
    """A test of each name made up by hand, and of 25 that are drawn."""
    for name in CODE:
        test = example(name=name)(test)
    return MANY(given(name=TEXT)(test))


def program_of(name: Callable[[str], str]) -> CompensationProgram:
    """A compensator, reading = bias + (1 + scale)·s + 0.1·x, every text of which is what `name` makes of it."""
    unknown = {"unit": name("deg/s"), "mean": 0.5}
    data = {
        "about": {
            "instrument": name("gyro"),
            "title": name("A gyroscope"),
            "stimulus": name("rate"),
            "unit": name("deg/s"),
            "output_unit": name("V"),
            "effects": [[name("bias.constant"), name("c")]],
            "reference": {name("T0"): 30.0},
            "sources": [[name("a.csv"), name("00ff")]],
            "raw": [name("V"), 2.0, 1.0],
            "notes": [name("Only the bias was calibrated.")],
            "made_by": name("bayescal"),
            "calibration": name("00ff"),
        },
        "inputs": [
            {"name": name("temperature"), "unit": name("degC"), "meaning": name("of the board")}
            | {"kind": "column", "column": name("temperature"), "low": -40.0, "high": 85.0}
        ],
        "stimulus_range": [-100.0, 100.0],
        "unknowns": [{"name": name("bias"), **unknown}, {"name": name("scale"), **unknown}],
        "covariance": [[1.0, 0.1], [0.1, 2.0]],
        "affine": True,
        "equation": {
            "operations": [
                *(["input", "(stimulus)"], ["input", name("temperature")], ["const", 0.1]),
                *(["mul", 1, 2], ["const", 1.5], ["mul", 0, 4], ["add", 3, 5], ["const", 1.0]),
            ],
            "expected": 6,
            "slope": 4,
            "gradient": [7, 0],
            "noise": 2,
        },
    }
    return validate(data, CompensationProgram)


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
        secondary_columns=(name, f"{name}b", f"{name}c"),
        instrument=name,
    )


@cache
def device() -> tuple[bc.Calibration, bc.Decisions]:
    calibration = references.calibration("still_sensor")
    return calibration, bc.decide(calibration, "bias.temperature: ±1 g/°C")


def certificate_of(name: str) -> str:
    """A certificate whose every text is a name."""
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
    return dcc_of(calibration, {**stated, "conditions": {name: name}}, decided)


# What readers take of a text: a compiler, Python, a browser, YAML, whoever reads lines.


def tokens_of_c(text: str) -> str:
    """Trigraphs and spliced lines resolved, comments gone, blanks alike; it compiles without a word."""
    assert COMPILER is not None

    def run(*how: str) -> bytes:
        command = [COMPILER, *how, "-x", "c", "-"]
        made = subprocess.run(command, input=text.encode("ascii"), capture_output=True, check=False)
        assert made.returncode == 0, made.stderr.decode()
        return made.stdout

    run(*FLAGS, "-fsyntax-only")
    return " ".join(run("-std=c99", "-fpreprocessed", "-E", "-P").decode("ascii").split())


def marks_of_c(text: str) -> tuple[int, int]:
    """Statements and blocks, where names of the code are made of the texts."""
    tokens = tokens_of_c(text)
    return tokens.count(";"), tokens.count("{")


def shape_of(code: str) -> list[str]:
    """Kinds of statements and expressions of a Python module, one after the other."""
    return [type(node).__name__ for node in ast.walk(ast.parse(code))]


def code_lines(text: str) -> list[str]:
    """Lines that are no comment, as a reader splits them."""
    return [line for line in text.splitlines() if not line.startswith("#")]


def elements(text: str) -> list[tuple[str, dict[str, str]]]:
    """Of XML, with their attributes."""
    return [(e.tag, e.attrib) for e in ET.fromstring(text.encode("utf-8")).iter()]


def of_one_output(language: str) -> Callable[[str], str]:
    """A compensator with a name for every text, exported."""

    return lambda name: text_of(program_of(lambda _: name), language)


def of_three_axes(format: str, unit: str = "g", **called: str) -> Callable[[str], str]:
    """A correction of three axes with a name for every text, exported."""
    return lambda name: text_of(corrected(name, unit), format, **called)


def parameters_with(name: str) -> str:
    """Parameters of an autopilot with such a note."""
    sources = {"gyro_x": "00ff"}
    return bc.FirmwareParameters("px4-params", {"TC_G_ENABLE": 1}, {}, sources, (name,)).text()


@dataclass(frozen=True)
class Exit:
    """A text that leaves with a name in it, and what its reader takes beside the name."""

    text: Callable[[str], str]
    read: Callable[[str], Any]

    @cached_property
    def plain(self) -> Any:
        return self.read(self.text("plain"))


SENSOR = {"name": "sensor"}
EXITS = {
    "c": Exit(of_one_output("c"), marks_of_c),
    "python": Exit(of_one_output("python"), shape_of),
    "axes in c": Exit(of_three_axes("c", **SENSOR), tokens_of_c),
    "axes in c, called after their instrument": Exit(of_three_axes("c"), marks_of_c),
    "axes in python": Exit(of_three_axes("python", **SENSOR), shape_of),
    "rates for px4": Exit(of_three_axes("px4-params", "deg/s"), code_lines),
    "axes for px4": Exit(of_three_axes("px4-params"), code_lines),
    "axes for ardupilot": Exit(of_three_axes("ardupilot-params"), code_lines),
    "parameters": Exit(parameters_with, code_lines),
    "certificate": Exit(lambda name: certificate_of(f"a{name}"), elements),
}


FAST = ("python", "parameters")
WAYS = [
    pytest.param(
        name,
        marks=[
            *([] if name in FAST else [pytest.mark.slow]),
            *([needs_compiler] if one.read in (tokens_of_c, marks_of_c) else []),
        ],
    )
    for name, one in EXITS.items()
]


@pytest.mark.parametrize("way", WAYS)
@of_any_name
def test_a_name_is_data_to_whoever_reads_what_leaves(way: str, name: str) -> None:
    """The same code, tags, keys and elements whatever the texts say."""
    assert EXITS[way].read(EXITS[way].text(name)) == EXITS[way].plain


@of_any_name
def test_a_name_comes_back_from_python(name: str) -> None:
    one = of_one_output("python")(name)
    for text in (one, of_three_axes("python", **SENSOR)(name)):
        assert name in {n.value for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Constant)}
    space: dict[str, Any] = {}
    exec(one, space)
    assert space["compensate"](4.0, 10.0)[0] == pytest.approx((4.0 - 1.0) / 1.5)
