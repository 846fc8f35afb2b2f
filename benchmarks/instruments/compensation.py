"""Does compensation lose nothing that the campaign has told? Campaigns drawn from the priors, and verification data.

    python -m benchmarks compensation                               1000 campaigns of each instrument
    python -m benchmarks.instruments.compensation mems_gyro --replicates 100

For each campaign the truth of every unknown is drawn from the model's own priors (all proper), and from that truth a
calibration and a verification data set, by the model's own composition and noise: the same device, new runs and
cells, a perfect test rig. The calibration is fitted by `Marginal`; `bayescal.compensator` turns the verification
readings back into the stimulus, by draws. Measured:

- *ratio*: rms error of the compensated stimulus over that of compensating with the true coefficients (a deviation
  that is new in use is zero for both). What the campaign does not identify is left aside, that is, errors are taken
  without what is constant (inclinometer: two mountings of an axis, each with its own zero; ng: the fixture's tilt is
  an alias of the bias) or in proportion to the stimulus (ng: the 1″ of the table's tilt is one of the scale factor).
- *covered*: how often value ± 2u holds the stimulus, u with the noise of the reading, by one verification reading a
  campaign, chosen at random, so that counts are independent; against 95.45 %, what k = 2 means for a Gaussian.
- of what is left aside: how often the coefficient's own mean ± 2u holds the truth.

Campaigns whose fit is not to be trusted are counted as the others are, and their share is stated. A differential pair
has no compensator: what it measures is no function of one reading (`differential_pair.py`).

Resumable: results/compensation_NAME.jsonl holds a line for each chunk. Writes results/compensation.json.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.accuracy.chunks import asked, collect
from benchmarks.instruments.compensation_campaigns import TRIALS, trial
from benchmarks.instruments.compensation_trial import Trial
from benchmarks.intervals import expected_counts
from benchmarks.record import RESULTS, read, write

K, NOMINAL = 2.0, float(2 * stats.norm.cdf(2.0) - 1)
LEVEL = 0.001  # chance that right programs fail, of one instrument's coverage
CLOSE = 1.05  # what the median ratio must not exceed


def summary(own: Trial, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What is written of one instrument."""
    names = ("ratio", "deviation", "trusted", *own.aside)
    every = {name: np.concatenate([row[name] for row in rows]) for name in names}
    count = len(every["ratio"])
    low, high = expected_counts(count, NOMINAL, LEVEL)
    covered = {n: int(np.sum(np.abs(every[n]) <= K)) for n in ("deviation", *own.aside)}
    ratio = every["ratio"]
    fails = [n for n, hits in covered.items() if not low <= hits <= high]
    return {
        "campaigns": count,
        "readings": len(own.plan),
        "verified": len(own.stimulus),
        "ratio": {
            "median": float(np.median(ratio)),
            "quantile95": float(np.quantile(ratio, 0.95)),
            "within": float(np.mean(ratio <= CLOSE)),
            "without": list(own.aside),
        },
        "covered": covered.pop("deviation"),
        "band": [low, high],
        "aside_covered": covered,
        "not_trusted": int(np.sum(~every["trusted"])),
        "seconds": round(sum(row["seconds"] for row in rows), 1),
        "fails": (["ratio"] if np.median(ratio) > CLOSE else []) + fails,
    }


HEAD = (
    f"{'instrument':26} {'campaigns':>9} {'ratio':>7} {'95 %':>7} {'covered':>7} {'band':>11} "
    f"{'untrusted':>9}  fails; what is left aside"
)


def line(name: str, s: dict[str, Any]) -> str:
    ratio, limits = s["ratio"], f"{s['band'][0]} … {s['band'][1]}"
    aside = ", ".join(f"{n} covered {hits}" for n, hits in s["aside_covered"].items())
    return (
        f"{name:26} {s['campaigns']:9} {ratio['median']:7.3f} {ratio['quantile95']:7.3f} {s['covered']:7} "
        f"{limits:>11} {s['not_trusted']:9}  {', '.join(s['fails']) or 'none'}; {aside or 'nothing'}"
    )


def main(arguments: list[str] | None = None) -> None:
    """Compute what is missing, print the table, write results."""
    names, replicates = asked(arguments, "benchmarks.instruments.compensation", __doc__, TRIALS)
    summaries = read("compensation").get("instruments", {})
    print(HEAD)
    for name in names:
        own = trial(name)
        rows = collect(own, replicates, RESULTS / f"compensation_{name}.jsonl")
        summaries[name] = summary(own, rows)
        print(line(name, summaries[name]), flush=True)
        write("compensation", {"nominal": NOMINAL, "level": LEVEL, "instruments": summaries})


if __name__ == "__main__":
    main(sys.argv[1:])
