"""Kinds of faulty records from a TOML file, so that kinds can be added without code.

    [[kind]]
    name = "thermometer late by a minute in the last run"
    steps = [{ do = "late", by = 60.0, where = "last run" }]

The fields of a kind are

- `name`; `true`, what is true of the record in words (default: the unit as it was); `says`, a regular expression for
  words that name the cause (default: a thermometer's);
- `finds`, the same for the name of an added effect, which then names the cause;
- `needs`: "runs" if the records must be runs, "sibling" if the unit must have a second thermometer;
- `of`: "record" (the default), or "hold-out from the record": hold-out data made from the training data are given;
- `must_say`: true if a right answer counts only with a sentence that names the cause;
- `alike`: true if the second campaign, which tests the result, has the same fault;
- `steps`, applied in order, each a table of `do`, a function of `STEPS`; `column`: "thermometer" (the default),
  "sibling", "output", "input", or a column's name; `where`: a name in `_where`; and the function's parameters.

A step is applied to each record in time separately, and changes only the rows of `where`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.spoilt_records.kinds import Kind, changed, records, rows, step
from benchmarks.spoilt_records.subject import Columns, Subject

TEN = 10


@dataclass(frozen=True)
class Piece:
    """Input of a step: one column in one record in time.

    Attributes:
        time: times, s.
        usual: usual time between readings, s.
        cells: values of the column.
        before: values in the preceding record; for the first record, those of the last.
        all: values in the whole file.
        rng: random-number generator.
    """

    time: np.ndarray
    usual: float
    cells: np.ndarray
    before: np.ndarray
    all: np.ndarray
    rng: np.random.Generator

    def at(self, part: float) -> float:
        """Return the value at a fraction of the column's range, from 0 at its minimum to 1 at its maximum."""
        return float(self.all.min() + part * np.ptp(self.all))


def _late(p: Piece, by: float = 0.0, readings: float = 0.0) -> np.ndarray:
    return np.interp(p.time - by - readings * p.usual, p.time, p.cells)


def _hold(p: Piece, readings: int) -> np.ndarray:
    return p.cells[np.arange(len(p.cells)) // readings * readings]


def _dropped(p: Piece, share: float) -> np.ndarray:
    present = p.rng.random(len(p.cells)) >= share
    present[0] = True
    return p.cells[np.maximum.accumulate(np.where(present, np.arange(len(present)), 0))]


def _smoothed(p: Piece, over: float = 0.0, readings: float = 0.0) -> np.ndarray:
    """Return the temperature of a first-order body that starts at the column's first value."""
    tau, smoothed = over + readings * p.usual, p.cells.astype(float)
    keep = np.exp(-np.diff(p.time) / tau)
    for i in range(1, len(smoothed)):
        smoothed[i] = p.cells[i] + keep[i - 1] * (smoothed[i - 1] - p.cells[i])
    return smoothed


def _high_pass(p: Piece, over: float) -> np.ndarray:
    return p.cells - _smoothed(p, over)


def _averaged(p: Piece, readings: int = 0) -> np.ndarray:
    if not readings:
        return np.full(len(p.cells), p.cells.mean())
    ends = readings // 2
    padded = np.pad(p.cells, ends, mode="edge")
    return np.convolve(padded, np.ones(readings) / readings, mode="valid")[: len(p.cells)]


def _interpolated(p: Piece, readings: int) -> np.ndarray:
    knots = np.union1d(np.arange(0, len(p.cells), readings), len(p.cells) - 1)
    return np.interp(p.time, p.time[knots], p.cells[knots])


def _clipped(p: Piece, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    return np.clip(p.cells, p.at(low), p.at(high))


def _wrapped(p: Piece, high: float) -> np.ndarray:
    return np.where(p.cells > p.at(high), p.cells - high * np.ptp(p.all), p.cells)


def _noisy(p: Piece, by: float = 0.0, of_range: float = 0.0) -> np.ndarray:
    return p.cells + (by + of_range * np.ptp(p.all)) * p.rng.standard_normal(len(p.cells))


def _drifting(p: Piece, of_range: float) -> np.ndarray:
    """Add a drift in proportion to the readings of each record."""
    return p.cells + of_range * np.ptp(p.all) * np.linspace(0.0, 1.0, len(p.cells))


def _stretched(p: Piece, by: float) -> np.ndarray:
    return np.interp(p.time[0] + by * (p.time - p.time[0]), p.time, p.cells)


def _rounded(p: Piece, of_range: float = 0.0, to: float = 0.0) -> np.ndarray:
    grid = to + of_range * np.ptp(p.all)
    return grid * np.rint(p.cells / grid)


STEPS: dict[str, Callable[..., Any]] = {
    "late": _late,
    "held": _hold,
    "dropped": _dropped,
    "smoothed": _smoothed,
    "high_pass": _high_pass,
    "averaged": _averaged,
    "interpolated": _interpolated,
    "clipped": _clipped,
    "wrapped": _wrapped,
    "noisy": _noisy,
    "drifting": _drifting,
    "stretched": _stretched,
    "rounded": _rounded,
    "scaled": lambda p, by=1.0, plus=0.0: by * p.cells + plus,
    "plus": lambda p, of_range: p.cells + of_range * np.ptp(p.all),
    "set": lambda p, to: np.full(len(p.cells), to),
    "displaced": lambda p: np.resize(p.before, len(p.cells)),
    "reversed": lambda p: p.cells[::-1],
    "unsigned": lambda p: np.abs(p.cells),
    "single": lambda p: p.cells.astype(np.float32).astype(float),
    "numbered": lambda p: [f"{a} {i}" for i, a in enumerate(p.cells)],
    "renamed": lambda p: [f"later {a}" for a in p.cells],
}
ON_WHOLE_FILES = ("halved", "kept", "exchanged")
_NAMES = {"name", "true", "says", "finds", "needs", "of", "must_say", "alike", "steps"}
_OF = ("record", "hold-out from the record")
THERMOMETER = "temperature|thermometer"


def kinds_of(path: Path) -> dict[str, Kind]:
    """Return the kinds of a file, by name.

    Raises:
        ValueError: an unknown or repeated name, and where it is.
    """
    kinds: dict[str, Kind] = {}
    for table in tomllib.loads(path.read_text("utf-8"))["kind"]:
        name = table.get("name", "?")
        unknown = set(table) - _NAMES
        unknown |= {s["do"] for s in table["steps"] if s["do"] not in (*STEPS, *ON_WHOLE_FILES)}
        if unknown or name in kinds or table.get("of", _OF[0]) not in _OF:
            raise ValueError(f"{path.name}, kind {name!r}: unknown or twice: {sorted(unknown)}")
        kinds[name] = _kind(table)
    return kinds


def _kind(table: dict[str, Any]) -> Kind:
    needs = set(table.get("needs", ()))

    def fits(subject: Subject) -> bool:
        runs = "runs" not in needs or subject.group == "run"
        return runs and ("sibling" not in needs or bool(subject.sibling))

    def spoil(columns: Columns, subject: Subject, rng: np.random.Generator) -> Columns:
        for options in table["steps"]:
            columns = _done(columns, subject, rng, **options)
        return columns

    spoil.__doc__ = f"{table['name']}. True: {table.get('true', 'the unit as it was')}."
    hold_out = table.get("of", _OF[0]) == _OF[1]
    return Kind(
        table["name"],
        spoil,
        fits,
        table.get("says", THERMOMETER),
        table.get("finds", "^$"),
        of_holdout=hold_out,
        of_training=hold_out,
        must_say=table.get("must_say", False),
        alike=table.get("alike", False),
    )


def _done(
    columns: Columns,
    subject: Subject,
    rng: np.random.Generator,
    *,
    do: str,
    column: str = "thermometer",
    where: str = "everywhere",
    **numbers: float,
) -> Columns:
    """Apply one step to the rows of `where`; return the columns."""
    if do == "halved":
        return rows(columns, np.arange(len(columns["output"])) % 2 == 0)
    roles = {"thermometer": subject.thermometer, "sibling": subject.sibling, "input": subject.input}
    name = roles.get(column, column)
    old, chosen = columns[name], _where(where, columns, subject, rng)
    if do == "kept":
        return rows(columns, chosen)
    if do == "exchanged":
        other = columns[subject.sibling]
        both = np.where(chosen, other, old), np.where(chosen, old, other)
        return changed(columns, **{name: both[0], subject.sibling: both[1]})
    usual, pieces = step(columns, subject), records(columns, subject)
    new = old.astype(object)
    for k, rows_ in enumerate(pieces):
        piece = Piece(columns["time"][rows_], usual, old[rows_], old[pieces[k - 1]], old, rng)
        new[rows_] = STEPS[do](piece, **numbers)
    new = np.where(chosen, new, old)
    return changed(columns, **{name: new.astype(old.dtype if old.dtype.kind == "f" else str)})


def _where(name: str, columns: Columns, subject: Subject, rng: np.random.Generator) -> np.ndarray:
    """Select rows: everywhere, first run, last run, second half, last third, first readings, ten rows."""
    count = len(columns["output"])
    chosen, record_rows = np.zeros(count, bool), records(columns, subject)
    if name == "everywhere":
        chosen[:] = True
    elif name in ("first run", "last run"):
        chosen[record_rows[0 if name == "first run" else -1]] = True
    elif name == "second half":  # of the middle run, and all that follows
        middle = record_rows[len(record_rows) // 2]
        chosen[middle[len(middle) // 2] :] = True
    elif name == "last third":
        chosen[-(count // 3) :] = True
    elif name == "first readings":
        chosen[[piece[0] for piece in record_rows]] = True
    elif name == "ten rows":
        chosen[rng.choice(count, TEN, replace=False)] = True
    else:
        raise ValueError(f"there are no rows called {name!r}")
    return chosen
