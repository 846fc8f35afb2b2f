"""kill -9 of a worker at random moments of a run: whether the results are the same, bit for bit."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._annexes.fleet.engine import open_cluster
from bayescal_models import mems_gyro
from benchmarks.fleet.simulated import T0, write_partition

MODEL = mems_gyro.INSTRUMENT.baseline()
PARTITIONS, DEVICES, SEED = 24, 400, 7


def measured(work: Path, times: int) -> dict[str, Any]:
    """Runs in each of which one of two workers is killed at a moment drawn over the run's length."""
    folder, out = work / "killed", work / "killed_out"
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(PARTITIONS):
        write_partition(folder, number, DEVICES, SEED)

    def fit(client: Any = None) -> bc.FleetResult:
        shutil.rmtree(out, ignore_errors=True)
        return bc.fit_batch(
            MODEL, folder, out=out, client=client, reference={"T0": T0}, partition_rows=DEVICES * 60
        )

    expected, rng, rows = fit().rows(), np.random.default_rng(SEED), []
    length = 0.0
    for _ in range(times):
        with open_cluster(2) as client:
            own: Any = client.run(os.getpid)
            if not length:  # warm, then timed
                fit(client)
                begun = time.perf_counter()
                fit(client)
                length = time.perf_counter() - begun
            moment = float(rng.uniform(0.0, length))
            victim = sorted(own.values())[int(rng.integers(2))]
            killer = threading.Timer(moment, os.kill, (victim, signal.SIGKILL))
            killer.start()
            found = fit(client)
            killer.join()
            same = found.rows().equals(expected)
            rows.append({"moment_s": moment, "same": same, "missing": len(found.missing)})
    return {
        "partitions": PARTITIONS,
        "devices": PARTITIONS * DEVICES,
        "run_s": length,
        "kills": rows,
        "same": sum(row["same"] for row in rows),
    }
