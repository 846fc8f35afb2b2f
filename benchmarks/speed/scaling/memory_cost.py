"""Peak memory of reading a file and fitting it, each in a process of its own, beside the normal equations' answer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.record import ROOT

GOAL, LIMIT = 2.0, 8.0  # GiB; the last ends a process
DATA = """
import numpy as np, bayescal as bc, sys
from bayescal_models import mems_gyro
n, rng = int(sys.argv[2]), np.random.default_rng(0)
t = rng.uniform(-40, 85, n)
y = 1.5 + 0.03 * (t - 20) + rng.normal(0, 0.2, n)
m = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, temperature=t, output=y)
m.write(sys.argv[1])
"""


def fit_in_here(path: str) -> None:
    """Read a Parquet file, fit the gyroscope's line, and print peak memory, GiB, and the answer as JSON."""
    import resource

    import numpy as np

    import bayescal as bc
    from bayescal_models import mems_gyro

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20

    begun = time.perf_counter()
    memory = {"imports": peak()}
    readings = bc.read(path, mems_gyro.INSTRUMENT)
    memory["readings"] = peak()
    model = mems_gyro.INSTRUMENT.baseline()
    mode = bc.fit(model, readings, bc.LeastSquares()).mode
    x = np.asarray(mode.x)
    memory["fit"] = peak()
    seconds = time.perf_counter() - begun
    centred = readings["temperature"] - np.round(readings["temperature"].mean())
    sums = np.array([[len(centred), centred.sum()], [centred.sum(), centred @ centred]])
    y = readings["output"]
    own = np.linalg.solve(sums, [y.sum(), centred @ y])
    apart = float(np.max(np.abs(x - own) / (0.2 * np.sqrt(np.diag(np.linalg.inv(sums))))))
    print(json.dumps({"memory": memory, "seconds": seconds, "apart_sd": apart}))


def _guarded(code: str, *arguments: str) -> dict[str, Any]:
    """Run code in a process that is ended where it holds more than `LIMIT`; what it printed.

    Raises:
        RuntimeError: it failed otherwise.
    """
    run = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    while run.poll() is None:
        held = Path(f"/proc/{run.pid}/statm").read_text("utf-8").split()
        if len(held) > 1 and int(held[1]) * os.sysconf("SC_PAGE_SIZE") > LIMIT * 2**30:
            run.kill()
            run.wait()
            return {"ended_above": LIMIT}
        time.sleep(0.05)
    told = run.stdout.read() if run.stdout else ""
    if run.returncode:
        raise RuntimeError(f"a fit in a process of its own ended with {run.returncode}: {told}")
    return json.loads(told) if told else {}


def memory(readings: int) -> dict[str, Any]:
    """Peak memory of reading a Parquet file and fitting it, by the kernel's account of the process.

    Raises:
        RuntimeError: the answer is not that of the normal equations.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "readings.parquet")
        _guarded(DATA, path, str(readings))
        code = "import sys; from benchmarks.speed.scaling.memory_cost import fit_in_here; fit_in_here(*sys.argv[1:])"
        found = _guarded(code, path)
    found = {"readings": readings, "goal_gib": GOAL, **found}
    if "ended_above" in found:
        told = f"above {LIMIT:.0f} GiB, where it was ended"
        return {**found, "told": f"{told} (goal {GOAL:.0f})"}
    if not found["apart_sd"] < 1e-3:  # the priors' own pull is 2e-4 at 1e5 readings, 2e-5 at 1e7
        raise RuntimeError(f"{readings} readings: {found['apart_sd']} sd apart")
    own = found["memory"]
    return {
        **found,
        "told": f"peak {own['fit']:.2f} GiB (goal {GOAL:.0f}), of which imports "
        f"{own['imports']:.2f}, with the readings {own['readings']:.2f}; {found['seconds']:.0f} s",
    }
