"""Many devices at once: 10,000 gyroscopes, a line in temperature each, against loops of scipy and lmfit.

Every device has 20 to 30 readings, an offset, a slope and noise. `bc.fit_batch` takes them all, by least squares;
`scipy.optimize.least_squares` (its default method, and the quicker "lm") and lmfit (`minimize`, and its LinearModel)
take them one after the other, with the same residuals and priors (LinearModel: no priors), from arrays already cut
into devices, on a sample of devices, scaled to all. All in one process and one run; times are the least of several,
compilation apart. Estimates are compared on the sample.

What is timed differs in what comes out, too: the peers give coefficients and a covariance scaled by the residual
variance; `fit_batch` the noise by restricted likelihood, a verdict for each device, and names and units.
"""

from __future__ import annotations

import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal_models import mems_gyro
from benchmarks.record import write
from benchmarks.speed.batches_peers import NOISE, T0, Line, Part, peers
from benchmarks.speed.timing import Timed, least_of

DEVICES, LEAST, MOST, SEED = 10_000, 20, 30, 2026
SAMPLE = 200  # devices that the peers fit
REPEATS, QUICK = 3, 20  # of what takes seconds, and of what takes a tenth of one
OFFSET, SLOPE = (2.0, 5.0), (0.03, 0.01)  # mean and sd over devices: °/s; °/s per °C
GOALS = {"scipy": 50, "lmfit": 200}
MODEL = mems_gyro.INSTRUMENT.baseline()


def lot() -> pd.DataFrame:
    """The readings of all devices, as they would stand in a file."""
    rng = np.random.default_rng(SEED)
    counts = rng.integers(LEAST, MOST + 1, DEVICES)
    device = np.repeat(np.arange(DEVICES), counts)
    temperature = rng.uniform(-40.0, 85.0, len(device))
    offset, slope = rng.normal(*OFFSET, DEVICES), rng.normal(*SLOPE, DEVICES)
    output = offset[device] + slope[device] * (temperature - T0)
    output = output + rng.normal(0.0, NOISE, len(device))
    names = np.array([f"G{i:05d}" for i in range(DEVICES)])
    return pd.DataFrame(
        {"device": names[device], "temperature [degC]": temperature, "output [deg/s]": output}
    )


def ours(table: pd.DataFrame) -> tuple[dict[str, Timed], float]:
    """All devices from a file, by `bc.fit_batch`: what each step takes, s, and what the first call took."""

    def split() -> bc.Devices:
        return bc.split_devices(file, mems_gyro.INSTRUMENT)

    def fit(devices: bc.Devices, population: bool = False) -> bc.BatchResult:
        return bc.fit_batch(MODEL, devices, population=population, reference={"T0": T0})

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lot.parquet"
        table.to_parquet(file)
        begun = time.perf_counter()
        fit(split())
        first = time.perf_counter() - begun
        read = least_of(split, QUICK)
        fitted = least_of(lambda: fit(read.made), QUICK)
        saved = least_of(lambda: fitted.made.save(Path(folder) / "result.parquet"), REPEATS)
        pooled = least_of(lambda: fit(read.made, population=True), REPEATS)
    print(
        f"  bayescal {fitted.clock:.3f} s (processor {fitted.processor:.3f} s), reading and splitting the file "
        f"{read.clock:.3f} s, first call {first:.1f} s"
    )
    return {"fit": fitted, "read": read, "save": saved, "with_population": pooled}, first


def agreement(result: bc.BatchResult, names: list[str], found: list[Line]) -> dict[str, float]:
    """Largest difference of the estimates in standard uncertainties, and of these uncertainties, relative."""
    apart, wide = 0.0, 0.0
    for name, (x, sd) in zip(names, found, strict=True):
        one = result[name]
        apart = max(apart, float(np.max(np.abs(one.mean[:2] - x) / one.sd[:2])))
        wide = max(wide, float(np.max(np.abs(sd / one.sd[:2] - 1))))
    return {"estimates_sd": apart, "uncertainties": wide}


def _against(name: str, peer: Timed, own: dict[str, Timed], names: list[str]) -> dict[str, Any]:
    """A peer's row: its time for all devices, how many times ours that is, and how near its numbers are."""
    read, fitted = own["read"], own["fit"]
    scale = DEVICES / len(names)
    ratio = {
        "fit": scale * peer.clock / fitted.clock,
        "fit, processor": scale * peer.processor / fitted.processor,
        "from the file": scale * peer.clock / (fitted.clock + read.clock),
    }
    close = agreement(fitted.made, names, peer.made)
    told = ", ".join(f"{what} {value:.0f}" for what, value in ratio.items())
    goal = f" (goal {GOALS[name]})" if name in GOALS else ""
    print(
        f"  {name}: {scale * peer.clock:.2f} s; times ours: {told}{goal}; estimates within "
        f"{close['estimates_sd']:.2g} sd, uncertainties within {100 * close['uncertainties']:.1g} %"
    )
    return {
        "seconds": scale * peer.clock,
        "processor_s": scale * peer.processor,
        "sample_s": peer.clock,
        "ratio": ratio,
        "goal": GOALS.get(name),
        "largest_difference": close,
        "version": version(name.partition(",")[0]),
    }


def sample(table: pd.DataFrame) -> tuple[list[str], list[Part]]:
    """The devices that the peers fit: their names and readings."""
    names = [f"G{i:05d}" for i in range(0, DEVICES, DEVICES // SAMPLE)]
    cut = dict(iter(table.groupby("device", sort=False)))
    parts = [
        (cut[n]["temperature [degC]"].to_numpy(), cut[n]["output [deg/s]"].to_numpy())
        for n in names
    ]
    return names, parts


def main() -> None:
    """Time all, compare, and write `results/batches.json`."""
    table = lot()
    names, parts = sample(table)
    print(f"{DEVICES} devices, {len(table)} readings; peers on {len(names)} of them, scaled")
    own, first = ours(table)
    rows: dict[str, Any] = {
        "bayescal": {
            "first_call_s": first,
            "trusted": int(own["fit"].made.ok.sum()),
            **{f"{n}_s": t.clock for n, t in own.items()},
            **{f"{n}_processor_s": t.processor for n, t in own.items()},
        }
    }
    sizes = np.array([e.coefficients[0].size for e in MODEL.effects])
    for name, peer in peers(sizes).items():
        timed = least_of(lambda peer=peer: peer(parts), REPEATS)
        rows[name] = _against(name, timed, own, names)
    pooled = own["with_population"]
    population = pooled.made.population
    assert population is not None
    print(f"  with a population {pooled.clock:.2f} s:\n{population}")
    truth = {"mean": [OFFSET[0], SLOPE[0]], "spread": [OFFSET[1], SLOPE[1]]}
    found = population.table.to_dict("records")
    write(
        "batches",
        {
            "devices": DEVICES,
            "readings": len(table),
            "sample": len(names),
            "seed": SEED,
            "times": rows,
            "population": {"found": found, "truth": truth},
        },
    )
