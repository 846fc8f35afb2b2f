"""Columns of three-axis instruments: of a session, of three components, and of computed readings."""

from __future__ import annotations

from typing import Any

import bayescal as bc

AXES = "xyz"
OUTPUTS = tuple(f"output_{a}" for a in AXES)
TURNED = tuple(f"turned_{a}{j}" for a in AXES for j in AXES)
PULLED = tuple(f"pulled_{a}{j}" for a in AXES for j in AXES)
SQUARED = tuple(f"squared_{a}" for a in AXES)
AROUND = tuple(f"around_{k}" for k in "123")
SESSION = (
    bc.Column("run", None, "label of the session", required=False),
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("temperature", "degC", "of the unit", required=False, low=-273.15, high=250.0),
)


def three(
    name: str, unit: str, words: str, also: tuple[str, ...] = (), **options: Any
) -> tuple[bc.Column, ...]:
    """Declare a column for each component.

    Args:
        name: name before the axis, as in `output_x`.
        unit: unit of all three.
        words: description, with `{axis}` for the axis.
        also: other names, likewise.
        options: options of `bc.Column`.
    """
    return tuple(
        bc.Column(
            f"{name}_{a}",
            unit,
            words.format(axis=a),
            also=tuple(other.format(axis=a) for other in also),
            **options,
        )
        for a in AXES
    )


def derived(unit: str, across: str, axis: str, output: str) -> tuple[bc.Column, ...]:
    """Declare the columns of readings computed from the three outputs."""
    return (
        *three("across", "1", across, required=False),
        bc.Column("axis", None, axis, required=False),
        bc.Column("output", unit, output, required=False),
    )


def declare_move_columns(unit: str) -> tuple[bc.Column, ...]:
    """Declare the basis columns of an output averaged over a move between poses, along an axis fixed in the sensor."""
    return (
        *(
            bc.Column(n, unit, f"rate about {n[-1]}, by component {n[-2]}", required=False)
            for n in TURNED
        ),
        *(
            bc.Column(n, "g", f"force along {n[-1]}, by component {n[-2]}", required=False)
            for n in PULLED
        ),
        *(
            bc.Column(n, f"({unit})^2", f"rate squared, by component {n[-1]}", required=False)
            for n in SQUARED
        ),
        *(bc.Column(n, "1", "of the Earth's rotation", required=False) for n in AROUND),
    )


def made_in_poses(unit: str) -> tuple[bc.Column, ...]:
    """Declare the columns of poses: direction uncertainty, and magnitude or projections of the outputs."""
    return (
        bc.Column(
            "pose_uncertainty",
            "rad",
            "standard uncertainty of that direction",
            required=False,
            low=0.0,
            high=1.0,
        ),
        *derived(
            unit,
            "of a reading that is a projection",
            "which reading of a pose it is",
            "magnitude or projection, made of the three outputs",
        ),
    )
