"""A session that somebody else left: nothing in its folder is run, and it is of its own readings alone."""

from __future__ import annotations

import json

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import Session
from tests.workbench.test_session import again

pytest.importorskip("panel", reason="bayescal[workbench] is not installed")


def change(session: Session, **told: object) -> None:
    """Write something else into session.json."""
    path = session.folder / "session.json"
    data = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({**data, **told}), "utf-8")


def test_a_formula_of_a_session_is_data(session: Session) -> None:
    change(session, typed=["bias.evil: __import__('os').system('false') * temperature"])
    with pytest.raises(bc.InputError):
        again(session)


@pytest.mark.parametrize("told", [{"current": "one"}, {"typed": "0"}, {"schema": ""}])
def test_a_session_that_was_changed_is_refused(session: Session, told: dict) -> None:
    change(session, **told)
    with pytest.raises(bc.InputError, match="no session that can be gone on with"):
        again(session)


def test_a_session_of_other_readings_is_refused(session: Session) -> None:
    others = mems_gyro.simulate({}, seed=9)
    with pytest.raises(bc.InputError, match="other readings"):
        Session.open(session.states[0].model, others, folder=session.folder)
