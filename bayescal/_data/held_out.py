"""Hold-out data against the readings that are fitted: are they new?"""

from __future__ import annotations

import pandas as pd

from bayescal._data.measurements import Measurements
from bayescal._data.record_settings import recording


def not_new(readings: Measurements, holdout: Measurements) -> int:
    """How many of the hold-out data are readings that are fitted, whatever their time and labels say.

    A reading is known by its numbers but for the time: output, temperatures, inputs. Where these repeat among the
    readings themselves, as rounded ones do, equal numbers say nothing, and 0 is returned.

    Args:
        readings: to fit.
        holdout: hold-out data, of the same instrument.
    """
    shared = [
        n
        for n in readings.columns
        if n != "time" and readings.unit(n) is not None and holdout.has(n)
    ]
    mine, theirs = (
        pd.DataFrame({n: r[n] for n in shared}).round(12).drop_duplicates()
        for r in (readings, holdout)
    )
    if len(mine) < recording().one_of_its_kind * len(readings):
        return 0
    both = len(theirs.merge(mine, how="inner", on=shared))
    return both if both > recording().not_new * len(theirs) else 0


def said_of(readings: Measurements, holdout: Measurements) -> str:
    """That hold-out data are not new, in words; empty where they are."""
    many = not_new(readings, holdout)
    if not many:
        return ""
    return (
        f"{holdout.file}: {many} of the {len(holdout)} readings of the hold-out data are readings that are fitted "
        "(equal output, temperature and inputs; times and labels apart): the hold-out error says nothing of new "
        "readings. Take readings of another run"
    )
