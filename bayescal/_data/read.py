"""Reading of measurements from files, with error messages that name the fault, its place and the remedy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

from bayescal._core.errors import InputError
from bayescal._core.quoting import to_printable
from bayescal._data.column import NominalScale
from bayescal._data.measurements import Measurements, measure_tables
from bayescal._data.read_options import InstrumentLike, ReadOptions, expected_columns, output_name
from bayescal._tables.open_table import MAX_BYTES, check_files, open_table
from bayescal._tables.raw_table import Objections, Table

Paths = str | Path | Sequence[str | Path]


@overload
def read(
    path_or_paths: Paths, instrument: InstrumentLike, *, outputs: None = None, **options: Any
) -> Measurements: ...
@overload
def read(
    path_or_paths: Paths, instrument: InstrumentLike, *, outputs: Sequence[str], **options: Any
) -> dict[str, Measurements]: ...
def read(  # pyright: ignore[reportInconsistentOverload]
    path_or_paths: Paths,
    instrument: InstrumentLike,
    *,
    outputs: Sequence[str] | None = None,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
    local_gravity: float | None = None,
    local_field: str | None = None,
    nominal_scale: NominalScale | str | None = None,
    nominal_zero: str | None = None,
    allow_one_temperature: bool = False,
    missing: str = "refuse",
    decimal: str = "",
    date_order: str = "",
    ignore: Sequence[str] = (),
    unwrap: Mapping[str, str] | None = None,
    begin: str | Mapping[str, str] = "",
    like: Measurements | None = None,
    max_bytes: int = MAX_BYTES,
) -> Measurements | dict[str, Measurements]:
    """Read readings of an instrument from one file or several: CSV, Parquet, NetCDF, Excel, MATLAB, or logs.

    Headers have the form `name [unit]`, or another unambiguous form ("Temp (°C)", "gyro_z_dps"), which a flag reports;
    a CSV header may be preceded by lines that begin with #. Columns are converted to the instrument's units, and rows
    keep their order. Dates, and times since 1970, become seconds since the first reading of all files; a date without a
    time zone is UTC. Each of several files without a column `run` is a run named after the file. A column that the
    instrument does not declare is kept in base units if it has a unit, else ignored with a flag. From a log (PX4 .ulg,
    ArduPilot .bin), only channels that `columns` or the instrument names are read.

    Args:
        path_or_paths: the files.
        instrument: the instrument that declares the columns.
        outputs: the file's names of several output channels of a device; each is read as the output without the others.
        columns: bayescal's name → the file's, if they differ: {"output": "gyro_x"}; a list, if files differ.
        units: the file's name (or bayescal's) → unit, if the header's is absent or wrong.
        local_gravity: m/s², for conversion of columns in m/s² to local g. By default standard gravity is assumed, and
            scale factors that depend on it have its uncertainty.
        local_field: magnitude of the magnetic field at the test site, for magnetometers, such as "48.2 uT".
        nominal_scale: raw output (V, Hz) per unit of output, in place of the instrument's value: "250 V/g".
        nominal_zero: raw output at zero input, such as "1.21 V".
        allow_one_temperature: accept readings at a single temperature, as for a prediction.
        missing: "refuse" files with missing readings, or "drop" their rows, which leaves gaps.
        decimal: decimal mark of text files, "." or ","; empty to detect it.
        date_order: order of month, day and year in dates such as 05/06/2026: "mdy", "dmy" or "ymd", or "hms" for times
            of day such as 10.11.12; empty to detect it from a day above 12.
        ignore: columns of the file to exclude.
        unwrap: the file's name (or bayescal's) → period of a counter that wraps around: {"time": "2^32us"},
            {"temperature": "256degC"}.
        begin: time of the first reading of a file without dates: a date, or a time on the clock of `like`, such as
            "9 days"; by file name for several files, or to replace dates: {"b.csv": "2026-05-13 10:14"}.
        like: earlier readings, such as those of a calibration, whose assignments of headers and nominal scale apply.
        max_bytes: limit on the size of all files together.

    Returns:
        The readings; for several outputs, a dictionary by output.

    Raises:
        InputError: a file, column, unit or cell cannot be used. The message names file, row and column, the fault, what
            was expected and the remedy; several problems are a list, also in the error's `problems`.
    """
    paths = [path_or_paths] if isinstance(path_or_paths, str | Path) else list(path_or_paths)
    paths = [Path(path) for path in paths]
    names = check_files(paths, max_bytes)
    options = ReadOptions.of(
        instrument,
        columns=columns or {},
        units=units or {},
        local_gravity=local_gravity,
        local_field=local_field,
        nominal_scale=nominal_scale or (like.scale if like else None),
        remembered=like.sources if like else (),
        nominal_zero=nominal_zero,
        missing=missing,
        decimal=decimal,
        date_order=date_order,
        ignore=ignore,
        unwrap=unwrap or {},
        begin=begin,
        epoch=like.since if like else None,
    )

    def read_one(options: ReadOptions) -> Measurements:
        problems, tables = Objections(), list[Table]()
        expected = (name for c in instrument.columns for name in (c.name, *c.also))
        names_wanted = (*options.headers, *expected)
        for path, name in zip(paths, names, strict=True):
            with problems.collecting():
                tables.append(open_table(path, name, max_bytes, options.decimal, names_wanted))
        labels, one_temperature = _make_run_labels(paths), allow_one_temperature
        return measure_tables(tables, instrument, options, one_temperature, labels, problems)

    if outputs is None:
        return read_one(options)
    if not outputs or len(set(outputs)) < len(outputs):
        raise InputError(f"outputs={list(outputs)}: name at least one channel, and each once")
    if (output := output_name(instrument)) in options.columns:
        raise InputError(f"{output}={options.columns[output]} and channels: give the channels only")
    for name in (expected_columns(instrument).keys() - {output}).intersection(outputs):
        raise InputError(
            f"{name!r} is not an output channel: {instrument.name!r} uses it as a covariate"
        )
    all_problems, readings = Objections(), dict[str, Measurements]()
    for name in outputs:
        columns, others = {**options.columns, output: name}, frozenset(outputs) - {name}
        with all_problems.collecting():
            readings[name] = read_one(replace(options, columns=columns, others=others))
    Objections(dict.fromkeys(all_problems)).refuse()
    return readings


def _make_run_labels(paths: Sequence[Path]) -> list[str]:
    """Return a run label for each file: its stem, with folder or number if it is not unique."""
    stems, labels = Counter(path.stem for path in paths), list[str]()
    for path in paths:
        folder = f"{path.resolve().parent.name}/" * (stems[path.stem] > 1)
        label = to_printable(f"{folder}{path.stem}")
        candidates = (label, *(f"{label} ({number})" for number in range(2, len(paths) + 1)))
        labels.append(next(text for text in candidates if text not in labels))
    return labels
