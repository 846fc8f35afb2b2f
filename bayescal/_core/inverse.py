"""The inverse of an equation: what acts, by the output that it makes; a number, or a vector reading by reading."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

STEPS = 20  # of Newton's, at most
MOST_ROUNDING_ERRORS = 1e4  # of the output, by which a solution may miss


def stepped(
    equation: Callable[[Any], tuple[Any, Callable[[Any], Any]]], y: Any, s: Any, steps: int
) -> Any:
    """s where an equation gives y, by so many steps of Newton from s, each of which squares the error; in JAX too.

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


def solved(
    equation: Callable[[Any], tuple[Any, Any]], y: np.ndarray, affine: bool
) -> tuple[np.ndarray, np.ndarray]:
    """s where an equation (of s, the output and its slope) gives y, and the slope there; both NaN where none is."""
    s, precision = np.zeros_like(y), np.finfo(y.dtype).eps
    with np.errstate(all="ignore"):
        for _ in range(1 if affine else STEPS):
            there, slope = equation(s)
            step = (there - y) / slope
            s = s - step
            if not np.any(np.abs(step) > precision * np.abs(s)):
                break
        if affine:
            return s, slope
        there, slope = equation(s)
        near = np.abs(there - y) <= MOST_ROUNDING_ERRORS * precision * (np.abs(y) + np.abs(there))
        return np.where(near, s, np.nan).astype(y.dtype), np.where(near, slope, np.nan)
