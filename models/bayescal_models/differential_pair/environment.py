"""The shared environment u(t), each device's sensitivity to it, and each device's own departure v(t).

env_k(t) = λd_k·u(t) + v_k(t). Both u and v are smooth random functions: Legendre polynomials over the record, of unit
rms, whose prior standard deviations fall by a constant ratio from order to order. Of u's orders above the fifth, which
are small, every device has λd = 1. For v both the size and the ratio are learned:
the identified orders bound those of a slow v, confounded with scale and sensitivity. The scale of u is fixed by
the population of λd, whose mean is 1; without v differencing would be exact for every pair (source 3 has
u1 = u2, hence v = 0; the departures are ours).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal import xp

ORDERS = 6  # orders of v, and of u with a sensitivity per device
SHARED_ORDERS = 9  # orders of u: error below 0.1 µg for a transient or wave as long as the record
RATIO = 0.6  # ratio of the prior standard deviations of successive orders of u
FALLING = (0.25, 0.95)  # 95 % of the prior of the same ratio for v
DISTURBANCE = 1000.0  # µg rms, of u
SENSITIVITY_SPREAD = 0.2  # standard deviation of λd over devices of one type
SHARE = (0.012, 0.21)  # 95 % range of the prior of v's size relative to 1 mg; its median is 5 %
SOURCE = "source 3; sizes ours"

SENSITIVITY = "environment.shared[sensitivity]"
DEPARTURE_SHARE = "departure.device.share"


def order_sizes() -> NDArray[np.float64]:
    """Return the prior standard deviations of the orders of u, µg; the sum of their squares is 1 mg²."""
    falling = RATIO ** np.arange(SHARED_ORDERS)
    return DISTURBANCE * falling / np.sqrt(np.sum(falling**2))


def polynomials(progress: Any, count: int) -> list[Any]:
    """Return the first Legendre polynomials of unit rms over the record, orders 0 to count − 1.

    Args:
        progress: (t − t̄)/(tmax − tmin), −½ … ½ on an even record; NumPy or JAX.
    """
    z = 2.0 * progress
    legendre = [1.0 + 0.0 * z, z]
    for n in range(1, count - 1):
        legendre.append(((2 * n + 1) * z * legendre[n] - n * legendre[n - 1]) / (n + 1))
    return [np.sqrt(2 * n + 1) * p for n, p in enumerate(legendre)]


def order_names(effect: bc.Effect) -> list[str]:
    """Return names of an effect's orders."""
    return [f"{effect.name}[{c.part}]" for c in effect.coefficients if "order" in c.part]


def _shared(r: bc.Frame) -> Any:
    parts = polynomials(r.progress, SHARED_ORDERS)
    return xp.stack([1.0 + 0.0 * parts[0], *parts], axis=-1)


def _departure(r: bc.Frame) -> Any:
    return xp.stack(polynomials(r.progress, ORDERS), axis=-1)


def _departure_sizes(share: Any, falling: Any) -> Any:
    """Return standard deviations of the orders of v, relative to u's rms: (6,), or (…, 6) of values (…, 1)."""
    powers = falling ** np.arange(ORDERS)
    return share * powers / (powers**2).sum(axis=-1, keepdims=True) ** 0.5


SHARED = bc.Effect(
    "environment.shared",
    "environment",
    basis=_shared,
    coefficients=(
        bc.Coefficient(
            "1",
            bc.Normal(1.0, SENSITIVITY_SPREAD),
            part="sensitivity",
            slot="sensitivity",
            per="device",
            group_sd=bc.HalfNormal(SENSITIVITY_SPREAD),
        ),
        *(
            bc.Coefficient(
                "ug", bc.Normal(0.0, float(sd)), f"order {n}", "departure" * (n >= ORDERS) or None
            )
            for n, sd in enumerate(order_sizes())
        ),
    ),
    columns=("device", "time"),
    equation="λd[device]·u(t),  u = Σ c_n·P_n(t),  λd ~ N(1, s²)",
    source=SOURCE,
)
DEPARTURE = bc.Effect(
    "departure.device",
    "departure",
    basis=_departure,
    coefficients=tuple(
        bc.Coefficient("ug", bc.Normal(0.0, DISTURBANCE), part=f"order {n}", per="device")
        for n in range(ORDERS)
    ),
    # Scales of the coefficients, not shapes of the columns: the joint density of scale and coefficients has its maximum
    # at a large scale and small coefficients.
    shapes=(bc.Shape("share", "1", *SHARE), bc.Shape("falling", "1", *FALLING)),
    weights=_departure_sizes,
    columns=("device", "time"),
    equation="v[device](t) = Σ c_n[device]·P_n(t),  c_n ~ N(0, share·falling^n, normalised)",
    source="ours: 5 % of the shared disturbance; size and spectrum learned",
)
