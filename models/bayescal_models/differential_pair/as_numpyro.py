"""Self-contained NumPyro model of accelerometers in two opposed groups on a centrifuge, in a shared environment.

It is the model that `bc.fit(equivalent_model(), readings)` fits. NUTS is run on it by

    nuts = NUTS(bc.non_centred(model, CENTRED), dense_mass=True, target_accept_prob=0.95)
    MCMC(nuts, num_warmup=1000, num_samples=4000).run(key, **model_arguments(readings))

Output y of device k at time t, with outward acceleration a, s = +1 outer and −1 inner (source 3; sizes assumed by us):

    y = s_k·(1 + κ_k)·a(t) + w_k(t) + e,     κ_k ~ N(0, s_κ²),  λ_k ~ N(1, s_λ²),  e ~ N(0, σ²)
    w_k = Σ c_kn·P_n,     c_kn ~ N(λ_k·u_n, s_n²),     P_n Legendre polynomials of unit rms over the record

w_k is λ_k·u(t), the response to the shared environment, plus the device's departure, whose standard deviations s_n
are estimated. Orders above the fifth are u_n in all devices.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import HalfNormal, LogNormal, Normal
from scipy.special import eval_legendre

import bayescal as bc
from bayescal_models.differential_pair import reference_problem

SENSITIVITY_SITE = "environment.shared[sensitivity]"
CENTRED_SITES = ("u", "w", "scale.device", SENSITIVITY_SITE)  # determined by readings, not priors
ORDERS, DEPARTURE_ORDERS = np.arange(9), np.arange(6)  # polynomial orders of u and departures
DISTURBANCE_UG = 1000.0  # µg, rms of u over the record
RATIOS = 0.6**ORDERS  # relative prior sd of the orders of u


def model(acceleration, sign, device, devices, orders, output=None) -> None:
    """Define the NumPyro model.

    Args:
        acceleration, sign, device: acceleration, µg, sign s and index of the device, (n,) each.
        devices, orders: number of devices; Legendre polynomials P_0 to P_8 of the time, (n, 9).
        output: outputs, µg, (n,); None to simulate.
    """
    group_sds = {
        name: numpyro.sample(f"{name}.group_sd", HalfNormal(size))
        for name, size in (("scale.device", 5000.0), (SENSITIVITY_SITE, 0.2))
    }
    u = numpyro.sample(
        "u", Normal(0.0, DISTURBANCE_UG * RATIOS / np.sqrt(np.sum(RATIOS**2))).to_event(1)
    )
    # Departures: rms relative to that of u, and ratio of the sds of successive orders.
    relative_rms = numpyro.sample("departure.device.share", LogNormal(np.log(0.0502), 0.730))
    order_ratio = numpyro.sample("departure.device.falling", LogNormal(np.log(0.4873), 0.3406))
    powers = order_ratio**DEPARTURE_ORDERS
    with numpyro.plate("devices", devices):
        kappa = 1e-6 * numpyro.sample("scale.device", Normal(0.0, group_sds["scale.device"]))
        sensitivity = numpyro.sample(SENSITIVITY_SITE, Normal(1.0, group_sds[SENSITIVITY_SITE]))
        departure_sd = DISTURBANCE_UG * relative_rms * powers / jnp.sqrt(jnp.sum(powers**2))
        mean = sensitivity[:, None] * u[: len(DEPARTURE_ORDERS)]
        w = numpyro.sample("w", Normal(mean, departure_sd).to_event(1))
    noise = numpyro.sample("noise.white", HalfNormal(50.0))  # µg
    mean = sign * (1 + kappa[device]) * acceleration + jnp.sum(
        orders[:, : len(DEPARTURE_ORDERS)] * w[device], axis=1
    )
    mean = mean + orders[:, len(DEPARTURE_ORDERS) :] @ u[len(DEPARTURE_ORDERS) :]
    numpyro.sample("output", Normal(mean, noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    (devices, device), (groups, group) = readings.groups("device"), readings.groups("group")
    time = readings["time"]
    progress = 2 * (time - time.mean()) / np.ptp(time)
    orders = np.stack([np.sqrt(2 * n + 1) * eval_legendre(n, progress) for n in ORDERS], axis=1)
    sign = np.where(np.array(groups)[group] == "outer", 1.0, -1.0)
    columns = {n: readings[n] for n in ("acceleration", "output")}
    return {**columns, "sign": sign, "device": device, "devices": len(devices), "orders": orders}


equivalent_model = reference_problem.model  # a sum of named effects with the same posterior
