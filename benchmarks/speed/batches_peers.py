"""A line in temperature fitted device by device by others: loops of scipy and of lmfit.

All take arrays already cut into devices, with the same residuals and priors (lmfit's LinearModel: no priors).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np

NOISE = 0.2  # °/s
T0 = 20.0  # °C
Part = tuple[np.ndarray, np.ndarray]  # temperature, °C, and output, °/s, of a device
Line = tuple[np.ndarray, np.ndarray]  # offset, °/s, and slope, °/s/°C; their standard uncertainties


def by_scipy(
    parts: list[Part], sizes: np.ndarray, method: Literal["trf", "lm"] = "trf"
) -> list[Line]:
    """Offset and slope with their standard uncertainties, device by device, by `scipy.optimize`."""
    from scipy.optimize import least_squares

    found = []
    for temperature, output in parts:
        t = temperature - T0

        def residuals(x, t=t, output=output):
            return np.append(output - x[0] - x[1] * t, NOISE * x / sizes)

        one: Any = least_squares(residuals, x0=np.zeros(2), method=method)
        variance = 2 * one.cost / (len(t) - 2)
        covariance = np.linalg.inv(one.jac.T @ one.jac) * variance
        found.append((one.x, np.sqrt(np.diag(covariance))))
    return found


def by_lmfit(parts: list[Part], sizes: np.ndarray) -> list[Line]:
    """The same by lmfit."""
    import lmfit  # pyright: ignore[reportMissingImports]

    found = []
    for temperature, output in parts:
        t = temperature - T0

        def residuals(p, t=t, output=output):
            x = np.array([p["offset"].value, p["slope"].value])
            return np.append(output - x[0] - x[1] * t, NOISE * x / sizes)

        start = lmfit.Parameters()
        start.add("offset", value=0.0)
        start.add("slope", value=0.0)
        one: Any = lmfit.minimize(residuals, start)
        found.append(
            (
                np.array([one.params[n].value for n in ("offset", "slope")]),
                np.array([one.params[n].stderr for n in ("offset", "slope")]),
            )
        )
    return found


def by_lmfit_model(
    parts: list[Part],
) -> list[Line]:
    """The same by lmfit's ready-made line, without the priors."""
    from lmfit.models import LinearModel  # pyright: ignore[reportMissingImports]

    line, found = LinearModel(), []
    for temperature, output in parts:
        one = line.fit(output, x=temperature - T0, intercept=0.0, slope=0.0)
        own = [one.params[n] for n in ("intercept", "slope")]
        found.append((np.array([p.value for p in own]), np.array([p.stderr for p in own])))
    return found


def peers(sizes: np.ndarray) -> dict[str, Callable[[list[Part]], list[Line]]]:
    """Every peer; `sizes` are the priors' of offset and slope."""
    return {
        "scipy": partial(by_scipy, sizes=sizes),
        "scipy, method='lm'": partial(by_scipy, sizes=sizes, method="lm"),
        "lmfit": partial(by_lmfit, sizes=sizes),
        "lmfit, LinearModel": by_lmfit_model,
    }
