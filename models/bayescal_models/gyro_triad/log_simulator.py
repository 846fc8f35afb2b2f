"""Simulator of a log of six channels: a unit turned by hand between poses at rest.

The true attitude is integrated in many steps between two samples, from rates in closed form, independently of the
model's integration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models.accelerometer_triad.simulator import BASELINE as ACCELEROMETERS
from bayescal_models.gyro_triad.campaign import MovesByHand
from bayescal_models.gyro_triad.simulator import BASELINE, COUNTS
from bayescal_models.triad.simulator import matrix_of, members_of

EARTH = 15.041 / 3600  # °/s
SHAKE = 0.1  # g, standard deviation of the hand's acceleration in moves
SUBSTEPS = 16  # between samples, in which the true attitude is integrated
LAWS = (
    "bias.constant",
    "bias.g_sensitivity",
    "scale.constant",
    "misalignment.constant",
    "square.constant",
)


def simulate_log(
    effects: Mapping[str, Any] | None = None, *, seed: int, campaign: MovesByHand | None = None
) -> dict[str, np.ndarray]:
    """Simulate a log: columns time (s), gyro_x, … (°/s), accel_x, … (g).

    Args:
        effects: canonical name of a gyroscopes' effect → true size, in the unit of its coefficients, or one for
            each of its members; bias, scale and misalignment are present unless given.
        seed: seed of the random-number generator.
        campaign: the poses and moves.

    Raises:
        ValueError: an effect that the simulator does not have.
    """
    plan, counts = campaign or MovesByHand(), {name: COUNTS[name] for name in LAWS}
    sizes = members_of(effects, counts, BASELINE)
    rng = np.random.default_rng(seed)
    rate, force, up = _path(plan, rng)  # °/s, g
    around = np.zeros(3)
    if plan.latitude is not None:
        heading, phi = rng.uniform(0, 2 * np.pi), np.deg2rad(plan.latitude)
        level = [np.cos(phi) * np.cos(heading), np.cos(phi) * np.sin(heading), np.sin(phi)]
        around = EARTH * np.array(level)
    rate = rate + np.einsum("nij,i->nj", up, around)
    matrix = matrix_of(1e-6 * sizes["scale.constant"], 1e-3 * sizes["misalignment.constant"])
    sensitivity = sizes["bias.g_sensitivity"].reshape(3, 3)
    gyro = rate @ matrix.T + sizes["bias.constant"] + force @ sensitivity.T
    gyro = gyro + 1e-6 * sizes["square.constant"] * rate**2
    scale, angles = (np.array(ACCELEROMETERS[f"{n}.constant"]) for n in ("scale", "misalignment"))
    accel = force @ matrix_of(1e-6 * scale, 1e-3 * angles).T
    accel = accel + 1e-3 * np.array(ACCELEROMETERS["bias.constant"])
    root_rate = math.sqrt(plan.rate)
    gyro = gyro + plan.gyro_noise * root_rate * rng.standard_normal(gyro.shape)
    accel = accel + plan.force_noise * root_rate * rng.standard_normal(accel.shape)
    columns = {"time": np.arange(len(gyro)) / plan.rate}
    columns |= {f"gyro_{a}": gyro[:, i] for i, a in enumerate("xyz")}
    return columns | {f"accel_{a}": accel[:, i] for i, a in enumerate("xyz")}


def _path(plan: MovesByHand, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rates against the ground (n, 3) in °/s, specific force (n, 3) in g, attitudes, body to level (n, 3, 3)."""
    fine = SUBSTEPS
    at_rest, moving = round(plan.still * plan.rate), round(plan.move * plan.rate)
    rates, forces, attitudes = [], [], []
    attitude = _rotation(rng.standard_normal(3))
    for pose in range(plan.poses):
        rates.append(np.zeros((at_rest, 3)))
        forces.append(np.tile(attitude[2], (at_rest, 1)))
        attitudes.append(np.tile(attitude, (at_rest, 1, 1)))
        if pose == plan.poses - 1:
            break
        axis = rng.standard_normal(3)
        mean = plan.angle * rng.uniform(0.5, 1.5) * axis / np.linalg.norm(axis) / plan.move
        aside, pushed = rng.standard_normal((2, 3))

        def turning(s: np.ndarray, mean: np.ndarray = mean, aside: np.ndarray = aside) -> Any:
            """Return the rate at fraction s of the move, rad/s."""
            swell = np.sin(np.pi * s)[:, None] ** 2
            return swell * (2 * mean + 0.5 * aside * np.sin(2 * np.pi * s)[:, None])

        whole = np.arange(moving) / moving
        rates.append(np.rad2deg(turning(whole)))
        orientation = np.empty((moving, 3, 3))
        middles = (np.arange(moving * fine) + 0.5) / (moving * fine)
        steps = turning(middles) / (plan.rate * fine)
        for k in range(moving * fine):
            if k % fine == 0:
                orientation[k // fine] = attitude
            attitude = attitude @ _rotation(steps[k])
        attitudes.append(orientation)
        swing = SHAKE * np.sin(np.pi * whole) ** 2 * np.sin(6 * np.pi * whole)
        felt = np.array([0.0, 0.0, 1.0]) + swing[:, None] * pushed
        forces.append(np.einsum("nij,ni->nj", orientation, felt))
    return np.concatenate(rates), np.concatenate(forces), np.concatenate(attitudes)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return Rodrigues' rotation matrix of a rotation vector, rad."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.eye(3) + cross
    once, twice = math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2
    return np.eye(3) + once * cross + twice * cross @ cross
