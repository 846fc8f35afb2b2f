"""Folders of results of one run: written to a hidden subfolder, then moved, with their `manifest.json` last.

A reader refuses files that do not agree with the manifest, so that files of a process killed while moving them are
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
from bayescal._core.atomic_file import flush, list_leftovers, sha256_of, write_advice
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
    """Content of manifest.json."""

    schema: str
    files: dict[str, str]  # name → SHA-256
    identity: str = ""  # this and the next of bayescal.manifest/1
    calibration: str | None = None


def folders_of(names: Iterable[str]) -> dict[str, str]:
    """Name a folder for each channel, without characters that a file system may not accept."""
    folders: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip("._") or "channel"
        used, folder, number = set(folders.values()), plain, 2
        while folder in used:
            folder, number = f"{plain}_{number}", number + 1
        folders[name] = folder
    return folders


def channel_folders(folder: Path) -> list[str]:
    """Return the names of the folders of a unit's channels, in the folder of its results."""
    listed = folder / CHANNELS
    try:
        names = [c["folder"] for c in read_json(listed)["channels"].values()]
        if strange := [n for n in names if not (isinstance(n, str) and is_inside(n))]:
            raise ValueError(f"{strange[0]!r} is no folder in it")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{listed} cannot be read ({error}): calibrate again") from None
    return names


def is_inside(name: str) -> bool:
    """Return whether a name in a file is of an entry in the file's own folder, on any system."""
    return name not in ("", ".", "..") and not set(name) & set("/\\:\0")


@contextmanager
def whole_folder(folder: Path, *, leaving: bool = False) -> Iterator[Path]:
    """Yield a hidden folder to write to, whose files are moved to `folder` once all are written.

    Other files in `folder` stay, except the unchanged results of a run before. The same holds in folders that are made
    in the hidden one, each with a manifest of its own; one that remains empty is removed.

    Args:
        folder: an existing one.
        leaving: whether the results there stay, and the new files belong to them.

    Raises:
        InputError: it cannot be written, or there is no room; the folder is as it was.
    """
    visible = Path(folder).resolve()
    hidden = visible / f".results.{os.getpid()}.partial"
    try:
        for leftover in (hidden, *list_leftovers(visible / "results")):
            shutil.rmtree(leftover, ignore_errors=True)
        visible.mkdir(exist_ok=True)
        hidden.mkdir()
        yield hidden
        _move(hidden, visible, leaving)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be written: {write_advice(error)}") from error
    except InputError as error:  # of a file in it, which the user knows by its place
        raise InputError(str(error).replace(str(hidden), str(folder)), error.problems) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


@contextmanager
def drawing(what: str) -> Iterator[None]:
    """Convert any exception of drawing to NotDrawn; the result that is drawn is written before.

    Raises:
        NotDrawn: they cannot be, whatever the reason: a font, LaTeX, the library that draws, a full disk.
    """
    try:
        yield
    except Exception as error:
        raise NotDrawn(what, error) from error


def files_of(folder: Path) -> dict[str, str]:
    """Return the files of the results in a folder, name → SHA-256; {} where there is no manifest.

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
    """Raise InputError for files (those named, or all) that are others than the manifest of their folder lists."""
    listed = {n: d for n, d in files_of(folder).items() if not names or n in names}
    for name, digest in listed.items():
        if (folder / name).is_file() and sha256_of(folder / name) != digest:
            raise InputError(
                f"{folder / name} is not the file that {MANIFEST} beside it lists: it was changed, or comes "
                f"from another run, and the files of {folder} do not belong together. {AGAIN}"
            )


def _results(folder: Path) -> dict[str, str]:
    """Return the unchanged files of a run before, name → SHA-256."""
    try:
        listed = files_of(folder)
    except InputError:
        return {}
    present = {n: d for n, d in listed.items() if (folder / n).is_file()}
    return {n: d for n, d in present.items() if sha256_of(folder / n) == d}


def _move(hidden: Path, visible: Path, keep_results: bool) -> None:
    """Move the files to their place, each manifest last; remove results of a run before, unless `keep_results`."""
    places = [*(p.name for p in hidden.iterdir() if p.is_dir()), "."]
    for entry in (e for place in places for e in (hidden / place).iterdir()):
        path = visible / entry.relative_to(hidden)
        if path.is_symlink() or path.is_file() if entry.is_dir() else path.is_dir():
            stands = "a file or a link" if entry.is_dir() else "a folder"
            raise InputError(
                f"{path} cannot be written: {stands} stands in its place. Move it, or choose another --out"
            )
    manifests = {p: _list_files(hidden / p, visible / p, keep_results) for p in places}
    for place, (new, gone) in manifests.items():
        source, target = hidden / place, visible / place
        target.mkdir(exist_ok=True)
        for name in new:
            os.replace(source / name, target / name)
        for name in gone:
            (target / name).unlink()
        if not any(target.iterdir()):
            target.rmdir()


def _list_files(source: Path, target: Path, keep_results: bool) -> tuple[list[str], list[str]]:
    """Write the manifest, flush all files to disk; return names to move to `target`, manifest last, and to remove."""
    paths, old = sorted(p for p in source.iterdir() if p.is_file()), _results(target)
    new = {p.name: sha256_of(p) for p in paths}
    if not new:
        return [], [] if keep_results else [*old, *[MANIFEST] * bool(old)]
    write_json({"schema": SCHEMA, "files": (old if keep_results else {}) | new}, source / MANIFEST)
    for path in (*paths, source / MANIFEST, source):
        flush(path)
    return [*new, MANIFEST], [] if keep_results else [*(old.keys() - new.keys())]
