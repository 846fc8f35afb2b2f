"""The fleet's table of effects: which are common, in how many devices, with intervals."""

from __future__ import annotations

import pandas as pd

from bayescal._fleet.find_devices import LEAST, EffectCounts
from bayescal._fleet.shares import shares

COLUMNS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]


def effects_table(counts: EffectCounts, seed: int = 0) -> pd.DataFrame:
    """One row an effect, the most probable first.

    Columns: effect; devices whose own structure has it; in how many it is one of the effects of which one is missing.
    Then of all devices together: probability that any has it, how many are expected to, their share, and its 95 %
    interval if any device has it.
    """
    found = shares(counts.evidence, seed)
    rows = [
        [name, counts.found[name], counts.possible[name], one.in_fleet, one.expected, *one[1:4]]
        for name, one in found.items()
        if counts.found[name] or counts.possible[name] or one.expected > LEAST
    ]
    rows.sort(key=lambda row: (-row[4], -row[1]))
    return pd.DataFrame(rows, columns=COLUMNS)
