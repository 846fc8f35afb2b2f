"""The open benchmark's tasks: the same bytes everywhere, mixed as stated, of physics that candidates approximate."""

from __future__ import annotations

import hashlib
from collections import Counter

import numpy as np
import pytest
from missing_effect.draws import Draws
from missing_effect.edition import TRACKS, published
from missing_effect.formulas import FORMULAS
from missing_effect.regression import grid
from missing_effect_maker.generate import contents, make, plan, sizes
from missing_effect_maker.simulate.bodies import body
from missing_effect_maker.simulate.instruments import INSTRUMENTS

CASES = plan()


def digest(place: int) -> str:
    texts = contents(make(f"task_{place:03d}", CASES[place])).values()
    return hashlib.sha256(b"".join(texts)).hexdigest()


@pytest.mark.parametrize("place", [0, 1, 4, 9, 57, 599])
def test_a_task_is_the_published_one(place: int) -> None:
    assert digest(place) == published()[f"task_{place:03d}"]


@pytest.mark.slow
def test_all_tasks_are_the_published_ones() -> None:
    assert {f"task_{place:03d}": digest(place) for place in range(len(CASES))} == published()


@pytest.mark.parametrize(("edition", "size"), [(e, s) for e in (1, 2) for s in sizes(e)])
def test_a_size_holds_its_share_of_each_track(edition: int, size: int) -> None:
    counts = Counter(case.track for case in plan(edition)[:size])
    for track, count in TRACKS.items():
        assert abs(counts[track] - size * count / 600) < 1.01
    assert TRACKS["empty"] * 3 == sum(TRACKS.values())


def test_what_an_entry_gets_does_not_tell_the_truth() -> None:
    made = make("task_000", CASES[0])
    public = b"".join(text for name, text in contents(made).items() if name != "truth.json")
    assert "output" not in made.task.holdout
    assert made.truth["track"].encode() not in public and b"decided" not in public


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_a_candidate_describes_its_own_effect_but_not_exactly(name: str) -> None:
    """The hidden physics leaves nine tenths or more of itself to the candidate, and never all."""
    import pandas as pd

    world = INSTRUMENTS[name](Draws(5, 6), 0.3)
    data = pd.DataFrame(world.columns)
    base = np.hstack([t.columns(data) for t in world.base])
    for term in world.candidates:
        hidden = world.hidden[term.name]
        trials = [np.hstack([base, term.columns(data, **s)]) for s in grid(term, 9)]
        left = min(_left(hidden, columns) for columns in trials)
        alone = _left(hidden, base)
        assert 0 < left < 0.35 * alone, term.name
        assert 0.15 * world.noise < alone < 5 * world.noise, term.name


def _left(y: np.ndarray, columns: np.ndarray) -> float:
    scaled = columns / np.maximum(np.abs(columns).max(axis=0), 1e-300)
    return float(np.std(y - scaled @ np.linalg.lstsq(scaled, y, rcond=None)[0]))


def test_the_lag_of_a_step_is_exponential() -> None:
    import pandas as pd

    time = np.arange(50.0)
    air = np.where(time > 0, 1.0, 0.0)
    data = pd.DataFrame({"run": 1, "time": time, "temperature": air})
    lag = FORMULAS["lag"](data, "temperature", "run", tau=8.0)[:, 0]
    assert lag[2:] == pytest.approx(lag[1] * np.exp(-(time[2:] - 1) / 8.0), rel=1e-12)
    # the same ramp to the step, by small steps
    fine = np.linspace(0, 1, 11)[:, None] * np.ones((1, 1))
    follows = body(np.concatenate([fine[:, 0], np.ones(1)]), 0.1, 8.0)
    assert lag[1] == pytest.approx(follows[10] - 1, abs=0.01)
