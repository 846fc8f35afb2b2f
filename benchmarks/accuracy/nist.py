"""What the NIST Statistical Reference Datasets for regression hold, and how many certified digits are met.

Source: NIST, Statistical Reference Datasets (www.itl.nist.gov/div898/strd).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.record import CERTIFIED_DATA

FOLDER = CERTIFIED_DATA / "nist_strd"
MOST = 16.0  # digits that a double can agree to


class Estimate(NamedTuple):
    """What a fit gives, in the order of the certificate."""

    parameters: np.ndarray
    sd: np.ndarray
    residual_sd: float
    converged: bool


def certificate(folder: Path, kind: str, name: str) -> tuple[dict[str, Any], np.ndarray]:
    """Return the certified values of a set, and its data, the response first.

    Args:
        folder: of the reference data.
        kind: "linear" or "nonlinear".
        name: of the set.
    """
    certified = json.loads((folder / kind / f"certified_{kind}.json").read_text("utf-8"))[name]
    return certified, np.loadtxt(folder / kind / f"{name}.csv", delimiter=",", skiprows=1)


def digits(estimates: Any, certified: Any) -> float:
    """Return the fewest agreeing digits: −log10 of the relative error, or of the error where zero is certified."""
    values = np.atleast_1d(np.asarray(estimates, float))
    true = np.atleast_1d(np.asarray(certified, float))
    if not np.all(np.isfinite(values)):
        return 0.0
    error = np.abs(values - true) / np.where(true == 0, 1.0, np.abs(true))
    worst = float(np.max(error))
    return MOST if worst < 10.0**-MOST else max(0.0, -math.log10(worst))
