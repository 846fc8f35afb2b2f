"""Coverage of intervals: simulation-based calibration of every instrument on its reference problem.

Data sets are drawn from the priors that the fit uses (`reference_problem` of an instrument), and each is fitted as
`bc.fit` does by default: mode and importance sampling. With uneven weights `bc.fit` would continue with NUTS; here the
weighted draws are used unchanged.
Ranks and coverage are stored in results/coverage.json.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._core.importance_weights import smooth
from bayescal._inference import sampled_products
from bayescal._inference.laplace import find_mode
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._inference.sampling import WeightedDraws, draw_weighted
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import Layout, Levels, Unknowns, bind
from bayescal_models import INSTRUMENTS
from benchmarks.accuracy.ranks import Judgement, Posterior, drawn, judge, ranks
from benchmarks.bank import Bank
from benchmarks.record import read, write

REPLICATES, CHUNK = 1000, 50  # data sets of each instrument, and of one row
PROPOSALS, ROUNDS = 2048, 3  # of `Marginal`
LEVEL = 0.01  # chance that right programs fail somewhere, over all instruments and unknowns
UNEVEN = 0.7  # k̂ above which importance weights are not trusted


@dataclass(frozen=True)
class Ground:
    """An instrument's reference problem.

    Attributes:
        name: name of the instrument.
        model: baseline effects with proper priors.
        plan: readings whose columns all data sets have.
        chunk: number of data sets per row.
    """

    name: str
    model: bc.Model
    plan: bc.Measurements
    chunk: int = CHUNK

    @classmethod
    def of(cls, name: str) -> Ground:
        problem = import_module(f"bayescal_models.{name}").reference_problem
        return cls(name, problem.model(), problem.readings())

    @cached_property
    def method(self) -> bc.Marginal:
        return bc.Marginal(
            proposals=PROPOSALS, rounds=ROUNDS, promote=promoted(self.model, self.plan)
        )

    def run(self, index: int) -> dict[str, Any]:
        """Compute the ranks of every unknown for one chunk, and k̂ of each data set."""
        seed = seed_of(self.name, index)
        data, truth = drawn(self.model, self.chunk, self.plan, seed)
        samples, k_hats = drawn_one_by_one(self.model, data, self.method, seed)
        rank_sums = ranks(samples, truth, seed)
        return {
            "ranks": {name: [round(r, 5) for r in values] for name, values in rank_sums.items()},
            "pareto_k": [round(k_hat, 3) for k_hat in k_hats],
        }


def seed_of(name: str, index: int) -> int:
    """Return the seed of one chunk; instruments have different seeds, so that their data sets are independent."""
    return zlib.crc32(f"{name} {index}".encode())


def promoted(model: bc.Model, plan: bc.Measurements) -> tuple[str, ...]:
    """Return the coefficients that `Marginal` samples; chosen once for the plan, so that data sets share a program."""
    layout, _ = bind(model, plan)
    record = Record(model.instrument, build_frame(plan, reference_of(plan)), plan["output"])
    return sampled_products.promote_products(Problem(layout, record), None)[0].layout.promoted


def drawn_one_by_one(
    model: bc.Model, data: Sequence[bc.Measurements], method: bc.Marginal, seed: int
) -> tuple[list[Posterior], list[float]]:
    """Draw weighted posterior samples of each data set; return them with their Pareto k̂."""
    samples, k_hats = [], []
    for index, data_set in enumerate(data):
        draws, of = drawn_once(model, data_set, method, seed + index)
        weights, k_hat = smooth(draws.log_weight)
        unknowns = Unknowns.of(*of)
        values = unknowns.values(draws.x, draws.v)
        samples.append(Posterior(weights, {n: unknowns.select(values, n) for n in unknowns.by_key}))
        k_hats.append(k_hat)
    return samples, k_hats


def drawn_once(
    model: bc.Model, readings: bc.Measurements, method: bc.Marginal, seed: int
) -> tuple[WeightedDraws, tuple[Layout, Levels]]:
    """Draw weighted posterior samples of one data set; return them with layout and levels of their unknowns."""
    layout, levels = bind(model, readings)
    frame = build_frame(readings, reference_of(readings))
    record = Record(model.instrument, frame, readings["output"])
    layout = sampled_products.promote_products(Problem(layout, record), method.promote)[0].layout
    problem = Problem(layout, record)
    drawn = draw_weighted(problem, find_mode(problem), seed, method.proposals, method.rounds)
    return drawn, (layout, levels)


def joined(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Join the ranks of every unknown over all chunks."""
    return {name: np.concatenate([row["ranks"][name] for row in rows]) for name in rows[0]["ranks"]}


def own_level(unknowns: int) -> float:
    """Return the significance level of one unknown: divided among instruments, then among an instrument's unknowns."""
    return LEVEL / (len(INSTRUMENTS) * unknowns)


def judged(rank_sums: dict[str, np.ndarray]) -> dict[str, Judgement]:
    return {name: judge(values, own_level(len(rank_sums))) for name, values in rank_sums.items()}


def uneven(rows: list[dict[str, Any]]) -> float:
    """Return the fraction of data sets with unreliable importance weights."""
    return float(np.mean(np.concatenate([row["pareto_k"] for row in rows]) > UNEVEN))


def summary(ground: Ground, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise the ranks of one instrument."""
    joined_ranks = joined(rows)
    verdicts = judged(joined_ranks)
    count = len(next(iter(joined_ranks.values())))
    coverage = {name: v.covered / count for name, v in verdicts.items()}
    return {
        "data_sets": count,
        "unknowns": len(joined_ranks),
        "readings": len(ground.plan),
        "promoted": list(ground.method.promote or ()),
        "uneven_weights": uneven(rows),
        "largest_distance": max(v.distance for v in verdicts.values()),
        "coverage95": {"least": min(coverage.values()), "most": max(coverage.values())},
        "fails": {n: v._asdict() for n, v in verdicts.items() if not v.ok},
        "by_unknown": {
            n: {"distance": round(v.distance, 4), "coverage95": coverage[n]}
            for n, v in verdicts.items()
        },
        "seconds": round(sum(row["seconds"] for row in rows), 1),
    }


def cases(name: str) -> Iterator[tuple[tuple[int], tuple[str, int]]]:
    """Yield the chunks of an instrument's data sets."""
    return (((index,), (name, index)) for index in range(REPLICATES // CHUNK))


def measure(case: tuple[str, int]) -> dict[str, Any]:
    """Return the row of one chunk."""
    name, index = case
    return Ground.of(name).run(index)


BANKS = tuple(Bank(f"coverage_{n}", partial(cases, n), measure, ("chunk",)) for n in INSTRUMENTS)


def main() -> None:
    """Write results/coverage.json from the stored rows; instruments without rows keep their previous results."""
    instruments = read("coverage")["instruments"]
    new = {
        n: summary(Ground.of(n), b.rows) for n, b in zip(INSTRUMENTS, BANKS, strict=True) if b.rows
    }
    if new:
        write("coverage", {"level": LEVEL, "instruments": {**instruments, **new}})
