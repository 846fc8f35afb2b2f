"""What is wrong with files, collected before any of it is said: one problem as a sentence, several as a list."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from shutil import get_terminal_size

from bayescal._core.errors import InputError
from bayescal._core.formatting import WIDTH

_SHOWN = 3  # rows that are named before the rest is counted


@dataclass(frozen=True)
class Problem:
    """One thing in a file that keeps it from being read.

    Attributes:
        file: its name.
        came: what stands there, such as "reads 'x'".
        expected: what was expected, such as "a number in °/s".
        cure: what to do, in words.
        option: of the command line that does it, quoted for a shell; empty if only an edit helps.
        column: its header; empty if it concerns no single column.
        rows: indices of the readings concerned; empty if it concerns no single reading.
        places: the first of them as an editor counts, "row 5", and how many there are.
        sentence: the whole in words, where the parts do not make a good one.
    """

    file: str
    came: str
    expected: str = ""
    cure: str = ""
    option: str = ""
    column: str = ""
    rows: tuple[int, ...] = ()
    places: tuple[str, ...] = ()
    sentence: str = ""

    def at(self, rows: Sequence[int], place: Callable[[int], str]) -> Problem:
        """The same problem of some readings, by their indices and what names their rows."""
        return replace(self, rows=tuple(rows), places=tuple(map(place, rows[:_SHOWN])))

    @property
    def count(self) -> int:
        return max(len(self.rows), len(self.places))

    def __str__(self) -> str:
        if self.sentence:
            return self.sentence
        where = f"{self.file!r}"
        where = f"{self.places[0]} of {where}" if self.places else where
        where = f"{where}, column {self.column!r}:" if self.column else f"{where}:"
        expected = f", {self.expected} was expected" if self.expected else ""
        more = f" (and in {self.count - 1} more)" if self.count > 1 else ""
        cure = f". {self.cure}" if self.cure else ""
        return f"{where} {self.came}{more}{expected}{cure}" + (
            f" ({self.option})" * bool(self.option)
        )

    @property
    def where(self) -> str:
        """Its rows, short: the first few, and how many there are."""
        if not self.places:
            return "–"
        numbers = [place.removeprefix("row ") for place in self.places[:_SHOWN]]
        more = f" … ({self.count} rows)" if self.count > len(numbers) else ""
        return ", ".join(numbers) + more


class Problems(list[Problem]):
    """Problems of some files, in the order in which they were met."""

    def refuse(self) -> None:
        """Refuse the files if there is a problem.

        Raises:
            InputError: there is; it carries them as `problems`.
        """
        if self:
            raise InputError(_text(self), tuple(self))

    @contextmanager
    def collecting(self, file: str = "") -> Iterator[None]:
        """Keep what a check inside refuses, in place of ending with it."""
        try:
            yield
        except InputError as error:
            self += error.problems or [Problem(file, str(error), sentence=str(error))]


def option(name: str, value: str) -> str:
    """An option of the command line as a shell takes it: --columns 'output=gz (deg/s)'."""
    return f"{name}{'=' if value.startswith('-') else ' '}{shlex.quote(value)}"


def _text(problems: Sequence[Problem]) -> str:
    if len(problems) == 1:
        return str(problems[0])
    files = list(dict.fromkeys(p.file for p in problems if p.file))
    of = f"{files[0]!r}" if len(files) == 1 else f"{len(files)} files"
    page = min(WIDTH, get_terminal_size((WIDTH, 24)).columns)
    said = "\n".join(_in_lines(p, len(files) > 1, page) for p in problems)
    options = " ".join(dict.fromkeys(p.option for p in problems if p.option))
    asked = f"\n\nwith these options, if they are meant: {options}" if options else ""
    return f"{len(problems)} problems with {of}\n\n{said}{asked}"


def _in_lines(problem: Problem, several: bool, page: int) -> str:
    """A problem as a list has it, folded to a page: where and what, then what to do."""
    p = problem
    where = [p.file] * several + [f"column {p.column!r}"] * bool(p.column)
    where += [f"row {p.where}" if len(p.places) == 1 else f"rows {p.where}"] * bool(p.places)
    expected = f"; expected: {p.expected}" if p.expected else ""
    first = f"{', '.join(where)}: {p.came}{expected}" if where else f"{p.came}{expected}"
    lines = textwrap.wrap(first, page - 2, initial_indent="- ", subsequent_indent="  ")
    lines += [f"    {p.option}"] * bool(p.option)  # to be copied: in one line
    indent = " " * 4
    return "\n".join(
        [*lines, *textwrap.wrap(p.cure, page - 4, initial_indent=indent, subsequent_indent=indent)]
    )
