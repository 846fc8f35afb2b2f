"""Checks of a whole data set: what makes it unusable, and what its owner should know of.

Refused: one temperature only, time running backwards. Flagged: repeated rows (with a time they are dropped), a
saturated output, a constant column, an output of an absurd size, a time of too few digits, runs of one reading each.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import ARRAYS, MAY_BE_EMPTY, ConvertedColumns, file_names
from bayescal._data.covariate_checks import oddities
from bayescal._data.record_settings import recording
from bayescal._data.stretches import Columns, label_codes, record_codes
from bayescal._data.unit_conversion import base_unit, convert, unit_label
from bayescal._tables.problems import Problem, Problems
from bayescal._tables.raw_table import Table

Where = Callable[[int], str]  # index of a reading → "row 12 of 'tilt.csv'"


def problems_of_whole(
    converted: ConvertedColumns, instrument: Any, one_temperature: bool
) -> Problems:
    """What is wrong with readings as a whole: one temperature only, time that runs backwards.

    Args:
        converted: their columns.
        instrument: whose readings they are. Where it says which effects its baseline has, and none of them needs the
            temperature to change, it need not.
        one_temperature: accept one temperature all the same.
    """
    problems, files = Problems(), [table.file for table in converted.tables]
    effects = getattr(instrument, "effects", None)
    needed = effects is None or any("temperature" in effect.varies for effect in effects)
    required = any(c.name == "temperature" and c.required for c in instrument.columns)
    if needed and required and not one_temperature and "temperature" in converted.values:
        with problems.collecting(files[0]):
            refuse_one_temperature(converted.values, file_names([f for f in files if f != ARRAYS]))
    with problems.collecting(files[0]):
        refuse_backward_time(converted.values, row_namer(converted.tables))
    return problems


def row_namer(tables: Sequence[Table]) -> Where:
    """What names the file and row of a reading, of several tables one after the other."""
    ends = np.cumsum([table.rows for table in tables])

    def where(index: int) -> str:
        which = int(np.searchsorted(ends, index, side="right"))
        table = tables[which]
        return f"{table.place(index - int(ends[which]) + table.rows)} of {table.file!r}"

    return where


def refuse_one_temperature(columns: Columns, names: str) -> None:
    """Refuse readings that hold one temperature only.

    Args:
        columns: readings; `temperature` in °C.
        names: the files, for the message.

    Raises:
        InputError: the temperatures span less than `RecordSettings.temperature_span`.
    """
    temperature = columns["temperature"]
    low, high = float(temperature.min()), float(temperature.max())
    if high - low < recording().temperature_span:
        seen = f"{low:g}" if low == high else f"{low:g} … {high:g}"
        cure = (
            "At least two are needed, or nothing that depends on temperature can be calibrated: add readings at "
            "another (files given together are read together)"
        )
        came = f"reads {seen} °C, one temperature only"
        said = f"{names}, column 'temperature': {came}. {cure}"  # of files, or of a device
        problem = Problem(names, came, cure=cure, column="temperature", sentence=said)
        raise InputError(said, (problem,))


def refuse_backward_time(columns: Columns, where: Where) -> None:
    """Refuse time that runs backwards within a run of a device and axis.

    Args:
        columns: readings; `time` in s.
        where: names a reading's file and row.

    Raises:
        InputError: it does, and where.
    """
    if "time" not in columns:
        return
    time = columns["time"]
    record = record_codes(columns)
    order = np.argsort(record, kind="stable")
    back = (np.diff(time[order]) < 0) & (np.diff(record[order]) == 0)
    if back.any():
        later = order[1:][back]
        index = int(later.min())
        before = int(order[np.flatnonzero(order == index)[0] - 1])
        labels = [f"{n} {columns[n][index]!s}" for n in ("run", "device", "axis") if n in columns]
        inside = f" within {', '.join(labels)}" if labels else ""
        cure = "Put the rows in the order in which they were taken, or give each record its own label in a column 'run'"
        came = f"reads {time[index]:.12g} s after {time[before]:.12g} s in {where(before)}: time runs backwards{inside}"
        places = tuple(where(int(i)).partition(" of ")[0] for i in np.sort(order[1:][back]))
        file = where(index).partition(" of ")[2].strip("'")
        problem = Problem(file, came, cure=cure, column="time", places=places)
        raise InputError(str(problem), (problem,))


def flags_of(
    converted: ConvertedColumns, output: str, names: str, repeated: np.ndarray
) -> list[str]:
    """What is odd in the readings but no reason to refuse them.

    Args:
        converted: the readings.
        output: name of the output column.
        names: the files, for the flags.
        repeated: rows that repeat an earlier one.
    """
    columns, units, where = converted.values, converted.units, row_namer(converted.tables)
    thermometers = {name for name, unit in units.items() if unit == "degC"} - {MAY_BE_EMPTY}
    flags = []
    if count := len(repeated):
        first = int(repeated[0])
        many, dropped = count > 1, "time" in columns
        said = f"{count} row{'s repeat' if many else ' repeats'} an earlier one in every column"
        end = f": {'they are' if many else 'it is'} dropped" if dropped else ""
        flags.append(f"{said}, first at {where(first)}{end}")
    for end, level in clip_levels(columns[output]) if output in columns else ():
        count = int((columns[output] == level).sum())
        flags.append(
            f"{names}: column {output!r} may be saturated: {count} readings stand exactly at its {end} {level:g}"
        )
    flags += [
        f"{names}: each run has one {name} of its own: differences between runs and a dependence on it are confounded, "
        "parted by their plausible sizes alone. Let it change within a run, or repeat one in another run"
        for name in one_plateau_a_run(columns, thermometers)
    ]
    flags += [
        f"{names}: column {one.column!r} {one.said} (first at {where(int(one.rows[0]))})"
        for one in oddities(columns, thermometers, output)
    ]
    for name, values in columns.items():
        number = values.dtype.kind == "f" and name not in converted.filled
        if number and len(values) > 1 and (values == values[0]).all():
            flags.append(f"{names}: column {name!r} is constant ({values[0]:g})")
        elif number and (stuck := stuck_rows(values, name in thermometers)) is not None:
            first, last = (where(row) for row in stuck)
            share = (stuck[1] - stuck[0] + 1) / len(values)
            much = (
                f", {100 * share:.0f} % of all readings" if share > recording().stuck_share else ""
            )
            flags.append(
                f"{names}: column {name!r} stands still at {values[stuck[0]]:g} from {first} to {last}{much}: was it "
                "stuck?"
            )
    return flags + [f"{names}: {said}" for said in odd_numbers(columns, units, output)]


def one_plateau_a_run(columns: Columns, thermometers: Collection[str]) -> list[str]:
    """Thermometers that stand at one temperature in each run, another in each: run and slope are confounded."""
    if "run" not in columns:
        return []
    codes = label_codes(columns, ["run"])
    count = np.bincount(codes)
    found = []
    for name in thermometers if len(count) > 1 else ():
        values = columns[name]
        means = np.bincount(codes, values) / count
        within = float(np.sqrt(np.mean((values - means[codes]) ** 2)))
        apart = float(np.diff(np.sort(means)).min())
        if apart > max(recording().plateau * within, recording().temperature_span):
            found.append(name)
    return found


def stuck_rows(values: np.ndarray, thermometer: bool = False) -> tuple[int, int] | None:
    """First and last row of a stretch, far longer than any other, in which a column that else changes does not.

    Args:
        values: one for each reading.
        thermometer: whether half of all readings in one stretch suffice, however often the others repeat.
    """
    ends = np.append(np.flatnonzero(values[1:] != values[:-1]), len(values) - 1)
    lengths = np.diff(ends, prepend=-1)
    worst = int(np.argmax(lengths))
    length, others = int(lengths[worst]), np.delete(lengths, worst)
    if not others.size:
        return None
    again = int(np.sum(others - 1))  # readings outside that repeat the one before
    longest, given = int(np.max(others, initial=1)), recording()
    rounded = again > given.repeated * int(np.sum(others))
    if rounded and thermometer and length >= given.stuck_share * len(values):
        rounded = False
    if rounded or length < max(given.stuck, given.stuck_excess * longest):
        return None
    return int(ends[worst]) - length + 1, int(ends[worst])


def repeated_rows(columns: Columns) -> np.ndarray:
    """Rows that repeat an earlier one in every column: looked for among those whose hashes agree, to save memory."""
    import pandas as pd

    table = pd.DataFrame(dict(columns), copy=False)
    hashed = pd.util.hash_pandas_object(table, index=False)  # pyright: ignore[reportAttributeAccessIssue]
    hashes = hashed.to_numpy()
    ordered = np.sort(hashes)
    shared = ordered[1:][ordered[1:] == ordered[:-1]]
    if not shared.size:
        return shared.astype(np.int64)
    alike = np.flatnonzero(np.isin(hashes, shared))
    return alike[table.iloc[alike].duplicated().to_numpy()]


def clip_levels(values: np.ndarray) -> list[tuple[str, float]]:
    """Ends of the range at which an output was cut off, each with the level; empty where it looks natural."""
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return []
    found, given = [], recording()
    for end, beside, name in ((-1, -2, "maximum"), (0, 1, "minimum")):
        enough = max(given.clipped, given.clipped_share * len(values))
        with np.errstate(over="ignore"):
            near = abs(levels[end] - levels[beside]) < given.clipped_gap * (levels[-1] - levels[0])
        if near and counts[end] >= enough and counts[end] > given.clipped_excess * counts[beside]:
            found.append((name, float(levels[end])))
    return found


def odd_numbers(columns: Columns, units: Mapping[str, str | None], output: str) -> list[str]:
    """What is odd in a record's numbers though each is a number, in words that begin with the column.

    Args:
        columns: readings by name.
        units: of the columns of numbers.
        output: name of the output column.
    """
    found = _of_size(columns[output], units[output] or "1", output) if output in columns else []
    if "time" in columns:
        found += _of_time(columns)
    if "run" in columns and len(columns["run"]) >= recording().counted_runs:
        runs = columns["run"]
        if len(set(runs.tolist())) == len(runs):
            found.append(
                f"column 'run' gives each of the {len(runs)} readings a run of its own: nothing goes on from one to "
                "the next, and no rate, lag or correlation is seen. Is it a counter? Leave it out, or label the runs"
            )
        elif output in columns:
            found += _of_first_readings(columns, output)
    return found


def _of_size(values: np.ndarray, unit: str, name: str) -> list[str]:
    with np.errstate(over="ignore"):
        reach = float(np.ptp(values))
    for base, least, most in recording().resolved:
        if unit == "any" or base_unit(unit) != base_unit(base):
            continue
        with np.errstate(over="ignore"):
            size = float(abs(convert([reach], unit, base)[0]))
        if reach > 0 and not least <= size <= most:
            small = size < least
            return [
                f"column {name!r} covers {reach:.2g} {unit_label(unit)} in all, {'less' if small else 'more'} than any "
                f"sensor {'resolves' if small else 'measures'} ({least if small else most:g} {base}): check its unit "
                "and its scale (--unit, --nominal-scale)"
            ]
    return []


def _of_time(columns: Columns) -> list[str]:
    time, codes = columns["time"], record_codes(columns)
    same = (time[1:] == time[:-1]) & (codes[1:] == codes[:-1])
    share = float(np.mean(same)) if len(same) else 0.0
    if share < recording().same_tick:
        return []
    steps = np.diff(np.unique(time))
    step = f" Its values are {np.min(steps):.3g} s apart at the least." if len(steps) else ""
    return [
        f"column 'time' has too few digits, or a coarse clock: {share:.0%} of the readings have the time of the one "
        f"before.{step} Rates and lags within that are lost: record it with more digits"
    ]


def _of_first_readings(columns: Columns, output: str) -> list[str]:
    """Where every run begins with one and the same output, exactly, that hardly occurs elsewhere."""
    runs, values = columns["run"], columns[output]
    _, first = np.unique(runs, return_index=True)
    level = values[first[0]]
    count = int(np.count_nonzero(values == level))
    if len(first) < 2 or not np.all(values[first] == level) or count > len(first):
        return []
    return [
        f"column {output!r} reads exactly {level:g} at the first reading of every run: was it set there, or does a "
        "filter in the logger (a high-pass) begin so? What the output was before that filter is not known"
    ]
