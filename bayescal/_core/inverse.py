"""Inversion of a measurement equation by Newton's method: stimulus from output, scalar or vector."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

MAX_NEWTON_STEPS = 20  # few are needed: the error decreases quadratically
MAX_ROUNDING_ERRORS = 1e4  # tolerance of a solution, in rounding errors of the output


def iterate_newton(
    equation: Callable[[Any], tuple[Any, Callable[[Any], Any]]], y: Any, s: Any, steps: int
) -> Any:
    """Solve the measurement equation for the stimulus s at output y by Newton steps from s; differentiable in JAX.

    Args:
        equation: s → (output, function that multiplies a change of the output by the inverse derivative).
        y: output.
        s: starting value.
        steps: number of steps; one suffices for an affine equation.
    """
    for _ in range(steps):
        value, apply_inverse = equation(s)
        s = s - apply_inverse(value - y)
    return s


def solve_newton(
    equation: Callable[[Any], tuple[Any, Any]], y: np.ndarray, is_affine: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Solve `equation`, s → (output, derivative), for s at output y; return s and the derivative, NaN if unsolved."""
    s, precision = np.zeros_like(y), np.finfo(y.dtype).eps
    with np.errstate(all="ignore"):
        for _ in range(1 if is_affine else MAX_NEWTON_STEPS):
            value, slope = equation(s)
            step = (value - y) / slope
            s = s - step
            if not np.any(np.abs(step) > precision * np.abs(s)):
                break
        if is_affine:
            return s, slope
        value, slope = equation(s)
        tolerance = MAX_ROUNDING_ERRORS * precision * (np.abs(y) + np.abs(value))
        is_valid = np.abs(value - y) <= tolerance
        return np.where(is_valid, s, np.nan).astype(y.dtype), np.where(is_valid, slope, np.nan)
