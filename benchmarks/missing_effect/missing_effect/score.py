"""Scores of an entry's probabilities and predictions for each task, and their means with bootstrap intervals.

Sources: log score, Brier score and CRPS of a normal distribution, T. Gneiting & A. Raftery, J. Am. Stat. Assoc. 102
(2007) 359 (equation 21); bootstrap percentiles, B. Efron & R. Tibshirani (1993), chapter 13.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtr
from scipy.stats import binomtest

from missing_effect.draws import Draws
from missing_effect.edition import FILES, published
from missing_effect.run import InputError, task_folders
from missing_effect.task import OUTSIDE

FLOOR = 1e-3  # a probability below it counts as it: one blunder costs ln 1000 = 6.9, not everything
CLAIM = 0.95  # probability that something is missing from which an entry is taken to say so
# Nats by which the readings decide for the truth, as the simulator's likelihood has it.
CLEAR = 15.0
BANDS = (0.0, 0.5, 0.8, 0.95, 1.0)  # of the probability of the most probable set
Z95 = 1.959963984540054
RESAMPLES = 2000
ORACLE = "oracle"


@dataclass(frozen=True)
class Score:
    """Scores of one entry on one task; None if the entry states no sets.

    Attributes:
        track: track of the task.
        clear: whether the log Bayes factor of the truth exceeds `CLEAR`.
        log: ln of the total probability of the true set and the sets equivalent to it, at least ln FLOOR.
        log_exact: the same for the true set alone.
        brier: Σ (p − 1[set is true])² over sets, with equivalent sets added up: 0 to 2.
        alarm: false alarm of an empty task: a probability above `CLAIM` that anything ("outside" too) is missing.
        likely_alarm: the same, with a probability above one half.
        top: probability of the most probable set, and whether it is true.
        crps: mean CRPS of the hold-out readings, in standard deviations of their noise.
        covered: fraction of hold-out readings inside the stated 95 % interval.
        seconds: processor time, s.
        failed: why there is no answer.
        fleet: whether the task has many devices; some of these tasks are empty.
    """

    track: str
    clear: bool
    log: float | None
    log_exact: float | None
    brier: float | None
    alarm: bool | None
    likely_alarm: bool | None
    top: tuple[float, bool] | None
    crps: float
    covered: float
    seconds: float
    failed: str = ""
    fleet: bool = False


@dataclass(frozen=True)
class Summary:
    """Mean scores over tasks, each with its 95 % bootstrap interval (mean, low, high); NaN if nothing is stated."""

    log: tuple[float, float, float]
    log_exact: tuple[float, float, float]
    brier: tuple[float, float, float]
    alarm: tuple[float, float, float]
    likely_alarm: tuple[float, float, float]
    crps: tuple[float, float, float]
    covered: tuple[float, float, float]
    seconds: tuple[float, float, float]


def scored(tasks: Path, results: Path, entry: str, size: int | None) -> dict[str, Score]:
    """Return the scores of an entry, by task.

    Raises:
        InputError: a task has no answer yet.
    """
    scores = {}
    for folder in task_folders(tasks, size):
        truth = json.loads((folder / "truth.json").read_text("utf-8"))
        place = results / entry / f"{folder.name}.json"
        if entry == ORACLE:
            answer = knowing(truth)
        elif place.is_file():
            answer = json.loads(place.read_text("utf-8"))
        else:
            raise InputError(
                f"{entry} has no answer to {folder.name} in {results}: run it with "
                f"`python -m missing_effect run {entry}`"
            )
        scores[folder.name] = score(answer, truth, folder)
    return scores


def entries_in(results: Path, tasks: Path, size: int | None) -> list[str]:
    """Return the entries that have an answer to each of the tasks."""
    names = {f.name for f in task_folders(tasks, size)}
    return sorted(p.name for p in results.glob("*/") if names <= {f.stem for f in p.glob("*.json")})


def knowing(truth: dict[str, Any]) -> dict[str, Any]:
    """Return the oracle's answer: the true set, the true output without noise, and the noise's standard deviation."""
    sd = [truth["noise_sd"]] * len(truth["holdout"])
    return {"sets": [[truth["set"], 1.0]], "mean": truth["expected"], "sd": sd, "seconds": 0.0}


def score(answer: dict[str, Any], truth: dict[str, Any], folder: Path) -> Score:
    """Score one answer. A failed answer counts as the mean of the training readings, without sets."""
    failed = answer.get("failed", "")
    y, noise = np.asarray(truth["holdout"]), truth["noise_sd"]
    if failed:
        past = pd.read_csv(folder / "train.csv")["output"].to_numpy(float)
        answer = {**answer, "sets": [], "mean": [past.mean()] * y.size, "sd": [past.std()] * y.size}
    mean, sd = np.asarray(answer["mean"]), np.asarray(answer["sd"])
    z = (y - mean) / sd
    decided = truth["decided"]
    of_sets = dict.fromkeys(("log", "log_exact", "brier", "alarm", "likely_alarm", "top"))
    if answer["sets"] is not None:
        of_sets = _of_sets(answer["sets"], truth)
    return Score(
        truth["track"],
        decided is not None and decided > CLEAR,
        **of_sets,
        crps=float(np.mean(_crps(z) * sd)) / noise,
        covered=float(np.mean(np.abs(z) <= Z95)),
        seconds=answer["seconds"],
        failed=failed,
        fleet=truth["instrument"] == "fleet",
    )


def _of_sets(stated: list[Any], truth: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of the stated sets; "outside" is removed from a set before it is compared with the truth."""
    probability: dict[frozenset[str], float] = {}
    something = 0.0
    for names, p in stated:
        something += p if names else 0.0
        named = frozenset(names) - {OUTSIDE}
        probability[named] = probability.get(named, 0.0) + p
    true = frozenset(truth["set"])
    same = {true, *(frozenset(e) for e in truth["equivalent"])}
    exact = probability.get(true, 0.0)
    p_true = min(1.0, sum(probability.get(s, 0.0) for s in same))
    others = [p for s, p in probability.items() if s not in same]
    top = max([(p_true, True), *((p, False) for p in others)])
    empty = truth["track"] == "empty"
    return {
        "log": math.log(max(p_true, FLOOR)),
        "log_exact": math.log(max(exact, FLOOR)),
        "brier": (1 - p_true) ** 2 + sum(p**2 for p in others),
        "alarm": something > CLAIM if empty else None,
        "likely_alarm": something > 0.5 if empty else None,
        "top": top if stated else None,
    }


def _crps(z: np.ndarray) -> np.ndarray:
    """Return the CRPS of a standard normal distribution at z."""
    density = np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    return z * (2 * ndtr(z) - 1) + 2 * density - 1 / math.sqrt(math.pi)


def summary(scores: dict[str, Score]) -> Summary:
    """Return mean scores with bootstrap intervals; entries with equally many tasks have the same resamples."""
    columns = {
        f.name: np.array(
            [math.nan if (v := getattr(s, f.name)) is None else float(v) for s in scores.values()]
        )
        for f in fields(Summary)
    }
    count = len(scores)
    pick = (Draws(20261125).uniform(RESAMPLES * count) * count).astype(int).reshape(-1, count)
    return Summary(**{name: _interval(values, pick) for name, values in columns.items()})


def _interval(values: np.ndarray, pick: np.ndarray) -> tuple[float, float, float]:
    if np.isnan(values).all():
        return math.nan, math.nan, math.nan
    finite = ~np.isnan(values[pick])
    sums = np.where(finite, values[pick], 0.0).sum(axis=1)
    means = sums[finite.any(axis=1)] / finite.sum(axis=1)[finite.any(axis=1)]
    low, high = np.quantile(means, [0.025, 0.975])
    return float(np.nanmean(values)), float(low), float(high)


def calibration(scores: dict[str, Score]) -> list[dict[str, Any]]:
    """Return, by band of the top probability: number of tasks, mean probability, fraction true, 95 % interval."""
    tops = [s.top for s in scores.values() if s.top is not None]
    rows = []
    for low, high in pairwise(BANDS):
        inside = [t for t in tops if low <= t[0] < high or (high == 1.0 == t[0])]
        if inside:
            right = sum(true for _, true in inside)
            ends = binomtest(right, len(inside)).proportion_ci(0.95)
            stated = float(np.mean([p for p, _ in inside]))
            row = {"band": (low, high), "count": len(inside), "stated": stated}
            rows.append({**row, "true": right / len(inside), "interval": (ends.low, ends.high)})
    return rows


def alien(tasks: Path, size: int | None) -> list[str]:
    """Return the tasks that are not byte for byte those of the published edition."""
    editions, unknown = published(), []
    for folder in task_folders(tasks, size):
        digest = hashlib.sha256()
        for name in (*FILES, "truth.json"):
            digest.update((folder / name).read_bytes())
        if editions.get(folder.name) != digest.hexdigest():
            unknown.append(folder.name)
    return unknown


def by_track(scores: dict[str, Score], of: Callable[[Score], float | None]) -> dict[str, float]:
    """Return the mean of a score for each track."""
    tracks: dict[str, list[float]] = {}
    for s in scores.values():
        if (value := of(s)) is not None:
            tracks.setdefault(s.track, []).append(float(value))
    return {t: float(np.mean(v)) for t, v in tracks.items()}
