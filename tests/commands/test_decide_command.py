"""`bayescal decide`: 0 where every limit is met, 1 where one is not or is undecided."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.command_line import needs_installation, run
from tests.support.made_up import bent_sensor

pytestmark = needs_installation


@pytest.fixture(scope="module")
def turned(tmp_path_factory) -> Path:
    """A saved calibration of a gyroscope on its table, 30 to 80 °C."""
    return bent_sensor.gyro().save(tmp_path_factory.mktemp("turned") / "calibration.nc")


def test_a_limit_that_is_met_leaves_with_0_and_is_written(turned, tmp_path) -> None:
    out = tmp_path / "decisions.json"
    done = run("decide", turned, "--limit", "bias: 20..24 °/s", "--out", out, "--json")
    assert done.status == 0 and done.said == []
    assert json.loads(out.read_text("utf-8")) == done.data
    assert done.data["schema"] == "bayescal.decisions/1" and done.data["conforms"] is True
