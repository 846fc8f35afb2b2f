"""README.md tells the truth: its code prints what it shows, its commands and links exist."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

from tests.support.command_line import run
from tests.support.shown_output import assert_as_shown, blocks

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
    targets = set(
        re.findall(r"^([a-z-]+)%?:", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    )
    named = set(re.findall(r"(?:`|^ *)make ([a-z-]+)", PAGE, re.MULTILINE))
    named = {"bench-" if name.startswith("bench-") else name for name in named}
    assert {"demo", "test"} <= named <= targets


def test_commands_exist() -> None:
    help_ = run("--help").out
    for words in re.findall(r"\| `bayescal ([^|]*?)` \|", PAGE):
        for command in re.findall(r"[a-z]+", words):
            assert re.search(rf"^  {command} ", help_, re.MULTILINE), command


def test_options_of_the_shown_command_exist() -> None:
    (line,) = (c for c in "".join(blocks(PAGE, "sh")).splitlines() if "calibrate" in c)
    _, command, *arguments = shlex.split(line)
    help_ = run(command, "--help").out
    for option in (a for a in arguments if a.startswith("--")):
        assert option in help_


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)]+)\)", PAGE)
    assert "docs/error_falls.png" in links
    for link in links:
        assert (ROOT / link).is_file(), link


def test_supported_pythons_are_those_of_the_package() -> None:
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    assert 'requires-python = ">=3.11,<3.14"' in project
    assert "Python 3.11, 3.12 or 3.13" in PAGE
