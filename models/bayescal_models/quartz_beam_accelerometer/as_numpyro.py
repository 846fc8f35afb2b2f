"""Self-contained NumPyro model of a quartz resonant beam accelerometer with two thermometers, 15 columns (source 2).

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

t1 is the temperature of the circuit and t2 that of the head, both minus T0; δ = t1 − t2:

    output = b + (1 + κ)·a + e,     e ~ N(0, σ²)
    b, κ = Σ of  1, t1, t1², t1³,  1, t2, t2², t2³,  δ, δ², δ³,  dt1/dt, dt2/dt,  t2·dt2/dt, t2·δ

The fifteen columns have rank twelve: three combinations of coefficients are determined by their priors only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, Normal

import bayescal as bc
from bayescal_models.quartz_beam_accelerometer.model import two_thermometers

PRIOR_SDS = {  # prior standard deviations of the bias: µg, °C, min; in the order of the columns
    "constant_circuit": 2e4,
    "constant_head": 2e4,
    "gradient": 20.0,
    "gradient_quadratic": 1.0,
    "temperature_circuit": 50.0,
    "temperature_circuit_quadratic": 0.5,
    "temperature_circuit_cubic": 0.005,
    "temperature_head": 50.0,
    "temperature_head_quadratic": 0.5,
    "temperature_head_cubic": 0.005,
    "gradient_cubic": 0.1,
    "rate_circuit": 10.0,
    "rate_head": 10.0,
    "temperature_x_rate": 0.2,
    "temperature_x_gradient": 0.5,
}
SCALE_SIZE_RATIO = 0.1  # prior sd of a scale factor coefficient, ppm, over that of the bias, µg
CONSTANT_SDS = {"bias": 2e4, "scale": 5e3}


def model(columns, acceleration, output=None) -> None:
    """Define the NumPyro model: columns (n, 15) in the order of `PRIOR_SDS`; acceleration, output (n,), µg, or None."""

    def sample_polynomial(slot: str) -> Any:
        polynomial = 0.0
        for i, (name, size) in enumerate(PRIOR_SDS.items()):
            if name.startswith("constant"):
                size = CONSTANT_SDS[slot]
            elif slot == "scale":
                size = SCALE_SIZE_RATIO * size
            polynomial += numpyro.sample(f"{slot}.{name}", Normal(0.0, size)) * columns[:, i]
        return polynomial

    bias, kappa = sample_polynomial("bias"), 1e-6 * sample_polynomial("scale")
    noise = numpyro.sample("noise.white", HalfCauchy(20.0))  # µg
    numpyro.sample("output", Normal(bias + (1 + kappa) * acceleration, noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    temperatures = [readings[f"temperature_{place}"] for place in ("circuit", "head")]
    T0 = np.round(temperatures[1].mean())
    t1, t2 = (t - T0 for t in temperatures)
    rate1, rate2 = (_compute_rate(readings, t) for t in temperatures)
    ones, d = np.ones_like(t1), t1 - t2
    columns = (ones, ones, d, d**2, t1, t1**2, t1**3, t2, t2**2, t2**3, d**3, rate1, rate2)
    basis = np.stack([*columns, t2 * rate2, t2 * d], axis=1)
    return {"columns": basis} | {name: readings[name] for name in ("acceleration", "output")}


def _compute_rate(readings: bc.Measurements, values: np.ndarray) -> np.ndarray:
    """Return the rate of change since the previous reading of the run, per minute; 0 at the first reading."""
    time, run = readings["time"], readings.groups("run")[1]
    order = np.lexsort((time, run))
    step, change = np.diff(time[order], prepend=np.nan), np.diff(values[order], prepend=np.nan)
    is_first = np.diff(run[order], prepend=-1) != 0
    slope = np.where(is_first, 0.0, 60.0 * change / np.where(is_first, 1.0, step))
    return slope[np.argsort(order)]


equivalent_model = two_thermometers  # a sum of named effects with the same posterior
