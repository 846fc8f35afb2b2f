"""Speed beside peers: a command, one fit, ten thousand devices, a posterior; answers are compared before times.

bayescal and a peer run in turn on the same machine under its usual load, so that only ratios are comparable. A row
whose peer is not installed is unchanged.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal._model import state_space
from bayescal_models import mems_gyro
from benchmarks import pages
from benchmarks.record import ROOT, read, today, write

TABLE = ROOT / "models" / "bayescal_models" / "mems_gyro" / "data" / "zero_rate_table.csv"
# Prior sd of offset, slope and square, °/s, °/s/°C, °/s/°C²: the instrument's own.
SIZES = (50.0, 0.05, 5e-4)
NOISE = 0.1  # half-Cauchy scale of the noise, °/s: the instrument's own
REPEATS = 5  # of what is timed, of which the least counts
NEAR = 0.1  # standard deviations that answers may differ by
DEVICES, SAMPLE = 10_000, 200  # devices, and those that peers fit
T0, SCATTER = 20.0, 0.2  # °C; °/s
MODEL = mems_gyro.INSTRUMENT.baseline()
OURS = (
    *("from bayescal._cli.main import main; main()", "calibrate", str(TABLE)),
    *("--instrument", "mems_gyro", "--json"),
)
PEER = ("import sys; from benchmarks.speed import peer; peer(sys.argv[1])", str(TABLE))
Answer = tuple[float, np.ndarray]  # seconds, and numbers to compare
Row = dict[str, Any]


def peer(table: str) -> None:
    """Fit and compare a line and a quadratic by PyMC and nutpie, a script of one afternoon's work; print the slope."""
    import arviz as az  # pyright: ignore[reportMissingImports]
    import nutpie  # pyright: ignore[reportMissingImports]
    import pymc as pm  # pyright: ignore[reportMissingImports]

    temperature, output = np.loadtxt(table, delimiter=",", skiprows=1).T
    t, traces = temperature - np.round(temperature.mean()), {}
    for name, degree in (("line", 1), ("quadratic", 2)):
        with pm.Model() as model:
            mean = sum(pm.Normal(f"c{i}", 0.0, SIZES[i]) * t**i for i in range(degree + 1))
            pm.Normal("output", mean, pm.HalfCauchy("noise", NOISE), observed=output)
        program = nutpie.compile_pymc_model(model)
        traces[name] = nutpie.sample(program, chains=4, draws=1000, seed=1, progress_bar=False)
        with model:
            pm.compute_log_likelihood(traces[name], progressbar=False)
    az.compare(traces, ic="loo")
    slope = traces["line"].posterior["c1"]
    print(json.dumps({"slope": [float(slope.mean()), float(slope.std())]}))


def in_a_process(command: tuple[str, ...], folder: Path) -> tuple[float, dict[str, Any]]:
    """Run Python in a process with its compiled code cached in a folder; return processor seconds and its JSON.

    Raises:
        RuntimeError: the process failed.
    """
    variables = {
        "BAYESCAL_CACHE": str(folder / "bayescal"),
        "NUMBA_CACHE_DIR": str(folder / "numba"),
        "PYTENSOR_FLAGS": f"base_compiledir={folder / 'pytensor'}",
    }
    used = _children()
    environment = {**os.environ, **variables, "MPLBACKEND": "Agg"}
    command = (sys.executable, "-c", *command)
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])}: status {done.returncode}: {done.stderr}")
    return _children() - used, json.loads(done.stdout[done.stdout.index("{") :])


def _children() -> float:
    """Return the processor seconds of the finished child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def commands() -> Iterator[Row]:
    """Time a command on a table of 18 rows, and the peer's script, first without compiled code, then again."""
    with tempfile.TemporaryDirectory() as our_folder, tempfile.TemporaryDirectory() as other:
        for start in ("cold", "warm"):
            seconds, our_values = in_a_process(OURS, Path(our_folder))
            (slope,) = (r for r in our_values["coefficients"] if r["name"] == "bias.temperature")
            theirs, values = in_a_process(PEER, Path(other))
            answers = np.array([slope["mean"]]), np.array([values["slope"][0]])
            what = f"`calibrate` of 18 readings, {start}, beside a script of PyMC and nutpie"
            yield compared(what, (seconds, answers[0]), (theirs, answers[1]), values["slope"][1])


def compared(what: str, ours: Answer, theirs: Answer, sd: Any) -> Row:
    """Return the row of a comparison.

    Raises:
        RuntimeError: the answers differ by more than a tenth of their standard deviations.
    """
    gap = float(np.max(np.abs(ours[1] - theirs[1]) / sd))
    if not gap <= NEAR:
        raise RuntimeError(f"{what}: answers are {gap:.2g} standard deviations apart")
    return {"what": what, "ours_s": ours[0], "peer_s": theirs[0], "apart_sd": gap, "day": today()}


def least(work: Callable[[], np.ndarray]) -> Answer:
    """Return the smallest processor time, s, of several runs, and the last result."""
    seconds, values = [], np.zeros(0)
    for _ in range(REPEATS):
        start = time.process_time()
        values = work()
        seconds.append(time.process_time() - start)
    return min(seconds), values


def line_by(name: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a peer's fit of offset and slope of one device: output over T − T0, °C, with the instrument's priors."""
    from scipy.optimize import least_squares

    def residuals(x: np.ndarray, t: np.ndarray, output: np.ndarray) -> np.ndarray:
        return np.append(output - x[0] - x[1] * t, SCATTER * x / np.array(SIZES[:2]))

    def by_scipy(t: np.ndarray, output: np.ndarray) -> np.ndarray:
        return least_squares(residuals, np.zeros(2), method="lm", args=(t, output)).x

    if name == "scipy":
        return by_scipy
    import lmfit  # pyright: ignore[reportMissingImports]

    def by_lmfit(t: np.ndarray, output: np.ndarray) -> np.ndarray:
        start = lmfit.create_params(offset=0.0, slope=0.0)
        objective = lambda p: residuals(np.array([*p.valuesdict().values()]), t, output)  # noqa: E731
        return np.array([*lmfit.minimize(objective, start).params.valuesdict().values()])

    return by_lmfit


def lot() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return device, T − T0, °C, and output, °/s, of 25 readings of each device."""
    rng = np.random.default_rng(2026)
    device = np.repeat(np.arange(DEVICES), 25)
    t = rng.uniform(-60.0, 65.0, len(device))
    offset, slope = rng.normal(2.0, 5.0, DEVICES), rng.normal(0.03, 0.01, DEVICES)
    return device, t, offset[device] + slope[device] * t + rng.normal(0.0, SCATTER, len(device))


def devices() -> Iterator[Row]:
    """Time ten thousand devices by `fit_batch`, and peers' loops on a sample, scaled."""
    device, t, output = lot()
    names = np.array([f"G{i:05d}" for i in range(DEVICES)])
    columns = {"device": names[device], "temperature [degC]": T0 + t, "output [deg/s]": output}
    with tempfile.TemporaryDirectory() as folder:
        pd.DataFrame(columns).to_parquet(file := Path(folder) / "lot.parquet")
        split = bc.split_devices(file, mems_gyro.INSTRUMENT)
    chosen = [names[i] for i in range(0, DEVICES, DEVICES // SAMPLE)]
    sd = np.zeros(0)

    def ours() -> np.ndarray:
        nonlocal sd
        batch = bc.fit_batch(MODEL, split, reference={"T0": T0})
        sd = np.array([batch[n].sd[:2] for n in chosen])
        return np.array([batch[n].mean[:2] for n in chosen])

    our_time = least(ours)
    parts = [(t[device == int(n[1:])], output[device == int(n[1:])]) for n in chosen]
    for name in ("scipy", "lmfit"):
        fit = line_by(name)
        seconds, values = least(lambda fit=fit: np.array([fit(*part) for part in parts]))
        scaled = seconds * DEVICES / SAMPLE, values
        what = f"a line for each of 10,000 devices, beside a loop of {name}"
        yield compared(what, our_time, scaled, sd)


def single() -> Iterator[Row]:
    """Time one least-squares fit of 600 readings."""
    t = lot()[1][:600]
    output = 2.0 + 0.03 * t + np.random.default_rng(5).normal(0.0, SCATTER, 600)
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT, temperature=T0 + t, output=output, time=10.0 * np.arange(600.0)
    )
    how: dict[str, Any] = {"reference": {"T0": T0}}
    fit = bc.fit(MODEL, readings, bc.LeastSquares(), **how)
    names = ("bias.constant", "bias.temperature")
    sd = np.array([float(np.std(fit.samples(n))) for n in names])

    def ours() -> np.ndarray:
        calibration = bc.fit(MODEL, readings, bc.LeastSquares(), **how)
        return np.array([float(np.mean(calibration.samples(n))) for n in names])

    our_time = least(ours)
    for name in ("scipy", "lmfit"):
        their_time = least(partial(line_by(name), t, output))
        yield compared(f"a line through 600 readings, beside {name}", our_time, their_time, sd)


def posteriors() -> Iterator[Row]:
    """Time effective draws of a gyroscope's runs over a parabola: importance sampling beside NumPyro's NUTS."""
    model = MODEL + "bias.run" + "bias.temperature_quadratic"
    readings = mems_gyro.simulate({"bias.run": 0.1}, seed=1)
    rates, means, sd = [], [], np.zeros(0)
    for method in (bc.Marginal(), bc.NUTS()):
        start = time.process_time()
        calibration = bc.fit(model, readings, method, strict=False)
        rates.append((time.process_time() - start) / (calibration.verdict.ess or np.nan) * 1000)
        names = ("bias.temperature", "bias.temperature_quadratic")
        values = [calibration.samples(n) for n in names]
        means.append(np.array([np.mean(d) for d in values]))
        sd = np.array([np.std(d) for d in values])
    what = "1,000 effective draws, compilation included, beside NumPyro's NUTS of the same program"
    yield compared(what, (rates[0], means[0]), (rates[1], means[1]), sd)


def noise() -> Iterator[Row]:
    """Time the log likelihood of 100,000 uneven readings under white noise and two Ornstein–Uhlenbeck processes."""
    import celerite2  # pyright: ignore[reportMissingImports]
    import jax

    step = np.random.default_rng(1).uniform(0.5, 1.5, 100_000)
    y, times, variances = np.random.default_rng(2).standard_normal(100_000), (5.0, 80.0), (0.5, 2.0)
    fast, slow = (celerite2.terms.RealTerm(a=v, c=1 / t) for v, t in ((0.5, 5.0), (2.0, 80.0)))

    def theirs() -> np.ndarray:
        process = celerite2.GaussianProcess(fast + slow)
        process.compute(np.cumsum(step), diag=np.ones_like(y))
        return np.array([process.log_likelihood(y)])

    @jax.jit
    def likelihood(h: jax.Array, y: jax.Array) -> jax.Array:
        block = state_space.build_exponential(np.array(times), np.array(variances), h)
        states = state_space.assemble_states([block], h.at[0].set(-1.0))
        new, log_sd = state_space.kalman_whiten(states, np.ones(len(step)), y[:, None])
        return -0.5 * jax.numpy.sum(new**2 + np.log(2 * np.pi)) - jax.numpy.sum(log_sd)

    ours = least(lambda: np.array([likelihood(step, y)]))
    what = "log likelihood of 100,000 readings under two Ornstein–Uhlenbeck processes, beside celerite2"
    yield compared(what, ours, least(theirs), 1e-6)


def main() -> None:
    """Measure all; rows whose peer is not installed stay."""
    rows = {row["what"]: row for row in read("speed").get("rows", [])}
    for part in (commands, devices, single, posteriors, noise):
        try:
            for row in part():
                rows[row["what"]] = row
                print(row, flush=True)
        except (ImportError, RuntimeError) as error:
            print(f"speed: {part.__name__}: {error}", file=sys.stderr)
    write("speed", {"rows": list(rows.values())})


def render() -> pages.Texts:
    """Render the page from the stored results."""
    rows = read("speed")["rows"]
    table = pages.table(
        ["processor seconds, on one machine", "bayescal", "peer", "peer over bayescal", "measured"],
        [
            [r["what"], *(f"{n:.3g}" for n in (a, b)), f"{b / a:.2g}", r["day"]]
            for r, a, b in ((r, r["ours_s"], r["peer_s"]) for r in rows)
        ],
    )
    about = """
Answers are compared before their times: within a tenth of a standard deviation. `calibrate` also checks the line
and evaluates every candidate; `fit` also estimates the noise, draws, and judges convergence; a peer is given the
noise. *Effective draws*: as stated in the verdict of each fit.
"""
    return pages.page("speed", "Speed", "speed", [r["day"] for r in rows], about, table)
