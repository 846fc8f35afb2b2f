"""The inverse of an equation: what acts, by the output that it makes; a number, or a vector reading by reading."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayescal._core.lazy_jax import jax, jnp

NEWTON_TOLERANCE = 1e-13  # of the last step, relative
MOST_STEPS = 40  # that are tried
NEAR_SHARE = 1e-9  # of the outputs, by which one found may miss


def stepped(
    equation: Callable[[Any], tuple[Any, Callable[[Any], Any]]], y: Any, s: Any, steps: int
):
    """s where an equation gives y, by so many steps of Newton, each of which squares the error; NumPy's or JAX's.

    So firmware does it, and what is differentiated backward.

    Args:
        equation: of s, the output, and what a small change of the output comes to in s: its division by the slope.
        y: the output.
        s: to begin with.
        steps: how many; one where the equation is a straight line.
    """
    for _ in range(steps):
        there, undone = equation(s)
        s = s - undone(there - y)
    return s


def settled(equation: Callable[[Any], Any], y: Any, affine: bool) -> tuple[Any, Any]:
    """s where an equation of one number gives y, and its slope there, in JAX; NaN where none is found.

    Args:
        equation: of s, the output.
        y: the output.
        affine: whether the equation is a straight line, which needs no search.
    """
    at_zero, slope = jax.value_and_grad(lambda s: equation(s) - y)(0.0)
    first = -at_zero / slope
    if affine:
        return first, slope
    import optimistix as optx  # a sixth of a second that only a curved equation needs

    solver = optx.Newton(rtol=NEWTON_TOLERANCE, atol=1e-300)
    found = optx.root_find(
        lambda s, _: equation(s) - y, solver, first, max_steps=MOST_STEPS, throw=False
    ).value
    miss, slope = jax.value_and_grad(lambda s: equation(s) - y)(found)
    near = jnp.abs(miss) <= NEAR_SHARE * (jnp.abs(y) + jnp.abs(at_zero))
    return jnp.where(near, found, jnp.nan), slope
