"""The page that answers computes what Python computes, holds no name as code, and needs no network."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._use.compensation_program import STIMULUS
from bayescal._use.expression_graph import JAVASCRIPT, statements
from bayescal._use.program_text import effects_of
from tests.support.browser import chromium
from tests.support.export_check import (
    PAIRS,
    each_operation,
    inputs_of,
    random_rows,
)
from tests.support.inside import text_of
from tests.support.made_up import bent_sensor

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="needs Node.js, as `node`")
ROWS, LARGEST = 1_000, 500_000  # readings compared; bytes of a page
SCRIPT = re.compile(r'<script id="program">\n(.*?)</script>', re.DOTALL)
MADE = {"bent": bent_sensor.calibration, "gyro": bent_sensor.gyro}


@pytest.fixture(scope="module", params=list(MADE))
def compensator(request) -> bc.Compensator:
    """One with memory, shapes and no closed inverse; a straight line."""
    return bc.compensator(MADE[request.param]())


@pytest.fixture(scope="module")
def page(compensator) -> str:
    return text_of(compensator.program, "html")


def in_node(script: str, call: str, rows: np.ndarray) -> list[Any]:
    """What a script's function says of each row, by Node.js.

    Args:
        script: that declares what `call` needs.
        call: an expression of `row`, an array of numbers.
        rows: of numbers, (n, k).
    """
    assert NODE is not None
    program = f"""{script}
const rows = JSON.parse(require("fs").readFileSync(0, "utf8"));
const text = v => JSON.stringify(v, (_, x) => typeof x === "number" && !Number.isFinite(x) ? String(x) : x);
process.stdout.write(text(rows.map(row => {call})));"""
    given = json.dumps(rows.tolist())
    ran = subprocess.run(
        [NODE, "-e", program], input=given, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


@needs_node
def test_the_page_computes_what_python_computes(compensator, page) -> None:
    rows = random_rows(compensator, ROWS)
    (script,) = SCRIPT.findall(page)
    found = in_node(script, "compensate(row[0], row.slice(1))", rows)
    value, own, one = (
        np.array([float(f[n]) for f in found])
        for n in ("value", "uncertainty", "uncertaintyReading")
    )
    by_python, uncertainty, inclination = compensator.program.run(
        rows[:, 0], inputs_of(compensator, rows)
    )
    floor = 1e-3 * np.abs(by_python).max()  # near zero a value is a difference of large numbers
    assert np.max(np.abs(value - by_python) / np.maximum(np.abs(by_python), floor)) < 1e-12
    np.testing.assert_allclose(own, uncertainty, rtol=1e-12)
    np.testing.assert_allclose(
        one, np.hypot(uncertainty, compensator.noise * inclination), rtol=1e-12
    )


@needs_node
def test_parts_of_the_variance_add_up_and_are_those_of_the_covariance(compensator, page) -> None:
    rows = random_rows(compensator, 20)
    (script,) = SCRIPT.findall(page)
    for row, found in zip(
        rows, in_node(script, "compensate(row[0], row.slice(1))", rows), strict=True
    ):
        gradient = np.array(found["gradient"])
        parts = gradient * (compensator.program.covariance @ gradient)
        np.testing.assert_allclose(
            found["parts"], parts, rtol=1e-7, atol=1e-9 * np.abs(parts).max()
        )
        total = sum(found["parts"]) + compensator.noise**2
        assert found["variance"] == pytest.approx(total, rel=1e-9), row


@needs_node
def test_each_operation_is_the_same_in_javascript() -> None:
    graph, outputs = each_operation()
    lines, results = statements(graph, outputs, {"a": "row[0]", "b": "row[1]"}, JAVASCRIPT)
    found = in_node("", f"(() => {{ {''.join(lines)} return [{', '.join(results)}]; }})()", PAIRS)
    want = graph.evaluate(outputs, {"a": PAIRS[:, 0], "b": PAIRS[:, 1]})
    np.testing.assert_allclose(found, np.array(want, float).T, rtol=1e-14, atol=1e-16)


def test_every_unknown_belongs_to_one_effect(compensator) -> None:
    shown = effects_of(compensator.program)
    numbers = sorted(i for e in shown for i in (*e.linear, *e.others))
    assert numbers == list(range(len(compensator.program.unknowns)))
    known = {n for n, _ in compensator.program.about.effects}
    for e in shown:
        assert e.name in known
        for i in e.linear:
            name = compensator.program.unknowns[i].name
            assert name.startswith(e.name) and not name.removeprefix(e.name).startswith(".")
        for i in e.others:
            assert compensator.program.unknowns[i].name.startswith(f"{e.name}.")


def test_the_page_is_small_and_asks_nothing_of_anyone(compensator, page) -> None:
    assert len(page.encode("utf-8")) < LARGEST
    assert "default-src 'none'" in page
    assert not re.search(r"https?://|src=|href=|@import|url\(|fetch\(|XMLHttpRequest", page)
    for i in compensator.inputs:
        if i.kind != "lag slope":
            assert f'aria-label="{i.name}"' in page
    assert STIMULUS not in page


def test_a_result_that_is_not_reliable_says_so_on_its_page() -> None:
    gyro = bent_sensor.gyro()
    spoilt = replace(gyro, verdict=replace(gyro.verdict, against=("It is <off>.",)))
    page = text_of(bc.compensator(spoilt).program, "html")
    assert "Result not reliable:</b> It is &lt;off&gt;." in page


def test_it_is_exported_by_its_suffix_and_from_json(tmp_path, compensator, page) -> None:
    assert compensator.export(tmp_path / "page.html").read_text("utf-8") == page
    loaded = bc.load_compensator(compensator.export(tmp_path / "c.json"))
    loaded.export(tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text("utf-8") == page


@pytest.mark.slow
def test_in_a_browser_without_network_it_computes_what_python_computes(
    compensator, tmp_path: Path
) -> None:
    """In Chromium, offline: one condition moved by hand, no line on the console."""
    sync_api = pytest.importorskip("playwright.sync_api")
    file = compensator.export(tmp_path / "page.html")
    with sync_api.sync_playwright() as program:
        arguments = ["--no-sandbox", "--disable-gpu"]
        browser = program.chromium.launch(executable_path=chromium(), args=arguments)
        context = browser.new_context(offline=True)
        page, said, asked = context.new_page(), [], []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(file.as_uri())
        # The reading stays while the temperature moves beyond its range: what is shown is what Python says.
        k, temperature = next(
            (k, i) for k, i in enumerate(compensator.inputs) if i.name == "temperature"
        )
        beyond = temperature.high + 10.0
        page.fill(f"#input-{k}-number", repr(beyond))
        reading = float(page.input_value("#reading-number"))
        shown = float(page.inner_text("#value").replace("\u2212", "-"))
        at = {i.name: np.array([0.5 * (i.low + i.high)]) for i in compensator.inputs}
        at |= {
            i.name: np.zeros(1) for i in compensator.inputs if i.kind not in ("column", "elapsed")
        }
        at["temperature"] = np.array([beyond])
        want, alone, inclination = compensator.program.run(np.array([reading]), at)
        one = np.hypot(alone[0], compensator.noise * inclination[0])
        assert shown == pytest.approx(want[0], abs=0.051 * one)  # to two digits of its uncertainty
        assert "temperature" in page.inner_text("#outside")
        shares = page.locator("td[id^=share-]").all_inner_texts()
        numbers = [float(s.removesuffix("%").replace("\u2212", "-")) for s in shares]
        assert sum(numbers) == pytest.approx(100.0, abs=0.05 * len(numbers) + 0.01)
        for width in (1200, 800, 400):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.locator("#chart path.dashed").count() == 1
        assert said == [] and asked == [file.as_uri()]
        browser.close()
