"""Do the intervals cover? Simulation-based calibration of every instrument on its reference problem.

    python -m benchmarks coverage                            1000 data sets for each instrument
    python -m benchmarks.accuracy.coverage mems_gyro --replicates 100

Data sets are drawn from the priors that the fit uses (`bayescal_models/NAME/reference_problem.py`), and each is fitted
as `bc.fit` fits it: mode and importance sampling on the host. Where its weights are uneven, `bc.fit` would go on to
NUTS; here they count as they are.
Resumable: results/coverage_NAME.jsonl holds a line for each chunk, and chunks that stand there for the same model
are not computed again. Writes results/coverage.json and a figure for each instrument, results/coverage_NAME.png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._calibration.fitted import named
from bayescal._core.importance_weights import smoothed
from bayescal._inference import sampled_products
from bayescal._inference.laplace import find_mode
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._inference.sampling import WeightedDraws, weighted_draws
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import Layout, Levels, bind
from bayescal_models import INSTRUMENTS
from benchmarks.accuracy.chunks import (
    PROPOSALS,
    ROUNDS,
    asked,
    collect,
    fingerprint_of,
    promoted,
    seed_of,
)
from benchmarks.accuracy.ranks import Judgement, Posterior, band, drawn, judge, ranks
from benchmarks.record import RESULTS, read, write

LEVEL = 0.01  # chance that right programs fail somewhere, over all instruments and unknowns
UNEVEN = 0.7  # k̂ above which importance weights are not trusted


@dataclass(frozen=True)
class Ground:
    """An instrument's reference problem.

    Attributes:
        name: of the instrument.
        model: baseline effects, proper priors.
        plan: readings whose columns every data set shares.
        chunk: data sets of one line of the file.
    """

    name: str
    model: bc.Model
    plan: bc.Measurements
    chunk: int = 50

    @classmethod
    def of(cls, name: str) -> Ground:
        problem = import_module(f"bayescal_models.{name}.reference_problem")
        return cls(name, problem.model(), problem.readings())

    @cached_property
    def method(self) -> bc.Marginal:
        return bc.Marginal(
            proposals=PROPOSALS, rounds=ROUNDS, promote=promoted(self.model, self.plan)
        )

    @property
    def fingerprint(self) -> str:
        """Changes with the model, its priors, its response, the plan or the method."""
        data, _ = drawn(self.model, 1, self.plan, seed_of(self.name, 0))
        return fingerprint_of(self.model, data[0]["output"], repr(self.method), "one by one")

    def run(self, index: int) -> dict[str, Any]:
        """One chunk: ranks of every unknown, k̂ of every data set."""
        seed = seed_of(self.name, index)
        data, truth = drawn(self.model, self.chunk, self.plan, seed)
        made, k_hats = drawn_one_by_one(self.model, data, self.method, seed)
        found = ranks(made, truth, seed)
        return {
            "ranks": {name: [round(r, 5) for r in values] for name, values in found.items()},
            "pareto_k": [round(k_hat, 3) for k_hat in k_hats],
        }


def drawn_one_by_one(
    model: bc.Model, data: Sequence[bc.Measurements], method: bc.Marginal, seed: int
) -> tuple[list[Posterior], list[float]]:
    """Weighted draws of each data set by the engine, with their Pareto k̂."""
    made, k_hats = [], []
    for index, one in enumerate(data):
        found, of = drawn_once(model, one, method, seed + index)
        weights, k_hat = smoothed(found.log_weight)
        names = named(*of, *(a[None] for a in (found.x, found.v)))
        made.append(Posterior(weights, {str(n): names[n].values[0] for n in names}))
        k_hats.append(k_hat)
    return made, k_hats


def drawn_once(
    model: bc.Model, readings: bc.Measurements, method: bc.Marginal, seed: int
) -> tuple[WeightedDraws, tuple[Layout, Levels]]:
    """Weighted draws of one data set by the engine, and what their numbers are of."""
    layout, levels = bind(model, readings)
    frame = build_frame(readings, reference_of(readings))
    record = Record(model.instrument, frame, readings["output"])
    layout = sampled_products.choose(Problem(layout, record), method.promote)[0].layout
    problem = Problem(layout, record)
    drawn = weighted_draws(problem, find_mode(problem), seed, method.proposals, method.rounds)
    return drawn, (layout, levels)


def joined(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Ranks of every unknown over all chunks."""
    return {name: np.concatenate([row["ranks"][name] for row in rows]) for name in rows[0]["ranks"]}


def own_level(unknowns: int) -> float:
    """Level of the test of one unknown: shared over the instruments, then over an instrument's unknowns."""
    return LEVEL / (len(INSTRUMENTS) * unknowns)


def judged(found: dict[str, np.ndarray]) -> dict[str, Judgement]:
    return {name: judge(values, own_level(len(found))) for name, values in found.items()}


def uneven(rows: list[dict[str, Any]]) -> float:
    """Share of the data sets whose weights are not to be trusted."""
    return float(np.mean(np.concatenate([row["pareto_k"] for row in rows]) > UNEVEN))


def picture(name: str, found: dict[str, np.ndarray], path: Path) -> None:
    """Departure of each unknown's ECDF from uniform, within the simultaneous band."""
    import matplotlib.pyplot as plt  # only where there is something to draw

    count = len(next(iter(found.values())))
    limits = band(count, own_level(len(found)) / 2)
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    low, high = (edge / count - limits.points for edge in (limits.low, limits.high))
    axes.fill_between(
        limits.points, low, high, color="0.88", label="99 % band, all unknowns at once"
    )
    grid = np.linspace(0, 1, 401)
    for values in found.values():
        ecdf = np.searchsorted(np.sort(values), grid, side="right") / count
        axes.plot(grid, ecdf - grid, lw=0.8)
    axes.set(
        title=f"{name}: {len(found)} unknowns, {count} data sets drawn from the priors",
        xlabel="rank of the truth among the draws",
        ylabel="ECDF − uniform",
        xlim=(0, 1),
    )
    axes.legend(loc="upper right", frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def summary(ground: Ground, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What is written of one instrument."""
    found = joined(rows)
    verdicts = judged(found)
    count = len(next(iter(found.values())))
    coverage = {name: v.covered / count for name, v in verdicts.items()}
    return {
        "data_sets": count,
        "unknowns": len(found),
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


HEAD = f"{'instrument':26} {'data sets':>9} {'unknowns':>8} {'max KS':>7} {'95 % covers':>15} {'k̂ > 0.7':>8}  fails"


def line(name: str, s: dict[str, Any]) -> str:
    covers = f"{s['coverage95']['least']:.3f} … {s['coverage95']['most']:.3f}"
    fails = ", ".join(s["fails"]) or "none"
    return (
        f"{name:26} {s['data_sets']:9} {s['unknowns']:8} {s['largest_distance']:7.4f} {covers:>15} "
        f"{s['uneven_weights']:8.1%}  {fails}"
    )


def main(arguments: list[str] | None = None) -> None:
    """Compute what is missing, print the table, write results and figures."""
    names, replicates = asked(arguments, "benchmarks.accuracy.coverage", __doc__, INSTRUMENTS)
    summaries = read("coverage").get("instruments", {})
    print(HEAD)
    for name in names:
        ground = Ground.of(name)
        rows = collect(ground, replicates, RESULTS / f"coverage_{name}.jsonl")
        summaries[name] = summary(ground, rows)
        picture(name, joined(rows), RESULTS / f"coverage_{name}.png")
        print(line(name, summaries[name]), flush=True)
        write("coverage", {"level": LEVEL, "instruments": summaries})  # each as it comes


if __name__ == "__main__":
    main(sys.argv[1:])
