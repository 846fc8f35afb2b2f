"""Pages that show commands, code and what they print: run, compared, and printed anew.

    python -m benchmarks shown start.md …         writes what is printed now into pages of docs/

On a page, in order and in one folder: a `python` block is run, or written to a file where it has a `title`; each line
of a `sh` block is a bayescal command, which exits with 0 or with the status that a comment names; a `text` block is
what the block before it printed, "…" standing for lines left out. Indented and `console` blocks are only shown.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from benchmarks.record import DOCS

BLOCK = re.compile(
    r'^```(python|sh|text)(?: title="([^"]+)")?\n(.*?)^```', re.DOTALL | re.MULTILINE
)
LEFT_OUT = re.compile(r"^…\n", re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)")
BOUND = re.compile(r"[<>] (?=\d)")  # of a probability: "< 0.01" is compared as 0.01
RELATIVE = 0.02
LAST_DIGITS = 2.0  # units of the last digit shown, within which a number is the same

Run = Callable[
    [Sequence[str]], tuple[int, str]
]  # arguments of bayescal; exit status, what it printed


class Shown(NamedTuple):
    """A `text` block of a page: what it shows, what was printed, and where its text begins and ends in the page."""

    shown: str
    printed: str
    first: int
    last: int

    def difference(self, last_digits: float = LAST_DIGITS) -> str:
        """Where its parts between lines of "…" do not stand in what was printed, in order; empty if they do."""
        left = self.printed.splitlines()
        for part in LEFT_OUT.split(self.shown):
            if not (wanted := part.strip("\n").splitlines()):
                continue
            start = _place(wanted[0], left)
            if start is None:
                return f"{wanted[0]!r} is not printed:\n{self.printed}"
            there = "\n".join(left[start : start + len(wanted)])
            if said := difference(there, "\n".join(wanted), last_digits):
                return said
            left = left[start + len(wanted) :]
        return ""

    def anew(self) -> str:
        """The block as it is printed now: each part from where its first line is to where its last one is."""
        left, made = self.printed.rstrip("\n").splitlines(), list[str]()
        for i, part in enumerate(LEFT_OUT.split(self.shown)):
            made += ["…"] if i else []
            if not (wanted := part.strip("\n").splitlines()):
                continue
            start = _place(wanted[0], left) or 0
            # As long as it was where its last line stands there, else up to where that line stands.
            usual = start + len(wanted) - 1
            ends = [j for j in (usual, *range(start, len(left))) if left[j : j + 1]]
            end = next((j for j in ends if _words(left[j]) == _words(wanted[-1])), usual)
            made += [line.rstrip() for line in left[start : end + 1]]
            left = left[end + 1 :]
        return "\n".join(made) + "\n"


def difference(printed: str, shown: str, last_digits: float = LAST_DIGITS) -> str:
    """How a text differs from what is shown; empty if it does not.

    Words are compared exactly, numbers within some of the last digit shown, or 2 %. Rules under a table's head and the
    spaces between columns are not compared: their lengths depend on the numbers.
    """
    where = f"\nprinted now:\n\n{printed}\n\nshown:\n\n{shown}"
    for one, other in zip_longest(_lines(printed), _lines(shown), fillvalue=""):
        if NUMBER.sub("#", one) != NUMBER.sub("#", other):
            return f"the words differ:\n  {one}\n  {other}{where}"
        for a, b in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True):
            if abs(float(a) - float(b)) > max(last_digits * _last(b), RELATIVE * abs(float(b))):
                return f"{a} is not {b}, in:\n  {one}\n  {other}{where}"
    return ""


def followed(page: str, run: Run) -> Iterator[Shown]:
    """Run a page from top to bottom in the current folder, and give each of its `text` blocks.

    Raises:
        ValueError: a command is not one of bayescal, or ends with another status than the page says.
    """
    names: dict[str, object] = {}
    printed = ""
    for found in BLOCK.finditer(page):
        language, title, code = found.groups()
        if language == "text":
            yield Shown(code, printed, *found.span(3))
        elif title:
            Path(title).write_text(code, encoding="utf-8")
        elif language == "sh":
            printed = "".join(
                _command(line, run) for line in code.replace("\\\n", " ").splitlines()
            )
        else:
            caught = io.StringIO()
            with contextlib.redirect_stdout(caught), contextlib.redirect_stderr(io.StringIO()):
                exec(compile(code, "page", "exec"), names)
            printed = caught.getvalue()


def in_a_process(arguments: Sequence[str]) -> tuple[int, str]:
    """A command of bayescal in a process of its own; lines that tell how far it is are left out."""
    surroundings = {**os.environ, "COLUMNS": "80", "MPLBACKEND": "Agg"}
    command = [sys.executable, "-m", "bayescal", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=surroundings)
    said = (line for line in done.stderr.splitlines() if not line.endswith("…"))
    return done.returncode, done.stdout + "".join(f"{line}\n" for line in said)


def differing(name: str) -> Iterator[str]:
    """What a page of docs/ shows otherwise than it is printed now, a sentence each."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for one in followed((DOCS / name).read_text("utf-8"), in_a_process):
            if said := one.difference():
                yield f"docs/{name}: {said}"


def main(names: Sequence[str]) -> None:
    """Print pages anew."""
    for name in names:
        path = DOCS / name
        page, made, before = path.read_text("utf-8"), "", 0
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            for one in followed(page, in_a_process):
                made += page[before : one.first] + (one.anew() if one.difference() else one.shown)
                before = one.last
        path.write_text(made + page[before:], "utf-8")
        print(f"docs/{name}: {'as it was' if made + page[before:] == page else 'printed anew'}")


def _command(line: str, run: Run) -> str:
    command, _, comment = line.partition("  # exit status ")
    name, *arguments = shlex.split(command)
    if name != "bayescal":
        raise ValueError(f"{line}: a page runs commands of bayescal alone")
    status, printed = run(arguments)
    if status != int(comment or 0):
        raise ValueError(f"{line}: exit status {status}\n{printed}")
    return printed


def _place(line: str, among: Sequence[str]) -> int | None:
    return next((i for i, one in enumerate(among) if _words(one) == _words(line)), None)


def _words(line: str) -> str:
    """A line without its numbers."""
    return NUMBER.sub("#", BOUND.sub("", " ".join(line.split())))


def _lines(text: str) -> list[str]:
    plain = (" ".join(BOUND.sub("", line).split()) for line in text.splitlines())
    return [line for line in plain if line and not line.startswith("──")]


def _last(number: str) -> float:
    """One unit of the last digit: 0.01 for 3.14, 1 for 322."""
    digits, _, power = number.partition("e")
    places = len(digits.partition(".")[2])
    return 10.0 ** (int(power or 0) - places)
