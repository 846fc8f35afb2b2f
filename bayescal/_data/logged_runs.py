"""Runs of a log with their still stretches, and the poses in which the sensors of two logs are at rest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import InstrumentLike, Measurements
from bayescal._data.pose_rows import ACROSS
from bayescal._data.still_stretches import StillStretches, still_stretches


class LoggedRun(NamedTuple):
    """One run of a log: what was recorded in it, and its still stretches."""

    time: Float[np.ndarray, "n"]
    outputs: Float[np.ndarray, "n 3"]
    temperature: Float[np.ndarray, "n"] | None
    still: StillStretches

    def ends(self) -> Float[np.ndarray, "k 2"]:
        return np.stack([self.time[self.still.first], self.time[self.still.last - 1]], axis=1)

    def means(self, windows: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        return np.stack([self.outputs[self.inside(*w)].mean(axis=0) for w in windows])

    def inside(self, begin: float, end: float) -> slice:
        at = np.searchsorted(self.time, [begin, end])
        return slice(int(at[0]), int(at[1]) + 1)


def per_sample(log: Measurements) -> Measurements:
    """One row a sample, where each is three readings.

    Raises:
        InputError: no column `time`.
    """
    if not log.has("time"):
        raise InputError(f"{log.file}: still stretches need the column 'time', in s")
    return log.select(np.arange(0, len(log), 3)) if log.has(ACROSS[0]) else log


def logged_runs(
    log: Measurements, names: tuple[str, ...], shortest: float | None
) -> dict[str, LoggedRun]:
    """Of each run its samples and still stretches."""
    labels, codes = log.groups("run")
    found = {}
    for k, label in enumerate(labels):
        own = np.flatnonzero(codes == k)
        outputs = np.stack([log[name][own] for name in names], axis=1)
        warm = log["temperature"][own] if log.has("temperature") else None
        still = still_stretches(log["time"][own], outputs, shortest)
        found[label] = LoggedRun(log["time"][own], outputs, warm, still)
    return found


def as_readings(
    columns: dict[str, np.ndarray], instrument: InstrumentLike, log: Measurements
) -> Measurements:
    """What was made of a log as readings of an instrument; columns that it does not know have the log's units."""
    known = {c.name for c in instrument.columns} | {UNCERTAINTY}
    units = {n: str(log.unit(n)) for n in columns if n not in known and log.unit(n)}
    given: dict[str, Any] = {"units": units, "allow_one_temperature": True, **columns}
    return Measurements.from_arrays(instrument, **given)


def in_common(one: Float[np.ndarray, "k 2"], other: Float[np.ndarray, "l 2"]) -> np.ndarray:
    """Windows in which both are still, at least half as long as the shortest stretch of either (m, 2)."""
    begin = np.maximum(one[:, None, 0], other[None, :, 0])
    end = np.minimum(one[:, None, 1], other[None, :, 1])
    least = 0.5 * min(np.min(one[:, 1] - one[:, 0]), np.min(other[:, 1] - other[:, 0]))
    kept = end - begin >= least
    windows = np.stack([begin[kept], end[kept]], axis=1)
    return windows[np.argsort(windows[:, 0])]
