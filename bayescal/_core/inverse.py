"""Inversion of a measurement equation by Newton's method: stimulus from output, scalar or vector."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

MAX_NEWTON_STEPS = 20  # few are needed: convergence is quadratic
MAX_ROUNDING_ERRORS = 1e4  # tolerance of a solution, in rounding errors of the output


def iterate_newton(
    equation: Callable[[Any], tuple[Any, Callable[[Any], Any]]], y: Any, s: Any, steps: int
) -> Any:
    """Return the stimulus at output y after a fixed number of Newton steps from `s`; differentiable in JAX.

    Args:
        equation: s → (output, function that multiplies an output difference by the inverse derivative ds/dy).
        y: output.
        s: starting value of the stimulus.
        steps: number of steps; one suffices for an affine equation.
    """
    for _ in range(steps):
        value, apply_inverse = equation(s)
        s = s - apply_inverse(value - y)
    return s


def solve_newton(
    equation: Callable[[Any], tuple[Any, Any]], y: np.ndarray, is_affine: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Solve `equation`, s → (output, derivative), for s (n,) at output y (n,); return s and dy/ds, NaN if unsolved."""
    s, machine_epsilon = np.zeros_like(y), np.finfo(y.dtype).eps
    with np.errstate(all="ignore"):
        for _ in range(1 if is_affine else MAX_NEWTON_STEPS):
            value, derivative = equation(s)
            step = (value - y) / derivative
            s = s - step
            if not np.any(np.abs(step) > machine_epsilon * np.abs(s)):
                break
        if is_affine:
            return s, derivative
        value, derivative = equation(s)
        tolerance = MAX_ROUNDING_ERRORS * machine_epsilon * (np.abs(y) + np.abs(value))
        is_valid = np.abs(value - y) <= tolerance
        return np.where(is_valid, s, np.nan).astype(y.dtype), np.where(is_valid, derivative, np.nan)
