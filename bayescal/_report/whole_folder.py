"""A folder of results is there whole: written hidden, swapped in one step, with `manifest.json` of what belongs to it.

On Linux the hidden folder and the visible one change places by one system call, renameat2 with RENAME_EXCHANGE; a
process killed at any moment leaves the old results or the new. Elsewhere, and of the folder that a program works in, a
mount point, and one whose parent cannot be written to, files are replaced one by one, the manifest last, and a reader
refuses what does not agree with it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

from bayescal._core.as_json import write_json
from bayescal._core.atomic_file import left_behind, sha256_of, to_disk, why
from bayescal._core.errors import InputError, NotDrawn
from bayescal._core.json_shape import read_json

MANIFEST = "manifest.json"
CHANNELS = "channels.json"  # of a unit, whose channels have each a folder of its own
CALIBRATION = "calibration.nc"  # of the structure that is shown
AVERAGED = "averaged.nc"  # the calibration averaged over structures, beside that of the one shown
SCHEMA = "bayescal.manifest/1"
AGAIN = "Take a copy of the whole folder, or calibrate again"
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


class Manifest(TypedDict):
    """What manifest.json holds; `files` with their SHA-256."""

    schema: str
    identity: str
    calibration: str | None
    files: dict[str, str]


def folders_of(names: Iterable[str]) -> dict[str, str]:
    """A folder's name for each channel: its own, without what a file system may not take."""
    found: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip("._") or "channel"
        taken, folder, number = set(found.values()), plain, 2
        while folder in taken:
            folder, number = f"{plain}_{number}", number + 1
        found[name] = folder
    return found


def channel_folders(folder: Path) -> list[str]:
    """Names of the folders of a unit's channels, in the one that its results are in."""
    listed = folder / CHANNELS
    try:
        names = [c["folder"] for c in read_json(listed)["channels"].values()]
        if strange := [n for n in names if not (isinstance(n, str) and is_inside(n))]:
            raise ValueError(f"{strange[0]!r} is no folder in it")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{listed} cannot be read ({error}): calibrate again") from None
    return names


def is_inside(name: str) -> bool:
    """Whether a name that stands in a file is that of something in the file's own folder, on any system."""
    return name not in ("", ".", "..") and not set(name) & set("/\\:\0")


@contextmanager
def whole_folder(
    folder: Path, calibration: str | None = None, *, more: bool = False
) -> Iterator[Path]:
    """A hidden folder to write to, whose files take their place in `folder` in one step.

    What else stands in `folder` stays, but for the unchanged results of a run before. The same holds in folders that
    are made in the hidden one, each with a manifest of its own (`list_files`); one that ends empty is not there.

    Args:
        folder: an existing one.
        calibration: identity of the calibration that the files are of; None: as a manifest written inside says.
        more: whether results that stand there stay, and what is written belongs to them.

    Raises:
        InputError: it cannot be written, or there is no room; the folder is as it was.
    """
    visible = Path(folder).resolve()
    parent = visible.parent if os.access(visible.parent, os.W_OK) else visible
    for left in left_behind(parent / visible.name):
        shutil.rmtree(left, ignore_errors=True)
    hidden = parent / f".{visible.name}.{os.getpid()}.partial"
    shutil.rmtree(hidden, ignore_errors=True)
    try:
        hidden.mkdir()
        if more:
            _link_results(visible, hidden)
        yield hidden
        list_files(hidden, calibration)
        _take_its_place(hidden, visible)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be written: {why(error)}") from error
    except InputError as error:  # of a file in it, which the user knows by its place
        raise InputError(str(error).replace(str(hidden), str(folder)), error.problems) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


@contextmanager
def drawing(what: str) -> Iterator[None]:
    """Pictures and pages, made once the result that they show is written.

    Raises:
        NotDrawn: they cannot be, whatever the reason: a font, LaTeX, the library that draws, a full disk.
    """
    try:
        yield
    except Exception as error:
        raise NotDrawn(what, error) from error


def _link_results(visible: Path, hidden: Path) -> None:
    """Bring the results that stand in a folder, and in those in it, to the one that takes its place."""
    inner = (p for p in visible.iterdir() if p.is_dir() and not p.is_symlink())
    for place in (visible, *inner):
        for name in sorted(_gone(place)):
            there = hidden / place.relative_to(visible) / name
            there.parent.mkdir(exist_ok=True)
            _link(place / name, there)


def files_of(folder: Path) -> dict[str, str]:
    """What belongs to the results in a folder, name → SHA-256; nothing where there is no manifest.

    Raises:
        InputError: the manifest cannot be read.
    """
    return {} if not (folder / MANIFEST).is_file() else _manifest(folder)["files"]


def refuse_mixed(folder: Path, *names: str) -> None:
    """Files that do not belong to the results of their folder, if it has a manifest.

    Args:
        folder: which may have one.
        names: of the files asked for; none: all that are there.

    Raises:
        InputError: a file is another than the manifest lists.
    """
    listed = {n: d for n, d in files_of(folder).items() if not names or n in names}
    for name, digest in listed.items():
        if (folder / name).is_file() and sha256_of(folder / name) != digest:
            raise InputError(
                f"{folder / name} is not the file that {MANIFEST} beside it lists: it was changed, or comes "
                f"from another run, and the files of {folder} do not belong together. {AGAIN}"
            )


def _manifest(folder: Path) -> Manifest:
    try:
        data = read_json(folder / MANIFEST, Manifest)
        if data["schema"] != SCHEMA or data["identity"] != _identity(data["files"]):
            raise ValueError("it is not as it was written")
        for name in data["files"]:
            if not is_inside(name):
                raise ValueError(f"it lists {name!r}, which is no file of this folder")
        return data
    except (OSError, ValueError) as error:
        raise InputError(
            f"{folder / MANIFEST} cannot be used ({type(error).__name__}: {error}). {AGAIN}"
        ) from None


def list_files(folder: Path, calibration: str | None) -> None:
    """Write the manifest of the files that stand in a folder, and have all of them put on the disk.

    Args:
        folder: whose files belong together.
        calibration: identity of the calibration that they are of; None: as a manifest that stands there says.

    Raises:
        OSError: they cannot be written.
        InputError: the manifest that stands there cannot be read.
    """
    inner = folder / MANIFEST
    if calibration is None and inner.is_file():
        calibration = _manifest(folder)["calibration"]
    paths = sorted(p for p in folder.iterdir() if p.is_file() and p != inner)
    files = {p.name: sha256_of(p) for p in paths}
    data = {
        "schema": SCHEMA,
        "identity": _identity(files),
        "calibration": calibration,
        "files": files,
    }
    write_json(data, inner)
    for path in (*paths, inner, folder):
        to_disk(path)


def _identity(files: dict[str, str]) -> str:
    told = "".join(f"{digest}  {name}\n" for name, digest in sorted(files.items()))
    return hashlib.sha256(told.encode()).hexdigest()


def _gone(folder: Path) -> set[str]:
    """What another run replaces: results as the run before left them."""
    try:
        files = files_of(folder)
    except InputError:
        files = {}
    same = {n for n, d in files.items() if (folder / n).is_file() and sha256_of(folder / n) == d}
    return {*same, MANIFEST} if same else set()


def _take_its_place(hidden: Path, visible: Path) -> None:
    places = [*(p.name for p in hidden.iterdir() if p.is_dir()), "."]
    new = {place: {p.name for p in (hidden / place).iterdir()} for place in places}
    for entry in (hidden / place / name for place in places for name in new[place]):
        there = visible / entry.relative_to(hidden)
        if there.is_symlink() or there.is_file() if entry.is_dir() else there.is_dir():
            stands = "a file or a link" if entry.is_dir() else "a folder"
            raise InputError(
                f"{there} cannot be written: {stands} stands in its place. Move it, or choose another --out"
            )
    settled = {place: new[place] | _gone(visible / place) for place in places}
    stays = hidden.parent == visible or visible.is_mount() or Path.cwd().is_relative_to(visible)
    if sys.platform == "linux" and not stays:
        for place in places:
            _complete(hidden / place, visible / place, settled[place])
        if _swapped(hidden, visible):
            return
    for place in places:
        (visible / place).mkdir(exist_ok=True)
        for name in settled[place] - new[place]:
            (visible / place / name).unlink(missing_ok=True)
        for name in sorted(new[place] - {*places}, key=lambda n: n == MANIFEST):
            os.replace(hidden / place / name, visible / place / name)
        _remove_if_empty(visible / place)


def _complete(hidden: Path, visible: Path, settled: set[str]) -> None:
    """Bring what stays of a folder to the one that takes its place."""
    if visible.is_dir():
        for entry in visible.iterdir():
            if entry.name not in settled:
                _carry(entry, hidden / entry.name)
        shutil.copystat(visible, hidden)
    _remove_if_empty(hidden)


def _remove_if_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()


def _swapped(hidden: Path, visible: Path) -> bool:
    """Whether two folders have changed places, as most file systems of Linux can have them do."""
    names = AT_FDCWD, os.fsencode(hidden), AT_FDCWD, os.fsencode(visible)
    exchange = getattr(ctypes.CDLL(None), "renameat2", None)
    return exchange is not None and exchange(*names, RENAME_EXCHANGE) == 0


def _carry(entry: Path, to: Path) -> None:
    """A file or folder of the user's own, by hard link, or copied where there are none."""
    if entry.is_dir() and not entry.is_symlink():
        shutil.copytree(entry, to, symlinks=True, copy_function=_link)
    else:
        _link(entry, to)


def _link(entry: str | Path, to: str | Path) -> None:
    try:
        os.link(entry, to, follow_symlinks=False)
    except OSError:
        shutil.copy2(entry, to, follow_symlinks=False)
