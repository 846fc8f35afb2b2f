"""Self-contained NumPyro model of a ng accelerometer on a tilted, turning table, at several temperatures.

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

The face of the table is tilted by γ and rotated to θ; the specific force along the input axis is a = g·u·s (source 0):

    u = ( sin γ2∥,  cos γ2∥·sin(γ + γ2⊥),  cos γ2∥·cos(γ + γ2⊥) ),     s = ( cos γ1·cos θ,  cos γ1·sin θ,  sin γ1 )
    output = K0 + (1 + κ)·a + e,     e ~ N(0, σ²)

K0, κ, γ1, γ2∥ and γ2⊥ are each a constant and a random deviation per *cell* (one temperature point of one run) of
estimated standard deviation; K0 and κ also have tempcos, and γ2∥ and γ2⊥ tides. Priors: assumed, for a recalibration.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import HalfNormal, Normal

import bayescal as bc
from bayescal_models.ng_accelerometer import reference_problem
from bayescal_models.ng_accelerometer.model import INSTRUMENT

G = 1e6  # µg
ARCSEC, DEGREE = np.pi / 648_000, np.pi / 180  # rad
TIDES = {  # period, h; prior standard deviation of each cosine and sine, nrad
    "M2": (12.4206012, 50.0),
    "S2": (12.0, 25.0),
    "N2": (12.6583475, 10.0),
    "K1": (23.9344721, 30.0),
    "O1": (25.8193387, 20.0),
}


def model(temperature, time, tilt, angle, cell, cells, T0, output=None) -> None:
    """Define the NumPyro model: temperature, T0 °C, time s, tilt, angle rad, cell index; cell count; output µg."""

    def constant(name: str, mean: float, sd: float) -> Any:
        return numpyro.sample(name, Normal(mean, sd))

    def deviation(name: str, scale: float, part: str = "") -> Any:
        group_sd = numpyro.sample(f"{name}{part}.group_sd", HalfNormal(scale))
        with numpyro.plate(f"cells of {name}{part}", cells):
            return group_sd * numpyro.sample(f"{name}{part}.standard", Normal(0.0, 1.0))

    def tide(component: str) -> Any:
        tilt_sum = 0.0
        for name, (period_h, sd) in TIDES.items():
            phase = 2 * np.pi * time / (3600.0 * period_h)
            for wave in (jnp.cos, jnp.sin):
                tilt_sum += constant(
                    f"base_tilt.tide[{component},{name},{wave.__name__}]", 0.0, sd
                ) * wave(phase)
        return 1e-9 * tilt_sum

    departure = temperature - T0
    K0 = constant("bias.constant", 850.0, 200.0)  # µg
    K0 += constant("bias.temperature", 10.0, 5.0) * departure
    K0 += deviation("bias.cell", 5.0)[cell]
    kappa = constant("scale.constant", 1500.0, 2000.0)
    kappa += constant("scale.temperature", 60.0, 100.0) * departure
    kappa = 1e-6 * (kappa + deviation("scale.cell", 50.0)[cell])  # from ppm
    fixture_tilt = 1e-6 * (
        constant("fixture_tilt.constant", 0.0, 291.0) + deviation("fixture_tilt.cell", 5.0)[cell]
    )
    base = {
        component: ARCSEC * constant(f"base_tilt.constant[{component}]", 0.0, 1.0)
        + 1e-6 * deviation("base_tilt.cell", 1.0, f"[{component}]")[cell]
        + tide(component)
        for component in ("parallel", "perp")
    }
    parallel, perp = base["parallel"], base["perp"] + ARCSEC * constant("tilt.setting", 0.0, 1.0)
    theta = angle + DEGREE * constant("rotation.constant", 0.0, 0.1)  # azimuth of the input axis

    in_face = jnp.sin(parallel) * jnp.cos(theta) + jnp.cos(parallel) * jnp.sin(
        tilt + perp
    ) * jnp.sin(theta)
    normal = jnp.cos(parallel) * jnp.cos(tilt + perp)
    a = G * (jnp.cos(fixture_tilt) * in_face + jnp.sin(fixture_tilt) * normal)
    noise = numpyro.sample("noise.white", HalfNormal(1.0))  # µg
    numpyro.sample("output", Normal(K0 + (1 + kappa) * a, noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    cells, cell = readings.groups("cell")
    columns = {n: readings[n] for n in ("temperature", "time", "tilt", "output")}
    columns |= {"angle": readings["position_angle"], "cell": cell, "cells": len(cells)}
    return columns | {"T0": np.round(readings["temperature"].mean())}


def equivalent_model() -> bc.Model:
    """Return the bayescal model, a sum of named effects, with the same posterior as `model`."""
    return reference_problem.model() + INSTRUMENT.effect("base_tilt.tide")
