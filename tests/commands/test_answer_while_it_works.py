"""A search tells how it goes on, ends when it is asked to, and is taken up where it was ended."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import bayescal as bc
from bayescal._search import discover as search_module
from tests.support.command_line import GYRO, QUICK, TABLE, needs_installation, run

pytestmark = needs_installation


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The walk as if Ctrl-C were pressed after its first look around; the seeds that each walk was given."""
    real, given = search_module.walk, []

    def walk(library, max_effects, follow, seeds, last):
        given.append(list(seeds))

        def once(structures):
            follow(structures)
            raise KeyboardInterrupt

        return real(library, max_effects, once, seeds, last)

    monkeypatch.setattr(search_module, "walk", walk)
    return given


def calibrate(folder: Path, *more: object):
    return run("calibrate", folder / "bent.csv", *GYRO, *QUICK, *more)


def test_ctrl_c_leaves_the_best_so_far_and_the_next_run_takes_it_up(
    loop: Any, folder: Path, tmp_path: Path, interrupted: list[Any]
) -> None:
    done = calibrate(folder, "--out", tmp_path)
    assert done.status == 0, done.err
    assert done.out.startswith("WHERE THE FIRST MODEL FAILS")
    assert done.out.count("WHERE THE FIRST MODEL FAILS") == 1
    assert "structures weighed; best so far: + bias.temperature_quadratic" in done.err
    assert "end: The search was interrupted after" in done.out
    data = json.loads((tmp_path / "result.json").read_text("utf-8"))
    assert data["complete"] is False
    assert data["search"]["stopped"].startswith("The search was interrupted")
    again = calibrate(folder, "--out", tmp_path, "--json")
    assert again.said == [
        f"bayescal: note: goes on with the search in {tmp_path}, which was ended early"
    ]
    assert again.data["steps"][-1]["added"] == "bias.temperature_quadratic"
    assert again.data["search"]["resumed"] == len(data["search"]["structures"])
    assert again.data["search"]["ending"].count("was resumed from") == 1
    assert loop.data["search"]["resumed"] == 0 and "resumed" not in loop.data["search"]["ending"]
    first, second = interrupted
    assert first == []
    told = {(frozenset(s["effects"]), s["noise"]) for s in data["search"]["structures"]}
    assert {(s.effects, s.noise) for s in second} == told


def test_other_readings_begin_anew(folder: Path, tmp_path: Path, interrupted: list[Any]) -> None:
    calibrate(folder, "--out", tmp_path)
    other = run("calibrate", TABLE, *GYRO, *QUICK, "--out", tmp_path, "--json")
    assert not other.said
    assert interrupted[-1] == []


def test_a_search_that_ended_is_not_taken_up(loop: Any, folder: Path) -> None:
    from bayescal._report.result_json import earlier
    from bayescal_models import mems_gyro

    assert loop.data["complete"] is True
    readings = bc.read(folder / "bent.csv", mems_gyro.INSTRUMENT)
    assert earlier(folder / "loop", mems_gyro.INSTRUMENT.baseline(), readings) == ()


def test_the_result_is_there_from_the_first_step_on(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: Any) -> str:
        raise MemoryError

    monkeypatch.setattr(search_module, "walk", killed)
    with pytest.raises(MemoryError):
        calibrate(folder, "--out", tmp_path)
    data = json.loads((tmp_path / "result.json").read_text("utf-8"))
    assert data["complete"] is False
    assert [s["title"] for s in data["steps"]] == ["baseline"]
    refused = run("report", tmp_path, "-o", tmp_path / "r.html")
    assert refused.status == 2
    assert not (tmp_path / "r.html").exists()


def test_a_time_limit_ends_the_search_and_json_stays_json(folder: Path) -> None:
    done = calibrate(folder, "--time-limit", "1e-6", "--json")
    assert done.status in (0, 1)
    assert done.data["complete"] is False
    assert done.data["search"]["stopped"].startswith("The search was ended after")
    assert done.data["search"]["ending"].startswith(done.data["search"]["stopped"])


def test_the_end_says_why(folder: Path) -> None:
    nothing = run("calibrate", TABLE, *GYRO, *QUICK, "--json").data["search"]["ending"]
    assert "below the 0.95 asked for" in nothing
    bound = calibrate(folder, "--max-effects", 1, "--json").data["search"]["ending"]
    assert bound.startswith("The search has added as many effects as it may, 1")
