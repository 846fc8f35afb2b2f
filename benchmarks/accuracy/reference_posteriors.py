"""Write `reference_posterior.json` of an instrument: the posterior of its reference problem by long NUTS runs.

    python -m benchmarks.accuracy.reference_posteriors mems_gyro
    python -m benchmarks.accuracy.reference_posteriors ng_accelerometer --sampler whitened

The reference must be independent of what it tests, so coefficients are never integrated out. `program` is NumPyro's
NUTS on the plain program (`bc.NUTS`); `whitened` runs the same kernel on the same exact log density in coordinates of
uniform curvature, for posteriors so correlated that the plain program does not mix. Runs are lengthened until the
Monte-Carlo error of every mean is below 0.02 posterior standard deviations. A reference is written only if
R-hat < 1.01, fewer than one transition in a thousand diverges, and the errors are reached.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from arviz_stats.base.array import array_stats

import bayescal as bc
from bayescal._inference import nuts_chains, sampled_products
from bayescal._inference.laplace import find_mode
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import Layout, Unknowns, bind
from bayescal_models import INSTRUMENTS
from benchmarks.record import ROOT, surroundings

SEED = 20261121
CHAINS, WARMUP = 4, 2000
DRAWS = 2500  # per chain, at first; then twice, four times as many
LENGTHENED = 3
MCSE = 0.02  # of a mean, in posterior standard deviations
R_HAT = 1.01
DIVERGENT = 1e-3  # share of transitions
AGREEMENT = {"mean": 0.1, "sd": 0.07}  # what a method is held to: sds, relative; and 4 errors


def _program(model: bc.Model, readings: bc.Measurements, draws: int):
    """Return the draws of every unknown, as `columns_of`, and the number of divergent transitions."""
    method = bc.NUTS(warmup=WARMUP, draws=draws, chains=CHAINS)
    calibration = bc.fit(model, readings, method, seed=SEED, strict=False)
    return columns_of(calibration.layout, calibration.values), calibration.verdict.divergences or 0


def _whitened(model: bc.Model, readings: bc.Measurements, draws: int):
    """Return the problem in whitened coordinates about the Laplace mode; the log density is exact.

    Where a product of unknowns makes the model nonlinear, one factor is among the hyper-parameters, and the other's
    coordinates depend on it.
    """
    layout, _ = bind(model, readings)
    frame, y = build_frame(readings, reference_of(readings)), readings["output"]
    record = Record(model.instrument, frame, y)
    layout = sampled_products.promote_products(Problem(layout, record), None)[0].layout
    problem = Problem(layout, record)
    density, unpack, start, covariance = nuts_chains.whiten_posterior(problem, find_mode(problem))
    key = jax.random.key(SEED)
    plan = nuts_chains.Plan(WARMUP, draws, CHAINS)
    ran = nuts_chains.run(density, start, covariance, key, plan)
    place = jax.jit(lambda q: jax.lax.map(lambda q1: unpack(q1)[:2], q, batch_size=64))
    flat = place(ran.draws.reshape(-1, start.size))
    shaped = (np.asarray(a).reshape(CHAINS, draws, *a.shape[1:]) for a in flat)
    return columns_of(layout, Unknowns.of(layout).values(*shaped)), ran.divergences


SAMPLERS = {"program": _program, "whitened": _whitened}


def columns_of(layout: Layout, values: np.ndarray) -> dict[str, tuple[np.ndarray, str]]:
    """Return draws (chains, draws) and unit of every unknown; group members are numbered."""
    return {u.name: (values[..., i], u.unit) for i, u in enumerate(Unknowns.of(layout))}


def _diagnosed(values: np.ndarray) -> dict[str, float]:
    """Return mean, sd and Monte-Carlo error of draws (chains, draws), with convergence diagnostics."""
    axes: Any = {"chain_axis": 0, "draw_axis": 1}
    statistics = {
        "mean": values.mean(),
        "sd": values.std(ddof=1),
        "mcse": array_stats.mcse(values, **axes, method="mean"),
        "mcse_sd": array_stats.mcse(values, **axes, method="sd"),
        "r_hat": array_stats.rhat(values, **axes),  # rank-normalised
        "ess": array_stats.ess(values, **axes, method="bulk"),
    }
    return {name: float(np.asarray(value)) for name, value in statistics.items()}


def reference_posterior(name: str, sampler: str = "program") -> dict[str, Any]:
    """Compute the reference posterior of an instrument's reference problem.

    Raises:
        SystemExit: the tolerances were not reached.
    """
    problem = import_module(f"bayescal_models.{name}").reference_problem
    model, readings = problem.model(), problem.readings(seed=0)
    start, draws = time.perf_counter(), DRAWS
    for _ in range(LENGTHENED):
        columns, divergences = SAMPLERS[sampler](model, readings, draws)
        diagnostics = {n: _diagnosed(values) for n, (values, _) in columns.items()}
        r_hat = max(f["r_hat"] for f in diagnostics.values())
        worst = max(f["mcse"] / f["sd"] for f in diagnostics.values())
        ess = min(f["ess"] for f in diagnostics.values())
        divergent = divergences / (CHAINS * draws)
        print(
            f"{name}: {sampler}, {CHAINS} × {draws} draws, R-hat {r_hat:.4f}, mcse {worst:.4f} sd, "
            f"ess {ess:.0f}, {divergences} divergent, {time.perf_counter() - start:.0f} s",
            file=sys.stderr,
        )
        if r_hat < R_HAT and worst < MCSE and divergent <= DIVERGENT:
            break
        draws *= 2
    else:
        raise SystemExit(f"{name}: the last run above missed its tolerances: try another sampler")
    statistics = ("mean", "sd", "mcse", "mcse_sd")
    return {
        "made_by": f"python -m benchmarks.accuracy.reference_posteriors {name} --sampler {sampler}",
        "sampler": {
            "kind": sampler,
            "numpyro": version("numpyro"),
            "warmup": WARMUP,
            "chains": CHAINS,
            "seed": SEED,
        },
        "readings": f"bayescal_models.{name}.reference_problem.readings(seed=0), {len(readings)} rows",
        "surroundings": surroundings(),
        "tolerances": {
            "mcse": MCSE,
            "r_hat": R_HAT,
            "divergent": DIVERGENT,
            "agreement": AGREEMENT,
        },
        "draws": CHAINS * draws,
        "max_r_hat": round(r_hat, 5),
        "min_ess": round(ess),
        "divergences": divergences,
        "coefficients": {
            n: {**{k: float(f"{f[k]:.7g}") for k in statistics}, "unit": columns[n][1]}
            for n, f in diagnostics.items()
        },
    }


def write(name: str, reference: dict[str, Any]) -> Path:
    """Write a reference beside the instrument's model; return its path."""
    path = ROOT / "models" / "bayescal_models" / name / "reference_posterior.json"
    path.write_text(json.dumps(reference, indent=1, ensure_ascii=False) + "\n", "utf-8")
    return path


def main(argv: list[str] | None = None) -> None:
    """Compute and write the references of the named instruments in turn."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.reference_posteriors")
    parser.add_argument("names", nargs="+", choices=INSTRUMENTS, metavar="instrument")
    parser.add_argument("--sampler", choices=SAMPLERS, default="program")
    options = parser.parse_args(argv)
    for name in options.names:
        print(write(name, reference_posterior(name, options.sampler)).relative_to(ROOT))


if __name__ == "__main__":
    main(sys.argv[1:])
