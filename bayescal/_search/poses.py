"""A raw log of three axes as poses: readings that the instrument takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import Measurements
from bayescal._data.pose_rows import ACROSS, OF
from bayescal._data.still_stretches import as_readings, per_sample, said_of, still_stretches
from bayescal._model.instrument import Instrument


def poses(
    log: Measurements, instrument: Instrument, *, shortest: float | None = None
) -> Measurements:
    """Still stretches of a log, averaged, a row each; other numeric columns are averaged beside them.

    Of gyroscopes on a rate table they are stretches of a steady rate.

    Args:
        log: samples of the three outputs, read with the instrument, with a column `time`.
        instrument: of three axes.
        shortest: of a pose, s; None for two, or one where the log holds many that are shorter.

    Raises:
        InputError: an instrument of one output, no column `time`, or no still stretch.
    """
    if instrument.vector is None:
        raise InputError(f"instrument {instrument.name!r} has one output: poses are of three axes")
    log = per_sample(log)
    _, runs = log.groups("run")
    rows: dict[str, list[np.ndarray]] = {}
    ratios, left_out = list[float](), list[float]()
    for run in np.unique(runs):
        own = np.flatnonzero(runs == run)
        outputs = np.stack([log[name][own] for name in instrument.vector.outputs], axis=1)
        found = still_stretches(log["time"][own], outputs, shortest)
        ratios.append(found.ratio)
        left_out += found.left_out
        for name in log.columns:
            if name in ("output", UNCERTAINTY, OF, *ACROSS):
                continue
            values = log[name][own]
            pairs = zip(found.first, found.last, strict=True)
            # Labels do not average: the one at the stretch's beginning holds for it.
            made = [values[a] if log.unit(name) is None else np.mean(values[a:b]) for a, b in pairs]
            rows.setdefault(name, []).append(np.array(made))
        rows.setdefault(UNCERTAINTY, []).append(found.uncertainty)
    columns = {name: np.concatenate(parts) for name, parts in rows.items()}
    made = as_readings(columns, instrument, log)
    said = (
        f"{len(made['output'])} readings of {len(columns[UNCERTAINTY])} poses found in {log.file}; means of blocks "
        f"scatter {np.mean(ratios):.1f} times as much as those of independent samples would"
    )
    short = (f"{log.file}: {said_of(left_out)}",) if left_out else ()
    return replace(made, sources=log.sources, flags=(*log.flags, *made.flags, said, *short))
