"""Reference posteriors are met: means within 0.05 sd, sds within 3 % and Monte-Carlo error."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.accuracy import posteriordb
from tests.support.tiers import slow_but

FOLDER = Path(__file__).parents[1] / "data" / "posteriordb"
SHIFT = 0.05
# The others are slow only by their number.
FAST = (posteriordb.SCHOOLS,)


@pytest.mark.parametrize("name", slow_but(FAST, posteriordb.PROBLEMS))
def test_reference_posterior_is_reproduced(name) -> None:
    fit, rows = posteriordb.compare(name, FOLDER)
    assert fit.verdict.ok
    for row in rows:
        assert abs(row.shift) < SHIFT, row
        assert abs(row.ratio - 1) < row.ratio_allowed, row


def test_every_stored_reference_posterior_is_compared() -> None:
    assert {p.name for p in FOLDER.iterdir() if p.is_dir()} == set(posteriordb.PROBLEMS)
