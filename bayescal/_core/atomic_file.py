"""A file is there whole or not at all: written beside its place, renamed, and sealed so that damage is seen.

A sealed file ends in a trailer of 84 bytes: a magic word, and the SHA-256 of all that stands before it. HDF5, and so
xarray and ArviZ, take no notice of what follows the end that the file itself states.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bayescal._core.errors import InputError

MAGIC = b"\n# bayescal sha256 "
TRAILER = re.compile(re.escape(MAGIC) + rb"([0-9a-f]{64})\n\Z")
LENGTH = len(MAGIC) + 64 + 1
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # a full disk, a used-up quota, a limit


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a file to write beside `path`, which takes its place once it is whole; nothing is left of another."""
    # In the same folder, so that the rename stays within one file system and is atomic (POSIX rename); the process's
    # number tells what is left behind from what another process writes now.
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    for left in left_behind(path):
        if left.is_file():
            left.unlink(missing_ok=True)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def left_behind(path: Path) -> list[Path]:
    """Return what processes that were killed left beside a file or folder; what others are writing is not."""
    names = path.parent.glob(f".{glob.escape(path.name)}.*.partial")
    return [left for left in names if not _runs(left.name.split(".")[-2])]


def _runs(process: str) -> bool:
    """Return whether a process of this number may run; only POSIX says so without sending it a signal."""
    if os.name != "posix" or not process.isdecimal():
        return True
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it is another user's
        pass
    return True


@contextmanager
def replacing_for_user(path: Path) -> Iterator[Path]:
    """Yield the same for a place that the user chose, its folder made if need be.

    Raises:
        InputError: a place that cannot be written to, or no room; the old file is as it was.
    """
    try:
        with result_folder(path.parent), replacing(path) as partial:
            yield partial
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be written: {why(error)}") from error


@contextmanager
def result_folder(folder: Path | None) -> Iterator[Path | None]:
    """Make a folder with those that it is in, if one is named; take away what was made if nothing comes of it.

    Raises:
        InputError: it cannot be made, or is a file.
    """
    missing = [] if folder is None else [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        if folder is not None:
            _make(folder)
        yield folder
    except BaseException:
        for made in missing:
            with suppress(OSError):  # not empty: something was written
                made.rmdir()
        raise


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{folder} is a file, a folder was expected: name another") from None
    except OSError as error:
        raise InputError(f"cannot write to the folder {folder}: {error.strerror}") from None


def why(error: OSError) -> str:
    """Return what stood against writing, and what to do about it."""
    said = error.strerror or str(error)
    if error.errno in FULL:
        return f"{said}. Make room there, or choose another place; what stood there is as it was"
    is_folder = error.errno == errno.EISDIR
    return f"{said}. {'Name a file' if is_folder else 'Choose a folder that may be written to'}"


def write_text(text: str, path: str | Path) -> Path:
    """Write text as UTF-8 to a place that the user chose; see `replacing_for_user`."""
    path = Path(path)
    with replacing_for_user(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
    return path


def to_disk(path: Path) -> None:
    """Have the operating system put a file, or the names of a folder, on the disk."""
    if path.is_dir() and os.name != "posix":
        return  # only there can a folder be opened
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def storable(name: str) -> str:
    """Return a name as NetCDF can hold it, in which a / parts groups: it is written %2F."""
    if "/" in name or name != named_back(name):
        return name.replace("%", "%25").replace("/", "%2F")
    return name


def named_back(stored: str) -> str:
    """Return the name that `storable` made this of."""
    return stored.replace("%2F", "/").replace("%25", "%")


def write_sealed(content: bytes | memoryview, path: Path) -> None:
    """Write bytes and the trailer by which `verified` knows them."""
    with path.open("wb") as file:
        file.write(content)
        file.write(MAGIC + hashlib.sha256(content).hexdigest().encode() + b"\n")


def verified(path: Path, what: str, instead: str) -> memoryview:
    """Return the bytes of a sealed file without their trailer, if they are as they were written.

    Args:
        path: of the file.
        what: it should be, such as "a saved calibration".
        instead: what to do where it is not.

    Raises:
        InputError: it cannot be read, has no trailer, or is not as it was written.
    """
    try:
        found = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path.name} cannot be read: {error.strerror or error}. {instead}"
        ) from None
    content = memoryview(found)[: max(0, len(found) - LENGTH)]
    # At the very end: HDF5 passes over what follows its own end, so that both read the same bytes.
    trailer = TRAILER.fullmatch(found[len(content) :])
    if not found.startswith(b"\x89HDF"):
        said = f"is not {what}"
    elif trailer is None:
        said = f"is damaged, is not {what}, or is of an earlier version: its checksum is missing"
    elif hashlib.sha256(content).hexdigest().encode() != trailer[1]:
        said = "is damaged: its bytes do not have the checksum at its end"
    elif TRAILER.fullmatch(found[max(0, len(content) - LENGTH) : len(content)]):
        said = "has two checksums at its end, expected one"
    else:
        return content
    raise InputError(f"{path.name} {said}. {instead}")
