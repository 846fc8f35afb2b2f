"""A comparison: its first row, its sentences and its errors say one thing, however few groups there are."""

from __future__ import annotations

import numpy as np

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT

QUICK = bc.LeastSquares(draws=400)
LINE = INSTRUMENT.baseline()
CURVE = LINE + "bias.temperature_quadratic"


def campaign(runs: int, bend: float) -> bc.Measurements:
    """Runs over one range of temperatures, each with the same line and the same bend; seed 0."""
    random = np.random.default_rng(0)
    temperature = np.tile(np.linspace(30.0, 80.0, 20), runs)
    output = 20.0 + 0.05 * temperature + bend * (temperature - 55.0) ** 2
    return bc.Measurements.from_arrays(
        INSTRUMENT,
        run=np.repeat([f"{i}" for i in range(runs)], 20),
        temperature=temperature,
        output=output + 0.05 * random.standard_normal(output.size),
    )


def both(readings: bc.Measurements) -> list[bc.Calibration]:
    return [bc.fit(LINE, readings, QUICK), bc.fit(CURVE, readings, QUICK)]


def evidence_gap(found: bc.Comparison) -> float:
    first, second = (row.log_evidence for row in found.rows)
    assert first is not None
    assert second is not None
    return first - second


def test_over_three_groups_the_evidence_ranks_and_no_error_is_given() -> None:
    fits = both(campaign(3, bend=2e-4))
    found = bc.compare(fits)
    assert [r.name for r in found.rows] == ["+ bias.temperature_quadratic", "model 1"]
    assert found.chosen_by == "log evidence"
    assert [r.group_error for r in found.rows] == [None, None]
    assert evidence_gap(found) > 3
    " ".join(str(found).split())


def test_a_small_difference_in_evidence_tells_nothing_apart() -> None:
    found = bc.compare(dict(zip(("line", "curve"), both(campaign(3, bend=4e-5)), strict=True)))
    gap = evidence_gap(found)
    assert gap < 3


def test_over_many_groups_their_scores_rank() -> None:
    found = bc.compare(both(campaign(12, bend=2e-4)))
    assert found.chosen_by == "leave-one-group-out"
    assert found.rows[1].group_error
