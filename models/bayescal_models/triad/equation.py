"""The output of three axes, each a polynomial of what acts.

    y_a = f_a + b_a + Σ_j G_aj·f_j + Q_a·f_a² + Σ_{i<j} C_aij·f_i·f_j

b is the bias, the diagonal of G the deviations of the scale factors, the others misalignments (IEEE Std 1293-2018,
model equation: K0, K1, the angles of the input axis, K2 and the cross-coupling coefficients).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

import bayescal as bc

AXES = ("x", "y", "z")
BIAS = tuple(f"bias_{a}" for a in AXES)
SCALE = tuple(f"scale_{a}" for a in AXES)
UPPER = ("misalignment_xy", "misalignment_xz", "misalignment_yz")  # of the first axis toward the second
LOWER = ("misalignment_yx", "misalignment_zx", "misalignment_zy")
SQUARE = tuple(f"square_{a}" for a in AXES)
CROSS = tuple(f"cross_{a}_{p}" for a in AXES for p in ("xy", "xz", "yz"))


def slots(unit: str, acts: str) -> tuple[bc.Slot, ...]:
    """The slots of three axes whose outputs are in `unit`; `acts` says of what, for people."""
    return (
        *(bc.Slot(name, unit, f"output of axis {name[-1]} at no {acts}") for name in BIAS),
        *(bc.Slot(name, "1", f"deviation of the scale factor of axis {name[-1]}") for name in SCALE),
        *(
            bc.Slot(name, "rad", f"angle of axis {name[-2]} toward {name[-1]}")
            for name in (*UPPER, *LOWER)
        ),
    )


def second_order(unit: str) -> tuple[bc.Slot, ...]:
    """Further slots, of terms of second order."""
    return (
        *(bc.Slot(name, f"1/{unit}", f"of axis {name[-1]}, times its own input squared") for name in SQUARE),
        *(bc.Slot(name, f"1/{unit}", f"of axis {name[6]}, times {name[8]} and {name[9]}") for name in CROSS),
    )


def equation(force: Any, given: Mapping[str, Any], r: bc.Frame) -> Any:
    """The three outputs where `force` acts, (n, 3), output unit; second order where there are slots for it."""
    f = dict(zip(AXES, (force[:, 0], force[:, 1], force[:, 2]), strict=True))
    made = []
    for a in AXES:
        total = f[a] * (1 + given[f"scale_{a}"]) + given[f"bias_{a}"]
        total += sum(given[f"misalignment_{a}{j}"] * f[j] for j in AXES if j != a)
        if SQUARE[0] in given:
            total += given[f"square_{a}"] * f[a] ** 2
            total += sum(given[f"cross_{a}_{p}"] * f[p[0]] * f[p[1]] for p in ("xy", "xz", "yz"))
        made.append(total)
    return jnp.stack(made, axis=1)
