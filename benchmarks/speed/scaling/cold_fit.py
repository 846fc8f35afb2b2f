"""One least-squares fit from a cold start: fresh processes of ours and of the peers, on the gyroscope's warm-up."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from benchmarks.record import ROOT
from benchmarks.speed.scaling.fit_cost import (
    PEERS_NEAR,
    by_hand,
    by_lmfit,
    by_scipy,
    case,
    problem_of,
    scales,
)

CODE = "import sys; from benchmarks.speed.scaling.cold_fit import NAMES; NAMES[sys.argv[1]](sys.argv[2])"


def _ours(_: str) -> None:
    """Print when `bc.fit` ended, and its answer in standardised unknowns."""
    import bayescal as bc

    found = bc.fit(*case("warm-up"), bc.LeastSquares())
    ended = time.time()  # before what only the comparison needs
    print(json.dumps([ended, problem_of("warm-up", found)[1].tolist()]))


def _scipy(given: str) -> None:
    """The same by scipy, told the priors' sizes and the noise as JSON."""
    z, _ = by_scipy(by_hand("warm-up", *json.loads(given)), "trf")
    print(json.dumps([time.time(), z.tolist()]))


def _lmfit(given: str) -> None:
    """The same by lmfit."""
    z, _ = by_lmfit(by_hand("warm-up", *json.loads(given)))
    print(json.dumps([time.time(), z.tolist()]))


NAMES = {"bayescal": _ours, "scipy": _scipy, "lmfit": _lmfit}


def cold() -> dict[str, Any]:
    """Seconds of a fresh process that fits the warm-up: with nothing kept from before, and again with what it kept.

    Raises:
        RuntimeError: the answers differ.
    """
    import bayescal as bc

    fitted = bc.fit(*case("warm-up"), bc.LeastSquares())
    problem, answer = problem_of("warm-up", fitted)
    sd = np.sqrt(np.diag(by_scipy(problem, "trf")[1]))
    given = json.dumps(scales(fitted))

    def once(name: str, folder: str) -> float:
        begun = time.time()
        own = {**os.environ, "BAYESCAL_CACHE": folder}
        command = [sys.executable, "-c", CODE, name, given]
        ran = subprocess.run(
            command, cwd=ROOT, env=own, check=True, stdout=subprocess.PIPE, text=True
        )
        ended, z = json.loads(ran.stdout.splitlines()[-1])
        apart[name] = max(apart.get(name, 0.0), float(np.max(np.abs(np.array(z) - answer) / sd)))
        return ended - begun

    first, again, apart = {}, {}, {}
    for name in NAMES:
        with tempfile.TemporaryDirectory() as folder:
            first[name] = once(name, folder)
            again[name] = min(once(name, folder) for _ in range(2))
    if not max(apart.values()) <= PEERS_NEAR:
        raise RuntimeError(f"cold starts: answers from ours, sd: {apart}")
    told = ", ".join(f"{n} {first[n]:.1f} s, then {again[n]:.1f} s" for n in NAMES)
    return {
        "nothing_kept": first,
        "again": again,
        "apart_sd": apart,
        "told": f"fresh processes: {told}; answers within {max(apart.values()):.1g} sd",
    }
