"""A session that somebody else left: nothing in it is run that this command does not name."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

import bayescal as bc
from tests.support.command_line import GYRO, needs_installation, run
from tests.support.inside import Session
from tests.workbench.conftest import Campaign

pytest.importorskip("panel", reason="bayescal[workbench] is not installed")
EVIL = """
from pathlib import Path
import bayescal as bc

Path(__file__).with_suffix(".ran").touch()
EFFECTS = (bc.Effect("bias.evil", "bias", lambda r: r["temperature"] ** 2, (bc.Coefficient("deg/s"),),
                     columns=("temperature",)),)
INSTRUMENT = None
"""


@pytest.fixture
def evil(tmp_path: Path) -> Path:
    path = tmp_path / "evil.py"
    path.write_text(EVIL)
    return path


def ran(path: Path) -> bool:
    return path.with_suffix(".ran").exists()


def change(session: Session, **told: Any) -> None:
    """Write something else into session.json; `origin` and `settings` key by key."""
    path = session.folder / "session.json"
    data = json.loads(path.read_text("utf-8"))
    for key, value in told.items():
        data[key] = {**data[key], **value} if isinstance(value, dict) else value
    path.write_text(json.dumps(data), "utf-8")


def test_a_file_that_a_session_names_is_not_run(session: Session, evil: Path) -> None:
    change(session, origin={"effect_files": [str(evil)]})
    hashlib.sha256(EVIL.encode()).hexdigest()
    with pytest.raises(bc.InputError):
        Session.resume(session.folder)
    with pytest.raises(bc.InputError):
        Session.resume(session.folder, trust=[evil.with_name("other.py")])
    assert not ran(evil)
    assert "bias.evil" in Session.resume(session.folder, trust=[evil]).own
    assert ran(evil)


@needs_installation
def test_the_command_runs_what_it_names_itself_alone(
    session: Session, evil: Path, campaign: Campaign
) -> None:
    change(session, origin={"effect_files": [str(evil)], "holdout": []})
    out = session.folder.with_name("output")
    out.mkdir()
    session.folder.rename(out / "session_1")
    asked = ("workbench", campaign.file, *GYRO, "--no-open", "--out", out)
    done = run(*asked)
    assert done.status == 2
    assert not ran(evil)
