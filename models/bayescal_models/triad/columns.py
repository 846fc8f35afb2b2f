"""Column declarations of three-axis instruments: sessions, components, and readings computed from the outputs."""

from __future__ import annotations

from typing import Any

import bayescal as bc

AXES = "xyz"
OUTPUTS = tuple(f"output_{a}" for a in AXES)
MEAN_RATE = tuple(f"turned_{a}{j}" for a in AXES for j in AXES)
MEAN_FORCE = tuple(f"pulled_{a}{j}" for a in AXES for j in AXES)
SQUARED_RATE_COLUMNS = tuple(f"squared_{a}" for a in AXES)
EARTH_RATES = tuple(f"around_{k}" for k in "123")
SESSION = (
    bc.Column("run", None, "label of the session", required=False),
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("temperature", "degC", "of the unit", required=False, low=-273.15, high=250.0),
)


def triple(
    name: str, unit: str, description: str, aliases: tuple[str, ...] = (), **options: Any
) -> tuple[bc.Column, ...]:
    """Declare one column per axis x, y, z.

    Args:
        name: column name without the axis, such as "output" for `output_x`.
        unit: unit of the three columns.
        description: description, with `{axis}` for the axis.
        aliases: other column names in files, with `{axis}` for the axis.
        options: further options of `bc.Column`.
    """
    return tuple(
        bc.Column(
            f"{name}_{a}",
            unit,
            description.format(axis=a),
            also=tuple(alias.format(axis=a) for alias in aliases),
            **options,
        )
        for a in AXES
    )


def derived_columns(unit: str, across: str, axis: str, output: str) -> tuple[bc.Column, ...]:
    """Declare the columns of readings computed from three outputs; `across`, `axis`, `output`: their descriptions."""
    return (
        *triple("across", "1", across, required=False),
        bc.Column("axis", None, axis, required=False),
        bc.Column("output", unit, output, required=False),
    )


def declare_move_columns(unit: str) -> tuple[bc.Column, ...]:
    """Declare basis columns for outputs averaged over a rotation between poses, along a direction fixed in space."""
    return (
        *(
            bc.Column(n, unit, f"mean rate about {n[-1]} times component {n[-2]}", required=False)
            for n in MEAN_RATE
        ),
        *(
            bc.Column(n, "g", f"mean force along {n[-1]} times component {n[-2]}", required=False)
            for n in MEAN_FORCE
        ),
        *(
            bc.Column(n, f"({unit})^2", f"rate squared times component {n[-1]}", required=False)
            for n in SQUARED_RATE_COLUMNS
        ),
        *(bc.Column(n, "1", "weight of Earth's rotation", required=False) for n in EARTH_RATES),
    )


def declare_pose_columns(unit: str) -> tuple[bc.Column, ...]:
    """Declare the columns of poses: direction uncertainty, and magnitude or projections of the outputs."""
    return (
        bc.Column(
            "pose_uncertainty",
            "rad",
            "standard uncertainty of the direction",
            required=False,
            low=0.0,
            high=1.0,
        ),
        *derived_columns(
            unit,
            "direction of a projection",
            "kind of computed reading",
            "magnitude or projection of the three outputs",
        ),
    )
