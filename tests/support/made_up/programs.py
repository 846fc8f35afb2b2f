"""NumPyro programs and their readings: what the tests of programs share."""

# What numpyro.sample returns is an array to its users, and a union of types to pyright.
# pyright: reportOperatorIssue=false, reportIndexIssue=false, reportArgumentType=false

from __future__ import annotations

import numpy as np
import numpyro
import numpyro.distributions as dist

SCHOOLS = {
    "y": np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0]),
    "sigma": np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0]),
}  # Rubin, J. Educ. Stat. 6 (1981) 377
RANDOM = np.random.default_rng(20261121)
AT = np.linspace(-1.0, 1.0, 30)
LINE = {"at": AT, "y": 1.5 - 0.7 * AT + 0.3 * RANDOM.standard_normal(AT.size)}

traced: list[str] = []  # grows each time that JAX traces eight_schools


def eight_schools(y, sigma):
    traced.append("eight_schools")
    mu = numpyro.sample("mu", dist.Normal(0, 5))
    tau = numpyro.sample("tau", dist.HalfCauchy(5))
    with numpyro.plate("school", len(y)):
        theta = numpyro.sample("theta", dist.Normal(mu, tau))
        numpyro.sample("y", dist.Normal(theta, sigma), obs=y)


def line(at, y, noise=None):
    """A straight line; its noise known, or not."""
    b = numpyro.sample("b", dist.Normal(0.0, 2.0).expand([2]).to_event(1))
    sigma = numpyro.sample("sigma", dist.HalfNormal(1.0)) if noise is None else noise
    numpyro.deterministic("at_one", b[0] + b[1])
    numpyro.sample("y", dist.Normal(b[0] + b[1] * at, sigma), obs=y)
