"""Outputs of three axes, each a polynomial of the input.

    y_a = f_a + b_a + Σ_j G_aj·f_j + Q_a·f_a² + Σ_{i<j} C_aij·f_i·f_j + R_a·f_a³

b is the bias, the diagonal of G the deviations of the scale factors, the others misalignments (IEEE Std 1293-2018,
model equation: K0, K1, the angles of the input axis, K2, the cross-coupling coefficients and K3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import bayescal as bc
from bayescal import xp

AXES = ("x", "y", "z")
BIAS = tuple(f"bias_{a}" for a in AXES)
SCALE = tuple(f"scale_{a}" for a in AXES)
# Angles of the first axis toward the second.
UPPER = ("misalignment_xy", "misalignment_xz", "misalignment_yz")
LOWER = ("misalignment_yx", "misalignment_zx", "misalignment_zy")
FIRST = tuple(f"scale_{i}" if i == j else f"misalignment_{i}{j}" for i in AXES for j in AXES)
SQUARE = tuple(f"square_{a}" for a in AXES)
CUBE = tuple(f"cube_{a}" for a in AXES)
CROSS = tuple(f"cross_{a}_{p}" for a in AXES for p in ("xy", "xz", "yz"))


def slots(unit: str, acts: str) -> tuple[bc.Slot, ...]:
    """Return the slots of three axes whose outputs are in `unit`; `acts` describes the input."""
    return (
        *(bc.Slot(name, unit, f"output of axis {name[-1]} at no {acts}") for name in BIAS),
        *(
            bc.Slot(name, "1", f"deviation of the scale factor of axis {name[-1]}")
            for name in SCALE
        ),
        *(
            bc.Slot(name, "rad", f"angle of axis {name[-2]} toward {name[-1]}")
            for name in (*UPPER, *LOWER)
        ),
    )


def higher_order(unit: str) -> tuple[bc.Slot, ...]:
    """Return the slots of second- and third-order terms."""
    return (
        *(
            bc.Slot(name, f"1/{unit}", f"of axis {name[-1]}, times its own input squared")
            for name in SQUARE
        ),
        *(
            bc.Slot(name, f"1/{unit}", f"of axis {name[6]}, times {name[8]} and {name[9]}")
            for name in CROSS
        ),
        *(
            bc.Slot(name, f"1/{unit}^2", f"of axis {name[-1]}, times its own input cubed")
            for name in CUBE
        ),
    )


def equation(values: Mapping[str, Any], r: bc.Frame) -> Callable[[Any], Any]:
    """Return the three outputs (n, 3), output unit, as a function of the input (n, 3); with higher orders if given."""

    def stacked(names: Sequence[str]) -> Any:
        return xp.stack([values[name] for name in names], axis=-1).reshape(r.size, 3, -1)

    bias, first = stacked(BIAS)[:, :, 0], stacked(FIRST)
    square = stacked(SQUARE)[:, :, 0] if SQUARE[0] in values else None
    cross = stacked(CROSS) if CROSS[0] in values else None
    cube = stacked(CUBE)[:, :, 0] if CUBE[0] in values else None

    def outputs(force: Any) -> Any:
        total = force + bias + xp.sum(first * force[:, None, :], axis=-1)
        if square is not None:
            total = total + square * force**2
        if cube is not None:
            total = total + cube * force**3
        if cross is None:
            return total
        products = xp.stack(
            [force[:, i] * force[:, j] for i, j in ((0, 1), (0, 2), (1, 2))], axis=-1
        )
        return total + xp.sum(cross * products[:, None, :], axis=-1)

    return outputs
