"""The script of a state, run in a process of its own, gives the numbers that the page showed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import needs_installation
from tests.support.inside import Origin, Session, identity_of
from tests.workbench.conftest import Campaign
from tests.workbench.test_session import TYPED

ROOT = Path(__file__).resolve().parents[2]
NUMBERS = """
import json
from tests.support.inside import identity_of
print(json.dumps({"identity": [identity_of(c) for c in calibrations], "rms": bc.check(calibration).rms,
    "held_out": None if holdout is None else bc.predict(calibration, holdout).rmse}))
"""
pytestmark = needs_installation


def run(script: str, tmp_path: Path) -> dict:
    """What a script's numbers are, where it knows nothing of this process."""
    file = tmp_path / "workbench.py"
    file.write_text(script + NUMBERS, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(file)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'models'}"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def same(session: Session, tmp_path: Path) -> None:
    told = run(session.script(), tmp_path)
    path = session.path()
    assert told["identity"] == [identity_of(s.calibration) for s in path]
    assert told["rms"] == path[-1].step.check.rms
    assert told["held_out"] == path[-1].step.holdout_rmse


@pytest.mark.slow
def test_all_that_can_be_done(session: Session, tmp_path: Path) -> None:
    session.add("bias.thermal_lag")
    session.fix("bias.temperature", 0.054)
    session.resize("bias.thermal_lag", 0.2)
    session.add_formula(TYPED)
    session.noise("ornstein_uhlenbeck")
    session.free("bias.temperature")
    session.add("unknown(elapsed)")
    session.take_out("bias.temperature")
    same(session, tmp_path)


@pytest.mark.slow
def test_files_as_they_were_read(campaign: Campaign, tmp_path: Path) -> None:
    """A hostile name of a file is a name; columns, units and means are as they were."""
    odd = tmp_path / 'it\'s "odd"; import os #<script>.csv'
    text = campaign.file.read_text().replace("output [deg/s]", "rate_z [deg/s]")
    odd.write_text(text)
    how: dict[str, Any] = {"columns": {"output": "rate_z"}}
    instrument = mems_gyro.INSTRUMENT
    readings = bc.exclude_faults(bc.read(odd, instrument, **how)).average("1min")
    session = Session.open(
        dict(instrument.structures)["quadratic"](),
        readings,
        folder=tmp_path / "out",
        origin=Origin.of("mems_gyro", [odd], read_options=how, average="1min"),
        seed=3,
        reference={"T0": 20.0},
    )
    session.add("bias.thermal_lag")
    assert "average('1min')" in session.script()
    same(session, tmp_path)
