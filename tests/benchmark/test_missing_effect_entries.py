"""The open benchmark's runner and scores: an entry that cheats is refused, and a score is what it is said to be."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from missing_effect import prior, run
from missing_effect.entries import bic, bma, exhaustive, mbic
from missing_effect.regression import Regression
from missing_effect.score import FLOOR, Score, calibration, score, summary
from missing_effect.task import Task
from missing_effect_maker.generate import Case, generate, make, write
from scipy.integrate import quad
from scipy.special import ndtr

HONEST = """
import numpy as np
def solve(task):
    n = len(task.holdout)
    return {"sets": {(): 0.5}, "mean": np.zeros(n), "sd": np.ones(n)}
"""
CHEATS = {
    "network": ("import socket; socket.create_connection(('127.0.0.1', 9))", "the network"),
    "truth": ("open(TRUTH).read()", "truth.json"),
    "truth unbuffered": ("import io, pathlib; io.FileIO(pathlib.Path(TRUTH))", "truth.json"),
    "truth by another name": ("import os; os.symlink(TRUTH, 'a'); open('a').read()", "truth.json"),
    "program": ("import subprocess; subprocess.run(['true'])", "another process"),
    "fork": ("import os; os.fork() or os._exit(0)", "another process"),
    "maker": ("import missing_effect_maker.generate", "makes tasks"),
    "runs on": ("\n    while True: pass", "of processor"),
}


@pytest.fixture(scope="module")
def tasks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tasks")
    assert len(list(generate(folder, 3))) == 3
    return folder


def answer_of(tasks: Path, folder: Path, code: str, limit: float = 20.0) -> dict:
    entry = folder / "entry.py"
    entry.write_text(code, "utf-8")
    return run.solve(entry, tasks / "task_000", tasks, limit)


def test_an_honest_entry_is_answered(tasks: Path, tmp_path: Path) -> None:
    answer = answer_of(tasks, tmp_path, HONEST)
    assert "failed" not in answer and answer["sets"] == [[[], 0.5]] and answer["seconds"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("how", CHEATS)
def test_an_entry_that_cheats_is_refused(tasks: Path, tmp_path: Path, how: str) -> None:
    act, said = CHEATS[how]
    act = act.replace("TRUTH", repr(str(tasks / "task_000" / "truth.json")))
    code = HONEST.replace(
        "    n =", f"    try:\n        {act.strip()}\n    except Exception: pass\n    n ="
    )
    answer = answer_of(tasks, tmp_path, code, limit=2.0 if how == "runs on" else 20.0)
    assert said in answer["failed"] and "mean" not in answer


@pytest.mark.skipif(not run.can_hide(), reason="this system lets no user make namespaces")
def test_tasks_cannot_be_found_by_an_entry(tasks: Path, tmp_path: Path) -> None:
    """Where namespaces are, an entry sees an empty folder in place of the tasks, whatever the name of the truth."""
    code = HONEST.replace("(): 0.5", f"(): 0.1 + len(__import__('os').listdir({str(tasks)!r}))")
    assert answer_of(tasks, tmp_path, code)["sets"] == [[[], 0.1]]


TRUTH: dict[str, Any] = {
    "track": "linear",
    "instrument": "mems_gyro",
    "set": ["a", "b"],
    "equivalent": [["a", "c"]],
    "decided": 20.0,
    "noise_sd": 0.5,
    "holdout": [1.0, 2.0, 4.0],
    "expected": [1.0, 2.0, 3.0],
}


def scored_as(sets: list | None, **truth: object) -> Score:
    answer = {"sets": sets, "mean": [1.0, 2.0, 3.0], "sd": [0.4] * 3, "seconds": 1.0}
    return score(answer, {**TRUTH, **truth}, Path())


def test_equivalent_sets_are_the_truth_together() -> None:
    found = scored_as([[["a", "b"], 0.3], [["a", "c"], 0.4], [["a"], 0.2]])
    assert found.log == pytest.approx(math.log(0.7))
    assert found.log_exact == pytest.approx(math.log(0.3))
    assert found.brier == pytest.approx(0.3**2 + 0.2**2) and found.top == (0.7, True)


def test_a_probability_of_zero_costs_the_floor() -> None:
    assert scored_as([[["c"], 1.0]]).log == math.log(FLOOR)
    assert scored_as(None).log is None


def test_crps_is_its_integral() -> None:
    def integral(y: float, mean: float, sd: float) -> float:
        below, _ = quad(lambda x: ndtr((x - mean) / sd) ** 2, mean - 10, y)
        above, _ = quad(lambda x: ndtr((mean - x) / sd) ** 2, y, mean + 10)
        return below + above

    each = [integral(y, m, 0.4) for y, m in zip(TRUTH["holdout"], TRUTH["expected"], strict=True)]
    found = scored_as([[[], 1.0]])
    assert found.crps == pytest.approx(np.mean(each) / 0.5, rel=1e-6)
    assert found.covered == pytest.approx(2 / 3)


def test_an_interval_holds_its_mean_and_bands_count_every_task() -> None:
    scores = {str(i): scored_as([[["a", "b"], 0.5 + 0.004 * i]]) for i in range(100)}
    mean, low, high = summary(scores).log
    assert low < mean < high and mean == pytest.approx(
        np.mean([math.log(0.5 + 0.004 * i) for i in range(100)])
    )
    assert sum(row["count"] for row in calibration(scores)) == 100


@pytest.mark.parametrize("entry", [bic, mbic, bma, exhaustive], ids=lambda e: e.__name__)
def test_an_entry_finds_what_the_readings_decide(entry, tmp_path: Path) -> None:
    """White noise, one effect, thirty nats and more: the true set has more probability than any other."""
    found = 0
    for number in range(12):
        made = make("task", Case("linear", number), edition=77)
        if len(made.truth["set"]) == 1 and made.truth["decided"] > 30:
            write(made, tmp_path)
            sets = entry.solve(Task.read(tmp_path))["sets"]
            found += max(sets, key=sets.get) == tuple(made.truth["set"])
            found -= sum(sets.values()) > 1 + 1e-9
            break
    assert found == 1


def test_a_prediction_is_the_bases_and_what_candidates_add_beyond_it(tmp_path: Path) -> None:
    write(make("task", Case("linear", 0), edition=77), tmp_path)
    problem = Regression(Task.read(tmp_path))
    assert [c.train.shape[1] for c in problem.candidates[:1]] == [1]
    column = problem.projected[0][:, 0]
    size = column @ problem.left / (column @ column)
    expected = problem.predict(())[0] + size * problem.beyond[:, 0]
    assert problem.predict((0,))[0] == pytest.approx(expected, rel=1e-7)
    noise = np.sqrt(problem.left @ problem.left / (problem.y.size - problem.parameters))
    sd = np.sqrt(noise**2 * problem.of_base + problem.extra)
    assert problem.predict(())[1] == pytest.approx(sd, rel=1e-12)
    assert np.all(problem.of_base > 1)


def test_the_evidence_of_a_set_is_that_of_the_whole_covariance() -> None:
    """Base, coloured noise and two coefficients against none, at the noise's size that the set leaves."""
    rng = np.random.default_rng(4)
    lags = np.abs(np.subtract.outer(np.arange(50), np.arange(50)))
    coloured = np.exp(-lags / 3)
    base = rng.standard_normal((50, 4))
    x = rng.standard_normal((50, 2))
    y = rng.standard_normal(50) + x @ [1.0, -0.5]
    term = exhaustive.Columns("a", x[None], x[None])
    law = exhaustive.Law("coloured", covariance=coloured)
    found = exhaustive.Products(law, y, (base, base), [term])
    own, none = found.weigh((term,)), found.weigh(())
    noise = float(own.noise[0])
    left, before = noise * 50, float(none.noise[0]) * 50
    gained = own.evidence[0] + np.log(exhaustive.SPREADS.size) - none.evidence[0, 0]
    gained += 25 * np.log(left / before) + (before - left) / (2 * noise)

    def density(covariance: np.ndarray) -> float:
        return float(-np.linalg.slogdet(covariance)[1] - y @ np.linalg.solve(covariance, y)) / 2

    without = noise * (coloured + base @ base.T)
    for size, value in zip(exhaustive.SPREADS, gained, strict=True):
        whole = density(without + size**2 * x @ x.T) - density(without)
        assert value == pytest.approx(whole, rel=1e-6)


def test_sets_have_the_data_sheets_shares() -> None:
    """Of white, coloured and outside together they are those of the tracks, whatever the number of candidates."""
    for count in (7, 10):
        whole = [
            sum(prior.weight(kind, k, count) * math.comb(count, k) for k in range(5))
            for kind in ("white", "coloured", "outside")
        ]
        assert whole == pytest.approx([210, 180, 60])
    assert prior.weight("white", 3, 7) == 0.0
