"""Pages that show commands, code and their output: run, compare and print them again.

    python -m benchmarks shown start.md …         write the present output into pages of docs/

The blocks of a page are processed in order, in one folder: a `python` block is run, or written to a file if it has a
`title`; each line of a `sh` block is a bayescal command, which must exit with 0 or with the status in a comment; a
`text` block is the output of the block before it, "…" for omitted lines. Indented and `console` blocks are not run.
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

BLOCK = re.compile(r'^```(python|sh|text)(?: title="([^"]+)")?\n(.*?)^```', re.S | re.M)
LEFT_OUT = re.compile(r"^…\n", re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)")
BOUND = re.compile(r"[<>] (?=\d)")  # of a probability: "< 0.01" is compared as 0.01
RELATIVE = 0.02
LAST_DIGITS = 2.0  # units of the last digit shown, within which a number is the same

# Arguments of bayescal; exit status, what it printed.
Run = Callable[[Sequence[str]], tuple[int, str]]


class Example(NamedTuple):
    """A `text` block of a page: the text shown, the actual output, and the position of the text in the page."""

    shown: str
    printed: str
    first: int
    last: int

    def difference(self, last_digits: float = LAST_DIGITS) -> str:
        """Return the parts between lines of "…" that are absent from the output, in order; empty if none."""
        lines = self.printed.splitlines()
        for part in LEFT_OUT.split(self.shown):
            if not (expected := part.strip("\n").splitlines()):
                continue
            start = _place(expected[0], lines)
            if start is None:
                return f"{expected[0]!r} is not printed:\n{self.printed}"
            printed_part = "\n".join(lines[start : start + len(expected)])
            if message := difference(printed_part, "\n".join(expected), last_digits):
                return message
            lines = lines[start + len(expected) :]
        return ""

    def anew(self) -> str:
        """Return the block with its present output, each part from its first line to its last."""
        lines, output = self.printed.rstrip("\n").splitlines(), list[str]()
        for i, part in enumerate(LEFT_OUT.split(self.shown)):
            output += ["…"] if i else []
            if not (expected := part.strip("\n").splitlines()):
                continue
            start = _place(expected[0], lines) or 0
            # As long as it was where its last line stands there, else up to where that line stands.
            usual = start + len(expected) - 1
            ends = [j for j in (usual, *range(start, len(lines))) if lines[j : j + 1]]
            end = next((j for j in ends if _words(lines[j]) == _words(expected[-1])), usual)
            output += [line.rstrip() for line in lines[start : end + 1]]
            lines = lines[end + 1 :]
        return "\n".join(output) + "\n"


def difference(printed: str, expected: str, last_digits: float = LAST_DIGITS) -> str:
    """Return the difference of a text from the expected one; empty if none.

    Words are compared exactly, numbers within some units of the last shown digit, or 2 %. Rules under a table's head
    and spaces between columns, whose lengths depend on the numbers, are not compared.
    """
    where = f"\nprinted now:\n\n{printed}\n\nshown:\n\n{expected}"
    for line, other in zip_longest(_lines(printed), _lines(expected), fillvalue=""):
        if NUMBER.sub("#", line) != NUMBER.sub("#", other):
            return f"the words differ:\n  {line}\n  {other}{where}"
        for a, b in zip(NUMBER.findall(line), NUMBER.findall(other), strict=True):
            if abs(float(a) - float(b)) > max(last_digits * _last(b), RELATIVE * abs(float(b))):
                return f"{a} is not {b}, in:\n  {line}\n  {other}{where}"
    return ""


def followed(page: str, run: Run) -> Iterator[Example]:
    """Run a page from top to bottom in the current folder; yield each of its `text` blocks.

    Raises:
        ValueError: a command is not bayescal's, or exits with a status other than the page's.
    """
    names: dict[str, object] = {}
    printed = ""
    for block in BLOCK.finditer(page):
        language, title, code = block.groups()
        if language == "text":
            yield Example(code, printed, *block.span(3))
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
    """Run a bayescal command in a separate process; return status and output without progress lines."""
    surroundings = {**os.environ, "COLUMNS": "80", "MPLBACKEND": "Agg"}
    command = [sys.executable, "-m", "bayescal", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=surroundings)
    errors = (line for line in done.stderr.splitlines() if not line.endswith("…"))
    return done.returncode, done.stdout + "".join(f"{line}\n" for line in errors)


def differing(name: str) -> Iterator[str]:
    """Yield the differences of a page of docs/ from present output, one sentence each."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for block in followed((DOCS / name).read_text("utf-8"), in_a_process):
            if message := block.difference():
                yield f"docs/{name}: {message}"


def main(names: Sequence[str]) -> None:
    """Print pages again."""
    for name in names:
        path = DOCS / name
        page, output, before = path.read_text("utf-8"), "", 0
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            for b in followed(page, in_a_process):
                output += page[before : b.first] + (b.anew() if b.difference() else b.shown)
                before = b.last
        path.write_text(output + page[before:], "utf-8")
        print(f"docs/{name}: {'unchanged' if output + page[before:] == page else 'updated'}")


def _command(line: str, run: Run) -> str:
    command, _, comment = line.partition("  # exit status ")
    name, *arguments = shlex.split(command)
    if name != "bayescal":
        raise ValueError(f"{line}: a page may only run commands of bayescal")
    status, printed = run(arguments)
    if status != int(comment or 0):
        raise ValueError(f"{line}: exit status {status}\n{printed}")
    return printed


def _place(line: str, among: Sequence[str]) -> int | None:
    return next((i for i, other in enumerate(among) if _words(other) == _words(line)), None)


def _words(line: str) -> str:
    """Return a line without its numbers."""
    return NUMBER.sub("#", BOUND.sub("", " ".join(line.split())))


def _lines(text: str) -> list[str]:
    plain = (" ".join(BOUND.sub("", line).split()) for line in text.splitlines())
    return [line for line in plain if line and not line.startswith("──")]


def _last(number: str) -> float:
    """Return one unit of the last digit: 0.01 for 3.14, 1 for 322."""
    digits, _, power = number.partition("e")
    places = len(digits.partition(".")[2])
    return 10.0 ** (int(power or 0) - places)
