"""Self-contained NumPyro model of a ng accelerometer on a tilted, turning table, over temperature.

Bias and scale factor follow the temperature; the angles of fixture, base and tide are latent.

The model that `bc.fit(equal(), readings)` fits; `mems_gyro/as_numpyro.py` says how to run it.

The face of the table is tilted by γ and rotated to θ; gravity acts along the input axis as a = g·u·s (source 0), with

    u = ( sin γ2∥,  cos γ2∥·sin(γ + γ2⊥),  cos γ2∥·cos(γ + γ2⊥) ),     s = ( cos γ1·cos θ,  cos γ1·sin θ,  sin γ1 )
    output = K0 + (1 + κ)·a + e,     e ~ N(0, σ²)

K0, κ, γ1, γ2∥ and γ2⊥ each are a constant and a deviation per *cell* (one temperature point of one run), whose spread
is learned; K0 and κ follow the temperature, γ2 the tide. Priors are those of a recalibration, ours.
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
ARCSEC, DEGREE = np.pi / 648_000, np.pi / 180
TIDES = {  # period, h; prior standard deviation of each cosine and sine, nrad
    "M2": (12.4206012, 50.0),
    "S2": (12.0, 25.0),
    "N2": (12.6583475, 10.0),
    "K1": (23.9344721, 30.0),
    "O1": (25.8193387, 20.0),
}


def model(temperature, time, tilt, angle, cell, cells, T0, output=None) -> None:
    """Define the model of temperatures °C, times s, γ, θ rad, cells from 0 (n,), T0 °C; output µg, or None."""

    def constant(name: str, mean: float, size: float) -> Any:
        return numpyro.sample(name, Normal(mean, size))

    def deviation(name: str, most: float, part: str = "") -> Any:
        spread = numpyro.sample(f"{name}{part}.group_sd", HalfNormal(most))
        with numpyro.plate(f"cells of {name}{part}", cells):
            return spread * numpyro.sample(f"{name}{part}.standard", Normal(0.0, 1.0))

    def tide(side: str) -> Any:
        total = 0.0
        for name, (hours, size) in TIDES.items():
            phase = 2 * np.pi * time / (3600.0 * hours)
            for wave in (jnp.cos, jnp.sin):
                total += constant(
                    f"base_tilt.tide[{side},{name},{wave.__name__}]", 0.0, size
                ) * wave(phase)
        return 1e-9 * total

    change = temperature - T0
    K0 = (
        constant("bias.constant", 850.0, 200.0) + constant("bias.temperature", 10.0, 5.0) * change
    )  # µg
    K0 += deviation("bias.cell", 5.0)[cell]
    kappa = (
        constant("scale.constant", 1500.0, 2000.0)
        + constant("scale.temperature", 60.0, 100.0) * change
    )
    kappa = 1e-6 * (kappa + deviation("scale.cell", 50.0)[cell])  # from ppm
    fixture = 1e-6 * (
        constant("fixture_tilt.constant", 0.0, 291.0) + deviation("fixture_tilt.cell", 5.0)[cell]
    )
    base = {
        side: ARCSEC * constant(f"base_tilt.constant[{side}]", 0.0, 1.0)
        + 1e-6 * deviation("base_tilt.cell", 1.0, f"[{side}]")[cell]
        + tide(side)
        for side in ("parallel", "perp")
    }
    parallel, perp = base["parallel"], base["perp"] + ARCSEC * constant("tilt.setting", 0.0, 1.0)
    theta = angle + DEGREE * constant("rotation.constant", 0.0, 0.1)  # azimuth of the input axis

    in_face = jnp.sin(parallel) * jnp.cos(theta) + jnp.cos(parallel) * jnp.sin(
        tilt + perp
    ) * jnp.sin(theta)
    normal = jnp.cos(parallel) * jnp.cos(tilt + perp)
    a = G * (jnp.cos(fixture) * in_face + jnp.sin(fixture) * normal)
    noise = numpyro.sample("noise.white", HalfNormal(1.0))  # µg
    numpyro.sample("output", Normal(K0 + (1 + kappa) * a, noise), obs=output)


def data(readings: bc.Measurements) -> dict[str, Any]:
    """Return the readings as arguments of `model`."""
    cells, cell = readings.groups("cell")
    columns = {n: readings[n] for n in ("temperature", "time", "tilt", "output")}
    columns |= {"angle": readings["position_angle"], "cell": cell, "cells": len(cells)}
    return columns | {"T0": np.round(readings["temperature"].mean())}


def equal() -> bc.Model:
    """Return the same model as a sum of named effects."""
    return reference_problem.model() + INSTRUMENT.effect("base_tilt.tide")
