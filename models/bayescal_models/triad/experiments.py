"""Feasible experiments for three axes: inputs along the axes, halfway between two axes and along the diagonals."""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any

import numpy as np

DIRECTIONS = np.array([d for d in product((1.0, 0.0, -1.0), repeat=3) if any(d)])
SOAK_DEGC = (-20.0, 25.0, 70.0)  # °C
READING_INTERVAL_S = 20.0  # s, between readings


def _plan_columns(count: int, temperatures: tuple[float, ...]) -> dict[str, Any]:
    """Return the run, time and temperature columns of `count` readings at each temperature."""
    rows = count * len(temperatures)
    return {
        "run": np.full(rows, "planned"),
        "time": READING_INTERVAL_S * np.arange(rows),
        "temperature": np.repeat(temperatures, count),
    }


def plan_poses(magnitude: float, temperatures: tuple[float, ...]) -> dict[str, Any]:
    """Return the columns of a pose in each of `DIRECTIONS` at each temperature, °C, with an input of this magnitude."""
    columns = _plan_columns(len(DIRECTIONS), temperatures) | {"magnitude": magnitude}
    unit_vectors = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    outputs = np.tile(magnitude * unit_vectors, (len(temperatures), 1))
    return columns | {f"output_{a}": outputs[:, i] for i, a in enumerate("xyz")}


def rates(rate: float, temperatures: tuple[float, ...]) -> dict[str, Any]:
    """Return the columns of rotations at ±`rate`, °/s, with each axis up and down, at each temperature, °C."""
    axes = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 2, axis=0)
    columns = _plan_columns(len(axes), temperatures)
    axes = np.tile(axes, (len(temperatures), 1))
    columns |= {"rate": np.tile([rate, -rate], len(axes) // 2)}
    for i, a in enumerate("xyz"):
        columns[f"direction_{a}"] = columns[f"gravity_{a}"] = axes[:, i]
        columns[f"output_{a}"] = columns["rate"] * axes[:, i]
    return columns


def list_pose_experiments(magnitude: float) -> tuple[tuple[str, Any], ...]:
    """Return (description, function that returns the columns) of experiments in poses; `magnitude`: of the input."""
    return (
        ("26 directions at 25 °C", partial(plan_poses, magnitude, (25.0,))),
        ("26 directions at −20, 25 and 70 °C", partial(plan_poses, magnitude, SOAK_DEGC)),
    )


RATE_EXPERIMENTS = (
    ("100 °/s each way, each axis up and down, 25 °C", partial(rates, 100.0, (25.0,))),
    ("100 °/s each way, each axis up and down, −20, 25, 70 °C", partial(rates, 100.0, SOAK_DEGC)),
)
