"""Whether all runs have one profile of temperature, and the one run of another that would tell more.

Where they do, all that is thermal is a function of the time within a run: a quadratic at the temperature of a body, its
lag and a warm-up are told apart by their forms alone, and a free curve of that time can stand for any of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim
from bayescal._core.formatting import number
from bayescal._data.measurements import Measurements
from bayescal._data.time_in_runs import run_codes

# Correlation of two runs' temperatures at the same time within them, from which they are one profile.
ALIKE_CORRELATION = 0.99
DWELL_LAGS = 3.0  # times the slowest lag, after which five per cent of it are left


def repeated(readings: Measurements, column: str) -> bool:
    """Whether a temperature is the same function of the time within a run in all runs, two or more."""
    if not (readings.has("time") and readings.has(column)):
        return False
    names, codes = run_codes(readings)
    if len(names) < 2:
        return False
    runs = []
    for code in range(len(names)):
        rows = np.flatnonzero(codes == code)
        rows = rows[np.argsort(readings["time"][rows], kind="stable")]
        time = readings["time"][rows]
        runs.append((time - time[0], readings[column][rows]))
    first, known = runs[0]
    for time, values in runs[1:]:
        inside = time <= first[-1]
        if inside.sum() < 3 or np.ptp(values[inside]) == 0:
            return False
        other = np.interp(time[inside], first, known)
        if np.ptp(other) == 0 or np.corrcoef(other, values[inside])[0, 1] < ALIKE_CORRELATION:
            return False
    return True


def said_of_profiles(calibration: Calibration) -> list[Claim]:
    """That all runs have one profile, where the model has something that changes within them, and what would tell."""
    readings, model = calibration.readings, calibration.model
    thermal = [e for e in model.effects if "time" in e.columns or e.along == "elapsed"]
    warm = [n for n in sorted(model.columns) if readings.has(n) and readings.unit(n) == "degC"]
    warm = [n for n in warm if n != "temperature_point" and repeated(readings, n)]
    if not (thermal and warm):
        return []
    told = {"column": warm[0], "another": another_run(calibration, warm[:1])}
    return [Claim("profile.one", *(e.name for e in thermal), **told)]


def another_run(calibration: Calibration, columns: Sequence[str]) -> str:
    """The run that would tell most: the range from the other side, at the record's fastest rate, with dwells.

    Readings at the temperatures of a stepped test show no rate between them: none is said then.
    """
    readings, (column, *others) = calibration.readings, columns
    if others or column not in calibration.frame.rates:
        return f"Vary {' and '.join(columns)} otherwise in another run."
    values, rates = readings[column], np.abs(np.asarray(calibration.frame.rates[column]))
    runs = _rows_of_runs(readings)
    begins = float(np.median([values[rows][0] for rows in runs]))
    low, high = float(values.min()), float(values.max())
    ends = (low, high) if abs(begins - low) > abs(begins - high) else (high, low)
    pace = 60.0 * float(np.quantile(rates[rates > 0], 0.95)) if np.any(rates > 0) else 0.0
    mean = max(
        60.0 * np.ptp(values[rows]) / (np.ptp(readings["time"][rows]) or 1.0) for rows in runs
    )
    taus = [
        float(np.mean(calibration.samples(e.shape_name(s))))
        for e in calibration.model.effects
        for s in e.column_shapes
        if s.name == "tau"
        and column in e.columns
        and e.shape_name(s) in calibration.unknowns.by_key
    ]
    dwell = (
        f", a dwell of {number(DWELL_LAGS * max(taus) / 60.0, 2)} min at either end" if taus else ""
    )
    ramp = f"ramps of {number(pace, 2)} °C/min" if pace > 0.9 * mean else "ramps"
    return (
        f"One run of another profile would tell: from {number(ends[0], 3)} to {number(ends[1], 3)} °C and back, "
        f"{ramp}{dwell}."
    )


def _rows_of_runs(readings: Measurements) -> list[np.ndarray]:
    names, codes = run_codes(readings)
    order = np.argsort(readings["time"], kind="stable")
    return [order[codes[order] == code] for code in range(len(names))]
