"""Inversion of a measurement equation: the stimulus by its output; a number, or a vector reading by reading."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

MAX_NEWTON_STEPS = 20  # quadratic convergence needs few
MAX_ROUNDING_ERRORS = 1e4  # of the output: tolerance of a solution


def stepped(
    equation: Callable[[Any], tuple[Any, Callable[[Any], Any]]], y: Any, s: Any, steps: int
) -> Any:
    """Solve an equation for s at output y by a number of Newton steps from s, each squaring the error; in JAX too.

    Args:
        equation: s → the output, and the function from a small change of the output to that of s (÷ slope).
        y: the output.
        s: starting value.
        steps: number of steps; one where the equation is a straight line.
    """
    for _ in range(steps):
        value, undone = equation(s)
        s = s - undone(value - y)
    return s


def solved(
    equation: Callable[[Any], tuple[Any, Any]], y: np.ndarray, affine: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Solve an equation (s → output and slope) for s at output y; return s and the slope, NaN without a solution."""
    s, precision = np.zeros_like(y), np.finfo(y.dtype).eps
    with np.errstate(all="ignore"):
        for _ in range(1 if affine else MAX_NEWTON_STEPS):
            value, slope = equation(s)
            step = (value - y) / slope
            s = s - step
            if not np.any(np.abs(step) > precision * np.abs(s)):
                break
        if affine:
            return s, slope
        value, slope = equation(s)
        near = np.abs(value - y) <= MAX_ROUNDING_ERRORS * precision * (np.abs(y) + np.abs(value))
        return np.where(near, s, np.nan).astype(y.dtype), np.where(near, slope, np.nan)
