"""Readings of many devices of one type, read from files and split into one `Measurements` per device.

A file is checked and converted as a whole; a device's columns are slices of the file's. An error in the rows of one
device rejects that device only.
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


@ws.renamed(refused="rejection_reasons")
@dataclass(frozen=True, eq=False)
class Devices:
    """Readings of many devices of one type.

    `devices["A17"]` is the `Measurements` of one device; iteration yields those of each accepted device.

    Attributes:
        names: names of all devices, including rejected ones, in order of appearance.
        measurements: name → readings of each accepted device.
        rejection_reasons: name of a rejected device → error message.
    """

    names: tuple[str, ...]
    measurements: dict[str, bc.Measurements]
    rejection_reasons: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> bc.Measurements:
        """Return the readings of one device; raise InputError if it does not exist or was rejected."""
        if name in self.measurements:
            return self.measurements[name]
        names = ", ".join(self.names[:5]) + " …" * (len(self) > 5)
        fault = f"no readings; the {len(self)} devices are: {names}"
        raise bc.InputError(f"device {name!r}: {self.rejection_reasons.get(name, fault)}")

    def __iter__(self) -> Iterator[bc.Measurements]:
        return iter(self.measurements.values())

    def select(self, names: Sequence[str]) -> Devices:
        """Return the devices of these names, in the order of the names."""
        measurements = {n: self.measurements[n] for n in names if n in self.measurements}
        reasons = {n: self.rejection_reasons[n] for n in names if n in self.rejection_reasons}
        return Devices(tuple(names), measurements, reasons)

    def __repr__(self) -> str:
        return f"<{sum(map(len, self))} readings of {len(self)} devices, {len(self.rejection_reasons)} rejected>"

    @classmethod
    def of_files(cls, by_file: Mapping[Path, Devices]) -> Devices:
        """Combine the devices of several files; reject a device that is in more than one of them."""
        measurements, reasons = dict[str, bc.Measurements](), dict[str, str]()
        first_files = dict[str, Path]()
        for file, devices in by_file.items():
            measurements |= devices.measurements
            reasons = devices.rejection_reasons | reasons
            for name in devices.names:
                if (first := first_files.setdefault(name, file)) != file:
                    fault = f"is in several files, {first.name!r} and {file.name!r}"
                    reasons[name] = f"device {name!r} {fault}: combine its readings in one file"
        accepted = {name: m for name, m in measurements.items() if name not in reasons}
        return cls(tuple(first_files), accepted, reasons)

    @classmethod
    def of_measurements(
        cls, readings: Sequence[bc.Measurements] | Mapping[str, bc.Measurements]
    ) -> Devices:
        """Build devices devices by the keys of a mapping, unique labels in the column `device`, or numbers from 1.

        Raises:
            InputError: there are no measurements, or an entry is of another type.
        """
        entries = [*(readings.values() if isinstance(readings, Mapping) else readings)]
        if not entries or not all(isinstance(entry, bc.Measurements) for entry in entries):
            raise bc.InputError("fit_batch: give one Measurements per device, or paths of files")
        if isinstance(readings, Mapping):
            names = [*map(str, readings)]
        else:
            levels = [e.groups(DEVICE)[0] if e.has(DEVICE) else () for e in entries]
            names = [v[0] if len(v) == 1 else str(i + 1) for i, v in enumerate(levels)]
            if len({*names}) < len(names):
                names = [str(i + 1) for i in range(len(entries))]
        devices = dict(zip(names, entries, strict=True))
        reasons = {n: error for n, d in devices.items() if (error := _find_non_finite_value(d))}
        measurements = {name: device for name, device in devices.items() if name not in reasons}
        return cls(tuple(devices), measurements, reasons)


def _find_non_finite_value(device: bc.Measurements) -> str:
    """Return an error message for the first value that is not finite; "" if there is none."""
    for column in device.columns:
        is_numeric = device.unit(column) is not None and column != "temperature_point"
        if is_numeric and len(indices := np.flatnonzero(~np.isfinite(device[column]))):
            return f"reading {indices[0] + 1} of {column!r} is not a finite number: correct or remove it"
    return ""


def list_files(paths: Sequence[Path]) -> tuple[list[Path], dict[str, str]]:
    """List files of readings: the given files, and those in the given folders and their subfolders.

    Returns:
        The files; and relative path → reason for each entry of a folder that is not read.

    Raises:
        InputError: there is no file of readings.
    """
    files, skip_reasons = list[Path](), dict[str, str]()
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        for entry in sorted(path.rglob("*")):
            relative_path, suffix = entry.relative_to(path), entry.suffix.lower()
            is_hidden = [part[0] in "._" for part in relative_path.parts]
            if any(is_hidden[:-1]):
                continue
            name, is_readable = ws.to_printable(relative_path), os.access(entry, os.R_OK | os.X_OK)
            if is_hidden[-1]:
                skip_reasons[name] = "names that begin with . or _ are reserved for programs"
            elif entry.is_file() and suffix in ws.SUFFIXES:
                files.append(entry)
            elif entry.is_file():
                skip_reasons[name] = f"the suffix {suffix!r} is not supported"
            elif entry.is_symlink() or not (entry.is_dir() and is_readable):
                skip_reasons[name] = "a link to a folder, or neither a file nor a readable folder"
    if not files:
        reasons = "".join(f"; {name}: {text}" for name, text in list(skip_reasons.items())[:3])
        raise bc.InputError(
            f"no file of readings in {', '.join(map(str, paths))}: expected one of {', '.join(ws.SUFFIXES)}{reasons}"
        )
    return files, skip_reasons


@ws.renamed(needs="needed_columns")
def split_devices(
    paths: str | Path | Sequence[str | Path],
    instrument: bc.Instrument,
    *,
    needed_columns: Sequence[str] = (),
    **settings: Any,
) -> Devices:
    """Read files of many devices and split them by the column `device`; a file without this column is one device.

    Args:
        paths: CSV, Parquet or NetCDF files. Rows of different devices may be mixed; those of one are in time order.
        instrument: instrument type of the devices.
        needed_columns: additional columns that a model's effects use; a device without numbers in them is rejected.
        settings: columns, units, local_gravity, missing, decimal, nominal_scale, nominal_zero, date_order, ignore: as
            in `read`; columns={"device": "serial"} splits by the column `serial`.

    Returns:
        The devices. A device with an unusable cell, equal temperatures, decreasing time, or readings in several files
        is in `rejection_reasons` with its error message; the others are not affected.

    Raises:
        InputError: a file cannot be read, lacks a column, has a wrong unit, or has rows without a device.
    """
    files = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    options = ws.ReadOptions.of(instrument, **{k: v for k, v in settings.items() if v is not None})
    by_file = {p: read_devices(p, instrument, options, needed_columns) for p in files}
    return Devices.of_files(by_file)


def read_devices(
    path: Path, instrument: bc.Instrument, options: ws.ReadOptions, needed_columns: Sequence[str]
) -> Devices:
    """Read the devices of one file, or of a log's selected channels; a file without a column `device` is one device.

    Raises:
        InputError: as in `split_devices`.
    """
    table = ws.open_table(path, path.name, ws.MAX_BYTES, options.decimal, options.headers)
    problems, options = ws.Objections(), options.restrict_to(table)
    ws.check_options([table], options, problems)
    problems.refuse()
    additional_columns = _find_additional_columns(table, instrument, options, needed_columns)
    columns, output = (*instrument.columns, *additional_columns), ws.output_name(instrument)
    expected = ws.ExpectedColumns(instrument.name, columns, instrument.nominal_scale, output)
    file = ws.MatchedFile(table, expected, options, problems)
    problems.refuse()
    table, labels = file.table, np.full(table.rows, path.stem, dtype=object)
    if (position := file.positions.get(DEVICE)) is not None:
        labels = ws.load_whole(table, {position: False})[position].values
    codes, levels = pd.factorize(labels)
    if "" in levels:
        row = table.place(int(np.argmax(labels == "")))
        raise bc.InputError(f"{row} of {table.file!r} has no device: fill it in or remove the row")
    names = tuple(map(str, levels))
    values, units, rows, reasons = _convert_usable_rows(table, codes, names, expected, options)
    measurements, required = dict[str, bc.Measurements](), {c.name for c in columns if c.required}
    starts = np.flatnonzero(np.diff(codes[rows], prepend=-1))
    for start, end in itertools.pairwise([*starts, len(rows)]):
        name = names[codes[rows[start]]]
        device = {n: column[start:end] for n, column in values.items()}
        if error := _find_device_error(device, name, {"temperature"} <= required & device.keys()):
            reasons[name] = error
        else:
            source = Source(f"{table.file}, device {name}", table.sha256, int(end - start))
            measurements[name] = bc.Measurements(device, units, (source,), output=output)
    return Devices(names, measurements, reasons)


def _find_additional_columns(
    table: ws.Table, instrument: bc.Instrument, options: ws.ReadOptions, names: Iterable[str]
) -> tuple[bc.Column, ...]:
    """Return those columns `names` of a table, in base units, that the instrument does not declare."""
    headers = {h.name: h for h in table.headers}
    columns = []
    for name in [n for n in names if n not in ws.expected_columns(instrument)]:
        header = headers.get(options.columns.get(name, name))
        if header is not None and (unit := ws.unit_of(header, name, options)) is not None:
            columns.append(bc.Column(name, ws.base_unit(unit), required=False))
    return tuple(columns)


def _convert_usable_rows(
    table: ws.Table,
    codes: np.ndarray,
    names: Sequence[str],
    expected: ws.ExpectedColumns,
    options: ws.ReadOptions,
) -> tuple[Mapping[str, np.ndarray], Mapping[str, str | None], np.ndarray, dict[str, str]]:
    """Convert the rows of usable devices, sorted by device; return values, units, rows, rejected device → reason."""
    rows, reasons = np.argsort(codes, kind="stable"), dict[str, str]()
    while rows.size:
        problems, subtable = ws.Objections(), table.take(rows)
        with problems.collecting():
            converted = ws.convert_columns(subtable, expected, options)
            rows = rows if converted.kept_rows is None else rows[converted.kept_rows]
            return converted.values, converted.units, rows, reasons
        ws.Objections(p for p in problems if not p.rows).refuse()
        errors: dict[int, str] = {}
        for problem in problems:
            for index in problem.rows:
                row_problem = replace(problem, rows=(index,), places=(subtable.place(index),))
                errors[int(codes[rows[index]])] = str(row_problem)
        reasons |= {names[code]: error for code, error in errors.items()}
        rows = rows[~np.isin(codes[rows], list(errors))]
    return {}, {}, rows, reasons


def _find_device_error(columns: dict[str, np.ndarray], name: str, needs_temperatures: bool) -> str:
    """Return an error message if a device's time decreases, or all its temperatures are equal; "" otherwise."""
    file = f"device {name}"
    problems = [*find_single_temperature(columns, file)] if needs_temperatures else []
    problems += find_time_reversals(columns, lambda row: Place(f"reading {row + 1}", file))
    return str(problems[0]) if problems else ""
