"""A file is there whole or not at all: it is written beside its place and then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bayescal._core.errors import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to write beside `path`, which takes its place once it is whole; nothing is left of one that is not.

    Raises:
        OSError: it cannot be written or renamed; the old file is as it was.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def replacing_for_user(path: Path) -> Iterator[Path]:
    """The same for a place that the user chose: what stands against it is said in words.

    Raises:
        InputError: no such folder, or a place that cannot be written to.
    """
    if not path.parent.is_dir():
        raise InputError(
            f"{str(path)!r} cannot be written: there is no folder {str(path.parent)!r}. Make it, "
            "or choose another"
        )
    try:
        with replacing(path) as partial:
            yield partial
    except OSError as error:
        raise InputError(
            f"{str(path)!r} cannot be written: {error.strerror or error}. Choose a folder that may "
            "be written to"
        ) from error


def write_text(text: str, path: str | Path) -> Path:
    """Write text as UTF-8 to a place that the user chose.

    Raises:
        InputError: no such folder, or a place that cannot be written to.
    """
    path = Path(path)
    with replacing_for_user(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
    return path
