"""A session: the loop by hand, step by step, back and aside; each step is what the public functions give."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import Session, identity_of
from tests.workbench.conftest import HIDDEN, Campaign

TYPED = "bias.steps: a * board_temperature^2; a = 1e-4 deg/s/degC^2"


def again(session: Session, **given: Any) -> Session:
    """The session, as another process goes on with it."""
    first = session.states[0].model
    holdout = {"holdout": session.holdout}
    return Session.open(first, session.readings, folder=session.folder, **holdout, **given)


@pytest.mark.slow
def test_the_loop_by_hand(session: Session) -> None:
    """What is found and added brings the hold-out error down to the floor; a step back begins a branch."""
    found = session.find_missing()
    assert {name for s in found.findings for name in s.effects} == set(HIDDEN)
    assert session.current.discovery is found
    before = session.current.step
    for name in HIDDEN:
        promised = session.preview("add", name)
        state = session.add(name)
        assert state.step.rmse_fitted == pytest.approx(promised.rms, rel=1e-6)
        left = session.states[state.parent or 0].step.check.residuals - promised.curve
        # Modes of a search are found to 0.03 standard deviations: to 1e-4 °/s beside a noise of 0.05.
        np.testing.assert_allclose(state.step.check.residuals, left, atol=1e-4)
    last = session.current.step
    assert last.holdout_rmse is not None and before.holdout_rmse is not None
    assert last.holdout_rmse < 1.15 * last.noise_floor < before.holdout_rmse
    titles = [s.title for s in session.path()[1:]]
    assert all(t.startswith(f"+ {n}") for t, n in zip(titles, HIDDEN, strict=True)), "in some form"
    session.go_to(1)
    branch = session.add("bias.drift")
    assert (branch.number, branch.parent, session.current) == (3, 1, branch)
    assert sorted(session.states) == [0, 1, 2, 3]


def test_a_step_is_what_fit_gives(session: Session, campaign: Campaign) -> None:
    state = session.add("bias.thermal_lag")
    model = mems_gyro.INSTRUMENT.baseline() + "bias.thermal_lag"
    alone = bc.fit(model, campaign.readings, bc.LeastSquares(draws=500), strict=False)
    np.testing.assert_array_equal(state.calibration.joint.x, alone.joint.x)
    kept = bc.predict(alone, campaign.holdout)
    assert state.step.holdout_rmse == kept.rmse


@pytest.mark.parametrize(
    ("kind", "arguments", "title"),
    [
        ("take_out", ("bias.temperature",), "− bias.temperature"),
        ("fix", ("bias.temperature", 0.05), "bias.temperature = 0.05 fixed"),
        ("resize", ("bias.temperature", 0.2), "bias.temperature of plausible size 0.2 °/s/°C"),
        pytest.param("noise", ("student_t",), "noise: Student-t", marks=pytest.mark.slow),
    ],
)
def test_consequences_come_before_the_change(
    session: Session, kind: str, arguments: tuple, title: str
) -> None:
    told = session.preview(kind, *arguments)
    assert len(session.states) == 1
    state = session.act(kind, *arguments)
    assert state.title == title
    assert state.step.rmse_fitted == pytest.approx(told.rms, rel=1e-3)


@pytest.mark.slow
def test_find_all_is_what_calibrate_finds(session: Session, campaign: Campaign) -> None:
    told: list[int] = []
    session.find_all(lambda trail: told.append(trail.search.weighed if trail.search else 0))
    trail = bc.calibrate(
        mems_gyro.INSTRUMENT.baseline(),
        campaign.readings,
        holdout=campaign.holdout,
        method=bc.LeastSquares(draws=500),
    )
    assert [s.title for s in session.path()] == [s.title for s in trail.steps]
    assert session.current.step.errors() == trail.final.errors()
    assert session.current.discovery is not None and trail.final.discovery is not None
    assert str(session.current.discovery) == str(trail.final.discovery)
    assert told == sorted(told)


@pytest.mark.slow
def test_effect_found_by_a_search_is_added_at_its_most_probable_size(tmp_path: Path) -> None:
    """A drift ten times its plausible size would be held back, and leave what looks like something else."""
    instrument = mems_gyro.INSTRUMENT
    stated = instrument.effect("bias.drift").coefficients[0].size
    readings = instrument.simulate({"bias.drift": 10 * stated}, seed=3)
    session = Session.open(instrument.baseline(), readings, folder=tmp_path / "drift")
    found = session.find_missing()
    (sized,) = (e for e in found.best if e.name.startswith("bias.drift"))  # in one of its forms
    assert sized.coefficients[0].size > 2 * stated
    state = session.add(sized.name)
    assert state.model.effect(sized.name) == sized


def test_a_typed_formula_is_drawn_before_it_is_added_and_goes_on_with_the_session(
    session: Session,
) -> None:
    line = "square: a*(temperature - 40)^2; a = 1e-3 deg/s/degC^2"
    before, drawn = session.current, session.preview("add", session.parse_formula(line))
    assert session.current is before and not session.effects and np.ptp(drawn.curve) > 0
    added = session.add_formula(line)
    assert added.title == "+ bias.square" and added.step.rmse == pytest.approx(drawn.rms, rel=0.02)
    later = again(session)
    assert later.current.model == added.model
    with pytest.raises(bc.InputError):
        session.parse_formula("square: a*(temperatur - 40)^2; a = 1e-3 deg/s")


# Nothing is lost: a folder holds every step, whatever ended the process that made them.


def same_states(one: Session, other: Session) -> None:
    assert list(one.states) == list(other.states)
    for number, state in one.states.items():
        again = other.states[number]
        assert again.step.errors() == state.step.errors()
        assert (again.title, again.parent) == (state.title, state.parent)
        assert identity_of(again.calibration) == identity_of(state.calibration)


@pytest.mark.slow
def test_resumed_as_it_was(session: Session) -> None:
    session.add_formula(TYPED)
    session.resize("bias.temperature", 0.2)
    session.go_to(0)
    session.noise("student_t")
    session.go_to(1)
    later = again(session, origin=session.origin)
    same_states(session, later)
    assert later.current.number == 1
    assert later.script() == session.script()
    assert later.add("bias.drift").parent == 1


# A session that somebody else left: nothing in its folder is run, and it is of its own readings alone.


def change(session: Session, **told: object) -> None:
    """Write something else into session.json."""
    path = session.folder / "session.json"
    data = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({**data, **told}), "utf-8")


@pytest.mark.parametrize("told", [{"current": "one"}, {"current": 7}, {"schema": ""}])
def test_a_session_that_was_changed_is_refused(session: Session, told: dict) -> None:
    change(session, **told)
    with pytest.raises(bc.InputError, match="no session that can be resumed"):
        again(session)


def test_a_session_of_other_readings_is_refused(session: Session) -> None:
    others = mems_gyro.simulate({}, seed=9)
    with pytest.raises(bc.InputError, match="other readings"):
        Session.open(session.states[0].model, others, folder=session.folder)
