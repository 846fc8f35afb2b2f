"""Noise laws: how readings scatter about the expected output.

A law that is Gaussian given its parameters offers `gram`, through which coefficients are integrated out in
closed form. The others (Student-t, rounding) offer a density alone, and are sampled with their coefficients.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from bayescal._model.frame import Frame
from bayescal._model.prior import HalfCauchy, LogNormal, LogUniform, Positive, multiplied
from bayescal._readings.column import UNCERTAINTY

Parameters = dict[str, Float[Array, ""]]
DIFFUSION, CORRELATION_TIME = "noise.diffusion", "noise.correlated.time"
_LOG_2PI = math.log(2 * math.pi)


class Gram(NamedTuple):
    """Weighted products of a matrix J and a vector r: all that a Gaussian likelihood needs of the readings."""

    jtj: Float[Array, "p p"]
    jtr: Float[Array, "p"]
    rtr: Float[Array, ""]
    logdet: Float[Array, ""]


class Noise(eqx.Module):
    """A noise law.

    `gaussian` says whether coefficients can be integrated out in closed form; `independent` whether one reading's
    noise says nothing of another's.
    """

    gaussian: ClassVar[bool]
    law: ClassVar[str]
    independent: ClassVar[bool] = True

    @abc.abstractmethod
    def parameters(self) -> dict[str, Positive]:
        """Names and priors of its unknowns; `noise.white` is in the unit of the output, `noise.diffusion` per √s."""

    @abc.abstractmethod
    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        """Variance of each reading about the expected output, output unit squared."""

    @abc.abstractmethod
    def log_density(
        self, y: Float[Array, "n"], mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Log density of each reading."""

    @abc.abstractmethod
    def sample(
        self, key: Array, mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Readings drawn about the expected output."""

    def constant(self, frame: Frame) -> bool:
        """Whether all readings share one variance and are independent: products over them are needed once."""
        return self.independent and UNCERTAINTY not in frame.columns

    def shared_variance(self, parameters: Parameters, frame: Frame) -> Float[Array, ""]:
        """The variance of every reading where it is `constant`, at a cost that does not grow with them."""
        first = eqx.tree_at(lambda f: f.order, frame, frame.order[:1])
        return self.variance(parameters, first)[0]

    def whiten(
        self,
        columns: Float[Array, "n m"],
        extra: Float[Array, "n"] | float,
        parameters: Parameters,
        frame: Frame,
    ) -> tuple[Float[Array, "n m"], Float[Array, ""]]:
        """L⁻¹ times columns, where L·Lᵀ = Σ + diag(extra), and log|Σ + diag(extra)|."""
        variance = self.variance(parameters, frame) + extra
        return columns / jnp.sqrt(variance)[:, None], jnp.sum(jnp.log(variance))

    def gram(
        self,
        jacobian: Float[Array, "n p"],
        residual: Float[Array, "n"],
        extra: Float[Array, "n"] | float,
        parameters: Parameters,
        frame: Frame,
    ) -> Gram:
        """JᵀΣ⁻¹J, JᵀΣ⁻¹r, rᵀΣ⁻¹r and log|Σ|, with Σ widened by the variance `extra` of each reading."""
        both = jnp.concatenate([jacobian, residual[:, None]], axis=1)
        white, logdet = self.whiten(both, extra, parameters, frame)
        j, r = white[:, :-1], white[:, -1]
        return Gram(j.T @ j, j.T @ r, r @ r, logdet)


def _known(frame: Frame) -> Float[Array, ""] | Float[Array, "n"]:
    if UNCERTAINTY in frame.columns:
        return frame.columns[UNCERTAINTY] ** 2
    return jnp.zeros(frame.size)


class White(Noise):
    """Independent Gaussian noise of one unknown standard deviation, beside each reading's known uncertainty.

    Attributes:
        scale: prior of the standard deviation, output unit.
    """

    scale: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "white"

    def parameters(self) -> dict[str, Positive]:
        return {"noise.white": self.scale}

    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return parameters["noise.white"] ** 2 + _known(frame)

    def log_density(self, y, mean, parameters, frame):
        variance = self.variance(parameters, frame)
        return -0.5 * ((y - mean) ** 2 / variance + jnp.log(variance) + _LOG_2PI)

    def sample(self, key, mean, parameters, frame):
        sd = jnp.sqrt(self.variance(parameters, frame))
        return mean + sd * jax.random.normal(key, mean.shape)


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

    shortest: float = eqx.field(static=True)
    longest: float = eqx.field(static=True)
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "ornstein_uhlenbeck"
    independent: ClassVar[bool] = False

    def __check_init__(self) -> None:
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
        return parameters["noise.white"] ** 2 + correlated_size(parameters) ** 2 + _known(frame)

    def _solver(self, extra: Float[Array, "n"] | float, parameters: Parameters, frame: Frame):
        """Cholesky factor of the covariance, in the order of time within runs."""
        from tinygp.kernels.quasisep import Exp  # a second that only correlated noise needs
        from tinygp.noise import Diagonal
        from tinygp.solvers import QuasisepSolver

        tau = parameters[CORRELATION_TIME]
        # Runs follow each other on one axis, so far apart that they share nothing. Readings at one time share it.
        axis = jnp.cumsum(jnp.where(frame.step < 0, 60.0 * tau, frame.step))
        white = parameters["noise.white"] ** 2 + _known(frame) + extra
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
        each = -0.5 * z**2 - jnp.log(solver.factor.diag.d) - 0.5 * _LOG_2PI
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

    def parameters(self) -> dict[str, Positive]:
        return {"noise.white": self.scale, "noise.freedom": self.freedom}

    def _squared_scale(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return parameters["noise.white"] ** 2 + _known(frame)

    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        freedom = jnp.maximum(parameters["noise.freedom"], 2.1)
        return self._squared_scale(parameters, frame) * freedom / (freedom - 2)

    def log_density(self, y, mean, parameters, frame):
        freedom, squared = parameters["noise.freedom"], self._squared_scale(parameters, frame)
        half = 0.5 * (freedom + 1)
        norm = gammaln(half) - gammaln(0.5 * freedom) - 0.5 * jnp.log(jnp.pi * freedom * squared)
        return norm - half * jnp.log1p((y - mean) ** 2 / (freedom * squared))

    def sample(self, key, mean, parameters, frame):
        draws = jax.random.t(key, parameters["noise.freedom"], mean.shape)
        return mean + jnp.sqrt(self._squared_scale(parameters, frame)) * draws


class Quantised(Noise):
    """White noise seen through a converter or a printed table that rounds to `step`.

    The likelihood of a printed value is the probability of the interval that rounds to it.

    Attributes:
        step: rounding step, output unit.
        scale: prior of the standard deviation before rounding, output unit.
    """

    step: float = eqx.field(static=True)
    scale: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = False
    law: ClassVar[str] = "quantised"

    def __check_init__(self) -> None:
        if not self.step > 0:
            raise ValueError(f"a rounding step must be positive, not {self.step}")

    def parameters(self) -> dict[str, Positive]:
        return {"noise.white": self.scale}

    def _before(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return parameters["noise.white"] ** 2 + _known(frame)

    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return self._before(parameters, frame) + self.step**2 / 12

    def log_density(self, y, mean, parameters, frame):
        sd = jnp.sqrt(self._before(parameters, frame))
        # On the side of the mean where both tails are small, so that the difference keeps its digits.
        centre = -jnp.abs(y - mean) / sd
        half = 0.5 * self.step / sd
        upper = jax.scipy.stats.norm.logcdf(centre + half)
        lower = jax.scipy.stats.norm.logcdf(centre - half)
        return (
            upper + jnp.log(-jnp.expm1(jnp.minimum(lower - upper, -1e-300))) - math.log(self.step)
        )

    def sample(self, key, mean, parameters, frame):
        sd = jnp.sqrt(self._before(parameters, frame))
        exact = mean + sd * jax.random.normal(key, mean.shape)
        return jnp.round(exact / self.step) * self.step
