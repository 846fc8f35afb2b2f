"""Spikes: single readings far from both of their neighbours, faults of the record and not of the sensor.

They are set aside before a calibration, by name, because one of them can outweigh thousands of readings.
"""

from __future__ import annotations

import numpy as np

from bayescal._data.measurements import Measurements
from bayescal._data.time_in_runs import run_codes

HEIGHT = 8.0  # robust standard deviations of such distances, from which a reading is a spike
FEWEST = 50  # readings that a record needs before any can be called a spike
GAP = 5.0  # usual steps, from which a pause parts the record
MOST = 0.005  # of all readings; where more stand out, the noise may be heavy-tailed, and its tail is asked
MANY = 0.05  # of all readings; more of them are no spikes, whatever the tail
TAIL = 4.0  # robust standard deviations, from which a tail is one
USUAL = 2.0, 5.0  # exponent of a tail before it is seen, and how many distances that counts as
BY_CHANCE = 0.01  # probability that a tail without spikes has such a gap


def find_spikes(readings: Measurements) -> np.ndarray:
    """Rows of spikes, found by each reading's distance from the line through its neighbours in its run.

    A smooth signal, however large, has small distances; a step has two large ones side by side and is kept.
    Only records in time have neighbours: without a column `time` there are no spikes. Where more readings stand out
    than spikes would, the noise may have heavy tails: what lies beyond a gap that such a tail lacks is a spike there.
    """
    none = np.zeros(0, dtype=int)
    if not readings.has("time") or len(readings) < FEWEST:
        return none
    found, heights, rest = [none], [np.zeros(0)], [np.zeros(0)]
    _, codes = run_codes(readings)
    for run in np.unique(codes):
        rows = np.flatnonzero(codes == run)
        rows = rows[np.argsort(readings["time"][rows], kind="stable")]
        steps = np.diff(readings["time"][rows])
        # Readings on either side of a gap are no neighbours.
        for piece in np.split(rows, 1 + np.flatnonzero(steps > GAP * np.median(steps))):
            if len(piece) >= FEWEST:
                at, high, others = _standing_out(readings["output"][piece])
                found.append(piece[at])
                heights.append(high)
                rest.append(others)
    rows, high = np.concatenate(found), np.concatenate(heights)
    if len(rows) > max(1.0, MOST * len(readings)):
        rows = rows[_beyond_the_tail(high, np.concatenate(rest), len(readings))]
    return np.sort(rows)


def _standing_out(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Readings that stand out, their heights, and heights of all others, in robust standard deviations.

    The worst is taken out and its neighbours are judged anew, until none is left.
    """
    count = len(y)
    before, after = np.arange(count) - 1, np.arange(count) + 1

    def height(i: int) -> float:
        i = (
            after[i] if before[i] < 0 else before[i] if after[i] >= count else i
        )  # an end as its neighbour
        return float(abs(y[i] - 0.5 * (y[before[i]] + y[after[i]])))

    inner = np.abs(y[1:-1] - 0.5 * (y[:-2] + y[2:]))
    heights = np.concatenate([inner[:1], inner, inner[-1:]])
    scale, first, last = 1.4826 * float(np.median(heights)), 0, count - 1
    found, high = [], []
    while scale > 0 and len(found) <= MANY * count + 1:
        # A spike at an end and its neighbour stand out alike: then it is the end.
        worst = int(np.argmax(heights))
        worst = next((end for end in (first, last) if heights[end] == heights[worst]), worst)
        if heights[worst] < HEIGHT * scale:
            break
        found.append(worst)
        high.append(heights[worst])
        heights[worst] = -1.0
        left, right = before[worst], after[worst]
        first, last = (right if left < 0 else first), (left if right >= count else last)
        if left >= 0:
            after[left] = right
        if right < count:
            before[right] = left
        near = [
            left,
            right,
            before[left] if left >= 0 else -1,
            after[right] if right < count else -1,
        ]
        for i in (i for i in near if 0 <= i < count):
            heights[i] = height(int(i))
    size = scale or 1.0
    return np.array(found, dtype=int), np.array(high) / size, heights[heights >= 0] / size


def _beyond_the_tail(high: np.ndarray, rest: np.ndarray, count: int) -> np.ndarray:
    """Which of the heights that stand out lie beyond a gap that a heavy tail would not have.

    Of a tail like x^−ν the i-th largest height is above the next by a factor whose logarithm times i·ν is standard
    exponential (A. Rényi, On the theory of order statistics, Acta Math. Hung. 4 (1953) 191); ν is that of the heights
    below the gap (B. Hill, Ann. Stat. 3 (1975) 1163).
    """
    order = np.argsort(-high)
    tail = np.concatenate([high[order], np.sort(rest[rest > TAIL])[::-1], [TAIL]])
    logs = np.log(np.maximum(tail / TAIL, 1.0))
    most = min(len(high), int(MANY * count))
    i = np.arange(1, most + 1)
    below, sums = len(tail) - 1 - i, np.cumsum(logs[::-1])[::-1]
    nu, weight = USUAL
    exponent = (below + weight) / (sums[i] + i * logs[i] + weight / nu)
    gaps = i * exponent * (logs[i - 1] - logs[i])
    beyond = np.flatnonzero(gaps > np.log(max(most, 1) / BY_CHANCE))
    return order[: beyond[-1] + 1] if beyond.size else order[:0]
