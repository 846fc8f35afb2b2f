"""Spoilt records are answered rightly or said to be spoilt; `python -m benchmarks gauntlet` has all instruments.

One record of each kind, of the gyroscope, with nothing hidden in it. The kinds and what is true of them stand in
`benchmarks/spoilt_records/`, the judge in its `judge.py`.
"""

from __future__ import annotations

import pytest

from benchmarks.spoilt_records.judge import judged
from benchmarks.spoilt_records.kinds import KINDS
from benchmarks.spoilt_records.measurement import furthest
from benchmarks.spoilt_records.subjects import SUBJECTS
from tests.support.tiers import slow_but

GYRO = SUBJECTS["mems_gyro"]
SEED = 2
FAST = {
    *("time corrected during the record", "thermometer rounded to 0.5 °C", "one temperature"),
    *("−999 in a few rows of the temperature", "constant 1e+09 times the noise", "constant output"),
}


CASES = [name for name, kind in KINDS.items() if kind.fits(GYRO) and name != "nothing"]


@pytest.mark.parametrize("name", slow_but(FAST, CASES))
def test_faulty_record_is_answered_correctly_or_flagged(name: str) -> None:
    row = judged(GYRO, KINDS[name], SEED)
    found = {key: row.get(key) for key in ("added", "noise", "error", "due", "stated", "says")}
    assert row["verdict"] in ("right", "said"), f"{found}, {furthest(row)}"


def test_sound_record_is_answered_correctly_without_flags() -> None:
    row = judged(GYRO, KINDS["nothing"], SEED)
    assert row["verdict"] == "right"
    assert row["ok"]
    assert row["added"] == []
