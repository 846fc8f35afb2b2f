"""`bayescal decide`: 0 where every limit is met, 1 where one is not or is undecided."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from tests.support.command_line import GYRO, QUICK, needs_installation, run
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


def test_one_limit_of_two_that_is_open_leaves_with_1(turned) -> None:
    two = ("--limit", "bias: 20..24 °/s", "--limit", "scale.constant: ±150 ppm")
    done = run("decide", turned, *two)
    assert done.status == 1 and "guarded acceptance" in done.out
    assert done.said == [
        "bayescal: note: not shown to conform: scale.constant: ±150 ppm (undecided)"
    ]
    done = run("decide", turned, *two, "--rule", "simple", "--population", "bias: sd 1 °/s")
    assert done.status == 0 and "consumer's risk" in done.out
    done = run("decide", turned, "--limit", "bias: ±1 °/s")
    assert done.status == 1 and "(reject)" in done.said[0]


@pytest.mark.slow
@pytest.mark.parametrize("place", ["fleet", "fleet.parquet"])
def test_what_a_batch_learned_is_a_population(place, tmp_path) -> None:
    parts = []
    for seed in range(4):
        file = tmp_path / f"{seed}.csv"
        assert run("simulate", *GYRO, "--seed", seed, "--out", file).status == 0
        parts.append(pd.read_csv(file).assign(device=f"A{seed}"))
    lot, one, out = tmp_path / "lot" / "lot.csv", tmp_path / "one", tmp_path / place
    lot.parent.mkdir()
    pd.concat(parts).to_csv(lot, index=False)
    from_ = lot if out.suffix else lot.parent
    done = run("batch", from_, *GYRO, "--population", "bias.constant", "--out", out)
    assert done.status == 0, done.err
    assert run("fit", tmp_path / "0.csv", *GYRO, *QUICK, "--out", one).status == 0
    done = run("decide", one, "--limit", "bias: ±100 °/s", "--population", out, "--json")
    assert done.status == 0, done.err
    (found,) = done.data["decisions"]
    assert found["global_risks"]["conforming"] > 0.9 and found["population"][0] > 10
    plain = tmp_path / "plain.parquet"
    assert run("batch", lot, *GYRO, "--out", plain).status == 0
    refused = run("decide", one, "--limit", "bias: ±100 °/s", "--population", plain)
    assert refused.status == 2 and "have no population" in refused.said[0]
