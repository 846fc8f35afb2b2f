"""Gradients under Ornstein–Uhlenbeck noise, at a thousand to a million readings, on one core.

A pass at each evaluation, linear in the readings, beside the dense Cholesky factor that it replaces.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.speed.scaling.gradient_cost import AT, T0, Bound, bound, slopes
from benchmarks.speed.timing import clocks, interleaved

GOAL = 1e5  # readings a second
SIZES, DENSE = (1_000, 3_000, 10_000, 100_000, 1_000_000), (1_000, 3_000)
REPEATS = 3


def _another(density: Any, v: np.ndarray) -> Any:
    """The density a little aside, for which nothing is kept."""
    return density.at(v + 1e-9 * np.random.default_rng().standard_normal(len(v)))


def dense_density(b: Bound) -> float:
    """log p(y, φ) by the Cholesky factor of the whole covariance, coefficients and all, in numpy alone."""
    from scipy.linalg import cho_factor, cho_solve

    white, q, tau = (AT[k] for k in ("noise.white", "noise.diffusion", "noise.correlated.time"))
    time_s = np.asarray(b.frame["time"])
    j = np.column_stack([np.ones(len(b.y)), np.asarray(b.frame["temperature"]) - T0])
    j = j * [e.coefficients[0].size for e in b.layout.model.effects]
    covariance = 0.5 * q**2 * tau * np.exp(-np.abs(time_s[:, None] - time_s) / tau) + j @ j.T
    covariance[np.diag_indices(len(time_s))] += white**2
    factor = cho_factor(covariance, lower=True, overwrite_a=True)
    y = np.asarray(b.y)
    rest = y @ cho_solve(factor, y)
    volume = 2 * np.sum(np.log(np.diag(factor[0])))
    prior = sum(float(h.prior.log_density(b.v[i])) for i, h in enumerate(b.layout.hypers))
    return -0.5 * (rest + volume + len(y) * np.log(2 * np.pi)) + prior


def wander() -> dict[str, Any]:
    """Values and gradients under Ornstein–Uhlenbeck noise.

    Raises:
        RuntimeError: the value is not the dense one's.
    """
    seconds: dict[int, dict[str, float]] = {}
    for n in SIZES:
        b = bound(n, correlated=True)

        mine, steps = b.density.at(b.v)[0], max(1, 30_000 // n)
        runs: dict[str, Callable[[], Any]] = {
            "gradient": slopes(b.density, b.v, steps),
            "value": partial(_another, b.density, b.v),
        }
        if n in DENSE:
            theirs = dense_density(b)
            if not abs(mine - theirs) <= 1e-8 * abs(theirs):
                raise RuntimeError(f"at {n} readings: log density {mine}, dense {theirs}")
            runs["dense value"] = partial(dense_density, b)
        best = clocks(interleaved(runs, REPEATS))
        seconds[n] = {**best, "gradient": best["gradient"] / steps}
    first, middle, last = SIZES[0], SIZES[2], SIZES[-1]
    exponent = np.log10(seconds[last]["gradient"] / seconds[middle]["gradient"]) / np.log10(
        last / middle
    )
    rate = {n: n / s["gradient"] for n, s in seconds.items()}
    ratio = seconds[DENSE[-1]]["dense value"] / seconds[DENSE[-1]]["value"]
    return {
        "seconds": seconds,
        "readings_per_second": rate,
        "exponent": float(exponent),
        "goal_rate": GOAL,
        "dense_over_ours": ratio,
        "told": f"gradient {1e3 * seconds[first]['gradient']:.2f} ms at 10³ readings, "
        f"{1e3 * seconds[last]['gradient']:.0f} ms at 10⁶; growth from 10⁴ to 10⁶ as n^{exponent:.2f}; "
        f"{rate[first]:.2g} to {rate[last]:.2g} readings per core-second, value and gradient (goal {GOAL:.0e}); "
        f"the dense value takes {ratio:.0f} × ours at {DENSE[-1]}, equal to 1e-8",
    }
