"""Atomic writing of result folders: files are written to a hidden subfolder, then moved, `manifest.json` last.

Files that do not match the manifest are rejected, so that a result moved in part by a killed process is never used.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bayescal._core.atomic_file import compute_sha256, explain_error, list_leftovers
from bayescal._core.errors import InputError, NotDrawn
from bayescal._core.json_data import read_json, validate, write_json

MANIFEST = "manifest.json"
CHANNELS = "channels.json"  # of a device, whose channels have a folder each
CALIBRATION = "calibration.nc"  # calibration of the most probable structure
AVERAGED = "averaged.nc"  # calibration averaged over structures
SCHEMA = "bayescal.manifest/2"
REPAIR_ADVICE = "Use a backup of the whole folder, or calibrate again"


def name_folders(names: Iterable[str]) -> dict[str, str]:
    """Return channel → folder name: unique, without characters that file systems may reject."""
    folders: dict[str, str] = {}
    for name in names:
        base_name = re.sub(r"[^\w.-]+", "_", name).strip("._") or "channel"
        used_names, folder, number = set(folders.values()), base_name, 2
        while folder in used_names:
            folder, number = f"{base_name}_{number}", number + 1
        folders[name] = folder
    return folders


def channel_folders(folder: Path) -> list[str]:
    """Return the names of the channels' subfolders; raise InputError if channels.json cannot be read."""
    file = folder / CHANNELS
    try:
        names = [c["folder"] for c in read_json(file)["channels"].values()]
        if invalid_names := [n for n in names if not (isinstance(n, str) and is_inside(n))]:
            raise ValueError(f"{invalid_names[0]!r} is not the name of a folder in it")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file} cannot be read ({error}): calibrate again") from None
    return names


def is_inside(name: str) -> bool:
    """Return whether a name read from a file is a file name without a path, on any operating system."""
    return name not in ("", ".", "..") and not set(name) & set("/\\:\0")


@contextmanager
def replace_folder(folder: Path, *, keep_results: bool = False) -> Iterator[Path]:
    """Yield a hidden folder to write to; move its files to `folder` once all are written.

    Unmodified results of an earlier run are removed from `folder`; other files are kept. The same applies to
    subfolders, each with its own manifest; a subfolder that is then empty is removed.

    Args:
        folder: an existing folder.
        keep_results: keep the results of the earlier run, and add the new files to its manifest.

    Raises:
        InputError: the folder cannot be written, or the disk is full; its files are unchanged.
    """
    visible = Path(folder).resolve()
    hidden = visible / f".results.{os.getpid()}.partial"
    try:
        for leftover in (hidden, *list_leftovers(visible / "results")):
            shutil.rmtree(leftover, ignore_errors=True)
        visible.mkdir(exist_ok=True)
        hidden.mkdir()
        yield hidden
        _move_files(hidden, visible, keep_results)
    except OSError as error:
        raise InputError(f"folder {folder} cannot be written: {explain_error(error)}") from error
    except InputError as error:  # of a file in it, which the user knows by its place
        raise InputError(str(error).replace(str(hidden), str(folder)), error.problems) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


@contextmanager
def guard_drawing(subject: str) -> Iterator[None]:
    """Convert any exception raised in the `with` block, which draws `subject`, to NotDrawn.

    Raises:
        NotDrawn: for any cause: a font, LaTeX, Matplotlib, a full disk.
    """
    try:
        yield
    except Exception as error:
        raise NotDrawn(subject, error) from error


def read_hashes(folder: Path) -> dict[str, str]:
    """Return the files listed in a folder's manifest, name → SHA-256; {} without a manifest.

    Raises:
        InputError: the manifest cannot be read.
    """
    manifest = folder / MANIFEST
    if not manifest.is_file():
        return {}
    try:
        hashes = validate(read_json(manifest)["files"], dict[str, str])
        for name in hashes:
            if not is_inside(name):
                raise ValueError(f"it lists {name!r}, which is not a file of this folder")
        return hashes
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{manifest} cannot be used: {error}. {REPAIR_ADVICE}") from None


def refuse_mixed(folder: Path, *names: str) -> None:
    """Raise InputError if files (`names`, or all) differ from their hashes in the folder's manifest."""
    hashes = {n: d for n, d in read_hashes(folder).items() if not names or n in names}
    for name, digest in hashes.items():
        if (folder / name).is_file() and compute_sha256(folder / name) != digest:
            raise InputError(
                f"{folder / name} differs from its SHA-256 in {MANIFEST}: it was changed, or comes from "
                f"another run, so that the files of {folder} do not belong together. {REPAIR_ADVICE}"
            )


def _find_unmodified(folder: Path) -> dict[str, str]:
    """Return the result files in a folder that still match its manifest, name → SHA-256; {} if it is unreadable."""
    try:
        hashes = read_hashes(folder)
    except InputError:
        return {}
    present_hashes = {n: d for n, d in hashes.items() if (folder / n).is_file()}
    return {n: d for n, d in present_hashes.items() if compute_sha256(folder / n) == d}


def _move_files(hidden: Path, visible: Path, keep_results: bool) -> None:
    """Move all files to the visible folder, manifests last; remove earlier results, unless `keep_results`."""
    subfolders = [*(p.name for p in hidden.iterdir() if p.is_dir()), "."]
    for entry in (e for subfolder in subfolders for e in (hidden / subfolder).iterdir()):
        path = visible / entry.relative_to(hidden)
        if path.is_symlink() or path.is_file() if entry.is_dir() else path.is_dir():
            obstacle = "a file or a link" if entry.is_dir() else "a folder"
            message = f"{path} cannot be written: {obstacle} of that name exists. Move it, or choose another --out"
            raise InputError(message)
    manifests = {p: _write_manifest(hidden / p, visible / p, keep_results) for p in subfolders}
    for subfolder, (new_names, obsolete_names) in manifests.items():
        source, target = hidden / subfolder, visible / subfolder
        target.mkdir(exist_ok=True)
        for name in new_names:
            os.replace(source / name, target / name)
        for name in obsolete_names:
            (target / name).unlink()
        if not any(target.iterdir()):
            target.rmdir()


def _write_manifest(source: Path, target: Path, keep_results: bool) -> tuple[list[str], list[str]]:
    """Write a manifest of the new files; return the names of files to move, manifest last, and of files to remove."""
    paths, old = sorted(p for p in source.iterdir() if p.is_file()), _find_unmodified(target)
    new = {p.name: compute_sha256(p) for p in paths}
    if not new:
        return [], [] if keep_results else [*old, *[MANIFEST] * bool(old)]
    write_json({"schema": SCHEMA, "files": (old if keep_results else {}) | new}, source / MANIFEST)
    return [*new, MANIFEST], [] if keep_results else [*(old.keys() - new.keys())]
