"""The fleet's table of effects: which are common, in how many devices, with intervals."""

from __future__ import annotations

import pandas as pd
from scipy import stats

from bayescal._finding.find_devices import EffectCounts

COLUMNS = ["effect", "devices", "share", "low", "high", "expected", "possible"]


def effects_table(counts: EffectCounts) -> pd.DataFrame:
    """One row an effect, the commonest first.

    Columns: effect; devices whose structure has it; their share, and its exact (Clopper–Pearson) 95 % interval; how
    many devices are expected to have it, the sum of their probabilities; in how many it is one of the effects of which
    one is missing.
    """
    rows = []
    for name, expected in sorted(
        counts.expected.items(), key=lambda item: (-counts.found[item[0]], -item[1])
    ):
        found = counts.found[name]
        low, high = stats.binomtest(found, counts.devices).proportion_ci(0.95, method="exact")
        share = (found / counts.devices, float(low), float(high))
        rows.append([name, found, *share, expected, counts.possible[name]])
    return pd.DataFrame(rows, columns=COLUMNS)
