"""Independent noise with outliers."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import betainc, gammaln

from bayescal._model.frame import Frame
from bayescal._model.noise_law import WHITE, Noise, known_variance, offered, scores_of_tails
from bayescal._model.prior import HalfCauchy, LogNormal, Positive

FREEDOM = "noise.freedom"
LEAST_FREEDOM = 2.1  # below 2 the variance does not exist


class StudentT(Noise):
    """Independent Student-t noise: readings with outliers.

    Attributes:
        scale: prior of the scale, output unit.
        freedom: prior of the degrees of freedom; below 2 the variance does not exist, and 2.1 is used
            where a variance is asked for.
    """

    scale: Positive = HalfCauchy(1.0)
    freedom: Positive = LogNormal(8.0, 0.8)
    gaussian: ClassVar[bool] = False
    law: ClassVar[str] = "student_t"
    words: ClassVar[str] = "Student-t"
    looks_like: ClassVar[str] = "white noise with outliers (Student-t)"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE,)

    def parameters(self) -> dict[str, Positive]:
        return {WHITE: self.scale, FREEDOM: self.freedom}

    def unit(self, name: str, output: str) -> str:
        return "1" if name == FREEDOM else output

    def _squared_scale(self, parameters, frame):
        return jnp.broadcast_to(parameters[WHITE] ** 2 + known_variance(frame), (frame.size,))

    def variance(self, parameters, frame):
        # Student-t of scale s and ν degrees of freedom has the variance s²·ν/(ν − 2).
        freedom = jnp.maximum(parameters[FREEDOM], LEAST_FREEDOM)
        return self._squared_scale(parameters, frame) * freedom / (freedom - 2)

    def log_density(self, y, mean, parameters, frame):
        freedom, squared = parameters[FREEDOM], self._squared_scale(parameters, frame)
        half = 0.5 * (freedom + 1)
        norm = gammaln(half) - gammaln(0.5 * freedom) - 0.5 * jnp.log(jnp.pi * freedom * squared)
        return norm - half * jnp.log1p((y - mean) ** 2 / (freedom * squared))

    def normal_scores(self, left, parameters, frame):
        # P(T < −t) = ½·I_{ν/(ν + t²)}(ν/2, ½)
        freedom = parameters[FREEDOM]
        squares = left**2 / self._squared_scale(parameters, frame)
        tail = 0.5 * betainc(0.5 * freedom, 0.5, freedom / (freedom + squares))
        return scores_of_tails(tail, left)

    def sample(self, key, mean, parameters, frame):
        draws = jax.random.t(key, parameters[FREEDOM], mean.shape)
        return mean + jnp.sqrt(self._squared_scale(parameters, frame)) * draws


@offered
def _heavy_tails(scale: Positive, frame: Frame) -> list[Noise]:
    return [StudentT(scale)]
