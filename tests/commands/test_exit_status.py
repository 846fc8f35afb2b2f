"""A result that is not reliable is written, and its command leaves with 1."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import bayescal as bc
from tests.support.command_line import GYRO, PRINTED_LINE, QUICK, TABLE, needs_installation, run

pytestmark = needs_installation


def test_a_fit_that_did_not_converge_leaves_with_1_and_its_result(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    real = bc.fit

    def never(*arguments: Any, **options: Any) -> bc.Calibration:
        found = real(*arguments, **options)
        return replace(found, verdict=bc.Verdict(False, ("It was told not to converge.",)))

    monkeypatch.setattr(bc, "fit", never)
    done = run("fit", TABLE, *GYRO, *QUICK, "--out", tmp_path, "--json")
    assert done.status == 1
    assert done.data["verdict"]["ok"] is False
    assert done.said == ["bayescal: result not reliable: It was told not to converge."]
    assert (tmp_path / "calibration.nc").is_file()


@pytest.mark.usefixtures("unpainted")
def test_what_a_gate_found_stays_with_the_result_wherever_it_is_taken(tmp_path: Path) -> None:
    done = run("calibrate", TABLE, *GYRO, *QUICK, *PRINTED_LINE, "--out", tmp_path, "--json")
    assert done.status == 1 and done.data["gate"]["ok"] is False
    reason = done.data["gate"]["reason"]
    assert reason in done.said[-1]
    assert done.data == json.loads((tmp_path / "result.json").read_text("utf-8"))
    file = tmp_path / "calibration.nc"
    loaded = bc.load(file)
    assert loaded.verdict.ok and not loaded.verdict.reliable
    assert loaded.verdict.why_not == reason and reason in " ".join(str(loaded).split())
    header = tmp_path / "gyro.h"
    for command in (
        ("export", file, "--out", header),
        ("export", file, "--out", tmp_path / "gyro.json"),
        ("budget", file, "--at", "temperature=60"),
        ("compensate", tmp_path / "gyro.json", TABLE, "--out", tmp_path / "by_export.csv"),
        ("compensate", file, TABLE, "--out", tmp_path / "done.csv"),
        ("predict", file, TABLE),
        ("report", file, "--out", tmp_path / "report.html"),
    ):
        done = run(*command)
        assert done.status == 1, command
        assert reason in done.said[-1], command
