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
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal_models import mems_gyro
from benchmarks.record import write

DEVICES, LEAST, MOST, SEED = 10_000, 20, 30, 2026
SAMPLE = 200  # devices that the peers fit
REPEATS, QUICK = 3, 20  # of what takes seconds, and of what takes a tenth of one
OFFSET, SLOPE, NOISE = (2.0, 5.0), (0.03, 0.01), 0.2  # °/s; °/s per °C; °/s
T0 = 20.0  # °C
GOALS = {"scipy": 50, "lmfit": 200}
MODEL = mems_gyro.INSTRUMENT.baseline()
PRIORS = np.array([e.coefficients[0].size for e in MODEL.effects])


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


class Timed(NamedTuple):
    """The shortest of several times, s: by the clock, and of the processor; and what came out."""

    clock: float
    processor: float
    made: Any


def least_of(run: Callable[[], Any], repeats: int = REPEATS) -> Timed:
    """Run several times. Other work on the machine lengthens the clock's time, hardly the processor's."""
    best, made = [np.inf, np.inf], None
    for _ in range(repeats):
        begun = time.perf_counter(), time.process_time()
        made = run()
        ended = time.perf_counter(), time.process_time()
        best = [min(b, e - s) for b, e, s in zip(best, ended, begun, strict=True)]
    return Timed(*best, made)


def by_scipy(
    parts: list[tuple[np.ndarray, np.ndarray]], method: Literal["trf", "lm"] = "trf"
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Offset and slope with their standard uncertainties, device by device, by `scipy.optimize`."""
    from scipy.optimize import least_squares

    found = []
    for temperature, output in parts:
        t = temperature - T0

        def residuals(x, t=t, output=output):
            return np.append(output - x[0] - x[1] * t, NOISE * x / PRIORS)

        one: Any = least_squares(residuals, x0=np.zeros(2), method=method)
        variance = 2 * one.cost / (len(t) - 2)
        covariance = np.linalg.inv(one.jac.T @ one.jac) * variance
        found.append((one.x, np.sqrt(np.diag(covariance))))
    return found


def by_lmfit(parts: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The same by lmfit."""
    import lmfit

    found = []
    for temperature, output in parts:
        t = temperature - T0

        def residuals(p, t=t, output=output):
            x = np.array([p["offset"].value, p["slope"].value])
            return np.append(output - x[0] - x[1] * t, NOISE * x / PRIORS)

        start = lmfit.Parameters()
        start.add("offset", value=0.0)
        start.add("slope", value=0.0)
        one: Any = lmfit.minimize(residuals, start)
        found.append(
            (
                np.array([one.params[n].value for n in ("offset", "slope")]),
                np.array([one.params[n].stderr for n in ("offset", "slope")]),
            )
        )
    return found


def by_lmfit_model(
    parts: list[tuple[np.ndarray, np.ndarray]],
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The same by lmfit's ready-made line, without the priors."""
    from lmfit.models import LinearModel

    line, found = LinearModel(), []
    for temperature, output in parts:
        one = line.fit(output, x=temperature - T0, intercept=0.0, slope=0.0)
        own = [one.params[n] for n in ("intercept", "slope")]
        found.append((np.array([p.value for p in own]), np.array([p.stderr for p in own])))
    return found


def agreement(
    result: bc.BatchResult, names: list[str], found: list[tuple[np.ndarray, np.ndarray]]
) -> dict[str, float]:
    """Largest difference of the estimates in standard uncertainties, and of these uncertainties, relative."""
    apart, wide = 0.0, 0.0
    for name, (x, sd) in zip(names, found, strict=True):
        one = result[name]
        apart = max(apart, float(np.max(np.abs(one.mean[:2] - x) / one.sd[:2])))
        wide = max(wide, float(np.max(np.abs(sd / one.sd[:2] - 1))))
    return {"estimates_sd": apart, "uncertainties": wide}


def _against(
    name: str, peer: Timed, read: Timed, fitted: Timed, names: list[str]
) -> dict[str, Any]:
    """A peer's row: its time for all devices, how many times ours that is, and how near its numbers are."""
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


def main() -> None:
    """Time all three, compare, and write `results/batches.json`."""
    table = lot()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lot.parquet"
        table.to_parquet(file)

        def fit(devices: bc.Devices) -> bc.BatchResult:
            return bc.fit_batch(MODEL, devices, reference={"T0": T0})

        begun = time.perf_counter()
        fit(bc.split_devices(file, mems_gyro.INSTRUMENT))
        first = time.perf_counter() - begun
        read = least_of(lambda: bc.split_devices(file, mems_gyro.INSTRUMENT), QUICK)
        devices = read.made
        fitted = least_of(lambda: fit(devices), QUICK)
        result = fitted.made
        saved = least_of(lambda: result.save(Path(folder) / "result.parquet"))
    pooled = least_of(lambda: bc.fit_batch(MODEL, devices, population=True, reference={"T0": T0}))
    names = [f"G{i:05d}" for i in range(0, DEVICES, DEVICES // SAMPLE)]
    cut = dict(iter(table.groupby("device", sort=False)))
    parts = [
        (cut[n]["temperature [degC]"].to_numpy(), cut[n]["output [deg/s]"].to_numpy())
        for n in names
    ]
    ours = {"fit": fitted, "read": read, "save": saved, "with_population": pooled}
    rows: dict[str, Any] = {
        "bayescal": {
            "first_call_s": first,
            "trusted": int(result.ok.sum()),
            **{f"{n}_s": t.clock for n, t in ours.items()},
            **{f"{n}_processor_s": t.processor for n, t in ours.items()},
        }
    }
    print(f"{DEVICES} devices, {len(table)} readings; peers on {len(names)} of them, scaled")
    print(
        f"  bayescal {fitted.clock:.3f} s (processor {fitted.processor:.3f} s), reading and splitting the file "
        f"{read.clock:.3f} s, first call {first:.1f} s"
    )
    peers = (
        ("scipy", by_scipy),
        ("scipy, method='lm'", lambda parts: by_scipy(parts, "lm")),
        ("lmfit", by_lmfit),
        ("lmfit, LinearModel", by_lmfit_model),
    )
    for name, peer in peers:
        rows[name] = _against(name, least_of(lambda peer=peer: peer(parts)), read, fitted, names)
    population = pooled.made.population
    assert population is not None
    told = population.table.to_dict("records")
    print(f"  with a population {pooled.clock:.2f} s:\n{population}")
    truth = {"mean": [OFFSET[0], SLOPE[0]], "spread": [OFFSET[1], SLOPE[1]]}
    write(
        "batches",
        {
            "devices": DEVICES,
            "readings": len(table),
            "sample": len(names),
            "seed": SEED,
            "times": rows,
            "population": {"found": told, "truth": truth},
        },
    )


if __name__ == "__main__":
    main()
