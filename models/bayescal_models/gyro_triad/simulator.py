"""Simulator of a rate-table test of three gyroscopes, mounted successively with different axes up.

Each mounting has a small random rotation error, which tilts rate and gravity away from their nominal axis. Outputs are
computed reading by reading in NumPy, independently of the implementation of the instrument's equation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.triad.simulator import T0_DEGC, axis_bias, axis_matrix, die_lag, expand_sizes

MOUNTING_SD_RAD = 1e-3  # rad, standard deviation of the mounting's rotation about each axis
# Default coefficients of the simulated unit: bias °/s, scale ppm, misalignment mrad.
BASELINE = {
    "bias.constant": (0.5, -0.8, 0.3),
    "scale.constant": (4000.0, -3000.0, 6000.0),
    "misalignment.constant": (3.0, -5.0, 2.0, 4.0, -2.0, 6.0),
}
MEMBER_COUNTS = {
    **dict.fromkeys(("bias.constant", "bias.temperature", "bias.temperature_quadratic"), 3),
    **dict.fromkeys(("bias.thermal_lag", "bias.drift", "bias.run"), 3),
    **dict.fromkeys(("scale.constant", "scale.temperature", "square.constant"), 3),
    **dict.fromkeys(("misalignment.constant", "misalignment.temperature"), 6),
    "bias.g_sensitivity": 9,
}


def simulate_columns(
    effects: Mapping[str, Any] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate readings with hidden effects; return columns by name.

    Args:
        effects: canonical name → true size in the unit of the effect's coefficients: a number, which
            `triad.simulator.FACTORS` scales for each coefficient, or one size per coefficient. Effects in `BASELINE`
            have its sizes unless given here.
        seed: seed of the random-number generator.
        campaign: plan of the test; by default six mountings at five rates.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    plan, sizes = campaign or Campaign(), expand_sizes(effects, MEMBER_COUNTS, BASELINE)
    rng = np.random.default_rng(seed)
    shape = (plan.runs, len(plan.mountings), len(plan.temperatures), len(plan.rates))
    run, mount, soak_index, rate_index = np.indices(shape).reshape(4, -1)
    temperature, rate = np.array(plan.temperatures)[soak_index], np.array(plan.rates)[rate_index]
    interval = np.where(rate_index == 0, plan.soak, plan.interval)
    time, run_deviates = np.cumsum(interval) + 3600.0 * run, rng.standard_normal((plan.runs, 3))
    errors = MOUNTING_SD_RAD * rng.standard_normal((plan.runs, len(plan.mountings), 3))[run, mount]
    up = np.array([_compute_upward_axis(mounting) for mounting in plan.mountings])[mount]
    true_axes = up + np.cross(errors, up)
    departure, omega = (temperature - T0_DEGC)[:, None], rate[:, None] * true_axes
    progress = (time - time[len(time) // 2]) / max(time[-1] - time[0], 1.0)
    lag = die_lag(temperature, run, interval)
    bias = axis_bias(sizes, temperature, progress, lag, run_deviates[run])
    bias = bias + true_axes @ sizes["bias.g_sensitivity"].reshape(3, 3).T
    scale = 1e-6 * (sizes["scale.constant"] + sizes["scale.temperature"] * departure)
    angles = 1e-3 * (sizes["misalignment.constant"] + sizes["misalignment.temperature"] * departure)
    output = np.einsum("nij,nj->ni", axis_matrix(scale, angles), omega) + bias
    output = output + 1e-6 * sizes["square.constant"] * omega**2
    output = output + plan.noise * rng.standard_normal(output.shape)
    columns: dict[str, Any] = {
        "run": (run + 1).astype(str),
        "time": time,
        "temperature": temperature,
        "rate": rate,
        "mounting": np.array([f"{r + 1}.{m + 1}" for r, m in zip(run, mount, strict=True)]),
        "pose_uncertainty": np.full(len(time), MOUNTING_SD_RAD),
    }
    for i, a in enumerate("xyz"):
        columns[f"output_{a}"] = output[:, i]
        columns[f"direction_{a}"] = columns[f"gravity_{a}"] = up[:, i]
    return columns


def _compute_upward_axis(mounting: str) -> np.ndarray:
    """Return the unit vector that points up, in body axes, in a mounting such as "x" or "-z"."""
    return (-1.0 if mounting.startswith("-") else 1.0) * np.eye(3)["xyz".index(mounting[-1])]
