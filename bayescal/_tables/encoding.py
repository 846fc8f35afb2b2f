"""In which encoding a text file is: UTF-8 or UTF-16, or one in which the signs of units alone are not ASCII."""

from __future__ import annotations

import codecs
import io
from pathlib import Path
from typing import BinaryIO

from bayescal._core.errors import InputError

_BLOCK = 1 << 24  # bytes looked at together
_ASCII = bytes(range(128))
_SIGNS = set("°µ²³·±".encode("latin-1"))  # the same in Latin-1, Latin-9 and Windows-1252
_MOST_UTF16 = 500_000_000  # bytes: it is held whole


def encoding_of(path: Path) -> str:
    """By its mark "utf-16"; "latin-1" where the only bytes beyond ASCII are signs such as ° and µ; else "utf-8".

    None of these signs begins a character in UTF-8, so the two cannot be taken for each other.
    """
    beyond = set[int]()
    with path.open("rb") as handle:
        if handle.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return "utf-16"
        handle.seek(0)
        while block := handle.read(_BLOCK):
            beyond.update(block.translate(None, _ASCII))
            if not beyond <= _SIGNS:
                return "utf-8"
    return "latin-1" if beyond else "utf-8"


def opened(path: Path, encoding: str) -> BinaryIO:
    """A file's bytes; those of UTF-16 as UTF-8.

    Raises:
        InputError: UTF-16 that is too large to be held, or broken.
    """
    if encoding != "utf-16":
        return path.open("rb")
    if path.stat().st_size > _MOST_UTF16:
        raise InputError(
            f"{path.name!r} is UTF-16 text of more than 500 MB: save it as 'CSV UTF-8'"
        )
    try:
        return io.BytesIO(path.read_bytes().decode("utf-16").encode())
    except UnicodeError as error:
        raise InputError(
            f"{path.name!r} is UTF-16 text that breaks off: save it as 'CSV UTF-8'"
        ) from error
