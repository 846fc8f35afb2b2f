"""Generation of tasks: track, instrument, hidden effects and their sizes, sets that the readings cannot distinguish."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from missing_effect.draws import Array, Draws
from missing_effect.edition import EDITION, TRACKS
from missing_effect.task import Task
from scipy.linalg import cho_factor, cho_solve

from missing_effect_maker.simulate.disturbances import NOT_WHITE, OUTSIDE, Noise, white
from missing_effect_maker.simulate.instruments import HOLDOUTS, INSTRUMENTS, READINGS, World, fleet

SPREAD = 3.0  # a hidden effect has between a third of its plausible size and three times that
# Correlation of confounded rivals, of their difference from one as 1 − ρ uniform in logarithm.
CORRELATIONS = (0.9, 0.999)
FREE = 0.3  # correlation of the same two quantities in the other tracks
# Nats: a rival within it is not told apart (Kass & Raftery 1995: "positive" begins there).
GROUPED = 3.0


class Case(NamedTuple):
    """A task in the plan: its track and its number there."""

    track: str
    number: int


@dataclass(frozen=True)
class GeneratedTask:
    """A task with its truth, the content of truth.json as plain data."""

    task: Task
    decimals: dict[str, int]
    truth: dict[str, Any]


def plan(edition: int = EDITION) -> list[Case]:
    """Return all tasks in order: tracks mixed so that each size has its share, and shuffled within a size."""
    ordered = [((n + 0.5) / count, t, n) for t, count in TRACKS.items() for n in range(count)]
    mixed = [Case(track, number) for _, track, number in sorted(ordered)]
    draws, cases = Draws(edition, 999), []
    for begin, end in pairwise((0, *sizes(edition))):
        cases += draws.shuffled(mixed[begin:end])
    return cases


def sizes(edition: int = EDITION) -> tuple[int, ...]:
    """Return the sizes of an edition: each contains the smaller ones, and has its share of each track.

    The published edition was fixed before the third one, of which 20 tasks are fleets, existed.
    """
    return (10, 100, 600) if edition == EDITION else (10, 100, 200, 600)


def generate(folder: Path, size: int, edition: int = EDITION) -> Iterator[tuple[str, str]]:
    """Write tasks; yield the name and the hash of each."""
    for place, case in enumerate(plan(edition)[:size]):
        task = make(f"task_{place:03d}", case, edition)
        yield task.task.name, write(task, folder / task.task.name)


def make(name: str, case: Case, edition: int = EDITION) -> GeneratedTask:
    """Generate one task."""
    draws = Draws(edition, list(TRACKS).index(case.track), case.number)
    of_fleet = case.track == "fleet" or (case.track == "empty" and case.number % 10 == 9)
    correlation = FREE
    if case.track == "confounded":
        correlation = 1 - draws.ratio(1 - CORRELATIONS[1], 1 - CORRELATIONS[0])
    instruments = list(INSTRUMENTS.values())
    turn = case.number + case.number // len(instruments)  # each instrument gets every law in turn
    world = (fleet if of_fleet else instruments[case.number % len(instruments)])(draws, correlation)
    count = len(world.columns["time"])
    other = not of_fleet and (case.track == "noise" or (case.track == "empty" and turn % 2))
    noise = (draws.one_of(NOT_WHITE) if other else white)(draws, count)
    hidden = _hidden(world, case, draws)
    outside, what = np.zeros(count), ""
    if case.track == "outside":
        law = OUTSIDE[turn % len(OUTSIDE)]
        shape = law(draws, world.columns["time"], world.columns["temperature"])
        outside = draws.sign() * draws.ratio(0.7, 3.0) * world.noise * shape / _rms(shape)
        what = law.__name__
    parts = {name: share * world.hidden[name] for name, share in hidden.items()}
    if what:
        parts["outside"] = outside
    true = world.known + sum(parts.values(), start=np.zeros(count))
    output = true + world.noise * noise.values
    holdout_rows = _held_out(world)
    frame = pd.DataFrame({**world.columns, "output": output})
    for column, places in world.decimals.items():
        frame[column] = frame[column].round(places)
    train, holdout = (frame.loc[at].reset_index(drop=True) for at in (~holdout_rows, holdout_rows))
    task = Task(
        name,
        world.unit,
        world.units,
        train,
        holdout.drop(columns="output"),
        tuple(world.base),
        tuple(draws.shuffled(world.candidates)),
    )
    likelihood = _Likelihood.of(task, world.noise, noise, ~holdout_rows)
    truth = {
        "track": case.track,
        "instrument": "fleet" if of_fleet else instruments[case.number % 6].__name__,
        "noise": noise.law,
        "outside": what,
        "set": sorted(hidden),
        "sizes": {n: round(share, 6) for n, share in sorted(hidden.items())},
        "correlation": round(correlation, 6) if case.track == "confounded" else None,
        "decided": likelihood.decided(parts, world.noise),
        "equivalent": _equivalent(world, hidden, likelihood, case),
        "noise_sd": world.noise,
        "holdout": [round(float(y), world.decimals["output"]) for y in holdout["output"]],
        "expected": [round(float(y), world.decimals["output"] + 2) for y in true[holdout_rows]],
    }
    return GeneratedTask(task, world.decimals, truth)


def write(task: GeneratedTask, folder: Path) -> str:
    """Write a task's four files; return the SHA-256 of their concatenated bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    for name, text in contents(task).items():
        (folder / name).write_bytes(text)
        digest.update(text)
    return digest.hexdigest()


def contents(generated: GeneratedTask) -> dict[str, bytes]:
    """Return the files of a task, by name."""
    task = generated.task
    return {
        "train.csv": _csv(task.train, generated.decimals),
        "holdout.csv": _csv(task.holdout, generated.decimals),
        "task.json": _json(task.description()),
        "truth.json": _json(generated.truth),
    }


def _csv(frame: pd.DataFrame, decimals: dict[str, int]) -> bytes:
    """Format a table with fixed decimals, minus zero as zero."""
    columns = []
    for name in frame:
        places = decimals[str(name)]
        columns.append([f"{v + 0.0:.{places}f}" for v in frame[name].tolist()])
    rows = [",".join(map(str, frame.columns)), *map(",".join, zip(*columns, strict=True))]
    return ("\n".join(rows) + "\n").encode()


def _json(document: dict[str, Any]) -> bytes:
    return (json.dumps(_plain(document), indent=1, ensure_ascii=False) + "\n").encode()


def _plain(value: Any) -> Any:
    """Round numbers to nine digits, since the last ones may differ between machines."""
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}")
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value


def _hidden(world: World, case: Case, draws: Draws) -> dict[str, float]:
    """Draw the hidden effects, in plausible sizes."""
    if case.track in ("empty", "outside"):
        return {}
    names = [c.name for c in world.candidates]
    if case.track == "confounded":
        names, count = list(world.environment), 1
    else:
        count = 2 if draws.between(0, 1) < 0.3 else 1
    chosen = draws.shuffled(names)[:count]
    return {n: draws.sign() * draws.ratio(1 / SPREAD, SPREAD) for n in sorted(chosen)}


def _held_out(world: World) -> Array:
    """Return the mask of the hold-out readings: the last run, or the last readings of each device."""
    if "device" in world.columns:
        return np.arange(len(world.columns["device"])) % READINGS >= READINGS - HOLDOUTS
    return world.columns["run"] == world.columns["run"].max()


def _rms(values: Array) -> float:
    return float(np.std(values))


@dataclass(frozen=True)
class _Likelihood:
    """The simulator's likelihood of the training readings, with the base terms integrated out.

    Attributes:
        y: output in standard deviations of the white noise, (n,).
        base: columns of the base terms times their plausible sizes, in the same unit, (n, q).
        factor: Cholesky factor of the noise covariance; its square root if diagonal.
        rows: indices of the training readings.
    """

    y: Array
    base: Array
    factor: Any
    rows: Array
    sd: float

    @classmethod
    def of(cls, task: Task, sd: float, noise: Noise, rows: Array) -> _Likelihood:
        covariance = noise.covariance
        if covariance.ndim == 1:
            factor = np.sqrt(covariance[rows])
        else:
            factor = cho_factor(covariance[np.ix_(rows, rows)], lower=True)
        base = np.hstack([t.size / sd * t.columns(task.train) for t in task.base])
        return cls(task.train["output"].to_numpy(float) / sd, base, factor, rows, sd)

    def _inverse(self, columns: Array) -> Array:
        if isinstance(self.factor, np.ndarray):
            return columns / (self.factor**2)[:, None]
        return cho_solve(self.factor, columns)

    def gain(self, parts: Sequence[tuple[Array, float]]) -> float:
        """Return the log evidence, up to a constant, with some causes included.

        Args:
            parts: contribution of each cause, and the standard deviation of the number that multiplies it.
        """
        added = [sd * part[self.rows, None] / self.sd for part, sd in parts]
        x = np.hstack([self.base, *added])
        weighted = self._inverse(x)
        inner = np.eye(x.shape[1]) + x.T @ weighted
        root = np.linalg.cholesky(inner)
        right = np.linalg.solve(root, weighted.T @ self.y)
        return float(0.5 * right @ right - np.log(np.diag(root)).sum())

    def decided(self, parts: dict[str, Array], sd: float) -> float | None:
        """Return the smallest log Bayes factor of the truth over itself without one cause; None for an empty task."""
        if not parts:
            return None
        whole = self.gain([(p, 1.0) for p in parts.values()])
        less = (
            self.gain([(p, 1.0) for n, p in parts.items() if n != without]) for without in parts
        )
        return round(min(whole - other for other in less), 1)


def _equivalent(
    world: World, hidden: dict[str, float], likelihood: _Likelihood, case: Case
) -> list[list[str]]:
    """Return the sets that the readings cannot distinguish from the truth; for a confounded task, the rival's set."""
    if case.track != "confounded":
        return []
    (true,) = hidden
    (rival,) = set(world.environment) - {true}
    gains = {n: likelihood.gain([(world.hidden[n], SPREAD**0.5)]) for n in (true, rival)}
    return [[rival]] if gains[true] - gains[rival] < GROUPED else []
