"""Files of many devices: those in folders, and what of these is not read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import bayescal as bc
from bayescal import workshop as ws


def files_of(paths: Sequence[Path]) -> tuple[list[Path], dict[str, str]]:
    """Return files, with those in folders and the folders in these, in order of their names; and what is not read.

    Returns:
        The files; what stands in a folder and is not read, by its place there, with the reason.

    Raises:
        InputError: a path is given twice, or holds no file of readings.
    """
    files, left_out = list[Path](), dict[str, str]()
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        unread = set[Path]()
        for place in sorted(path.rglob("*")):
            if not unread.isdisjoint(place.parents):
                continue
            if why := _why_not(place):
                unread.add(place)
                left_out[ws.one_line(place.relative_to(path))] = why
            elif place.is_file():
                files.append(place)
    if not files:
        first = "".join(f"; {name}: {why}" for name, why in list(left_out.items())[:3])
        raise bc.InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(ws.READ)} was expected{first}"
        )
    if len({p.resolve() for p in files}) < len(files):
        raise bc.InputError("a file of readings was given twice: give each file once")
    return files, left_out


def _why_not(path: Path) -> str:
    """Return why something in a folder is not read; "" for folders and files of readings."""
    if path.name[0] in "._":
        return "its name begins with . or _, as of what programs keep for themselves"
    if path.is_dir():
        readable = os.access(path, os.R_OK | os.X_OK) and not path.is_symlink()
        return "" if readable else "a link to a folder, or one that cannot be looked into"
    if not path.is_file():
        return "a link to nothing, a pipe or a device"
    suffix = path.suffix.lower()
    return (
        "" if suffix in ws.READ else f"{suffix or 'no suffix'} is none of the formats that are read"
    )
