"""Kinds of spoilt records from a table: each step does what it says to the rows that it is for, and to no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.spoilt_records import of_file
from benchmarks.spoilt_records.of_file import kinds_of
from benchmarks.spoilt_records.subjects import SUBJECTS

TABLE = Path(of_file.__file__).with_name("covariates.toml")
KINDS = kinds_of(TABLE)
SENSOR = SUBJECTS["still_sensor"]


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, "utf-8")
    return path


def test_steps_of_the_last_run_leave_the_others() -> None:
    record = SENSOR.campaign(2).record
    for name, kind in KINDS.items():
        if name.endswith("in one run") and kind.fits(SENSOR):
            spoilt = kind.spoil(record, SENSOR, np.random.default_rng(1))
            others = record["run"] != "3"
            for column in ("temperature", "output", "time"):
                assert np.array_equal(spoilt[column][others], record[column][others]), name


def test_a_late_thermometer_reads_what_was_a_minute_before(tmp_path: Path) -> None:
    table = '[[kind]]\nname = "late"\nsteps = [{ do = "late", by = 60.0 }]\n'
    (kind,) = kinds_of(written(tmp_path, table)).values()
    record = SENSOR.campaign(2).record
    warm = kind.spoil(record, SENSOR, np.random.default_rng(1))["temperature"]
    assert warm[6:241] == pytest.approx(record["temperature"][:235])
