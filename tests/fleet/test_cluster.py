"""On the workers of a Dask cluster a fleet has the same numbers, bit for bit."""

from __future__ import annotations

import pandas as pd
import pytest

import bayescal as bc
from tests.commands.conftest import OWN_EFFECTS
from tests.support.command_line import GYRO, needs_installation, run
from tests.support.inside import SMALL_TASKS
from tests.support.made_up.gyro_lot import MODEL


@pytest.mark.nightly
def test_workers_give_the_same_numbers(client, lot_folder, monkeypatch) -> None:
    here = bc.fit_batch(MODEL, lot_folder)
    monkeypatch.setattr(*SMALL_TASKS)
    there = bc.fit_batch(MODEL, lot_folder, client=client)
    pd.testing.assert_frame_equal(there.table(), here.table(), check_exact=True)


@pytest.mark.nightly
@needs_installation
def test_the_workers_get_effects_of_the_users_own(client, lot_folder, tmp_path) -> None:
    file = tmp_path / "effects_of_mine.py"
    file.write_text(OWN_EFFECTS, encoding="utf-8")
    ran = run(
        *("batch", lot_folder, *GYRO, "-o", tmp_path / "out.parquet", "--effects", file),
        *("--add", "bias.elbow", "--scheduler", client.scheduler.address),
    )
    assert ran.status == 0, ran.err


@pytest.mark.nightly
@needs_installation
def test_the_command_starts_workers(lot_folder, tmp_path) -> None:
    ran = run("batch", lot_folder, *GYRO, "-o", tmp_path / "out.parquet", "--workers", 2)
    assert ran.status == 0, ran.err
