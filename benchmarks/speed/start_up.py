"""From a command to its answer: `bayescal calibrate` on the gyroscope's table, beside PyMC with nutpie.

    python -m benchmarks start_up

Each is a process of its own, once with empty folders for compiled code and then again with what the first left
there. The peer is a script that a colleague might write of an afternoon: the line and the quadratic with the same
priors, each sampled by nutpie's NUTS with its own compiler (numba), and the two compared by ArviZ's leave-one-out.
`calibrate` does more in its time: it checks the line, leaves out blocks of rows, weighs every candidate effect that
the table can test, and refits the leading ones. Other work on the machine lengthens the clock's time, hardly the
processor's: both are given, and the ratios are of both.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import ROOT, write

TABLE = ROOT / "models" / "bayescal_models" / "mems_gyro" / "data" / "zero_rate_table.csv"
SIZES = (
    50.0,
    0.05,
    5e-4,
)  # prior sd of offset, slope and square, °/s, °/s/°C, °/s/°C²: the instrument's own
NOISE = 0.1  # half-Cauchy scale of the noise, °/s: the instrument's own
CHAINS, DRAWS = 4, 1000  # 4000 draws, as of `calibrate`
AGAIN = 2  # runs with what the first one left; the least counts
NEAR = 0.1  # standard deviations that the slopes may differ by
GOALS = {"cold": 3.0, "warm": 8.0}  # times the peer's cold start

OURS = (
    "from bayescal._cli.main import main; main()",
    "calibrate",
    str(TABLE),
    "--instrument",
    "mems_gyro",
    "--json",
)
PEER = ("import sys; from benchmarks.speed.start_up import peer; peer(*sys.argv[1:])", str(TABLE))


def peer(table: str, begun: str) -> None:
    """The script of PyMC and nutpie, in a process of its own; prints its answer as JSON.

    Args:
        table: CSV of temperature and output.
        begun: `time.time()` at which the process was started.
    """
    import arviz as az  # pyright: ignore[reportMissingImports]
    import nutpie  # pyright: ignore[reportMissingImports]
    import pymc as pm  # pyright: ignore[reportMissingImports]

    temperature, output = np.loadtxt(table, delimiter=",", skiprows=1).T
    t = temperature - np.round(temperature.mean())
    traces, line_s = {}, 0.0
    for name, degree in (("line", 1), ("quadratic", 2)):
        with pm.Model() as model:
            mean = sum(pm.Normal(f"c{i}", 0.0, SIZES[i]) * t**i for i in range(degree + 1))
            noise = pm.HalfCauchy("noise", NOISE)
            pm.Normal("output", mean, noise, observed=output)
        traces[name] = nutpie.sample(
            nutpie.compile_pymc_model(model),
            chains=CHAINS,
            draws=DRAWS,
            seed=1,
            progress_bar=False,
        )
        line_s = line_s or time.time() - float(begun)
        with model:
            pm.compute_log_likelihood(traces[name], progressbar=False)
    compared = az.compare(traces, ic="loo")
    own = traces["line"].posterior
    named = {"offset": "c0", "slope": "c1", "noise": "noise"}
    print(
        json.dumps(
            {
                **{k: [float(own[c].mean()), float(own[c].std())] for k, c in named.items()},
                "line_s": line_s,
                "best": str(compared.index[0]),
                "elpd_difference": float(compared["elpd_diff"].iloc[1]),
            }
        )
    )


def ours(told: dict[str, Any]) -> dict[str, Any]:
    """The same numbers out of `calibrate --json`."""
    rows = {row["name"]: row for row in (*told["coefficients"], *told["hyperparameters"])}
    named = {"offset": "bias.constant", "slope": "bias.temperature", "noise": "noise.white"}
    found = {k: [rows[name]["mean"], rows[name]["sd"]] for k, name in named.items()}
    return {**found, "effects": told["steps"][-1]["effects"]}


def timed(command: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Run a process of this Python, its compiled code kept in a folder: seconds, and what it printed.

    Raises:
        RuntimeError: it failed.
    """
    own = {
        "BAYESCAL_CACHE": str(folder / "bayescal"),
        "NUMBA_CACHE_DIR": str(folder / "numba"),
        "PYTENSOR_FLAGS": f"base_compiledir={folder / 'pytensor'}",
        "MPLBACKEND": "Agg",
    }
    used, begun = _processor(), time.time()
    ended = subprocess.run(
        [sys.executable, "-c", *command],
        cwd=ROOT,
        env={**os.environ, **own},
        capture_output=True,
        text=True,
        check=False,
    )
    clock = time.time() - begun
    if ended.returncode:
        raise RuntimeError(f"{' '.join(command[1:])} ended with {ended.returncode}: {ended.stderr}")
    text = ended.stdout[ended.stdout.index("{") :]
    return {"clock": clock, "processor": _processor() - used, "told": json.loads(text)}


def _processor() -> float:
    """Seconds of the processor that ended children have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def cold_and_warm(command: tuple[str, ...], begun: bool) -> dict[str, dict[str, Any]]:
    """Both starts of a command; `begun`: it is told when it was started."""
    with tempfile.TemporaryDirectory() as name:

        def once() -> dict[str, Any]:
            extra = (str(time.time()),) if begun else ()
            return timed((*command, *extra), Path(name))

        cold = once()
        warm = min((once() for _ in range(AGAIN)), key=lambda run: run["clock"])
    return {"cold": cold, "warm": warm}


def main() -> None:
    """Time both, compare the slopes, and write `results/start_up.json`.

    Raises:
        RuntimeError: the slopes differ.
    """
    try:
        versions = {
            name: version(name) for name in ("pymc", "nutpie", "pytensor", "numba", "arviz")
        }
    except ImportError as missing:
        print(f"start_up: skipped, {missing.name} is not installed", file=sys.stderr)
        return
    own, other = cold_and_warm(OURS, begun=False), cold_and_warm(PEER, begun=True)
    mine, theirs = ours(own["cold"]["told"]), other["cold"]["told"]
    apart = abs(mine["slope"][0] - theirs["slope"][0]) / theirs["slope"][1]
    if mine["effects"] != ["bias.constant", "bias.temperature"] or apart > NEAR:
        raise RuntimeError(f"the slopes are {apart:.2f} sd apart: {mine} and {theirs}")
    rows: dict[str, Any] = {}
    reference = other["cold"]
    for name in ("cold", "warm"):
        rows[name] = {
            "bayescal": {k: own[name][k] for k in ("clock", "processor")},
            "peer": {k: other[name][k] for k in ("clock", "processor")},
            "peer_line_alone_s": other[name]["told"]["line_s"],
            "times_the_peer_cold": {k: reference[k] / own[name][k] for k in ("clock", "processor")},
            "goal": GOALS[name],
        }
        row = rows[name]
        print(
            f"{name}: calibrate {own[name]['clock']:.1f} s (processor {own[name]['processor']:.1f} s); "
            f"PyMC + nutpie {other[name]['clock']:.1f} s (processor {other[name]['processor']:.1f} s; to the line's "
            f"posterior {row['peer_line_alone_s']:.1f} s); its cold start is "
            f"{row['times_the_peer_cold']['clock']:.2f} times ours, processor "
            f"{row['times_the_peer_cold']['processor']:.2f} (goal {GOALS[name]:.0f})"
        )
    print(
        f"slopes {mine['slope'][0]:.6f} and {theirs['slope'][0]:.6f} °/s/°C: {apart:.3f} sd apart"
    )
    write(
        "start_up",
        {
            "rows": rows,
            "slopes_apart_sd": apart,
            "bayescal": mine,
            "peer": theirs,
            "versions": versions,
        },
    )
