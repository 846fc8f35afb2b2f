"""Matrices here have ten to a hundred rows: several threads of BLAS spend their time waiting for each other."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import numpy as np
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, BLAS held to one thread and overflow passed over while it runs."""

    @wraps(function)
    def held(*args: P.args, **kwargs: P.kwargs) -> R:
        with _threads().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
            return function(*args, **kwargs)

    return held


def root_near(
    slope: Callable[[np.ndarray], np.ndarray], at: np.ndarray, shift: float
) -> np.ndarray:
    """The root of a gradient by Newton's steps, taken while the gradient falls."""
    here = slope(at)
    for _ in range(6):
        shifts = 10 * shift * np.eye(len(at))
        curvature = np.array([(slope(at + s) - slope(at - s)) / (20 * shift) for s in shifts])
        try:
            trial = at - np.linalg.solve(0.5 * (curvature + curvature.T), here)
        except np.linalg.LinAlgError:
            break
        there = slope(trial)
        if not np.linalg.norm(there) < 0.5 * np.linalg.norm(here):
            break
        at, here = trial, there
    return at
