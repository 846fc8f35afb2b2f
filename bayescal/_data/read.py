"""`read`: measurements from files, or an error that says where the fault is and what to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

from bayescal._core.errors import InputError
from bayescal._core.quoting import one_line
from bayescal._data.column import NominalScale
from bayescal._data.measurements import Measurements, measure_tables
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
)
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

    Headers read `name [unit]`, or as people write them ("Temp (°C)", "gyro_z_dps"), where that can be read in one
    way only, which a flag says; lines that begin with # may stand above a CSV's header. Columns are converted to the
    instrument's units, and rows keep their order. Dates, and counts since 1970, become seconds since the first reading
    of all files; a date without a zone counts as UTC. Where several files have no column `run`, each is a run named
    after its file. A column that the instrument does not know is kept in base units if it has a unit, and otherwise
    left out with a flag. Of a log (PX4 .ulg, ArduPilot .bin) only the channels are read that
    `columns` names, or that the instrument knows by name.

    Args:
        path_or_paths: the files.
        instrument: whose readings they are.
        outputs: the file's names of several channels of one unit: each is read as the output, the others left out.
        columns: our name → the file's, where they differ: {"output": "gyro_x"}; several, where files differ.
        units: the file's name (or ours) → unit, where the header has none or a wrong one.
        local_gravity: m/s², for columns in m/s²; internal accelerations are in local g. Where it is not given, standard
            gravity is taken, and scale factors that hang on it are as uncertain as that.
        local_field: magnitude of the magnetic field that magnetometers are turned in, such as "48.2 uT".
        nominal_scale: how a raw output (V, Hz) becomes the instrument's, in place of its own: "250 V/g".
        nominal_zero: the raw output at zero, such as "1.21 V".
        allow_one_temperature: accept one temperature, as for a prediction.
        missing: "refuse" files with missing readings, or "drop" the rows in which one is missing; they are gaps.
        decimal: "." or "," in the numbers of text files; empty where the file shows it.
        date_order: of month, day and year in dates such as 05/06/2026: "mdy", "dmy" or "ymd", or "hms" for times such
            as 10.11.12; empty where a day above 12 shows it.
        ignore: columns of the file that are left out.
        unwrap: the file's name (or ours) → what a counter held when it began anew: {"time": "2^32us"}, {"temperature":
            "256degC"}.
        begin: when the first reading of a file without dates was taken: a date, or a time on the clock of `like` such
            as "9 days"; of several files, or in place of a file's dates, by its name: {"b.csv": "2026-05-13 10:14"}.
        like: readings, as of a calibration, whose headers mean the same in these files unless given otherwise here;
            and their nominal scale holds.
        max_bytes: limit on the size of all files together.

    Returns:
        The readings; of several outputs, by their names.

    Raises:
        InputError: a file, a column, a unit or a cell cannot be used. One problem is a sentence that names file, row
            and column, what was read, what was expected, and what to do; several are a list of these, and the
            error's `problems`.
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
        labels, one_temperature = _run_labels(paths), allow_one_temperature
        return measure_tables(tables, instrument, options, one_temperature, labels, problems)

    if outputs is None:
        return read_one(options)
    if not outputs or len(set(outputs)) < len(outputs):
        raise InputError(f"outputs={list(outputs)}: name each channel once, and one at least")
    if (output := output_name(instrument)) in options.columns:
        raise InputError(f"{output}={options.columns[output]}, and channels: say only the channels")
    for name in (expected_columns(instrument).keys() - {output}).intersection(outputs):
        raise InputError(
            f"{name!r} is not an output channel: {instrument.name!r} uses it as a covariate"
        )
    all_problems, readings = Objections(), dict[str, Measurements]()
    for name in outputs:
        named, others = {**options.columns, output: name}, frozenset(outputs) - {name}
        with all_problems.collecting():
            readings[name] = read_one(replace(options, columns=named, others=others))
    Objections(dict.fromkeys(all_problems)).refuse()
    return readings


def _run_labels(paths: Sequence[Path]) -> list[str]:
    """Return a run's label for each file: its stem, with folder or number where that is not unique."""
    stems, labels = Counter(path.stem for path in paths), list[str]()
    for path in paths:
        folder = f"{path.resolve().parent.name}/" * (stems[path.stem] > 1)
        label = one_line(f"{folder}{path.stem}")
        tried = (label, *(f"{label} ({number})" for number in range(2, len(paths) + 1)))
        labels.append(next(text for text in tried if text not in labels))
    return labels
