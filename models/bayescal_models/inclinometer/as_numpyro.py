"""Self-contained NumPyro model of an inclinometer's zero offset against placement angle, for two axes.

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

Zero offset S, arcsec, of reading i on axis k in mounting j at the placement angle ω (source 4; mountings assumed):

    S_i = a_k + b_k·ω_i + d_j + e_i,     d_j ~ N(0, s²),     e_i ~ N(0, σ²)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, HalfNormal, Normal

import bayescal as bc
from bayescal_models.inclinometer.model import INSTRUMENT


def model(placement, axis, axes, run, runs, output=None) -> None:
    """Define the NumPyro model: placement angle °, index of axis and of run (n,), their numbers; output ″ or None."""
    with numpyro.plate("axes", axes):
        a = numpyro.sample("zero.constant", Normal(0.0, 1000.0))  # arcsec
        b = numpyro.sample("zero.placement", Normal(0.0, 2.0))  # arcsec/deg
    s = numpyro.sample("zero.run.group_sd", HalfNormal(2.0))  # arcsec, sd between mountings
    with numpyro.plate("runs", runs):
        d = s * numpyro.sample("zero.run.standard", Normal(0.0, 1.0))
    noise = numpyro.sample("noise.white", HalfCauchy(2.0))  # arcsec
    numpyro.sample("output", Normal(a[axis] + b[axis] * placement + d[run], noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    (axes, axis), (runs, run) = readings.groups("axis"), readings.groups("run")
    groups = {"axis": axis, "axes": len(axes), "run": run, "runs": len(runs)}
    columns = {"placement": np.degrees(readings["placement_angle"]), "output": readings["output"]}
    return columns | groups


equivalent_model = INSTRUMENT.baseline  # a sum of named effects with the same posterior
