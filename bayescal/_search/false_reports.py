"""How often the search reports an effect where the model is complete, asked of the model at hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._calibration.on_readings import Vectors, replicate
from bayescal._calibration.settings import searching
from bayescal._core import deadline
from bayescal._core.errors import InputError, TimeIsUp
from bayescal._core.progress import stage
from bayescal._inference.least_squares import LeastSquares
from bayescal._model.effect import Effect
from bayescal._search.discover import discover

LEVEL = 0.95  # of the interval


@dataclass(frozen=True)
class FalseReports:
    """Reports in campaigns for which the model is complete.

    Attributes:
        campaigns: simulated and searched.
        reported: of them, those in which something was reported.
        interval: exact (Clopper–Pearson) 95 % interval of the rate.
        effects: what was reported, and how often.
    """

    campaigns: int
    reported: int
    interval: tuple[float, float]
    effects: dict[str, int]

    def __str__(self) -> str:
        low, high = self.interval
        what = ", ".join(f"{name} ({count})" for name, count in self.effects.items())
        return (
            f"false reports: {self.reported} of {self.campaigns} campaigns simulated from this model, for which "
            f"the model is complete (95 % interval {100 * low:.1f} to {100 * high:.1f} %; at most "
            f"{100 * (1 - searching().found):.0f} % were meant)" + (f": {what}" if what else "")
        )


def false_reports(
    calibration: Calibration,
    campaigns: int,
    *,
    effects: Sequence[Effect] = (),
    max_effects: int = 5,
    seed: int = 0,
) -> FalseReports:
    """Simulate the campaign from the fitted model, fit it anew by least squares, and search it, time and again.

    Each campaign takes one posterior draw for the truth and keeps every column but the output. Repeated fits and
    searches compile nothing, so a campaign of a few hundred readings takes well under a second. At a deadline it ends
    with the campaigns searched so far.

    Args:
        calibration: a fit; its columns, groups and noise law are those of the simulated campaigns.
        campaigns: how many.
        effects, max_effects: as in `discover`.
        seed: of the simulated campaigns.

    Raises:
        InputError: fewer than one campaign.
        TimeIsUp: the deadline came before the first was searched.
    """
    if campaigns < 1:
        raise InputError(f"false reports: {campaigns} campaigns were asked for; ask for 1 or more")
    model, readings = calibration.model, calibration.readings
    found, reported = Counter[str](), 0
    with stage(f"searching {campaigns} campaigns for which the model is complete"):
        x, rows, v = calibration.draws()
        # A draw for each campaign: the rate is that over the posterior, not at one of its values.
        random = np.random.default_rng(seed)
        chosen = random.integers(len(x), size=campaigns)
        draws = Vectors(x[chosen], rows[chosen], v[chosen])
        outputs = replicate(calibration.assembly, draws, random)
        outputs += readings["output"] - calibration.frame["output"]
    end, searched = deadline.current(), 0
    for output in outputs:
        if end.over:
            break
        made, reference = readings.with_column("output", output), calibration.reference
        again = fit(model, made, LeastSquares(draws=40), reference=reference, strict=False)
        best = discover(again, effects=effects, max_effects=max_effects).best
        reported += bool(best)
        found.update(e.name for e in best)
        searched += 1
    if not searched:
        raise TimeIsUp(end.why)
    # Clopper–Pearson holds its level for any rate, also where nothing was reported.
    low, high = binomtest(reported, searched).proportion_ci(LEVEL, method="exact")
    return FalseReports(searched, reported, (float(low), float(high)), dict(found.most_common()))
