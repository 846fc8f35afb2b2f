"""White noise seen through a converter or a printed table that rounds."""

from __future__ import annotations

import math
from typing import ClassVar

import jax
import jax.numpy as jnp

from bayescal._model.noise_law import WHITE, Noise, known_variance
from bayescal._model.prior import HalfCauchy, Positive


class Quantised(Noise):
    """White noise seen through a converter or a printed table that rounds to `step`.

    The likelihood of a printed value is the probability of the interval that rounds to it.

    Attributes:
        step: rounding step, output unit.
        scale: prior of the standard deviation before rounding, output unit.
    """

    step: float
    scale: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = False
    law: ClassVar[str] = "quantised"
    looks_like: ClassVar[str] = "rounding and white noise"

    def __post_init__(self) -> None:
        if not self.step > 0:
            raise ValueError(f"a rounding step must be positive, not {self.step}")

    def parameters(self) -> dict[str, Positive]:
        return {WHITE: self.scale}

    def _before(self, parameters, frame):
        return jnp.broadcast_to(parameters[WHITE] ** 2 + known_variance(frame), (frame.size,))

    def variance(self, parameters, frame):
        # A rounding error is about uniform over a step, of variance step²/12 (B. Widrow and I. Kollár, Quantization
        # Noise, 2008).
        return self._before(parameters, frame) + self.step**2 / 12

    def log_density(self, y, mean, parameters, frame):
        sd = jnp.sqrt(self._before(parameters, frame))
        # On the side of the mean where both tails are small, so that the difference keeps its digits.
        centre = -jnp.abs(y - mean) / sd
        half = 0.5 * self.step / sd
        upper = jax.scipy.stats.norm.logcdf(centre + half)
        lower = jax.scipy.stats.norm.logcdf(centre - half)
        # log(Φ(u) − Φ(l)) = log Φ(u) + log(1 − exp(log Φ(l) − log Φ(u))), and over the step: a density, per output
        # unit.
        return (
            upper + jnp.log(-jnp.expm1(jnp.minimum(lower - upper, -1e-300))) - math.log(self.step)
        )

    def sample(self, key, mean, parameters, frame):
        sd = jnp.sqrt(self._before(parameters, frame))
        exact = mean + sd * jax.random.normal(key, mean.shape)
        return jnp.round(exact / self.step) * self.step
