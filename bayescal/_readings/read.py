"""`read`: files in, measurements out, or a refusal that says where and what to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bayescal._core.errors import InputError
from bayescal._logs.open_log import LOG_FORMATS
from bayescal._readings.column import MAY_BE_EMPTY, NominalScale, Source
from bayescal._readings.column_conversion import ConvertedColumns, convert_columns
from bayescal._readings.column_matching import InstrumentLike, ReadOptions, refuse_unused_units
from bayescal._readings.csv_reader import open_csv
from bayescal._readings.raw_table import FORMATS, Table, bytes_text
from bayescal._readings.unit_parsing import STANDARD_GRAVITY

if TYPE_CHECKING:
    from bayescal._readings.measurements import Measurements

MAX_BYTES = 2_000_000_000
_PICKLES = (".pkl", ".pickle", ".npy", ".npz", ".joblib")


def read(
    path_or_paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
    nominal_scale: NominalScale | None = None,
    allow_one_temperature: bool = False,
    max_bytes: int = MAX_BYTES,
) -> Measurements:
    """Read readings of an instrument from one file or several: CSV, Parquet or NetCDF, or logs.

    Headers read `name [unit]`; lines that begin with # may stand above a CSV's header. Columns are
    converted to the instrument's units, and rows keep their order. Where several files have no
    column `run`, each is a run named after its file. A column that the instrument does not know is
    kept in base units if it has a unit, and otherwise left out with a flag. Of a log (PX4 .ulg,
    ArduPilot .bin, ROS .bag, .mcap, .db3) only the channels that `columns` names are read.

    Args:
        path_or_paths: the files.
        instrument: whose readings they are.
        columns: our name → the file's, where they differ: {"output": "gyro_x"}.
        units: the file's name (or ours) → unit, where the header has none or a wrong one.
        local_gravity: m/s², for columns in m/s²; internal accelerations are in local g.
        nominal_scale: how a raw output (V, Hz) becomes the instrument's, in place of its own.
        allow_one_temperature: accept one temperature, as for a prediction.
        max_bytes: most that all files together may hold.

    Raises:
        InputError: a file, a column, a unit or a cell cannot be used; the message names file, row
            and column, what was read, what was expected, and what to do.
    """
    paths = [path_or_paths] if isinstance(path_or_paths, str | Path) else list(path_or_paths)
    paths = [Path(path) for path in paths]
    names = check_files(paths, max_bytes)
    asked = tuple((columns or {}).values())
    tables = [_open(path, name, max_bytes, asked) for path, name in zip(paths, names, strict=True)]
    options = ReadOptions(columns or {}, units or {}, local_gravity, nominal_scale)
    refuse_unused_units(tables, options)
    parts = [convert_columns(table, instrument, options) for table in tables]
    if len(tables) > 1:
        _label_runs(tables, parts, _runs(paths))
    joined = parts[0] if len(parts) == 1 else _join(tables, parts)
    joined = replace(joined, flags=[*joined.flags, *_equal_contents(tables)])

    from bayescal._readings.measurements import assemble  # after what is refused: it needs a second

    sources = tuple(Source(table.file, table.sha256, table.rows) for table in tables)
    return assemble(
        tables,
        joined,
        instrument,
        sources=sources,
        allow_one_temperature=allow_one_temperature,
    )


def check_files(paths: Sequence[Path], max_bytes: int = MAX_BYTES) -> list[str]:
    """Look at the files before anything is opened; what messages call them.

    Raises:
        InputError: no file, one twice, one that is not there or is no file, or all are too large.
    """
    names = _names(paths)
    _refuse_large(paths, names, max_bytes)
    return names


def _names(paths: Sequence[Path]) -> list[str]:
    """What messages call the files: the name, or the whole path where two have the same name.

    Raises:
        InputError: no file, or one twice.
    """
    if not paths:
        raise InputError("no file was given to read: give at least one")
    for path, count in Counter(path.resolve() for path in paths).items():
        if count > 1:
            raise InputError(f"{path.name!r} was given {count} times: give each file once")
    shared = Counter(path.name for path in paths)
    return [path.name if shared[path.name] == 1 else str(path) for path in paths]


def _refuse_large(paths: Sequence[Path], names: Sequence[str], max_bytes: int) -> None:
    """Look at the sizes before anything is opened.

    Raises:
        InputError: a file is not there or is no file, or all are too large.
    """
    total = 0
    for path, name in zip(paths, names, strict=True):
        try:
            size = path.stat().st_size
        except OSError as error:
            raise InputError(
                f"{str(path)!r} cannot be read: {error.strerror or error}. Check the name and the "
                "folder"
            ) from error
        if not path.is_file():
            raise InputError(
                f"{str(path)!r} is not a file: name a file, or all files of the folder"
            )
        total += size
        if total > max_bytes:
            held = (
                f"holds {bytes_text(size)}"
                if size > max_bytes
                else f"brings the files to {bytes_text(total)}"
            )
            raise InputError(
                f"{name!r} {held}, the limit is {bytes_text(max_bytes)}, and nothing was loaded. "
                "Average the readings, read fewer files, or raise max_bytes"
            )


def _open(path: Path, name: str, max_bytes: int, asked: Sequence[str]) -> Table:
    """Open a file in the format that its suffix names.

    Raises:
        InputError: another suffix, or a file that is not what its suffix says.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS and suffix not in LOG_FORMATS:
        never = (
            "Pickled objects are never read, because they can run code. "
            if suffix in _PICKLES
            else ""
        )
        raise InputError(
            f"{name!r}: {suffix or 'a file without a suffix'!r} cannot be read. {never}"
            f"Give one of {', '.join((*FORMATS, *LOG_FORMATS))}"
        )
    try:
        if not path.stat().st_size:
            raise InputError(
                f"{name!r} is empty (0 bytes): a header and rows of readings were expected"
            )
        if suffix == ".csv":
            return open_csv(path, name)
        from bayescal._readings.file_formats import open_log, open_netcdf, open_parquet

        if suffix in LOG_FORMATS:
            return open_log(path, name, asked)
        return (open_parquet if suffix == ".parquet" else open_netcdf)(path, name, max_bytes)
    except OSError as error:
        raise InputError(
            f"{str(path)!r} cannot be read: {error.strerror or error}. Check that it may be read"
        ) from error


def _runs(paths: Sequence[Path]) -> list[str]:
    """A run's label for each file: its stem, with folder or number where that is not enough."""
    stems = [path.stem for path in paths]
    if len(set(stems)) < len(stems):
        with_folder = [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
        repeated = Counter(stems)
        stems = [w if repeated[s] > 1 else s for s, w in zip(stems, with_folder, strict=True)]
    labels: list[str] = []
    for stem in stems:
        label, number = stem, 2
        while label in labels:
            label, number = f"{stem} ({number})", number + 1
        labels.append(label)
    return labels


def _label_runs(
    tables: Sequence[Table], parts: Sequence[ConvertedColumns], labels: Sequence[str]
) -> None:
    """Give the files without a column `run` a run of their own, and say which runs span files."""
    own = [set(part.values["run"]) if "run" in part.values else set() for part in parts]
    named = set().union(*own)
    for table, part, label in zip(tables, parts, labels, strict=True):
        if "run" not in part.values:
            label = f"file {label}" if label in named else label
            part.values["run"] = np.full(table.rows, label, dtype=object)
            part.units["run"] = None
    seen: dict[str, str] = {}
    for table, part, runs in zip(tables, parts, own, strict=True):
        for run in sorted(runs):
            if run in seen:
                part.flags.append(
                    f"run {run!r} of {table.file} is taken as the one of {seen[run]}, continued"
                )
            seen.setdefault(run, table.file)


def _join(tables: Sequence[Table], parts: Sequence[ConvertedColumns]) -> ConvertedColumns:
    """Files one after the other.

    Raises:
        InputError: labels in some files only, or one column in two dimensions.
    """
    joined = ConvertedColumns(flags=[flag for part in parts for flag in part.flags])
    joined.filled = set.intersection(*(part.filled for part in parts))
    units = {name: unit for part in parts for name, unit in part.units.items()}
    for name, unit in units.items():
        have = [name in part.values for part in parts]
        with_it, without = (
            tables[have.index(True)].file,
            None if all(have) else tables[have.index(False)].file,
        )
        for table, part in zip(tables, parts, strict=True):
            if part.units.get(name, unit) != unit:
                raise InputError(
                    f"column {name!r} is in {part.units[name]} in {table.file!r} and in {unit} in "
                    "another file: give it one kind of unit, or rename one"
                )
        if without and unit is None:
            raise InputError(
                f"{without!r} lacks the column {name!r} that {with_it!r} has: label every file, or "
                "none"
            )
        if without and name == MAY_BE_EMPTY:
            joined.flags.append(f"{without}: no {name!r}: its readings belong to no cell (a ramp)")
        elif without:
            joined.flags.append(f"column {name!r} left out: {with_it} has it, {without} has not")
            continue
        empty = [np.full(table.rows, np.nan) for table in tables]
        joined.values[name] = np.concatenate(
            [p.values.get(name, e) for p, e in zip(parts, empty, strict=True)]
        )
        joined.units[name] = unit
    return joined


def _equal_contents(tables: Sequence[Table]) -> list[str]:
    first: dict[str, str] = {}
    found = []
    for table in tables:
        if table.sha256 in first:
            found.append(
                f"{table.file} has the same content as {first[table.sha256]}: the same readings "
                "twice?"
            )
        first.setdefault(table.sha256, table.file)
    return found
