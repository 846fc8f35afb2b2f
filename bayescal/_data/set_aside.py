"""Readings that say nothing of the sensor are set aside before a calibration: clipped or stuck ones, and spikes.

Spikes of the output, and of the thermometers, at which it is not known what the output belongs to.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayescal._data.covariate_checks import leaps, pieces
from bayescal._data.dataset_checks import clip_levels, once, repeated_rows, stuck_rows
from bayescal._data.measurements import Measurements
from bayescal._data.rounding import rounding_step
from bayescal._data.spikes import find_spikes


def set_aside(readings: Measurements, keep_spikes: bool = False) -> Measurements:
    """The readings without clipped and stuck ones and spikes, named in flags; the same readings where there is none.

    Args:
        readings: as recorded.
        keep_spikes: leave spikes in.
    """
    readings = _without_stuck(_without_clipped(_once(readings)))
    return readings if keep_spikes else _without_spikes(_without_leaps(readings))


def _once(readings: Measurements) -> Measurements:
    """Without rows that repeat an earlier one: reading a file drops them, other sources may hold them."""
    columns = {name: readings[name] for name in readings.columns}
    kept = once(columns, repeated_rows(columns))
    if isinstance(kept, slice):
        return readings
    count = len(readings) - len(kept)
    flag = f"{readings.file}: {count} row(s) repeat an earlier one in every column: dropped"
    return replace(readings.select(kept), flags=(*readings.flags, flag))


def _without_clipped(readings: Measurements) -> Measurements:
    """Without what stands exactly at an end where the output was cut off: such a reading only says "beyond"."""
    output = readings["output"]
    clipped, told = np.zeros(len(readings), dtype=bool), []
    for end, level in [] if rounding_step(output) else clip_levels(output):
        at = output == level
        clipped |= at
        told.append(f"{int(at.sum())} at its {end} {level:.6g}")
    if not told or clipped.all():
        return readings
    flag = (
        f"{readings.file}: {int(clipped.sum())} clipped reading(s) of the output set aside, {' and '.join(told)}: "
        "what lies beyond was not measured, and no calibration holds there"
    )
    return replace(readings.select(np.flatnonzero(~clipped)), flags=(*readings.flags, flag))


def _without_stuck(readings: Measurements) -> Measurements:
    """Without repeats of one reading by an output that stood still: only the first was measured."""
    output = readings["output"]
    stuck = None if len(output) < 2 or rounding_step(output) else stuck_rows(output)
    if stuck is None:
        return readings
    first, last = stuck
    flag = (
        f"{readings.file}: {last - first} reading(s) set aside: the output stands still at {output[first]:.6g} "
        f"(rows {first + 2} to {last + 1})"
    )
    kept = np.r_[: first + 1, last + 1 : len(output)]
    return replace(readings.select(kept), flags=(*readings.flags, flag))


def _without_leaps(readings: Measurements) -> Measurements:
    """Without those at which a thermometer leaps there and back: nothing is known of the temperature there."""
    if not readings.has("time"):
        return readings
    columns = {n: readings[n] for n in readings.columns}
    gone, told, own = np.zeros(len(readings), bool), [], list(pieces(columns))
    for name in (n for n in columns if readings.unit(n) == "degC" and np.ptp(columns[n]) > 0):
        rows = leaps(columns[name], own)
        gone[rows] = True
        shown = ", ".join(f"{row + 1} ({columns[name][row]:.6g} °C)" for row in rows[:5])
        told += [f"{name}: row {shown}{' …' if len(rows) > 5 else ''}"] if len(rows) else []
    if not told or gone.all():
        return readings
    flag = (
        f"{readings.file}: {int(gone.sum())} reading(s) set aside, at which a thermometer leaps faster than a body can "
        f"follow, {'; '.join(told)}; keep_spikes keeps them"
    )
    return replace(readings.select(np.flatnonzero(~gone)), flags=(*readings.flags, flag))


def _without_spikes(readings: Measurements) -> Measurements:
    rows = find_spikes(readings)
    if not len(rows):
        return readings
    shown = ", ".join(f"{row + 1} ({readings['output'][row]:.6g})" for row in rows[:5])
    flag = (
        f"{readings.file}: {len(rows)} reading(s) set aside as spikes, far from both neighbours: "
        f"row {shown}{' …' if len(rows) > 5 else ''}; keep_spikes keeps them"
    )
    kept = np.setdiff1d(np.arange(len(readings)), rows)
    return replace(readings.select(kept), flags=(*readings.flags, flag))
