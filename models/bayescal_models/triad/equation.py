"""Model equation of three axes: each output y_a is a polynomial of the input f = (f_x, f_y, f_z).

    y_a = f_a + b_a + Σ_j G_aj·f_j + Q_a·f_a² + Σ_{i<j} C_aij·f_i·f_j + R_a·f_a³

b is the bias; G has the scale factor deviations on its diagonal and the misalignments off it; Q, C and R are the
second-order, cross-coupling and third-order coefficients (IEEE Std 1293-2018: K0, K1, angles, K2, cross-coupling, K3).
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
FIRST_ORDER = tuple(f"scale_{i}" if i == j else f"misalignment_{i}{j}" for i in AXES for j in AXES)
SQUARE = tuple(f"square_{a}" for a in AXES)
CUBE = tuple(f"cube_{a}" for a in AXES)
CROSS = tuple(f"cross_{a}_{p}" for a in AXES for p in ("xy", "xz", "yz"))


def make_slots(unit: str, input_name: str) -> tuple[bc.Slot, ...]:
    """Return the bias, scale factor and misalignment slots of three axes; `unit`: of the outputs."""
    return (
        *(bc.Slot(name, unit, f"output of axis {name[-1]} at zero {input_name}") for name in BIAS),
        *(bc.Slot(name, "1", f"scale factor deviation of axis {name[-1]}") for name in SCALE),
        *(
            bc.Slot(name, "rad", f"angle of axis {name[-2]} toward {name[-1]}")
            for name in (*UPPER, *LOWER)
        ),
    )


def make_higher_order_slots(unit: str) -> tuple[bc.Slot, ...]:
    """Return the slots of the second- and third-order terms of three axes; `unit`: of input and outputs."""
    return (
        *(
            bc.Slot(name, f"1/{unit}", f"second-order coefficient of axis {name[-1]}")
            for name in SQUARE
        ),
        *(
            bc.Slot(name, f"1/{unit}", f"coefficient of axis {name[6]} of {name[8]}·{name[9]}")
            for name in CROSS
        ),
        *(
            bc.Slot(name, f"1/{unit}^2", f"third-order coefficient of axis {name[-1]}")
            for name in CUBE
        ),
    )


def build_equation(values: Mapping[str, Any], r: bc.Frame) -> Callable[[Any], Any]:
    """Return the function from inputs (n, 3) to outputs (n, 3), both in the output unit, at values of the slots."""

    def stack_slots(names: Sequence[str]) -> Any:
        return xp.stack([values[name] for name in names], axis=-1).reshape(r.size, 3, -1)

    bias, first_order = stack_slots(BIAS)[:, :, 0], stack_slots(FIRST_ORDER)
    square_terms = stack_slots(SQUARE)[:, :, 0] if SQUARE[0] in values else None
    cross_terms = stack_slots(CROSS) if CROSS[0] in values else None
    cube_terms = stack_slots(CUBE)[:, :, 0] if CUBE[0] in values else None

    def outputs(force: Any) -> Any:
        output = force + bias + xp.sum(first_order * force[:, None, :], axis=-1)
        if square_terms is not None:
            output = output + square_terms * force**2
        if cube_terms is not None:
            output = output + cube_terms * force**3
        if cross_terms is None:
            return output
        products = xp.stack(
            [force[:, i] * force[:, j] for i, j in ((0, 1), (0, 2), (1, 2))], axis=-1
        )
        return output + xp.sum(cross_terms * products[:, None, :], axis=-1)

    return outputs
