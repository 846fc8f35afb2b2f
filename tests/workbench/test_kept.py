"""Nothing is lost: a folder holds every step, whatever ended the process that made them."""

from __future__ import annotations

import pytest

from tests.support.inside import Session, identity_of
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
