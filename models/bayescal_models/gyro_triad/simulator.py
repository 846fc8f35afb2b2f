"""Readings of a simulated rate-table test: a unit of three gyroscopes, mounted with one axis up after the other.

Each mounting has a small rotation error of its own, which tilts rate and gravity from their nominal axis. Everything
is computed reading by reading in NumPy, independently of the instrument's equation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.triad.simulator import REFERENCE, bias_of, lag_of, matrix_of, members_of

MOUNTING_SD = 1e-3  # rad, standard deviation of the mounting's rotation about each axis
# The simulated unit, unless effects override it: bias °/s, scale ppm, misalignment mrad.
BASELINE = {
    "bias.constant": (0.5, -0.8, 0.3),
    "scale.constant": (4000.0, -3000.0, 6000.0),
    "misalignment.constant": (3.0, -5.0, 2.0, 4.0, -2.0, 6.0),
}
COUNTS = {
    **dict.fromkeys(("bias.constant", "bias.temperature", "bias.temperature_quadratic"), 3),
    **dict.fromkeys(("bias.thermal_lag", "bias.drift", "bias.run"), 3),
    **dict.fromkeys(("scale.constant", "scale.temperature", "square.constant"), 3),
    **dict.fromkeys(("misalignment.constant", "misalignment.temperature"), 6),
    "bias.g_sensitivity": 9,
}


def simulated_columns(
    effects: Mapping[str, Any] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate readings with hidden effects; return columns by name.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, multiplied by `SHARES` for
            its members; or a size for each member; bias, scale and misalignment are there unless
            given otherwise.
        seed: seed of the random-number generator.
        campaign: plan; six mountings at five rates if not given.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    plan, sizes = campaign or Campaign(), members_of(effects, COUNTS, BASELINE)
    rng = np.random.default_rng(seed)
    shape = (plan.runs, len(plan.mountings), len(plan.temperatures), len(plan.rates))
    run, place, point, step = np.indices(shape).reshape(4, -1)
    temperature, rate = np.array(plan.temperatures)[point], np.array(plan.rates)[step]
    pause = np.where(step == 0, plan.soak, plan.interval)
    time = np.cumsum(pause) + 3600.0 * run
    of_run = rng.standard_normal((plan.runs, 3))
    off = MOUNTING_SD * rng.standard_normal((plan.runs, len(plan.mountings), 3))[run, place]
    up = np.array([_upward(mounting) for mounting in plan.mountings])[place]
    true = up + np.cross(off, up)
    warm, omega = (temperature - REFERENCE)[:, None], rate[:, None] * true
    progress = (time - time[len(time) // 2]) / max(time[-1] - time[0], 1.0)
    bias = bias_of(sizes, temperature, progress, lag_of(temperature, run, pause), of_run[run])
    bias = bias + true @ sizes["bias.g_sensitivity"].reshape(3, 3).T
    scale = 1e-6 * (sizes["scale.constant"] + sizes["scale.temperature"] * warm)
    angles = 1e-3 * (sizes["misalignment.constant"] + sizes["misalignment.temperature"] * warm)
    output = np.einsum("nij,nj->ni", matrix_of(scale, angles), omega) + bias
    output = output + 1e-6 * sizes["square.constant"] * omega**2
    output = output + plan.noise * rng.standard_normal(output.shape)
    cols: dict[str, Any] = {
        "run": (run + 1).astype(str),
        "time": time,
        "temperature": temperature,
        "rate": rate,
        "mounting": np.array([f"{r + 1}.{m + 1}" for r, m in zip(run, place, strict=True)]),
        "pose_uncertainty": np.full(len(time), MOUNTING_SD),
    }
    for i, a in enumerate("xyz"):
        cols[f"output_{a}"] = output[:, i]
        cols[f"direction_{a}"] = cols[f"gravity_{a}"] = up[:, i]
    return cols


def _upward(mounting: str) -> np.ndarray:
    """Return the unit vector up in the body, of a mounting such as "x" or "-z"."""
    return (-1.0 if mounting.startswith("-") else 1.0) * np.eye(3)["xyz".index(mounting[-1])]
