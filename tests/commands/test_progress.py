"""What takes long says what it is doing, for how long by now, and how long it usually takes: again and again."""

from __future__ import annotations

import ast
import re
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from bayescal._cli.output import ConsoleReporter
from bayescal._core import progress
from tests.support.command_line import needs_installation, run

PACKAGE = Path(progress.__file__).parents[1]


@pytest.fixture(autouse=True)
def _hundred_times_as_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "EVERY", 0.09)
    monkeypatch.setattr(progress, "SOON", 0.01)


def lines_of(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_a_long_stage_is_told_of_again_and_again(capsys) -> None:
    with progress.stage("checking", progress.SOON):
        time.sleep(1.2)  # two looks and more at the half second that a watcher sleeps
    first, *more = lines_of(capsys)
    assert first == "bayescal: checking (usually 1 to 10 s) …"
    assert more
    assert all(
        re.fullmatch(r"bayescal: checking, \d s so far \(usually 1 to 10 s\) …", m) for m in more
    )


def test_the_innermost_stage_is_told_of_alone(capsys) -> None:
    with progress.stage("outer", progress.SOON):
        with progress.stage("inner", progress.SOON):
            time.sleep(0.7)
        inner = lines_of(capsys)
        time.sleep(0.7)
    assert any("inner" in line for line in inner) and not any(
        "so far" in i and "outer" in i for i in inner
    )
    outer = lines_of(capsys)
    assert outer and all("outer" in line for line in outer)


def test_a_short_one_says_nothing(capsys) -> None:
    with progress.stage("short", 5.0):
        pass
    assert not lines_of(capsys)


def test_a_search_is_told_of_where_its_best_changes_or_after_a_while(capsys, monkeypatch) -> None:
    def told(best: str, weighed: int) -> list[str]:
        reporter(
            SimpleNamespace(
                progress=f"{weighed} structures weighed; best so far: {best}",
                search=SimpleNamespace(structures=[best]),
                steps=[None],
            )
        )
        return lines_of(capsys)

    reporter = ConsoleReporter(begun=True)
    monkeypatch.setattr(progress, "EVERY", 30.0)
    assert len(told("baseline", 1)) == 1
    assert not told("baseline", 2) and not told("baseline", 3)
    (line,) = told("+ bias.warm_up", 4)
    assert line == "bayescal: 4 structures weighed; best so far: + bias.warm_up …"
    monkeypatch.setattr(progress, "EVERY", 0.0)
    assert len(told("+ bias.warm_up", 5)) == 1


@needs_installation
def test_a_command_that_says_nothing_else_is_told_of(monkeypatch) -> None:
    monkeypatch.setattr(
        "bayescal._model.installed.installed_instruments", lambda: time.sleep(0.3) or {}
    )
    monkeypatch.setattr("bayescal._cli.options.EVERY", 0.09)
    done = run("instruments")
    assert "bayescal: bayescal instruments" not in done.err
    assert "bayescal: instruments" in done.err


def test_every_stage_says_how_long_it_usually_takes() -> None:
    named = set()
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "stage":
                named |= {one.value for one in node.args[:1] if isinstance(one, ast.Constant)}
    assert named and named <= set(progress.USUALLY)
