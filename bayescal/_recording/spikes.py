"""Spikes: single readings far from both of their neighbours, faults of the record and not of the sensor.

They are set aside before a calibration, by name, because one of them can outweigh thousands of readings.
"""

from __future__ import annotations

import numpy as np

from bayescal._readings.measurements import Measurements
from bayescal._recording.time_in_runs import run_codes

HEIGHT = 8.0  # robust standard deviations of such distances, from which a reading is a spike
FEWEST = 50  # readings that a record needs before any can be called a spike
GAP = 5.0  # usual steps, from which a pause parts the record
MOST = 0.005  # of all readings; where more stand out, the noise itself is heavy-tailed and all are kept


def find_spikes(readings: Measurements) -> np.ndarray:
    """Rows of spikes, found by each reading's distance from the line through its neighbours in its run.

    A smooth signal, however large, has small distances; a step has two large ones side by side and is kept.
    Only records in time have neighbours: without a column `time` there are no spikes.
    """
    if not readings.has("time") or len(readings) < FEWEST:
        return np.zeros(0, dtype=int)
    found: list[int] = []
    _, codes = run_codes(readings)
    for run in np.unique(codes):
        rows = np.flatnonzero(codes == run)
        rows = rows[np.argsort(readings["time"][rows], kind="stable")]
        steps = np.diff(readings["time"][rows])
        # Readings on either side of a gap are no neighbours.
        for piece in np.split(rows, 1 + np.flatnonzero(steps > GAP * np.median(steps))):
            if len(piece) >= FEWEST:
                found += piece[_spikes(readings["output"][piece])].tolist()
    rows = np.array(sorted(found), dtype=int)
    return rows if len(rows) <= max(1.0, MOST * len(readings)) else rows[:0]


def _spikes(y: np.ndarray) -> np.ndarray:
    """Positions of spikes: the worst is taken out and the rest judged anew, until none is left."""
    kept = np.arange(len(y))
    scale, found = None, []
    while len(found) <= MOST * len(y) + 1:
        height = _heights(y[kept])
        scale = 1.4826 * np.median(height) if scale is None else scale
        # A spike at an end and its neighbour stand out alike: then it is the end.
        worst = int(
            np.argmax(
                height * np.where(np.isin(np.arange(len(kept)), (0, len(kept) - 1)), 1 + 1e-9, 1)
            )
        )
        if not scale > 0 or height[worst] < HEIGHT * scale:
            break
        found.append(int(kept[worst]))
        kept = np.delete(kept, worst)
    return np.array(found, dtype=int)


def _heights(y: np.ndarray) -> np.ndarray:
    """Distance of each reading from the line through its two neighbours, in units that noise makes equal."""
    inner = np.abs(y[1:-1] - 0.5 * (y[:-2] + y[2:]))
    return np.concatenate([inner[:1], inner, inner[-1:]])
