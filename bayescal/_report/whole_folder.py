"""A folder of results is one run's: written to a hidden folder in it, then moved, with `manifest.json` of it all last.

A reader refuses files that do not agree with the manifest: what a process left that was killed while it moved them is
never taken for results.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bayescal._core.as_json import write_json
from bayescal._core.atomic_file import left_behind, sha256_of, to_disk, why
from bayescal._core.errors import InputError, NotDrawn
from bayescal._core.json_shape import read_json

MANIFEST = "manifest.json"
CHANNELS = "channels.json"  # of a unit, whose channels have each a folder of its own
CALIBRATION = "calibration.nc"  # of the structure that is shown
AVERAGED = "averaged.nc"  # the calibration averaged over structures, beside that of the one shown
SCHEMA = "bayescal.manifest/2"
AGAIN = "Take a copy of the whole folder, or calibrate again"


@dataclass(frozen=True)
class Manifest:
    """What manifest.json holds."""

    schema: str
    files: dict[str, str]  # name → SHA-256
    identity: str = ""  # this and the next of bayescal.manifest/1
    calibration: str | None = None


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
def whole_folder(folder: Path, *, more: bool = False) -> Iterator[Path]:
    """A hidden folder to write to, whose files are moved to `folder` once all are written.

    What else stands in `folder` stays, but for the unchanged results of a run before. The same holds in folders that
    are made in the hidden one, each with a manifest of its own; one that ends empty is not there.

    Args:
        folder: an existing one.
        more: whether results that stand there stay, and what is written belongs to them.

    Raises:
        InputError: it cannot be written, or there is no room; the folder is as it was.
    """
    visible = Path(folder).resolve()
    hidden = visible / f".results.{os.getpid()}.partial"
    try:
        for left in (hidden, *left_behind(visible / "results")):
            shutil.rmtree(left, ignore_errors=True)
        visible.mkdir(exist_ok=True)
        hidden.mkdir()
        yield hidden
        _move(hidden, visible, more)
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


def files_of(folder: Path) -> dict[str, str]:
    """Return what belongs to the results in a folder, name → SHA-256; nothing where there is no manifest.

    Raises:
        InputError: the manifest cannot be read.
    """
    manifest = folder / MANIFEST
    if not manifest.is_file():
        return {}
    try:
        files = read_json(manifest, Manifest).files
        for name in files:
            if not is_inside(name):
                raise ValueError(f"it lists {name!r}, which is no file of this folder")
        return files
    except (OSError, ValueError) as error:
        raise InputError(f"{manifest} cannot be used: {error}. {AGAIN}") from None


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


def _results(folder: Path) -> dict[str, str]:
    """Return what a run before left and nobody changed, name → SHA-256."""
    try:
        listed = files_of(folder)
    except InputError:
        return {}
    there = {n: d for n, d in listed.items() if (folder / n).is_file()}
    return {n: d for n, d in there.items() if sha256_of(folder / n) == d}


def _move(hidden: Path, visible: Path, more: bool) -> None:
    """Move what is written to its place, each manifest last; results of a run before go, unless there is to be more."""
    places = [*(p.name for p in hidden.iterdir() if p.is_dir()), "."]
    for entry in (e for place in places for e in (hidden / place).iterdir()):
        there = visible / entry.relative_to(hidden)
        if there.is_symlink() or there.is_file() if entry.is_dir() else there.is_dir():
            stands = "a file or a link" if entry.is_dir() else "a folder"
            raise InputError(
                f"{there} cannot be written: {stands} stands in its place. Move it, or choose another --out"
            )
    manifests = {place: _list_files(hidden / place, visible / place, more) for place in places}
    for place, (new, gone) in manifests.items():
        source, target = hidden / place, visible / place
        target.mkdir(exist_ok=True)
        for name in new:
            os.replace(source / name, target / name)
        for name in gone:
            (target / name).unlink()
        if not any(target.iterdir()):
            target.rmdir()


def _list_files(source: Path, target: Path, more: bool) -> tuple[list[str], list[str]]:
    """Write the manifest of the files in a folder, and have all of them put on the disk.

    Returns:
        Names of the files to be moved to the folder `target`, the manifest last, and of those that go there.
    """
    paths, old = sorted(p for p in source.iterdir() if p.is_file()), _results(target)
    new = {p.name: sha256_of(p) for p in paths}
    if not new:
        return [], [] if more else [*old, *[MANIFEST] * bool(old)]
    write_json({"schema": SCHEMA, "files": (old if more else {}) | new}, source / MANIFEST)
    for path in (*paths, source / MANIFEST, source):
        to_disk(path)
    return [*new, MANIFEST], [] if more else [*(old.keys() - new.keys())]
