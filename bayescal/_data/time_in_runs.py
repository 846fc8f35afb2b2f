"""The zero of time for readings beside a calibration, and which of their runs go on with fitted ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._data.records import PAUSE_STEPS, usual_step
from bayescal._tables.cells import date_text
from bayescal._tables.raw_table import option

# Changes from one record to the other, a reading, beyond which two lie in one time and neither goes on with the other.
INTERLEAVED_SHARE = 0.2


def on_clock(
    readings: Measurements, epoch: float | None, changing: Callable[[], str]
) -> Measurements:
    """Return readings with their times counted from a calibration's `epoch`, s since 1970; None where it has no dates.

    Times without dates count from the calibration's zero where that has no date either: a column `time` has one origin
    over all runs. `changing` gives what changes with the date, for the message; empty for nothing.

    Raises:
        InputError: one has dates and the other has none, and something changes with the date.
    """
    if not readings.has("time") or readings.since == epoch:
        return readings
    if readings.since is not None and epoch is not None:
        time = np.round(readings["time"] + (readings.since - epoch), 6)
        return replace(readings.with_column("time", time), since=epoch)
    if not (names := changing()):
        return readings
    dated = f"counts time from {date_text(epoch)}" if epoch is not None else "has no dates"
    own, example = ("no dates", "2026-05-13 10:14:20") if epoch is not None else ("dates", "9 days")
    of = readings.sources[0].file if len(readings.sources) == 1 else "FILE"
    raise InputError(
        f"{readings.file}: its times have {own}, the calibration {dated}; with the date changes {names}. Say "
        f"when its first reading was taken{' on the clock of the calibration' * (epoch is None)}: "
        f"{option('--begin', f'{of}={example}')} (in Python, begin={example!r} where it is read)"
    )


def going_on(fitted: Measurements, later: Measurements) -> dict[str, np.ndarray]:
    """Return which readings of which runs go on with a record that is known: rows of `later` by run.

    They have the run's name (and device and axis), and follow its readings in blocks, the first of them at once. A file
    of another test, whose clock begins anew, has times that fall among all of the record's, or far from them.
    """
    if not (fitted.has("time") and later.has("time")) or fitted.since != later.since:
        return {}
    at, own, found = later["time"], later.records.codes, {}
    for i, (name, known) in later.records.known_in(fitted.records).items():
        rows = np.flatnonzero(own == i)
        first = float(at[rows].min())
        before = known[known < first]
        if not before.size or known.size < 2 or np.isin(at[rows], known).any():
            continue
        merged = np.concatenate([np.zeros(known.size, bool), np.ones(rows.size, bool)])
        merged = merged[np.argsort(np.concatenate([known, at[rows]]), kind="stable")]
        most = max(2.0, INTERLEAVED_SHARE * min(known.size, rows.size))
        apart = np.count_nonzero(np.diff(merged)) <= most
        if apart and first - before[-1] <= PAUSE_STEPS * usual_step(known):
            found[name] = rows
    return found
