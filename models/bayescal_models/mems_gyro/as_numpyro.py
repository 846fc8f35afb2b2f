"""Self-contained NumPyro model of a gyroscope's bias over temperature, with a turn-on offset per run.

It is the model that `bc.fit(equivalent_model(), readings)` fits. NUTS is run on it by

    nuts = NUTS(bc.non_centred(model), dense_mass=True, target_accept_prob=0.95)
    MCMC(nuts, num_warmup=1000, num_samples=4000).run(key, **model_arguments(readings))

Rate output y of reading i in run j, °/s (straight line in temperature: source 1; runs and sizes assumed by us):

    y_i = c0 + c1·(T_i − T0) + d_j + e_i,     d_j ~ N(0, s²),     e_i ~ N(0, σ²)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, HalfNormal, Normal

import bayescal as bc
from bayescal_models.mems_gyro.model import INSTRUMENT


def model(temperature, run, runs, T0, output=None) -> None:
    """Define the NumPyro model: temperature °C and run index (n,), number of runs, T0 °C; output °/s (n,) or None."""
    c0 = numpyro.sample("bias.constant", Normal(0.0, 50.0))  # °/s
    c1 = numpyro.sample("bias.temperature", Normal(0.0, 0.05))  # °/s/°C
    s = numpyro.sample("bias.run.group_sd", HalfNormal(0.05))  # °/s, between runs
    with numpyro.plate("runs", runs):
        d = s * numpyro.sample("bias.run.standard", Normal(0.0, 1.0))
    noise = numpyro.sample("noise.white", HalfCauchy(0.1))  # °/s
    numpyro.sample("output", Normal(c0 + c1 * (temperature - T0) + d[run], noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    runs, run = readings.groups("run")
    columns = {name: readings[name] for name in ("temperature", "output")}
    T0 = np.round(columns["temperature"].mean())
    return columns | {"run": run, "runs": len(runs), "T0": T0}


def equivalent_model() -> bc.Model:
    """Return the bayescal model, a sum of named effects, with the same posterior as `model`."""
    return INSTRUMENT.baseline() + "bias.run"
