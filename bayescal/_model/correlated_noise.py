"""Correlated (Ornstein–Uhlenbeck) noise beside white noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayescal._model.frame import Frame
from bayescal._model.noise_laws import LOG_2PI, Noise, Parameters, White, known_variance
from bayescal._model.prior import HalfCauchy, LogUniform, Positive, multiplied

DIFFUSION, CORRELATION_TIME = "noise.diffusion", "noise.correlated.time"


def correlated_size(parameters: Mapping[str, Any]) -> Float[Array, "..."]:
    """σ = q·√(τ/2), the stationary standard deviation of correlated noise, output unit."""
    return parameters[DIFFUSION] * jnp.sqrt(0.5 * parameters[CORRELATION_TIME])


class OrnsteinUhlenbeck(Noise):
    """White noise and correlated (Ornstein–Uhlenbeck) noise of unknown diffusion and time within each run.

    The correlated part has the covariance (q²·τ/2)·exp(−|Δt|/τ) within a run; runs are independent. Readings close
    together against the time τ know only the diffusion q, the coefficient of the random walk (IEEE 952: rate random
    walk); hence τ is bounded. Solves are linear in the readings (tinygp's quasi-separable solver).

    Attributes:
        shortest, longest: bounds of the correlation time, s, its logarithm uniform between; see `over_record`.
        scale: prior of the white part's standard deviation, output unit.
        correlated: prior of the correlated part's, output unit, at the geometric middle of the correlation times.
    """

    shortest: float
    longest: float
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "ornstein_uhlenbeck"
    independent: ClassVar[bool] = False

    @property
    def in_words(self) -> str:
        return "Ornstein–Uhlenbeck"

    def __post_init__(self) -> None:
        if not 0 < self.shortest < self.longest:
            raise ValueError(
                f"correlation times must be positive and in order, not {self.shortest} and {self.longest}"
            )

    def parameters(self) -> dict[str, Positive]:
        middle = math.sqrt(self.shortest * self.longest)
        return {
            "noise.white": self.scale,
            DIFFUSION: multiplied(self.correlated, math.sqrt(2 / middle)),
            CORRELATION_TIME: LogUniform(self.shortest, self.longest),
        }

    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return (
            parameters["noise.white"] ** 2
            + correlated_size(parameters) ** 2
            + known_variance(frame)
        )

    def _solver(self, extra: Float[Array, "n"] | float, parameters: Parameters, frame: Frame):
        """Cholesky factor of the covariance, in the order of time within runs."""
        from tinygp.kernels.quasisep import Exp  # a second that only correlated noise needs
        from tinygp.noise import Diagonal
        from tinygp.solvers import QuasisepSolver

        tau = parameters[CORRELATION_TIME]
        # Runs follow each other on one axis, so far apart that they share nothing. Readings at one time share it.
        axis = jnp.cumsum(jnp.where(frame.step < 0, 60.0 * tau, frame.step))
        white = parameters["noise.white"] ** 2 + known_variance(frame) + extra
        kernel = Exp(scale=tau, sigma=correlated_size(parameters))
        return QuasisepSolver(kernel, axis, Diagonal(white[frame.order]), assume_sorted=True)

    def whiten(self, columns, extra, parameters, frame):
        solver = self._solver(extra, parameters, frame)
        white = solver.solve_triangular(columns[frame.order])
        logdet = 2 * jnp.sum(jnp.log(solver.factor.diag.d))
        return jnp.zeros_like(white).at[frame.order].set(white), logdet

    def log_density(self, y, mean, parameters, frame):
        """Of each reading given those before it in its run."""
        solver = self._solver(0.0, parameters, frame)
        z = solver.solve_triangular((y - mean)[frame.order])
        each = -0.5 * z**2 - jnp.log(solver.factor.diag.d) - 0.5 * LOG_2PI
        return jnp.zeros_like(each).at[frame.order].set(each)

    def sample(self, key, mean, parameters, frame):
        solver = self._solver(0.0, parameters, frame)
        made = solver.dot_triangular(jax.random.normal(key, mean.shape))
        return mean + jnp.zeros_like(made).at[frame.order].set(made)


def over_record(white: White, step: float, span: float) -> OrnsteinUhlenbeck:
    """White noise beside correlated noise whose correlation time the record can tell: from one step to its span.

    Args:
        white: whose prior is kept, for both parts.
        step: usual time between neighbours, s.
        span: of the longest run, s.
    """
    return OrnsteinUhlenbeck(step, max(span, 10 * step), white.scale, white.scale)
