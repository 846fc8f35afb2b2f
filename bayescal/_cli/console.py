"""How a command leaves: its result on standard output, notes on standard error, an exit status, a folder.

Light: every command loads it before it starts.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import typer

from bayescal._core.as_json import as_json, json_text
from bayescal._core.atomic_file import folder_made
from bayescal._core.errors import InputError, NotDrawn
from bayescal._core.quoting import one_line


def print_result(result: Any) -> None:
    """Data as JSON, anything else as the text that it prints as."""
    if isinstance(result, dict | list):
        result = json_text(as_json(result)).rstrip("\n")
    print(result)


def print_notes(notes: Iterable[str]) -> None:
    """What the user should know of and no reason to stop, on standard error."""
    for note in notes:
        print(f"bayescal: note: {one_line(note)}", file=sys.stderr)


def exit_unless(reliable: bool, why: str) -> None:
    """Leave with status 1 if the result that was printed is not reliable.

    Raises:
        typer.Exit: it is not.
    """
    if not reliable:
        print(f"bayescal: result not reliable: {why}", file=sys.stderr)
        raise typer.Exit(1)


def drawn(make: Callable[..., Any], *given: Any) -> bool:
    """Make pictures or a page of a result that is written; whether they could be made: where not, that is said."""
    try:
        make(*given)
    except NotDrawn as error:
        print_notes([str(error)])
        return False
    return True


def exit_unless_drawn(*made: bool) -> None:
    """Leave with status 1 if something could not be drawn, as `drawn` has said.

    Raises:
        typer.Exit: it could not.
    """
    if not all(made):
        raise typer.Exit(1)


@contextmanager
def result_folder(path: Path | None) -> Iterator[Path | None]:
    """A folder to write to, made if need be, and taken away again if nothing comes of it.

    Raises:
        InputError: it cannot be made, or is a file.
    """
    if path is None:
        yield None
        return
    with ExitStack() as stack:
        try:
            stack.enter_context(folder_made(path))
        except OSError as error:
            raise InputError(f"cannot write to the folder {path}: {error.strerror}") from None
        yield path
