"""Checks of numbers at the edge: an output of an absurd size, a time of too few digits, runs of one reading each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayescal._data.unit_conversion import base_unit, convert, unit_label

# Ranges of an output that any record of a sensor has, base units. Least: a superconducting gravimeter resolves
# 1e-12 m/s², a large ring laser 1e-13 rad/s, an interferometer on a lever 1e-12 rad. Most: gauges of impacts end at
# 2e6 m/s², rotors of any kind at 1e5 rad/s, and an angle beyond 1e4 rad has been counted in turns.
PLAUSIBLE = {
    "m/s^2": (1e-12, 1e7),
    "rad/s": (1e-13, 1e5),
    "rad": (1e-12, 1e4),
}
TICKS = 0.5  # of the readings with the time of the one before, at the least: most changes were lost
FEWEST = 8  # runs, below which one reading each may be the plan of a test

Columns = Mapping[str, np.ndarray]


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
    if "run" in columns and len(columns["run"]) >= FEWEST:
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
    for base, (least, most) in PLAUSIBLE.items():
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
    time, runs = columns["time"], columns.get("run")
    same = time[1:] == time[:-1]
    if runs is not None:
        same &= runs[1:] == runs[:-1]
    share = float(np.mean(same)) if len(same) else 0.0
    if share < TICKS:
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
