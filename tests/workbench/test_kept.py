"""Nothing is lost: a folder holds every step, whatever ended the process that made them."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import Origin, Session, identity_of
from tests.workbench.conftest import Campaign
from tests.workbench.test_session import OWN


def same_states(one: Session, other: Session) -> None:
    assert list(one.states) == list(other.states)
    for number, state in one.states.items():
        again = other.states[number]
        assert again.step.errors() == state.step.errors()
        assert (again.title, again.parent, again.at) == (state.title, state.parent, state.at)
        assert identity_of(again.calibration) == identity_of(state.calibration)


@pytest.mark.slow
def test_resumed_as_it_was(session: Session) -> None:
    session.load_draft(OWN)
    session.add("bias.steps")
    session.resize("bias.temperature", 0.2)
    session.go_to(0)
    session.noise("student_t")
    session.go_to(1)
    again = Session.resume(session.folder)
    same_states(session, again)
    assert again.current.number == 1
    assert again.script() == session.script()
    assert again.holdout is not None and len(again.holdout) == len(session.holdout or ())
    assert again.add("bias.drift").parent == 1


def test_a_file_read_with_every_option_is_gone_on_with(campaign: Campaign, tmp_path: Path) -> None:
    """A session of `--nominal-scale` or `--ignore` was refused by the next start: an option that it did not know."""
    how = {
        **{
            "columns": {"output": "raw"},
            "units": {"raw": "mV"},
            "local_gravity": 9.81,
            "local_field": None,
        },
        **{"nominal_scale": "250 mV/(deg/s)", "nominal_zero": "2 mV", "ignore": ("a", "b")},
        **{"missing": "drop", "decimal": ",", "date_order": "dmy", "unwrap": {"time": "2^32us"}},
        "begin": {"": "2026-05-13 10:14"},
    }
    read_by = set(inspect.signature(bc.read).parameters) - {"path_or_paths", "instrument"}
    assert how.keys() == read_by - {"outputs", "allow_one_temperature", "max_bytes", "like"}
    origin = Origin.of("mems_gyro", [campaign.file], read=how)
    model = mems_gyro.INSTRUMENT.baseline()
    begun = Session.begin(model, campaign.readings, folder=tmp_path / "out", origin=origin)
    again = Session.resume(begun.folder, of=Origin.of("mems_gyro", [campaign.file], read=how))
    assert again.script() == begun.script()
