"""Atomic writing of files by renaming a temporary file, and files sealed by a checksum.

A sealed file ends in a trailer of 84 bytes: a magic word and the SHA-256 of all preceding bytes. HDF5, and hence xarray
and ArviZ, ignore bytes after the end of data.
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
TRAILER_BYTES = len(MAGIC) + 64 + 1
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no space, quota or size limit


@contextmanager
def replace_atomically(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that replaces `path` if the `with` block succeeds, and is removed if it fails.

    If two processes write the same path at once, the second removes the temporary file of the first, which fails.
    """
    # In the same folder, so that the rename stays within one file system and is atomic (POSIX rename).
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    for leftover_path in filter(Path.is_file, list_leftovers(path)):
        leftover_path.unlink(missing_ok=True)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def list_leftovers(path: Path) -> list[Path]:
    """Return the temporary files of `path` that killed processes have left, or that another process is writing."""
    return [*path.parent.glob(f".{glob.escape(path.name)}.*.partial")]


@contextmanager
def replace_user_file(path: Path) -> Iterator[Path]:
    """Replace a file as `replace_atomically` does, and create its folder; raise InputError if it cannot be written."""
    try:
        with create_result_folder(path.parent), replace_atomically(path) as partial:
            yield partial
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be written: {explain_error(error)}") from error


@contextmanager
def create_result_folder(folder: Path | None) -> Iterator[Path | None]:
    """Create `folder`, if given, and yield it; on failure of the `with` block, remove it. Raises InputError."""
    missing = [] if folder is None else [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        if folder is not None:
            _make_folder(folder)
        yield folder
    except BaseException:
        for created_folder in missing:
            with suppress(OSError):  # not empty: something was written
                created_folder.rmdir()
        raise


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{folder} is a file, not a folder: give another name") from None
    except OSError as error:
        raise InputError(f"folder {str(folder)!r} cannot be created: {error.strerror}") from None


def explain_error(error: OSError) -> str:
    """Return the reason why a file cannot be written and the remedy, as two sentences."""
    text = error.strerror or str(error)
    if error.errno in DISK_FULL:
        return f"{text}. Free disk space, or choose another folder; an existing file is unchanged"
    is_folder = error.errno == errno.EISDIR
    return f"{text}. {'Give the name of a file' if is_folder else 'Choose a writable folder'}"


def write_text(text: str, path: str | Path) -> Path:
    """Write text as UTF-8 to a path chosen by the user, and return it; raise InputError if it cannot be written."""
    path = Path(path)
    with replace_user_file(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
    return path


def compute_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def encode_name(name: str) -> str:
    """Encode a name for NetCDF, in which "/" separates groups: "/" as %2F and, where ambiguous, "%" as %25."""
    if "/" in name or name != decode_name(name):
        return name.replace("%", "%25").replace("/", "%2F")
    return name


def decode_name(stored: str) -> str:
    """Decode a name that `encode_name` encoded."""
    return stored.replace("%2F", "/").replace("%25", "%")


def write_sealed(content: bytes | memoryview, path: Path) -> None:
    """Write bytes to a file, followed by the trailer with their checksum that `read_sealed` verifies."""
    with path.open("wb") as file:
        file.write(content)
        file.write(MAGIC + hashlib.sha256(content).hexdigest().encode() + b"\n")


def read_sealed(path: Path, kind: str, advice: str) -> memoryview:
    """Verify a sealed file and return its bytes without trailer; raise InputError: not `kind`, or damaged; `advice`."""
    try:
        data = path.read_bytes()
    except OSError as error:
        fault = f"cannot be read: {error.strerror or error}"
        raise InputError(f"{path.name} {fault}. {advice}") from None
    content = memoryview(data)[: max(0, len(data) - TRAILER_BYTES)]
    # At the very end: HDF5 ignores bytes after its own end, so that both read the same bytes.
    trailer = TRAILER.fullmatch(data[len(content) :])
    if not data.startswith(b"\x89HDF"):
        fault = f"is not {kind}"
    elif trailer is None:
        fault = f"has no checksum: it is damaged, is not {kind}, or is of an earlier version"
    elif hashlib.sha256(content).hexdigest().encode() != trailer[1]:
        fault = "is damaged: its bytes do not match the checksum at its end"
    elif TRAILER.fullmatch(data[max(0, len(content) - TRAILER_BYTES) : len(content)]):
        fault = "has two checksums at its end, expected one"
    else:
        return content
    raise InputError(f"{path.name} {fault}. {advice}")
