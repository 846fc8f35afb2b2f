"""Feasible campaigns of three axes: directions along the axes, at 45° between two and along the diagonals."""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any

import numpy as np

DIRECTIONS = np.array([d for d in product((1.0, 0.0, -1.0), repeat=3) if any(d)])
THERMAL = (-20.0, 25.0, 70.0)  # °C
INTERVAL = 20.0  # s, between readings


def _spread(count: int, temperatures: tuple[float, ...]) -> dict[str, Any]:
    """Return columns of so many readings at each temperature."""
    rows = count * len(temperatures)
    return {
        "run": np.full(rows, "planned"),
        "time": INTERVAL * np.arange(rows),
        "temperature": np.repeat(temperatures, count),
    }


def poses(size: float, temperatures: tuple[float, ...]) -> dict[str, Any]:
    """Return columns of a pose in each direction, of an input of magnitude `size`, at each temperature."""
    columns = _spread(len(DIRECTIONS), temperatures) | {"magnitude": size}
    units = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    outputs = np.tile(size * units, (len(temperatures), 1))
    return columns | {f"output_{a}": outputs[:, i] for i, a in enumerate("xyz")}


def rates(rate: float, temperatures: tuple[float, ...]) -> dict[str, Any]:
    """Return columns of a rate each way, each axis up and down, at each temperature."""
    axis = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 2, axis=0)
    columns = _spread(len(axis), temperatures)
    axis = np.tile(axis, (len(temperatures), 1))
    columns |= {"rate": np.tile([rate, -rate], len(axis) // 2)}
    for i, a in enumerate("xyz"):
        columns[f"direction_{a}"] = columns[f"gravity_{a}"] = axis[:, i]
        columns[f"output_{a}"] = columns["rate"] * axis[:, i]
    return columns


def experiments(size: float) -> tuple[tuple[str, Any], ...]:
    """Return the experiments of poses, by name."""
    return (
        ("26 directions at 25 °C", partial(poses, size, (25.0,))),
        ("26 directions at −20, 25 and 70 °C", partial(poses, size, THERMAL)),
    )


RATES = (
    ("100 °/s each way, each axis up and down, 25 °C", partial(rates, 100.0, (25.0,))),
    ("100 °/s each way, each axis up and down, −20, 25, 70 °C", partial(rates, 100.0, THERMAL)),
)
