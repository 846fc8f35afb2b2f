"""Readings of many devices of one type, one device's `Measurements` each; files split into them.

A file is checked and converted as a whole; a device's columns are a part of the file's. What is wrong with one device's
rows in a file refuses that device alone.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal import workshop as ws
from bayescal.workshop import Place, Source, find_single_temperature, find_time_reversals

DEVICE = "device"


@dataclass(frozen=True, eq=False)
class Devices:
    """Readings of many devices of one type.

    `devices["A17"]` is one device's `Measurements`; iterating gives them one at a time.

    Attributes:
        names: of all devices, in order of appearance, refused ones too.
        measurements: by name, of those that were let in.
        refused: name → why its rows cannot be used.
    """

    names: tuple[str, ...]
    measurements: dict[str, bc.Measurements]
    refused: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> bc.Measurements:
        """Return one device's readings; raise InputError if none is called so, or it was refused."""
        if name in self.measurements:
            return self.measurements[name]
        known = f"none is called so among the {len(self)}: {', '.join(self.names[:5])} …"
        raise bc.InputError(f"device {name!r}: {self.refused.get(name, known)}")

    def __iter__(self) -> Iterator[bc.Measurements]:
        return iter(self.measurements.values())

    def some(self, names: Sequence[str]) -> Devices:
        """Return some of the devices."""
        accepted = {n: self.measurements[n] for n in names if n in self.measurements}
        refused = {n: self.refused[n] for n in names if n in self.refused}
        return Devices(tuple(names), accepted, refused)

    def __repr__(self) -> str:
        count = sum(map(len, self))
        return f"<{count} readings of {len(self)} devices, {len(self.refused)} of them refused>"

    @classmethod
    def of_files(cls, by_file: Mapping[Path, Devices]) -> Devices:
        """Put the devices of files together; refuse one that stands in several: which readings count is not known."""
        measurements, refused = dict[str, bc.Measurements](), dict[str, str]()
        first_files = dict[str, Path]()
        for file, devices in by_file.items():
            measurements |= devices.measurements
            refused = devices.refused | refused
            for name in devices.names:
                if (first := first_files.setdefault(name, file)) != file:
                    refused[name] = (
                        f"device {name!r} stands in several files, {first.name!r} and {file.name!r}: put its readings "
                        "into one"
                    )
        accepted = {name: m for name, m in measurements.items() if name not in refused}
        return cls(tuple(first_files), accepted, refused)

    @classmethod
    def of_measurements(
        cls, readings: Sequence[bc.Measurements] | Mapping[str, bc.Measurements]
    ) -> Devices:
        """Return devices by their key, their label of column `device`, or their place.

        Raises:
            InputError: there is none, or an entry is of another type.
        """
        entries = [*(readings.values() if isinstance(readings, Mapping) else readings)]
        if not entries or not all(isinstance(entry, bc.Measurements) for entry in entries):
            raise bc.InputError("fit_batch: give measurements, one a device, or paths of files")
        if isinstance(readings, Mapping):
            names = [*map(str, readings)]
        else:
            levels = [e.groups(DEVICE)[0] if e.has(DEVICE) else () for e in entries]
            names = [v[0] if len(v) == 1 else str(i + 1) for i, v in enumerate(levels)]
            if len({*names}) < len(names):
                names = [str(i + 1) for i in range(len(entries))]
        by_name = dict(zip(names, entries, strict=True))
        bad = {name: why for name, device in by_name.items() if (why := _not_finite(device))}
        accepted = {name: device for name, device in by_name.items() if name not in bad}
        return cls(tuple(by_name), accepted, bad)


def _not_finite(device: bc.Measurements) -> str:
    """Return where a number is none; "" where all are (arrays made by hand were checked by no file reader)."""
    for column in device.columns:
        number = device.unit(column) is not None and column != "temperature_point"
        if number and len(bad := np.flatnonzero(~np.isfinite(device[column]))):
            return f"reading {bad[0] + 1} of {column!r} is no number: fill it in, or remove the reading"
    return ""


def files_of(paths: Sequence[Path]) -> tuple[list[Path], dict[str, str]]:
    """Return files, with those in folders and the folders in these, in order of their names; and what is not read.

    Returns:
        The files; what stands in a folder and is not read, by its place there, with the reason.

    Raises:
        InputError: no path holds a file of readings.
    """
    files, left_out = list[Path](), dict[str, str]()
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        for place in sorted(path.rglob("*")):
            inside, suffix = place.relative_to(path), place.suffix.lower()
            hidden = [part[0] in "._" for part in inside.parts]
            if any(hidden[:-1]):
                continue
            if hidden[-1]:
                left_out[ws.one_line(inside)] = "a name that begins with . or _ is a program's own"
            elif place.is_file() and suffix in ws.READ:
                files.append(place)
            elif place.is_file():
                left_out[ws.one_line(inside)] = f"{suffix or 'no suffix'} is no format that is read"
            elif (
                place.is_symlink() or not place.is_dir() or not os.access(place, os.R_OK | os.X_OK)
            ):
                left_out[ws.one_line(inside)] = "a link, no file, or a folder that cannot be read"
    if not files:
        first = "".join(f"; {name}: {why}" for name, why in list(left_out.items())[:3])
        raise bc.InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(ws.READ)} was expected{first}"
        )
    return files, left_out


def split_devices(
    paths: str | Path | Sequence[str | Path],
    instrument: bc.Instrument,
    *,
    needs: Sequence[str] = (),
    **how: Any,
) -> Devices:
    """Read files that hold many devices, split by the column `device`; a file without one is a device by itself.

    Args:
        paths: CSV, Parquet or NetCDF files. Devices in a file need not stand in order; their readings do.
        instrument: whose readings they are.
        needs: further columns that a model's effects use: a device that has no number there is refused.
        how: columns, units, local_gravity, missing, decimal, nominal_scale, nominal_zero, date_order, ignore, as of
            `read`; columns={"device": "serial"} splits by `serial`.

    Returns:
        The devices. Those with a cell that cannot be used, one temperature only, time that runs backwards, or readings
        in several files are in `refused`, each with its message; the others are not affected.

    Raises:
        InputError: a file cannot be read, lacks a column, has a wrong unit, or rows without a device.
    """
    files = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    options = ws.ReadOptions.of(instrument, **{k: v for k, v in how.items() if v is not None})
    by_file = {p: devices_of(p, instrument, options, needs) for p in files}
    return Devices.of_files(by_file)


def devices_of(
    path: Path,
    instrument: bc.Instrument,
    options: ws.ReadOptions,
    needs: Sequence[str] = (),
) -> Devices:
    """Read one file; without a column `device` it is a device called as the file; of a log, the channels named.

    Raises:
        InputError: as `split_devices`.
    """
    table = ws.open_table(path, path.name, ws.MAX_BYTES, options.decimal, options.headers)
    problems, options = ws.Objections(), options.of_file(table)
    ws.unused_options([table], options, problems)
    problems.refuse()
    columns = (*instrument.columns, *_further(table, instrument, options, needs))
    output = ws.output_name(instrument)
    expects = ws.ExpectedColumns(instrument.name, columns, instrument.nominal_scale, output)
    file = ws.MatchedFile(table, expects, options, problems)
    problems.refuse()
    table, labels = file.table, np.full(table.rows, path.stem, dtype=object)
    if (position := file.positions.get(DEVICE)) is not None:
        labels = ws.load_whole(table, {position: False})[position].values
    codes, levels = pd.factorize(labels)
    if "" in levels:
        where = table.place(int(np.argmax(labels == "")))
        raise bc.InputError(f"{where} of {table.file!r} names no device: fill it in, or remove it")
    names = tuple(map(str, levels))
    values, units, rows, refused = _convert_usable(table, codes, names, expects, options)
    by_name, needed = dict[str, bc.Measurements](), {c.name for c in columns if c.required}
    begin = np.flatnonzero(np.diff(codes[rows], prepend=-1))
    for first, end in itertools.pairwise([*begin, len(rows)]):
        name = names[codes[rows[first]]]
        device = {n: column[first:end] for n, column in values.items()}
        if why := _useless(device, name, "temperature" in needed and "temperature" in device):
            refused[name] = why
        else:
            source = Source(f"{table.file}, device {name}", table.sha256, int(end - first))
            by_name[name] = bc.Measurements(device, units, (source,), output=output)
    return Devices(names, by_name, refused)


def _further(
    table: ws.Table, instrument: bc.Instrument, options: ws.ReadOptions, needs: Iterable[str]
) -> tuple[bc.Column, ...]:
    """Return columns that effects need and the instrument does not know, in their base units."""
    headers = {h.name: h for h in table.headers}
    further = []
    for name in [n for n in needs if n not in ws.expected_columns(instrument)]:
        header = headers.get(options.columns.get(name, name))
        if header is not None and (unit := ws.unit_of(header, name, options)) is not None:
            further.append(bc.Column(name, ws.base_unit(unit), required=False))
    return tuple(further)


def _convert_usable(
    table: ws.Table,
    codes: np.ndarray,
    names: Sequence[str],
    expects: ws.ExpectedColumns,
    options: ws.ReadOptions,
) -> tuple[Mapping[str, np.ndarray], Mapping[str, str | None], np.ndarray, dict[str, str]]:
    """Convert columns of all usable devices; return values, units, rows, and why others are refused."""
    rows, refused = np.argsort(codes, kind="stable"), dict[str, str]()
    while rows.size:
        problems, some = ws.Objections(), table.take(rows)
        with problems.collecting():
            converted = ws.convert_columns(some, expects, options)
            rows = rows if converted.kept_rows is None else rows[converted.kept_rows]
            return converted.values, converted.units, rows, refused
        ws.Objections(p for p in problems if not p.rows).refuse()
        bad: dict[int, str] = {}
        for problem in problems:
            for index in problem.rows:
                in_row = replace(problem, rows=(index,), places=(some.place(index),))
                bad[int(codes[rows[index]])] = str(in_row)
        refused |= {names[code]: why for code, why in bad.items()}
        rows = rows[~np.isin(codes[rows], list(bad))]
    return {}, {}, rows, refused


def _useless(columns: dict[str, np.ndarray], name: str, warm: bool) -> str:
    """Return that a device has one temperature only, where it needs more, or time running backwards; "" otherwise."""
    file = f"device {name}"
    problems = [*find_single_temperature(columns, file)] if warm else []
    problems += find_time_reversals(columns, lambda row: Place(f"reading {row + 1}", file))
    return str(problems[0]) if problems else ""
