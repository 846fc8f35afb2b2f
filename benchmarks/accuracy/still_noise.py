"""Simulated records at rest: do the intervals of `bayescal noise` hold the truth, and is the law the right one?

    python -m benchmarks still_noise

White noise of one unit per reading at 10 Hz, and further terms whose sizes are drawn anew for each record: where the
Allan deviation of a term meets that of the white noise, log-uniformly from ten readings to a quarter of the record.
The oracle is the log evidence of the true sum less that of the best one that lacks a term of it. One JSON line a
record in results/still_noise.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from scipy.signal import lfilter

import bayescal as bc
from bayescal._calibration import noise_at_rest
from bayescal._data.allan_deviation import even_runs
from bayescal._model.noise_terms import FLAT, TERMS
from bayescal._model.summed_noise import SummedNoise
from bayescal_models import still_sensor
from benchmarks.hidden_effects.outcomes import CLEAR
from benchmarks.hidden_effects.resume import go_on
from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.record import RESULTS, read_lines, write

STEP = 0.1  # s
SEEDS = {1_000: range(100), 10_000: range(0, 100, 4), 100_000: range(2, 100, 12)}  # by readings
SENSOR = still_sensor.instrument("V", size=1.0, constant=10.0, span=0.0)
PATH = RESULTS / "still_noise.jsonl"
KINDS = {  # the law's terms beside white noise
    "nothing": (),
    "random walk": ("walk",),
    "flicker": ("flicker",),
    "one Ornstein–Uhlenbeck": ("correlated",),
    "two Ornstein–Uhlenbeck": ("correlated", "correlated"),
    "quantisation": ("quantisation",),
    "averaging": ("averaging",),
    "random walk, output rounded": ("walk",),
    "random walk, and a tone": ("walk", "tone"),
}
SUMS = {  # terms by what a person reads
    SummedNoise(1.0, 2.0, terms).in_words if terms else "white": terms
    for count in range(5)
    for terms in combinations_with_replacement(TERMS, count)
    if all(c == 1 or (t == "correlated" and c < 4) for t, c in Counter(terms).items())
    and not {"quantisation", "averaging"} <= {*terms}
}


def main() -> None:
    """Measure the records that do not stand in the file, then write and print the counts."""
    go_on(PATH, ("made", "readings", "seed"), ((case, case) for case in _cases()), measure)
    rows = read_lines(PATH)
    write("still_noise", {"counts": [_counts(rows, n, kind) for n in SEEDS for kind in KINDS]})
    print(page(rows))


def _cases() -> Iterator[tuple[str, int, int]]:
    for seed in range(max(seeds.stop for seeds in SEEDS.values())):
        for n in (n for n, seeds in SEEDS.items() if seed in seeds):
            yield from ((kind, n, seed) for kind in KINDS)


def measure(case: tuple[str, int, int]) -> tuple[dict[str, Any], str]:
    """One record: its truth, the figures, the law and the oracle; and what is told of it."""
    kind, n, seed = case
    random = np.random.default_rng([list(KINDS).index(kind), n, seed])
    output, truth = simulated(kind, n, random)
    readings = bc.Measurements.from_arrays(SENSOR, time=STEP * np.arange(n), output=output)
    begun = time.process_time()
    found = bc.noise(readings, seed=seed)
    seconds = time.process_time() - begun
    weighed = {SUMS[words]: p for words, p in found.probabilities.items()}
    best = next(iter(weighed))
    row = {"made": kind, "readings": n, "seed": seed, "truth": truth, "law": list(best)}
    row |= {"probability": weighed[best], "weighed": KINDS[kind] in weighed}
    row |= {"oracle": _oracle(readings, KINDS[kind], weighed), "seconds": seconds}
    seen = (f for f in found.figures if math.isfinite(f.high))
    row["figures"] = {f.symbol or f.name: [f.value, f.low, f.high, f.bound] for f in seen}
    return row, f"{case} {truth} -> {found.law} {row['oracle']}"


def simulated(kind: str, n: int, random: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
    """Readings, and the true figures by their symbol or name."""
    output, truth = random.standard_normal(n), {"N": math.sqrt(STEP)}
    meets = STEP * _drawn(random, 10, n / 4)  # s
    if "walk" in KINDS[kind]:
        truth["K"] = math.sqrt(3) * truth["N"] / meets
        output += truth["K"] * math.sqrt(STEP) * np.cumsum(random.standard_normal(n))
    if kind == "flicker":
        truth["B"] = truth["N"] / math.sqrt(FLAT * meets)
        output += truth["B"] * _flicker(n, random)
    if "correlated" in KINDS[kind]:
        memories = [_drawn(random, 3, n / 30)]
        if kind.startswith("two"):
            first = _drawn(random, 1, n / 200)
            memories = [first, first * _drawn(random, 5, n / 20 / first)]
        for place, memory in enumerate(memories, 1):
            # The Allan variance of such a process is largest at 1.89 times its memory, 0.38 of its variance.
            share = _drawn(random, 0.3, 30.0)
            size = math.sqrt(share / (0.38 * 1.89 * memory))
            name, kept = f"Ornstein–Uhlenbeck {place}", math.exp(-1 / memory)
            truth |= {f"{name}, size": size, f"{name}, correlation time": STEP * memory}
            fresh = math.sqrt(1 - kept**2) * random.standard_normal(n)
            fresh[0] = random.standard_normal()
            output += size * np.asarray(lfilter([1.0], [1.0, -kept], fresh))
    if kind == "quantisation":
        truth["Q"] = STEP * math.sqrt(_drawn(random, 0.5, 10.0) / 3)
        output += truth["Q"] / STEP * np.diff(random.standard_normal(n + 1))
    if kind == "averaging":
        share = _drawn(random, 0.1, 10.0)
        smooth = math.sqrt(share) * random.standard_normal(n + 1)
        output += 0.5 * (smooth[1:] + smooth[:-1])
        truth["N"] *= math.sqrt(1 + share)
    if kind.endswith("rounded"):
        grid = _drawn(random, 0.2, 2.0)
        output = grid * np.round(output / grid)
        truth["N"] *= math.sqrt(1 + grid**2 / 12)  # B. Widrow, I. Kollár, Quantization Noise (2008)
    if kind.endswith("tone"):
        frequency, size = random.uniform(0.02, 0.45), _drawn(random, 0.1, 2.0)  # per reading
        truth |= {"tone, size": size, "tone, frequency": frequency / STEP}
        turn, kept = 2 * math.pi * frequency, math.exp(-1 / _drawn(random, 100, n))
        fresh = random.standard_normal((n, 2)) @ np.array([1, 1j])
        fresh[1:] *= math.sqrt(1 - kept**2)
        output += size * np.real(lfilter([1.0], [1.0, -kept * np.exp(1j * turn)], fresh))
    return output, truth


def _drawn(random: np.random.Generator, low: float, high: float) -> float:
    return math.exp(random.uniform(math.log(low), math.log(high)))


def _flicker(n: int, random: np.random.Generator) -> np.ndarray:
    """1/f noise of B = 1: a stretch of eight times as much, so that its ends do not join."""
    longer = 8 * n
    f = np.fft.rfftfreq(longer)[1:]
    # Two-sided the spectrum per reading is 1/(2π·f), and a line of it has the variance of `longer` readings' sum.
    lines = random.standard_normal((2, len(f))) / math.sqrt(2)
    lines = np.sqrt(longer / (2 * math.pi * f)) * (lines[0] + 1j * lines[1])
    return np.fft.irfft(np.concatenate([[0.0], lines]), longer)[:n]


def _oracle(
    readings: bc.Measurements, true: tuple[str, ...], weighed: dict[tuple[str, ...], float]
) -> float | None:
    """None of white noise alone."""
    if not true:
        return None
    rival = max((t for t in weighed if Counter(true) - Counter(t)), key=lambda t: weighed[t])
    runs = even_runs(readings)
    channel, _ = noise_at_rest._channel(readings, runs)
    _, line = noise_at_rest._line(np.asarray(readings["output"], float), runs)
    channel = channel._replace(line=line)
    own, other = (noise_at_rest._fit(channel, terms).log_evidence for terms in (true, rival))
    return own - other


def _counts(rows: list[dict[str, Any]], n: int, kind: str) -> dict[str, Any]:
    """Of the records of a kind and length: laws and intervals."""
    some = [row for row in rows if row["made"] == kind and row["readings"] == n]
    clear = [row for row in some if row["oracle"] is None or row["oracle"] > CLEAR]
    true = Counter(KINDS[kind])
    held: dict[str, list[bool]] = {}
    for row in some:
        for name, value in row["truth"].items():
            if name in row["figures"]:
                _, low, high, _ = row["figures"][name]
                held.setdefault(name, []).append(low <= value <= high)
    return {
        **{"made": kind, "readings": n, "records": len(some), "clear": len(clear)},
        "right, where clear": proportion(
            sum(Counter(row["law"]) == true for row in clear), len(clear)
        ),
        "more than the truth": proportion(
            sum(Counter(row["law"]) > true for row in some), len(some)
        ),
        "held": {name: proportion(sum(some), len(some)) for name, some in held.items()},
        "seconds": round(sum(row["seconds"] for row in some) / max(1, len(some)), 1),
    }


def page(rows: list[dict[str, Any]]) -> str:
    """The counts as a table."""
    counts = [_counts(rows, n, kind) for n in SEEDS for kind in KINDS]
    names = list(dict.fromkeys(name for one in counts for name in one["held"]))
    head = [*(name for name in counts[0] if name != "held"), *names]
    lines = [[(one | one["held"]).get(name, "–") for name in head] for one in counts]
    return table(head, lines)
