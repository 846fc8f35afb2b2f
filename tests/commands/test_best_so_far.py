"""A search that a time limit or Ctrl-C ends leaves the best structure that it had weighed, fitted: not the first model.

Each test ends a search at a moment that it chooses, by the event that Ctrl-C sets, or by a deadline that has come.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

import bayescal as bc
from bayescal._core import deadline
from bayescal._search import calibrate as loop_module
from bayescal._search import discover as search_module
from bayescal._search.structures import Structures
from bayescal_models import mems_gyro
from tests.commands.test_ctrl_c import _as_at_a_terminal as _as_at_a_terminal
from tests.support.inside import result_of

HIDDEN = "bias.thermal_lag"


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    return mems_gyro.simulate({HIDDEN: 0.03}, seed=1)


def pressed() -> None:
    """Ctrl-C, as the main thread's handler notes it."""
    deadline.current().ended.set()


def walk_ending(monkeypatch: pytest.MonkeyPatch, end: Callable[[], None], looks: int = 1) -> None:
    """Have something end the walk once it has looked around so often."""
    real = search_module.walk

    def walk(library, max_effects, follow, seeds, given):
        left = [looks]

        def looked(structures: Structures) -> None:
            follow(structures)
            left[0] -= 1
            if not left[0]:
                end()

        return real(library, max_effects, looked, seeds, given)

    monkeypatch.setattr(search_module, "walk", walk)


def calibrate(readings: bc.Measurements, limit: float | None = None, **more) -> bc.SearchPath:
    with deadline.until(limit, apart=True):
        return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, **more)


def said_truly(trail: bc.SearchPath) -> None:
    assert trail.search is not None and not trail.complete
    best = trail.search.structures[0]
    assert {*best.effects} <= {*trail.final.calibration.model.names}
    for text in (trail.ending, trail.in_short):
        assert "othing was looked for" not in text and "was not fitted" not in text
        assert "before a second structure was weighed" not in text


def test_ctrl_c_in_the_walk_leaves_the_best_of_it(readings, monkeypatch) -> None:
    walk_ending(monkeypatch, pressed)
    trail = calibrate(readings)
    assert HIDDEN in trail.final.calibration.model.names
    assert "interrupted" in trail.ending
    found = trail.final.discovery
    assert found is not None and found.nothing_missing is None
    assert "ended early" in found.complete_in_words
    said_truly(trail)


def test_ctrl_c_while_a_step_on_the_way_is_fitted(readings, monkeypatch) -> None:
    """The best is fitted then, whatever of the way to it is left."""
    real = loop_module.fit

    def fit(model, *given, **more):
        if HIDDEN in model.names:
            fits.append(model)
            if len(fits) == 1:
                pressed()
                deadline.current().ask()
        return real(model, *given, **more)

    fits: list[bc.Model] = []
    monkeypatch.setattr(loop_module, "fit", fit)
    trail = calibrate(readings)
    assert len(fits) > 1, "it was begun again"
    assert HIDDEN in trail.final.calibration.model.names
    said_truly(trail)


def test_ctrl_c_of_a_python_session_too(readings, monkeypatch) -> None:
    """There it is an exception, in the walk and in a step."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    walk_ending(monkeypatch, interrupt)
    trail = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, method=bc.LeastSquares())
    assert HIDDEN in trail.final.calibration.model.names
    said_truly(trail)


@pytest.mark.usefixtures("_as_at_a_terminal")
def test_ctrl_c_pressed_again_does_not_wait(readings, monkeypatch) -> None:
    real = loop_module.check

    def press() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    def check(calibration):
        if HIDDEN in calibration.model.names:
            press()
            time.sleep(2.0)
        return real(calibration)

    walk_ending(monkeypatch, press)
    monkeypatch.setattr(loop_module, "check", check)
    trail = calibrate(readings)
    assert HIDDEN not in trail.final.calibration.model.names
    assert re.search(r"when \+ bias.thermal_lag.* was the most probable so far", trail.ending)
    assert "structures were weighed" in trail.in_short
    assert "Nothing was looked for" not in trail.in_short


@pytest.mark.slow
def test_a_time_limit_leaves_time_to_fit_the_best(readings, monkeypatch) -> None:
    """Fits take much longer than a search has: it ends early enough for the one that counts."""
    real, taken = loop_module.step_of, 1.0

    def slow(*given):
        time.sleep(taken)
        return real(*given)

    def endless(library, max_effects, follow, seeds, given):
        found = walk(library, max_effects, follow, seeds, given)
        while not deadline.current().over:
            time.sleep(0.01)
        return found or "The search was ended."

    calibrate(readings)  # compiled by now
    walk = search_module.walk
    monkeypatch.setattr(search_module, "walk", endless)
    monkeypatch.setattr(loop_module, "step_of", slow)
    trail = calibrate(readings, 12.0)
    assert HIDDEN in trail.final.calibration.model.names
    assert not trail.complete


@pytest.mark.slow
def test_each_channel_of_a_unit_is_left_with_its_best(monkeypatch) -> None:
    models = {name: mems_gyro.INSTRUMENT.baseline() for name in ("x", "y")}
    readings = {n: mems_gyro.simulate({HIDDEN: 0.03}, seed=s) for s, n in enumerate(models, 1)}
    real = loop_module.Loop.steps_to_best

    def steps(self, *given, **more):
        if not ended:
            ended.append(True)
            pressed()
            deadline.current().ask()
        return real(self, *given, **more)

    ended: list[bool] = []
    monkeypatch.setattr(loop_module.Loop, "steps_to_best", steps)
    with deadline.until(apart=True):
        found = bc.calibrate_channels(models, readings)
    assert [*found.trails] == ["x", "y"]
    for trail in found.trails.values():
        assert HIDDEN in trail.final.calibration.model.names


def test_ctrl_c_in_the_walk_of_the_first_channel_leaves_what_it_had(monkeypatch) -> None:
    models = {name: mems_gyro.INSTRUMENT.baseline() for name in ("x", "y")}
    readings = {n: mems_gyro.simulate({HIDDEN: 0.03}, seed=s) for s, n in enumerate(models, 1)}
    walk_ending(monkeypatch, pressed)
    with deadline.until(apart=True):
        found = bc.calibrate_channels(models, readings)
    said_truly(found.trails["x"])
    assert len(found.trails["x"].steps) == 2
    assert "x: The search was interrupted" in str(found)


def test_discover_says_what_was_found_so_far(readings, monkeypatch) -> None:
    walk_ending(monkeypatch, pressed)
    with deadline.until(apart=True):
        cal = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings, bc.LeastSquares())
        found = bc.discover(cal)
    assert found.sets and HIDDEN in found.sets[0].effects
    assert "interrupted" in found.stopped


def test_what_is_printed_of_a_cut_search_is_true(readings, monkeypatch) -> None:
    walk_ending(monkeypatch, pressed)
    trail = calibrate(readings)
    told = result_of(trail)
    assert told["search"]["stopped"] and told["complete"] is False
    assert replace(trail, average=None).final.calibration.model.names[-1] == HIDDEN
