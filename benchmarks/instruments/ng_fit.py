"""One fit of an ng accelerometer's readings, and what it took."""

from __future__ import annotations

import time
from typing import Any

import bayescal as bc
from bayescal_models import ng_accelerometer as ng


def fitted(
    readings: bc.Measurements, model: bc.Model | None = None, method: bc.LeastSquares | None = None
) -> tuple[bc.Calibration, dict[str, Any]]:
    """A fit, by the default method if none is given, and what it took.

    A fit of the same model to readings of the same shape compiles nothing, so the seconds of a first fit are mostly
    compilation.
    """
    begun = time.perf_counter()
    found = bc.fit(model or ng.INSTRUMENT.baseline(), readings, method, seed=1, strict=False)
    verdict = found.verdict
    how = {
        "seconds": time.perf_counter() - begun,
        "sampler": verdict.sampler,
        "pareto_k": verdict.pareto_k,
        "ess": verdict.ess,
        "ok": verdict.ok,
        "notes": list(verdict.notes),
    }
    print(f"   {how['seconds']:.0f} s, {verdict}", flush=True)
    return found, how
