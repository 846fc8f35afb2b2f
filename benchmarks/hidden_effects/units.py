"""Simulated units of six channels with one body: is its time covered, is each channel's structure right, what is false?

    make bench-units        goes on where it was stopped

A chamber is driven through random set points; six channels follow its temperature by a line, half of them by a
quadratic too, and all, some or none by a body that lags. Noise is white, an Ornstein–Uhlenbeck process beside white, or
a random walk beside white. The units are made here, by no code of an instrument's simulator. One JSON line a unit in
`results/units.jsonl`; `docs/units.md` is rendered from it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.signal import lfilter

import bayescal as bc
from bayescal._search.discover import structures_over
from bayescal._search.structures import Structure
from bayescal._search.walk import correlated_laws
from bayescal_models import still_sensor
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.record import DOCS, RESULTS, read_lines

PATH = RESULTS / "units.jsonl"
UNITS = 100
FIRST_SEED = 88_000
CHANNELS = tuple(f"channel_{i}" for i in range(1, 7))
STEP, READINGS = 10.0, 360  # s; an hour
LAW_TIMES = (60.0, 600.0)  # s, of an Ornstein–Uhlenbeck process
LAG, QUADRATIC = "bias.thermal_lag", "bias.temperature_quadratic"
TIMES = (100.0, 800.0)  # s, of the body
SIZES = (1.0, 30.0)  # of an effect at its largest, over the standard deviation of white noise
CLEAR = (
    10.0  # log Bayes factor of each true effect, above which a channel's structure should be right
)
SHOWN = {"all": 1.0, "some": 0.5, "none": 0.0}
NOISES = ("white", "ornstein_uhlenbeck", "random_walk")


def main() -> None:
    """Measure the units that are missing, and render the page."""
    go_on_by_seed(PATH, range(FIRST_SEED, FIRST_SEED + UNITS), measure)
    render()


def render() -> None:
    """Render the page from the rows that stand."""
    (DOCS / "units.md").write_text(page(read_lines(PATH)), encoding="utf-8")


def measure(seed: int) -> tuple[dict[str, Any], str]:
    """One unit: truth, what was found in each channel, and the body's time."""
    truth, readings = unit(seed)
    models = {n: still_sensor.INSTRUMENT.for_readings(r).baseline() for n, r in readings.items()}
    begun = time.process_time()
    found = bc.calibrate_channels(models, readings, method=bc.LeastSquares(draws=100))
    seconds = time.process_time() - begun
    lag = next((s for s in found.shared if s.effect == LAG), None)
    channels = {
        name: {
            "true": truth["effects"][name],
            "clear": clear(models[name], readings[name], truth["effects"][name], truth["tau"]),
            "found": [
                n for n in trail.final.calibration.model.names if n not in models[name].names
            ],
            "ok": trail.ok,
        }
        for name, trail in found.trails.items()
    }
    row = {
        "seed": seed,
        "shown": truth["shown"],
        "noise": truth["noise"],
        "tau": truth["tau"],
        "probability": lag and lag.probability,
        "interval": lag and list(lag.posterior[1:]),
        "channels": channels,
        "seconds": seconds,
    }
    right = sum(set(c["true"]) == set(c["found"]) for c in channels.values())
    return row, f"{seed} {truth['shown']} {truth['noise']}: {right} of 6 right, {seconds:.0f} s"


def unit(seed: int) -> tuple[dict[str, Any], dict[str, bc.Measurements]]:
    """A unit's truth, and readings of its channels."""
    rng = np.random.default_rng(seed)
    elapsed = STEP * np.arange(READINGS)
    points = rng.uniform(-20.0, 70.0, 5)
    air = np.interp(elapsed, np.linspace(0.0, elapsed[-1], 5), points)
    temperature = body(air, 60.0)
    middle = 0.5 * (temperature.min() + temperature.max())
    tau = float(np.exp(rng.uniform(*np.log(TIMES))))
    curves = {
        LAG: body(temperature, tau) - temperature,
        QUADRATIC: (temperature - middle) ** 2,
    }
    shown = list(SHOWN)[seed % 3]
    noise = NOISES[(seed // 3) % 3]
    truth: dict[str, Any] = {"shown": shown, "noise": noise, "tau": tau, "effects": {}}
    readings = {}
    for name in CHANNELS:
        has = {LAG: rng.random() < SHOWN[shown], QUADRATIC: rng.random() < 0.5}
        scale = float(np.exp(rng.uniform(-2.0, 4.0)))
        output = rng.normal(0.0, 20.0) + rng.normal(0.0, 1.0) * (temperature - middle)
        output = output + scatter(rng, noise)
        for effect, curve in curves.items():
            size = float(np.exp(rng.uniform(*np.log(SIZES)))) * rng.choice([-1.0, 1.0])
            output = output + has[effect] * size * curve / np.abs(curve).max()
        truth["effects"][name] = [effect for effect, there in has.items() if there]
        readings[name] = bc.Measurements.from_arrays(
            still_sensor.INSTRUMENT,
            units={"output": "mg"},
            time=elapsed,
            temperature=temperature,
            output=scale * output,
        )
    return truth, readings


def body(drive: np.ndarray, tau: float) -> np.ndarray:
    """A body of first order, at rest with what drives it when the record begins; exact on lines."""
    decay = np.exp(-STEP / tau)
    now = 1 - (1 - decay) * tau / STEP
    return drive[0] + lfilter([now, 1 - decay - now], [1, -decay], drive - drive[0])


def scatter(rng: np.random.Generator, noise: str) -> np.ndarray:
    """White noise of standard deviation 1, and what wanders beside it."""
    white, kicks = rng.standard_normal((2, READINGS))
    if noise == "ornstein_uhlenbeck":
        tau = np.exp(rng.uniform(*np.log(LAW_TIMES)))
        decay = np.exp(-STEP / tau)
        kicks[1:] *= np.sqrt(1 - decay**2)
        wander: Any = lfilter([1.0], [1.0, -decay], kicks)
        return white + rng.uniform(0.5, 3.0) * wander
    if noise == "random_walk":
        return white + rng.uniform(0.05, 0.5) * np.cumsum(kicks)
    return white


def clear(model: bc.Model, readings: bc.Measurements, true: Iterable[str], tau: float) -> bool:
    """Whether each true effect stands out by `CLEAR` to one who knows the others and the body's time."""
    true = list(true)
    reference = bc.fit(model, readings, bc.LeastSquares(draws=100), strict=False).reference
    structures, _ = structures_over(model, readings, reference)
    known = structures.candidates[LAG].ranging({"tau": (0.99 * tau, 1.01 * tau)})
    structures.candidates = {**structures.candidates, LAG: known}

    def evidence(effects: Iterable[str]) -> float:
        held = frozenset(effects)
        return max(
            structures.weigh(Structure(held, n)).log_evidence
            for n in ("", *correlated_laws(structures))
        )

    whole = evidence(true)
    return all(whole - evidence(n for n in true if n != name) > CLEAR for name in true)


def page(rows: list[dict[str, Any]]) -> str:
    """The page, from the rows measured."""
    body_rows = []
    for noise in (*NOISES, "all"):
        own = [r for r in rows if noise in (r["noise"], "all")]
        channels = [c for r in own for c in r["channels"].values()]
        there = [r for r in own if any(LAG in c["true"] for c in r["channels"].values())]
        told = [r for r in there if (r["probability"] or 0.0) > 0.95]
        covered = sum(r["interval"][0] <= r["tau"] <= r["interval"][1] for r in told)
        false = sum(bool(set(c["found"]) - set(c["true"])) for c in channels)
        clear_ones = [c for c in channels if c["clear"]]
        right = sum(set(c["found"]) == set(c["true"]) for c in clear_ones)
        empty = [r for r in own if r not in there]
        wrongly = sum((r["probability"] or 0.0) > 0.95 for r in empty)
        body_rows.append(
            [
                noise.replace("_", " "),
                len(own),
                f"{len(told)}/{len(there)}",
                proportion(covered, len(told)),
                f"{wrongly}/{len(empty)}",
                proportion(right, len(clear_ones)),
                proportion(false, len(channels)),
                f"{np.median([r['seconds'] for r in own]):.0f}" if own else "–",
            ]
        )
    head = [
        "noise",
        "units",
        "body found",
        "its time covered (95 %)",
        "found where there is none",
        "structure right, where clear",
        "channels with a false effect",
        "CPU, s",
    ]
    return PAGE + table(head, body_rows)


PAGE = """\
# Units of six channels: detection of a shared body

Rendered by `make bench-units` from `benchmarks/results/units.jsonl`. A unit's six channels follow the temperature by a
line, half of them by a quadratic too, and all, some or none by a body that lags behind it, with one time between 100
and 800 s. Sizes are 1 to 30 standard deviations of the white noise. `calibrate_channels` searches them together, with
every candidate of `still_sensor`.

*Body found*: the unit's lag has a probability above 0.95. *Clear*: whoever knows the other effects and the time has a
log Bayes factor above 10 for each effect of the channel, under the better noise law. *Right*: the effects added are the
true ones and no other. *False*: an effect is added that is not there, named or not.

"""
