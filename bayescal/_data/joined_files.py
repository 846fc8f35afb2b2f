"""Files one after the other, as the columns of one record: their runs told apart, their clocks made one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import ASSUMED_GRAVITY, MAY_BE_EMPTY, ConvertedColumns


def joined(parts: Sequence[ConvertedColumns], labels: Sequence[str]) -> ConvertedColumns:
    """Return the files' columns one after the other; files without a column `run` take `labels`.

    Raises:
        InputError: labels or dates stand in some files only, or one column has two dimensions.
    """
    if len(parts) == 1:
        return parts[0]
    _label_runs(parts, labels)
    whole = ConvertedColumns(tuple(table for part in parts for table in part.tables))
    whole.flags = [flag for part in parts for flag in part.flags]
    whole.filled = set.intersection(*(part.filled for part in parts))
    whole.beside = set().union(*(part.beside for part in parts))
    whole.origin = _on_one_clock(parts)
    for name, unit in {name: unit for part in parts for name, unit in part.units.items()}.items():
        for part in parts:
            if part.units.get(name, unit) != unit:
                raise InputError(
                    f"column {name!r} is in {part.units[name]} in {part.tables[0].file!r} and in {unit} in another "
                    "file: give it one kind of unit, or rename one"
                )
        with_it, without = _first_files(parts, [name in part.values for part in parts])
        if without and unit is None:
            raise InputError(
                f"{without!r} lacks the column {name!r} that {with_it!r} has: label every file, or none"
            )
        if without and name == MAY_BE_EMPTY:
            whole.flags.append(f"{without}: no {name!r}: its readings belong to no cell (a ramp)")
        elif without and name != ASSUMED_GRAVITY:
            whole.flags.append(f"column {name!r} left out: {with_it} has it, {without} has not")
            continue
        fill = 0.0 if name == ASSUMED_GRAVITY else np.nan
        missing = (np.full(table.rows, fill) for table in whole.tables)
        own = [p.values.get(name, none) for p, none in zip(parts, missing, strict=True)]
        whole.values[name], whole.units[name] = np.concatenate(own), unit
    first: dict[str, str] = {}
    for table in whole.tables:
        if (other := first.setdefault(table.sha256, table.file)) != table.file:
            same = f"{table.file} has the same content as {other}: the same readings twice?"
            whole.flags.append(same)
    return whole


def _label_runs(parts: Sequence[ConvertedColumns], labels: Sequence[str]) -> None:
    """Give the files without a column `run` a run of their own, and say which runs span files."""
    own = [set(part.values.get("run", ())) for part in parts]
    named, seen = set().union(*own), dict[str, str]()
    for part, label, runs in zip(parts, labels, own, strict=True):
        (table,) = part.tables
        if "run" not in part.values:
            label = f"file {label}" if label in named else label
            part.values["run"] = np.full(table.rows, label, dtype=object)
            part.units["run"] = None
        part.flags += [
            f"run {run!r} of {table.file} is taken as the one of {seen[run]}, continued"
            for run in sorted(runs & seen.keys())
        ]
        seen = dict.fromkeys(runs, table.file) | seen


def _first_files(
    parts: Sequence[ConvertedColumns], have: Sequence[bool]
) -> tuple[str | None, str | None]:
    """The first file that has something, and the first that has not."""
    first = {has: part.tables[0].file for part, has in reversed([*zip(parts, have, strict=True)])}
    return first.get(True), first.get(False)


def _on_one_clock(parts: Sequence[ConvertedColumns]) -> float | None:
    """Shift the times of files that count from dates to the earliest, which is returned; None without dates."""
    timed = [part for part in parts if "time" in part.values]
    origins = [part.origin for part in timed if part.origin is not None]
    if not origins:
        return None
    with_it, without = _first_files(timed, [part.origin is not None for part in timed])
    if without:
        raise InputError(
            f"{with_it!r} has dates in its column 'time', {without!r} has none: say when its first reading was taken, "
            f"--begin '{without}=2026-05-13 10:14:20', or read them one by one"
        )
    for part, origin in zip(timed, origins, strict=True):
        part.values["time"] = np.round(part.values["time"] + (origin - min(origins)), 6)
    return min(origins)
