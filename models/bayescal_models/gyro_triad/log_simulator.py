"""Simulator of a six-channel log of a unit rotated by hand between poses at rest.

The true attitude is integrated in many steps per sample from rates in closed form, independently of the integration
in the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models.accelerometer_triad.simulator import BASELINE as ACCELEROMETERS
from bayescal_models.gyro_triad.campaign import MovesByHand
from bayescal_models.gyro_triad.simulator import BASELINE, MEMBER_COUNTS
from bayescal_models.triad.simulator import axis_matrix, expand_sizes

EARTH_RATE_DEG_S = 15.041 / 3600  # °/s
HAND_SHAKE_G = 0.1  # g, amplitude scale of the hand's acceleration during rotations
SUBSTEPS = 16  # per sample, integration steps of the true attitude
EFFECT_NAMES = (
    "bias.constant",
    "bias.g_sensitivity",
    "scale.constant",
    "misalignment.constant",
    "square.constant",
)


def simulate_log(
    effects: Mapping[str, Any] | None = None, *, seed: int, campaign: MovesByHand | None = None
) -> dict[str, np.ndarray]:
    """Simulate a log; return its columns: time (s), gyro_x, … (°/s), accel_x, … (g).

    Args:
        effects: canonical name of an effect of the gyroscopes → true size in the unit of its coefficients (see
            `gyro_triad.simulator.simulate_columns`).
        seed: seed of the random-number generator.
        campaign: plan of the poses and rotations; None: `MovesByHand()`.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    plan, counts = campaign or MovesByHand(), {name: MEMBER_COUNTS[name] for name in EFFECT_NAMES}
    sizes, rng = expand_sizes(effects, counts, BASELINE), np.random.default_rng(seed)
    rate, force, up = _path(plan, rng)  # °/s, g
    earth_rate = np.zeros(3)
    if plan.latitude is not None:
        heading, phi = rng.uniform(0, 2 * np.pi), np.deg2rad(plan.latitude)
        earth_axis = [np.cos(phi) * np.cos(heading), np.cos(phi) * np.sin(heading), np.sin(phi)]
        earth_rate = EARTH_RATE_DEG_S * np.array(earth_axis)
    rate = rate + np.einsum("nij,i->nj", up, earth_rate)
    matrix = axis_matrix(1e-6 * sizes["scale.constant"], 1e-3 * sizes["misalignment.constant"])
    sensitivity = sizes["bias.g_sensitivity"].reshape(3, 3)
    gyro = rate @ matrix.T + sizes["bias.constant"] + force @ sensitivity.T
    gyro = gyro + 1e-6 * sizes["square.constant"] * rate**2
    scale, angles = (np.array(ACCELEROMETERS[f"{n}.constant"]) for n in ("scale", "misalignment"))
    accel = force @ axis_matrix(1e-6 * scale, 1e-3 * angles).T
    accel = accel + 1e-3 * np.array(ACCELEROMETERS["bias.constant"])
    root_rate = math.sqrt(plan.rate)
    gyro = gyro + plan.gyro_noise * root_rate * rng.standard_normal(gyro.shape)
    accel = accel + plan.force_noise * root_rate * rng.standard_normal(accel.shape)
    columns = {"time": np.arange(len(gyro)) / plan.rate}
    columns |= {f"gyro_{a}": gyro[:, i] for i, a in enumerate("xyz")}
    return columns | {f"accel_{a}": accel[:, i] for i, a in enumerate("xyz")}


def _path(plan: MovesByHand, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate rates relative to the ground, °/s, specific forces, g, (n, 3), and body-to-level matrices (n, 3, 3)."""
    substeps = SUBSTEPS
    rest_samples, move_samples = round(plan.still * plan.rate), round(plan.move * plan.rate)
    rates, forces, attitudes = [], [], []
    attitude = _compute_rotation_matrix(rng.standard_normal(3))
    for pose in range(plan.poses):
        rates.append(np.zeros((rest_samples, 3)))
        forces.append(np.tile(attitude[2], (rest_samples, 1)))
        attitudes.append(np.tile(attitude, (rest_samples, 1, 1)))
        if pose == plan.poses - 1:
            break
        axis = rng.standard_normal(3)
        mean = plan.angle * rng.uniform(0.5, 1.5) * axis / np.linalg.norm(axis) / plan.move
        cross, push_direction = rng.standard_normal((2, 3))

        def turn_rate(s: np.ndarray, mean: np.ndarray = mean, cross: np.ndarray = cross) -> Any:
            """Return the angular rate at fraction s of the rotation's duration, rad/s."""
            envelope = np.sin(np.pi * s)[:, None] ** 2
            return envelope * (2 * mean + 0.5 * cross * np.sin(2 * np.pi * s)[:, None])

        fractions = np.arange(move_samples) / move_samples
        rates.append(np.rad2deg(turn_rate(fractions)))
        orientation = np.empty((move_samples, 3, 3))
        midpoints = (np.arange(move_samples * substeps) + 0.5) / (move_samples * substeps)
        steps = turn_rate(midpoints) / (plan.rate * substeps)
        for k in range(move_samples * substeps):
            if k % substeps == 0:
                orientation[k // substeps] = attitude
            attitude = attitude @ _compute_rotation_matrix(steps[k])
        attitudes.append(orientation)
        push = HAND_SHAKE_G * np.sin(np.pi * fractions) ** 2 * np.sin(6 * np.pi * fractions)
        specific_force = np.array([0.0, 0.0, 1.0]) + push[:, None] * push_direction
        forces.append(np.einsum("nij,ni->nj", orientation, specific_force))
    return np.concatenate(rates), np.concatenate(forces), np.concatenate(attitudes)


def _compute_rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), rad, by Rodrigues' formula."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross_matrix = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.eye(3) + cross_matrix
    sine_term, cosine_term = math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2
    return np.eye(3) + sine_term * cross_matrix + cosine_term * cross_matrix @ cross_matrix
