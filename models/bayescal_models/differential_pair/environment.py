"""Effects of the shared environment u(t), the devices' sensitivities λd to it, and their departures v(t).

The environment of device k is λd_k·u(t) + v_k(t). Both u and v are smooth random functions: sums of Legendre
polynomials over the record, of unit rms, with prior standard deviations that decrease by a constant ratio from order
to order. For orders of u above the fifth, which are small, λd = 1 in every device. The rms and the ratio of v are
estimated; its low orders are confounded with scale and sensitivity, and are bounded by its higher orders. The mean of
λd, 1, fixes the scale of u. Without v differencing would be exact for every pair (source 3: v = 0; we add departures).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal import xp

ORDERS = 6  # number of orders of v, and of u with a sensitivity per device
SHARED_ORDERS = 9  # number of orders of u; error < 0.1 µg for transients as long as the record
ORDER_SD_RATIO = 0.6  # ratio of the prior standard deviations of successive orders of u
RATIO_RANGE = (0.25, 0.95)  # 95 % prior range of this ratio for v
DISTURBANCE_UG = 1000.0  # µg, rms of u
SENSITIVITY_SD = 0.2  # standard deviation of λd over devices of one type
SHARE_RANGE = (0.012, 0.21)  # 95 % prior range of the rms of v relative to that of u
SOURCE = "source 3; sizes assumed by us"

SENSITIVITY_NAME = "environment.shared[sensitivity]"
DEPARTURE_SHARE_NAME = "departure.device.share"


def compute_order_sds() -> NDArray[np.float64]:
    """Return the prior sds of the polynomial orders of the environment u, µg, (9,); their squares sum to 1 mg²."""
    powers = ORDER_SD_RATIO ** np.arange(SHARED_ORDERS)
    return DISTURBANCE_UG * powers / np.sqrt(np.sum(powers**2))


def evaluate_legendre_polynomials(progress: Any, count: int) -> list[Any]:
    """Return the values of the Legendre polynomials of unit rms over the record, orders 0 to count − 1.

    Args:
        progress: (t − t̄)/(tmax − tmin), −½ … ½ on an even record; NumPy or JAX.
    """
    z = 2.0 * progress
    legendre = [1.0 + 0.0 * z, z]
    for n in range(1, count - 1):
        legendre.append(((2 * n + 1) * z * legendre[n] - n * legendre[n - 1]) / (n + 1))
    return [np.sqrt(2 * n + 1) * p for n, p in enumerate(legendre)]


def list_order_names(effect: bc.Effect) -> list[str]:
    """Return the names of an effect's polynomial coefficients, such as "environment.shared[order 0]"."""
    return [f"{effect.name}[{c.part}]" for c in effect.coefficients if "order" in c.part]


def _evaluate_shared_basis(r: bc.Frame) -> Any:
    polynomials = evaluate_legendre_polynomials(r.progress, SHARED_ORDERS)
    return xp.stack([1.0 + 0.0 * polynomials[0], *polynomials], axis=-1)


def _evaluate_departure_basis(r: bc.Frame) -> Any:
    return xp.stack(evaluate_legendre_polynomials(r.progress, ORDERS), axis=-1)


def _compute_departure_sds(share: Any, falling: Any) -> Any:
    """Return the prior sds of the orders of v relative to the rms of u, (…, 6), from shapes (…, 1) or scalars."""
    powers = falling ** np.arange(ORDERS)
    return share * powers / (powers**2).sum(axis=-1, keepdims=True) ** 0.5


SHARED = bc.Effect(
    "environment.shared",
    "environment",
    basis=_evaluate_shared_basis,
    coefficients=(
        bc.Coefficient(
            "1",
            bc.Normal(1.0, SENSITIVITY_SD),
            part="sensitivity",
            slot="sensitivity",
            per="device",
            group_sd=bc.HalfNormal(SENSITIVITY_SD),
        ),
        *(
            bc.Coefficient(
                "ug", bc.Normal(0.0, float(sd)), f"order {n}", "departure" * (n >= ORDERS) or None
            )
            for n, sd in enumerate(compute_order_sds())
        ),
    ),
    columns=("device", "time"),
    equation="λd[device]·u(t),  u = Σ c_n·P_n(t),  λd ~ N(1, s²)",
    source=SOURCE,
)
DEPARTURE = bc.Effect(
    "departure.device",
    "departure",
    basis=_evaluate_departure_basis,
    coefficients=tuple(
        bc.Coefficient("ug", bc.Normal(0.0, DISTURBANCE_UG), part=f"order {n}", per="device")
        for n in range(ORDERS)
    ),
    # They scale the coefficients' priors, not the columns: otherwise the joint density of scale and coefficients would
    # have its maximum at a large scale and small coefficients.
    shapes=(bc.Shape("share", "1", *SHARE_RANGE), bc.Shape("falling", "1", *RATIO_RANGE)),
    weights=_compute_departure_sds,
    columns=("device", "time"),
    equation="v[device](t) = Σ c_n[device]·P_n(t),  c_n ~ N(0, share·falling^n, normalised)",
    source="assumed: 5 % of the shared disturbance; size and spectrum estimated",
)
