"""Nothing is lost: a folder holds every step, whatever ended the process that made them."""

from __future__ import annotations

import pytest

from tests.support.inside import Session, identity_of
from tests.workbench.test_session import TYPED, again


def same_states(one: Session, other: Session) -> None:
    assert list(one.states) == list(other.states)
    for number, state in one.states.items():
        again = other.states[number]
        assert again.step.errors() == state.step.errors()
        assert (again.title, again.parent, again.at) == (state.title, state.parent, state.at)
        assert identity_of(again.calibration) == identity_of(state.calibration)


@pytest.mark.slow
def test_resumed_as_it_was(session: Session) -> None:
    session.add_typed(TYPED)
    session.resize("bias.temperature", 0.2)
    session.go_to(0)
    session.noise("student_t")
    session.go_to(1)
    later = again(session, origin=session.origin)
    same_states(session, later)
    assert later.current.number == 1
    assert later.script() == session.script()
    assert later.add("bias.drift").parent == 1
