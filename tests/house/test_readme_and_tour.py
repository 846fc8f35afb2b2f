"""README.md tells the truth: its code prints what it shows, its commands and links exist."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Container, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.command_line import run
from tests.support.export_check import needs_compiler
from tests.support.shown_output import assert_as_shown, blocks, load_module

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "README.md").read_text("utf-8")


def test_the_code_prints_what_is_shown() -> None:
    """Words exactly; numbers within two of the last digit shown, or 2 %."""
    (code,), (shown,) = blocks(PAGE, "python"), blocks(PAGE, "text")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {})
    assert_as_shown(printed.getvalue(), shown)


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text("utf-8")
    targets = set(re.findall(r"^([a-z-]+)%?:", makefile, re.MULTILINE))
    named = set(re.findall(r"(?:`|^ *)make ([a-z-]+)", PAGE, re.MULTILINE))
    named = {"bench-" if name.startswith("bench-") else name for name in named}
    assert {"demo", "test"} <= named <= targets


def test_commands_exist() -> None:
    help_ = run("--help").out
    for words in re.findall(r"\| `bayescal ([^|]*?)` \|", PAGE):
        for command in re.findall(r"[a-z]+", words):
            assert re.search(rf"^  {command} ", help_, re.MULTILINE), command


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)]+)\)", PAGE)
    assert "docs/error_falls.png" in links
    for link in links:
        assert (ROOT / link).is_file(), link


# docs/tour.py, executed: each step prints what its page shows, and what is done by hand is what bayescal says.


DOCS = Path(__file__).resolve().parents[2] / "docs"
SITE = load_module(DOCS / "build_site.py")
SHOWN = blocks((DOCS / "tour.md").read_text("utf-8"), "text")
QUICK = (1, 3, 6, 8)  # the steps that need neither chains nor a search
BY_HAND = (6, 8)  # of these those that print what they worked out themselves


def follow(numbers: Iterable[int], compared: Container[int]) -> dict[str, Any]:
    """Run these steps, and hold what some of them print against the page; the names that they leave."""
    space: dict[str, Any] = {}
    for number in numbers:
        printed = io.StringIO()
        code = compile(f"# {SITE.steps()[number - 1]}", f"step {number}", "exec", 0, True)
        with contextlib.redirect_stdout(printed):
            exec(code, space)
        if number in compared:
            assert_as_shown(printed.getvalue(), SHOWN[number - 1])
    return space


def test_every_step_is_on_its_page() -> None:
    page = SITE.fill_in((DOCS / "tour.md").read_text("utf-8"))
    assert page.count("\n## ") == len(SITE.steps()) == len(SHOWN)
    assert "tour:" not in page
    for code in blocks(page, "python"):
        compile(code, "tour.md", "exec")


def by_hand_as_by_bayescal(space: dict[str, Any]) -> None:
    assert space["before"] == pytest.approx(space["fit"].log_evidence[0], abs=0.1)
    assert space["after"] == pytest.approx(space["better"].log_evidence[0], abs=0.1)
    for line, (rate, temperature) in zip(
        space["ran"].stdout.splitlines(), space["new"], strict=True
    ):
        python = space["correct"](output=rate, temperature=temperature, noise=False)
        c = np.array(line.split(), dtype=float)
        np.testing.assert_allclose(c, [python.value[0], python.uncertainty[0]], rtol=1e-6)


@needs_compiler
def test_evidence_and_firmware_by_hand() -> None:
    by_hand_as_by_bayescal(follow(QUICK, BY_HAND))


@pytest.mark.slow
@needs_compiler
def test_the_whole_tour() -> None:
    """NumPyro's draws have the means and widths of the fit, and the search has the Bayes factor of the Gram matrix."""
    every = range(1, len(SHOWN) + 1)
    space = follow(every, every)
    by_hand_as_by_bayescal(space)
    for name, drawn in space["drawn"].items():
        if name in space["fit"].posterior:
            own = space["fit"].samples(name)
            assert abs(own.mean() - drawn.mean()) < 0.15 * drawn.std()
            assert own.std() == pytest.approx(drawn.std(), rel=0.15)
    assert space["first"].effect == "bias.temperature_quadratic"
    assert space["first"].log_bayes_factor == pytest.approx(space["by_hand"], abs=0.1)
