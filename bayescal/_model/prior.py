"""Prior distributions: what is believed of an unknown before the readings.

Coefficients take `Normal` or `Flat`; spreads and noise scales take `HalfNormal`, `HalfCauchy` or `Flat`.
A hyper-parameter is sampled in a coordinate v on the whole real line; each positive prior here knows its
value at v and its log density *in v* (the Jacobian included), so that nothing else transforms anything.
"""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.jax_setup import configure_jax

configure_jax()

_LOG_2 = math.log(2.0)
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


def _of(v: Any) -> Any:
    """Whose functions a coordinate takes: JAX's within programs, NumPy's on the host."""
    return jnp if isinstance(v, jax.Array) else np


class Normal(eqx.Module):
    """A Gaussian prior; `mean` and `sd` in the coefficient's own unit."""

    mean: float = eqx.field(static=True, default=0.0)
    sd: float = eqx.field(static=True, default=1.0)

    def __check_init__(self) -> None:
        if not (math.isfinite(self.mean) and math.isfinite(self.sd) and self.sd > 0):
            raise ValueError(f"Normal needs a finite mean and a positive sd, not {self}")

    def value(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.mean + self.sd * v

    def log_density(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return -0.5 * v**2 - _HALF_LOG_2PI

    def coordinate(self, value: float) -> float:
        return (value - self.mean) / self.sd

    def sample(self, key: Array) -> Float[Array, ""]:
        return jax.random.normal(key)

    def distribution(self) -> Any:
        import numpyro.distributions as dist  # numpyro only where its program is asked for

        return dist.Normal(self.mean, self.sd)


class LogNormal(eqx.Module):
    """A positive quantity whose logarithm is Gaussian; `median` in its own unit, `sd` of the logarithm."""

    median: float = eqx.field(static=True)
    sd: float = eqx.field(static=True)

    def value(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.median * _of(v).exp(self.sd * v)

    def log_density(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return -0.5 * v**2 - _HALF_LOG_2PI

    def coordinate(self, value: float) -> float:
        return math.log(value / self.median) / self.sd

    def sample(self, key: Array) -> Float[Array, ""]:
        return jax.random.normal(key)

    def distribution(self) -> Any:
        import numpyro.distributions as dist

        return dist.LogNormal(math.log(self.median), self.sd)


class HalfNormal(eqx.Module):
    """The positive half of N(0, scale²), for spreads and noise scales."""

    scale: float = eqx.field(static=True, default=1.0)

    def value(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.scale * _of(v).exp(v)

    def log_density(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return _LOG_2 - _HALF_LOG_2PI - 0.5 * _of(v).exp(2 * v) + v

    def coordinate(self, value: float) -> float:
        return math.log(value / self.scale)

    def sample(self, key: Array) -> Float[Array, ""]:
        return jnp.log(jnp.abs(jax.random.normal(key)))

    def distribution(self) -> Any:
        import numpyro.distributions as dist

        return dist.HalfNormal(self.scale)


class HalfCauchy(eqx.Module):
    """The positive half of a Cauchy: a scale known to an order of magnitude or two."""

    scale: float = eqx.field(static=True, default=1.0)

    def value(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.scale * _of(v).exp(v)

    def log_density(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return math.log(2 / math.pi) - _of(v).logaddexp(0.0, 2 * v) + v

    def coordinate(self, value: float) -> float:
        return math.log(value / self.scale)

    def sample(self, key: Array) -> Float[Array, ""]:
        return jnp.log(jnp.abs(jax.random.cauchy(key)))

    def distribution(self) -> Any:
        import numpyro.distributions as dist

        return dist.HalfCauchy(self.scale)


class Flat(eqx.Module):
    """No preference at all. Improper: the evidence of a model that holds one is not defined.

    For a coefficient: flat on the real line. For a spread or a noise scale: flat on the positive half line,
    `scale` only setting the unit of its coordinate.
    """

    scale: float = eqx.field(static=True, default=1.0)

    def value(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.scale * _of(v).exp(v)

    def log_density(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return v + math.log(self.scale)

    def coordinate(self, value: float) -> float:
        return math.log(value / self.scale)

    def sample(self, key: Array) -> Float[Array, ""]:
        raise ValueError("a flat prior cannot be sampled: give a proper prior to simulate from it")

    def distribution(self) -> Any:
        import numpyro.distributions as dist

        return dist.ImproperUniform(dist.constraints.positive, (), ())


Positive = HalfNormal | HalfCauchy | LogNormal | Flat


class FlatLine(eqx.Module):
    """A flat prior on the whole line, for a flat coefficient that is sampled with the hyper-parameters."""

    scale: float = eqx.field(static=True, default=1.0)

    def value(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.scale * v

    def log_density(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        return 0.0 * v + math.log(self.scale)

    def coordinate(self, value: float) -> float:
        return value / self.scale

    def sample(self, key: Array) -> Float[Array, ""]:
        raise ValueError("a flat prior cannot be sampled: give a proper prior to simulate from it")

    def distribution(self) -> Any:
        import numpyro.distributions as dist

        return dist.ImproperUniform(dist.constraints.real, (), ())
