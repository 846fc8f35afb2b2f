"""Names of files, columns, devices and effects may hold anything: no export takes them for code, markup or formulas."""

from __future__ import annotations

import ast
import csv
import io
import json
import re
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import bayescal as bc
from bayescal._core.quoting import (
    c_comment,
    csv_cell,
    csv_cell_read,
    csv_line,
    html_text,
    identifier,
    python_string,
    python_words,
    xml_text,
)
from bayescal._core.result_table import as_html, plain_table
from bayescal._use.compensation_program import from_data
from bayescal._use.correction_files import load_correction
from bayescal_models import mems_gyro
from tests.support.export_check import COMPILER, FLAGS, needs_compiler
from tests.support.inside import text_of

# Pieces that mean something to C, Python, HTML, XML, spreadsheets, and to the programs that write these.
PIECES = (
    *(
        "*/",
        "/*",
        "*\\ ",
        "\\",
        "\\\n",
        "??/",
        "??)",
        "//",
        "#define x",
        '"',
        '"""',
        "'",
        "\x00",
        "\x1b[2J",
        "\x7f",
    ),
    *(
        "<",
        ">",
        "<script>alert(1)</script>",
        "<img src=x onerror=alert(1)>",
        "&lt;",
        "&",
        "]]>",
        "-->",
        "<!--",
    ),
    *(
        "{{ 7*7 }}",
        "{% raw %}",
        "${x}",
        "%s",
        "{0}",
        "=1+1",
        "+1",
        "-1",
        "@SUM(A1)",
        "\t=1",
        "\r\n",
        ",",
        ";",
    ),
    *(
        "\u2028",
        "\u202e",
        "\ufeff",
        "\ud800",
        "\uffff",
        "é",
        "漢",
        "int f(void){return 1;}",
        "system('x')",
        "\n#",
    ),
    *("import os", "NAN", "in", "range", "t0", "reading", "0", " "),
)
HOSTILE = st.lists(st.sampled_from(PIECES) | st.text(max_size=3), max_size=6).map("".join)
TEXT = HOSTILE.map(lambda name: name.replace("\ud800", "?"))  # what a file can hold
BY_HAND = (
    "gyro*\\ int f(void){return 1;}\\*.csv",
    '"""\nimport os\nos.system("x")\n"""',
    "*\\/ int x; /*",
    "a ??/\n int x;",
    '</title><script>alert(1)</script>"onload="x',
    "=cmd|'/c calc'!A1",
    "a*/int evil(void);/*b",
    "*\\",
    "/",
    "*",
    "??/",
    "??/\\",
    "\\\nint x;",
    "//",
    "\r*/ int x; //",
    "\x0b*/\x0c#include <x>",
    "#define fabs(x) system(x)",
    "_Pragma(x)",
    "%:define x",
    "fabs",
    "NAN",
    "INFINITY",
    "unix",
    "errno",
    "reading",
    "stimulus",
    "inputs",
    "values",
    "slope",
    "math",
    "range",
    "lambda",
    "t0",
    "__import__('os')",
    "{{ config }}",
    "{% include x %}",
    "'" * 3,
    '\\"""',
    "\u2028import os\u2029",
    "# -*- coding: utf-7 -*-",
    "\ufeff",
    "\u202egnp.cvs",
    "",
    "\x00",
)
MANY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def of_any_name(test: Callable[..., None]) -> Callable[..., None]:
    """A test of each name made up by hand, and of 60 that are drawn."""
    for name in BY_HAND:
        test = example(name=name)(test)
    return MANY(given(name=TEXT)(test))


def program_data(name: Callable[[str], str]) -> dict[str, Any]:
    """A compensator as JSON, reading = bias + (1 + scale)·s + 0.1·x, every text of which is what `name` makes of it."""
    unknown = {"unit": name("deg/s"), "mean": 0.5}
    return {
        "schema": "bayescal.compensator",
        "version": 2,
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
        "noise": 0.25,
        "affine": True,
        "equation": {
            "operations": [
                *(["input", "(stimulus)"], ["input", name("temperature")], ["const", 0.1]),
                *(["mul", 1, 2], ["const", 1.5], ["mul", 0, 4], ["add", 3, 5], ["const", 1.0]),
            ],
            "expected": 6,
            "slope": 4,
            "gradient": [7, 0],
        },
    }


def exported(name: Callable[[str], str], language: str) -> str:
    return text_of(from_data(program_data(name), "made.json"), language)


def tokens_of_c(text: str) -> str:
    """What a compiler sees of a header: trigraphs and spliced lines resolved, comments gone, blanks alike."""
    assert COMPILER is not None
    command = [COMPILER, "-std=c99", "-fpreprocessed", "-E", "-P", "-x", "c", "-"]
    made = subprocess.run(command, input=text.encode("ascii"), capture_output=True, check=True)
    return " ".join(made.stdout.decode("ascii").split())


@cache
def plain_export(language: str) -> str:
    return exported(lambda _: "plain", language)


@cache
def plain_tokens() -> str:
    return tokens_of_c(plain_export("c"))


def check_c(name: str) -> None:
    """The header compiles without a word, and is the same code whatever its texts say."""
    hostile = exported(lambda _: name, "c")
    assert COMPILER is not None
    command = [COMPILER, *FLAGS, "-fsyntax-only", "-x", "c", "-"]
    made = subprocess.run(command, input=hostile.encode("ascii"), capture_output=True, check=False)
    assert made.returncode == 0, made.stderr.decode()
    plain, found = plain_tokens(), tokens_of_c(hostile)
    assert found.count(";") == plain.count(";") and found.count("{") == plain.count("{")


def shape_of(code: str | ast.AST) -> list[str]:
    """Kinds of statements and expressions of a Python module, one after the other."""
    tree = ast.parse(code) if isinstance(code, str) else code
    return [type(node).__name__ for node in ast.walk(tree)]


def check_python(name: str) -> None:
    """The module parses to the same statements whatever its texts say, and its strings are the names."""
    hostile = ast.parse(exported(lambda _: name, "python"))
    assert shape_of(hostile) == shape_of(plain_export("python"))
    strings = {n.value for n in ast.walk(hostile) if isinstance(n, ast.Constant)}
    assert name in strings
    space: dict[str, Any] = {}
    exec(compile(hostile, "exported.py", "exec"), space)
    assert space["compensate"](4.0, 10.0)[0] == pytest.approx((4.0 - 1.0) / 1.5)


def check_page(name: str) -> None:
    """The page has the same tags and the same scripts whatever its texts say."""
    hostile, plain = exported(lambda _: name, "html"), plain_export("html")
    assert Seen(hostile).tags == Seen(plain).tags
    scripts = re.compile(r"<script.*?</script>", re.DOTALL)
    assert scripts.findall(hostile) == scripts.findall(plain)


EXPORTS = [
    pytest.param(check_c, marks=[needs_compiler, pytest.mark.slow]),
    check_python,
    check_page,
]


@pytest.mark.parametrize("check", EXPORTS)
@of_any_name
def test_a_name_is_no_code_in_an_export(check, name) -> None:
    check(name)


@settings(MANY, max_examples=300)
@given(HOSTILE)
def test_comments_and_strings_hold_their_text(name) -> None:
    for text in (c_comment(name), python_words(name)):
        assert text.isascii() and text.isprintable() and "\\" not in text
    comment = c_comment(name)
    assert not any(pair in comment for pair in ("*/", "/*", "??"))
    assert not comment.startswith(("/", "*")) and not comment.endswith(("*", "/"))
    assert '"' not in python_words(name)
    assert ast.literal_eval(python_string(name)) == name
    made = identifier(name, ("x", "x_"))
    assert made.isidentifier() and made.isascii() and made not in ("x", "x_")


class Seen(HTMLParser):
    """The tags and the text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[str] = []
        self.text = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs) -> None:
        self.tags += [tag, *(name for name, _ in attrs)]

    def handle_comment(self, data) -> None:
        self.tags.append("comment")

    def handle_data(self, data) -> None:
        self.text += data


@settings(MANY, max_examples=300)
@given(HOSTILE)
def test_no_hostile_name_is_markup(name) -> None:
    seen = Seen(f'<p title="{html_text(name)}">{html_text(name)}</p>')
    assert seen.tags == ["p", "title"]
    assert seen.text == name
    printed = as_html([plain_table(["effect", "size"], [[name, "1"]])])
    assert set(Seen(printed).tags) <= {
        *("table", "thead", "tbody", "tr", "th", "td", "p", "br", "style")
    }
    assert "table" in Seen(printed).tags
    element = ET.Element("name", value=xml_text(name))
    element.text = xml_text(name)
    back = ET.fromstring(ET.tostring(element, encoding="utf-8"))
    assert len(back) == 0 and (back.text or "").split() == xml_text(name).split()


@settings(MANY, max_examples=300)
@given(st.lists(HOSTILE, min_size=1, max_size=3))
def test_no_cell_of_a_table_is_a_formula(names) -> None:
    line = csv_line(["first", *names])
    (back,) = csv.reader(io.StringIO(line, newline=""))
    assert list(map(csv_cell_read, back)) == ["first", *names]
    for cell in back:
        assert not cell.startswith(("=", "@", "\t", "\r"))
        if cell.startswith(("+", "-")):
            float(cell)


def test_numbers_of_a_table_stay_numbers() -> None:
    assert list(map(csv_cell, ("-1.5e-3", "+2", "-nan", -0.25))) == [
        "-1.5e-3",
        "+2",
        "-nan",
        "-0.25",
    ]


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "about.reference.T0": lambda d: d["about"]["reference"].update(T0="1 */ int evil(void); /*"),
    "about.raw": lambda d: d["about"].update(raw=["V", "1)\nimport os\n(", 0.0]),
    "about.raw has a gain of zero": lambda d: d["about"].update(raw=["V", 0.0, 0.0]),
    "about.more is not known": lambda d: d["about"].update(more=1),
    "about.title is '\\ud800'": lambda d: d["about"].update(title="\ud800"),
    "about.title is a list": lambda d: d["about"].update(title=["a"]),
    "inputs[0].low": lambda d: d["inputs"][0].update(low="0)||system(1"),
    "inputs[0].high": lambda d: d["inputs"][0].update(high=1e400),
    "of the kind 'system'": lambda d: d["inputs"][0].update(kind="system"),
    "tau = None": lambda d: d["inputs"][0].update(kind="lag"),
    "two of its inputs have one name": lambda d: d["inputs"].append(d["inputs"][0]),
    "unknowns[1].mean": lambda d: d["unknowns"][1].update(mean=None),
    "covariance[0][1]": lambda d: d["covariance"].__setitem__(0, [1.0, True]),
    "noise": lambda d: d.update(noise="0.1; system(1)"),
    "affine": lambda d: d.update(affine="yes"),
    "equation.gradient is a table": lambda d: d["equation"].update(gradient={}),
    "equation.operations[0][0]": lambda d: d["equation"]["operations"].insert(0, [["const"]]),
    "needs 'humidity'": lambda d: d["equation"]["operations"].append(["input", "humidity"]),
    "more is not known": lambda d: d.update(more=1),
    "noise is missing": lambda d: d.pop("noise"),
    "is no correction": lambda d: d.update(schema="other"),
    "of version 3, this bayescal reads 1 and 2": lambda d: d.update(version=3),
    "is not known here: ['system', 0]": lambda d: d["equation"]["operations"].append(["system", 0]),
    "is no operation of it": lambda d: d["equation"].update(slope=10**6),
    "covariance": lambda d: d["covariance"].pop(),
}


@pytest.mark.parametrize("said", CHANGES)
def test_a_hostile_export_is_refused_before_it_is_used(said, tmp_path) -> None:
    data, path = program_data(str), tmp_path / "made.json"
    CHANGES[said](data)
    path.write_text(json.dumps(data), "utf-8")
    with pytest.raises(bc.InputError, match=r"made\.json is (damaged: |a |no )") as error:
        load_correction(path)
    assert said in str(error.value)


def test_a_number_that_no_float_holds_is_refused_wherever_it_stands(tmp_path) -> None:
    data, path = program_data(str), tmp_path / "made.json"
    constants = [i for i, op in enumerate(data["equation"]["operations"]) if op[0] == "const"]
    changes: list[Callable[[], object]] = [
        *(
            lambda i=i: data["equation"]["operations"][i].__setitem__(1, -(10**400))
            for i in constants
        ),
        lambda: data["inputs"][0].update(low=10**400),
    ]
    assert constants
    for change in changes:
        change()
        path.write_text(json.dumps(data), "utf-8")
        with pytest.raises(bc.InputError, match="whole number of more than 64 bits"):
            load_correction(path)
        data = program_data(str)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, "nonsense", "\x00", '"\ud800"'])
def test_what_is_nested_or_no_json_is_refused(text, tmp_path) -> None:
    path: Path = tmp_path / "made.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(bc.InputError, match=r"made.json is (not JSON|no correction)"):
        load_correction(path)


def hostile_file(name: str, folder: Path) -> Path:
    """Two runs of a gyroscope in a file whose name, run labels and one column are hostile."""
    found = mems_gyro.simulate(seed=1, campaign=mems_gyro.Campaign(runs=2))
    numbers = [n for n in found.columns if found.unit(n)]
    text = io.StringIO()
    rows, label = csv.writer(text), name.replace("\udcff", "?").replace("\x1b", "")
    rows.writerow(
        [*(f"{n} [{found.unit(n)}]" for n in numbers), "run", f"{label.replace('/', '|')} [V]"]
    )
    for i, run in enumerate(found["run"]):
        rows.writerow(
            [*(repr(float(found[n][i])) for n in numbers), f"{label}{run}", 1e-3 * (i % 7)]
        )
    path = folder / f"{name.replace('/', '∕').replace(chr(0), '')[:60]}.csv"
    path.write_text(text.getvalue(), "utf-8", newline="")
    return path


IN_A_FILE = [BY_HAND[0], BY_HAND[4], BY_HAND[5]]
IN_A_FILE += ["board\x1b[2J", "a\udcffb", "$\\frac{$ $$\\href{javascript:x}{y}$$"]


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
@pytest.mark.parametrize("name", IN_A_FILE)
def test_a_hostile_name_in_a_file_reaches_no_deliverable_as_code(name, tmp_path) -> None:
    """From the file to exports, report, certificate, tables and drafts."""
    gyro = mems_gyro.INSTRUMENT
    readings = bc.read(hostile_file(name, tmp_path), gyro)
    (column,) = set(readings.columns) - {c.name for c in gyro.columns}
    calibration = bc.fit(
        gyro.baseline() + f"unknown({column})", readings, bc.LeastSquares(draws=60), strict=False
    )
    made = bc.compensator(calibration)
    module = made.export(tmp_path / "made.py").read_text("utf-8")
    assert [n.names[0].name for n in ast.parse(module).body if isinstance(n, ast.Import)] == [
        "math"
    ]
    header = made.export(tmp_path / "made.h")
    if COMPILER is not None:
        command = [COMPILER, *FLAGS, "-fsyntax-only", "-x", "c", str(header)]
        assert subprocess.run(command, capture_output=True, check=False).returncode == 0
    bc.load_compensator(made.export(tmp_path / "made.json"))
    page = Seen(bc.report(calibration, tmp_path / "report.html").read_text("utf-8"))
    assert not {"script", "iframe", "object", "comment"} & set(page.tags)
    assert not [tag for tag in page.tags if tag.startswith("on")]
    assert page.tags.count("img") == 0
    draft = ast.parse(bc.draft_effect(calibration, f"unknown({column})"))
    assert [type(statement).__name__ for statement in draft.body] == [
        "Import",
        "Import",
        "FunctionDef",
        "Assign",
    ]
    for suffix in (".csv", ".parquet"):
        again = bc.read(readings.write(tmp_path / f"written{suffix}"), gyro)
        assert list(again["run"]) == list(readings["run"]) and again.columns == readings.columns
