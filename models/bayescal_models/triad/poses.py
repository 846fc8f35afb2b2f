"""Directions of what acts, in the body's axes: sets of poses, and true directions about nominal ones."""

from __future__ import annotations

import numpy as np

KINDS = ("random", "six", "twelve", "planar", "level")


def directions(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors (count, 3).

    Args:
        kind: "random" over the sphere; "six" each axis up and down, in turn; "twelve" halfway between two axes, in
            turn; "planar" at random angles about the y axis; "level" within 10° of z up.
        count: of poses.
        rng: of every random number.

    Raises:
        ValueError: another kind.
    """
    if kind == "random":
        made = rng.standard_normal((count, 3))
    elif kind == "six":
        made = np.resize(np.concatenate([np.eye(3), -np.eye(3)]), (count, 3))
    elif kind == "twelve":
        pairs = [
            (i, j, s, t) for i, j in ((0, 1), (0, 2), (1, 2)) for s in (1, -1) for t in (1, -1)
        ]
        made = np.zeros((12, 3))
        for row, (i, j, s, t) in zip(made, pairs, strict=True):
            row[i], row[j] = s, t
        made = np.resize(made, (count, 3))
    elif kind == "planar":
        angle = rng.uniform(0, 2 * np.pi, count)
        made = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    elif kind == "level":
        tilt, way = (
            np.deg2rad(10) * np.sqrt(rng.uniform(size=count)),
            rng.uniform(0, 2 * np.pi, count),
        )
        made = np.column_stack(
            [np.sin(tilt) * np.cos(way), np.sin(tilt) * np.sin(way), np.cos(tilt)]
        )
    else:
        raise ValueError(f"poses {kind!r} are not one of {', '.join(KINDS)}")
    return made / np.linalg.norm(made, axis=1)[:, None]


def beside(direction: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Directions that stand beside these by a random angle of this standard deviation about each cross axis, rad."""
    moved = direction + angle * rng.standard_normal(direction.shape)
    return moved / np.linalg.norm(moved, axis=1)[:, None]
