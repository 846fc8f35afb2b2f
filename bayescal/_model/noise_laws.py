"""Noise laws: how readings scatter about the expected output.

A law that is Gaussian given its parameters offers `gram`, through which coefficients are integrated out in
closed form. The others (Student-t, rounding) offer a density. Of Student-t it has one maximum in the coefficients where
there are enough readings, about which a Gaussian stands for it (Laplace).
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
from typing_extensions import dataclass_transform

from bayescal._model.frame import Frame
from bayescal._model.prior import HalfCauchy, LogNormal, Normal, Positive
from bayescal._model.static import static
from bayescal._readings.column import UNCERTAINTY

Parameters = dict[str, Float[Array, ""]]
SLOPE, CURVATURE = "noise.slope", "noise.curvature"
LOG_2PI = math.log(2 * math.pi)


class Gram(NamedTuple):
    """Weighted products of a matrix J and a vector r: all that a Gaussian likelihood needs of the readings."""

    jtj: Float[Array, "p p"]
    jtr: Float[Array, "p"]
    rtr: Float[Array, ""]
    logdet: Float[Array, ""]


@static
@dataclass_transform(frozen_default=True)
class Noise(abc.ABC):
    """A noise law.

    `gaussian` says whether coefficients can be integrated out in closed form; `independent` whether one reading's
    noise says nothing of another's; `needs` names the columns that its variance hangs on. A law of one's own is a
    subclass of this class, not of a law that is here: those are computed by their own formulas.
    """

    gaussian: ClassVar[bool]
    law: ClassVar[str]
    independent: ClassVar[bool] = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        given = next((b.__name__ for b in cls.__mro__[1:] if "law" in vars(b)), None)
        if given is not None:
            raise TypeError(f"{cls.__name__}: derive a noise law from Noise, not from {given}")
        static(cls)

    @property
    def needs(self) -> tuple[str, ...]:
        return ()

    @property
    def name(self) -> str:
        """The law, with the column that it follows."""
        return self.law

    @property
    def in_words(self) -> str:
        """The law as a person reads it, after "noise:"."""
        return self.law

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
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


def known_variance(frame: Frame) -> Float[Array, ""] | Float[Array, "n"]:
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
        return parameters["noise.white"] ** 2 + known_variance(frame)

    def log_density(self, y, mean, parameters, frame):
        variance = self.variance(parameters, frame)
        return -0.5 * ((y - mean) ** 2 / variance + jnp.log(variance) + LOG_2PI)

    def sample(self, key, mean, parameters, frame):
        sd = jnp.sqrt(self.variance(parameters, frame))
        return mean + sd * jax.random.normal(key, mean.shape)


class Heteroscedastic(Noise):
    """Independent Gaussian noise whose standard deviation follows a column: log-linear, with a curvature.

    σᵢ = σ·exp(a·zᵢ + b·(3zᵢ² − 1)/2), beside each reading's known uncertainty, z the column scaled to −1 … 1 over its
    range at the fit; beyond that range σ stays as at its end. σ is `noise.white`, a `noise.slope`, b `noise.curvature`:
    with a = 1 the scatter grows by e² from one end to the other.
    Source: A. Harvey, Econometrica 44 (1976) 461 (multiplicative heteroscedasticity).

    Attributes:
        column: a numeric column, "elapsed", or a rate such as "temperature rate".
        scale: prior of σ, output unit.
        slope, curvature: priors of a and b.
    """

    column: str
    scale: Positive = HalfCauchy(1.0)
    slope: Normal = Normal(0.0, 1.0)
    curvature: Normal = Normal(0.0, 1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "heteroscedastic"

    @property
    def needs(self) -> tuple[str, ...]:
        if self.column == "elapsed":
            return ("time",)
        column = self.column.removesuffix(" rate")
        return (column,) if column == self.column else (column, "time")

    @property
    def name(self) -> str:
        return f"{self.law}({self.column})"

    @property
    def in_words(self) -> str:
        return f"scatter follows {self.column}"

    def parameters(self) -> dict[str, Positive | Normal]:
        return {"noise.white": self.scale, SLOPE: self.slope, CURVATURE: self.curvature}

    @staticmethod
    def log_scale(parameters: Mapping[str, Any], z: Any) -> Any:
        """log(σᵢ/σ) at z; of JAX's arrays or NumPy's."""
        return parameters[SLOPE] * z + parameters[CURVATURE] * (1.5 * z**2 - 0.5)

    def constant(self, frame: Frame) -> bool:
        return False

    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        z = jnp.clip(2 * frame.position(self.column) - 1, -1.0, 1.0)
        own = jnp.exp(2 * self.log_scale(parameters, z))
        return parameters["noise.white"] ** 2 * own + known_variance(frame)

    log_density = White.log_density
    sample = White.sample


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

    @property
    def in_words(self) -> str:
        return "Student-t"

    def parameters(self) -> dict[str, Positive]:
        return {"noise.white": self.scale, "noise.freedom": self.freedom}

    def _squared_scale(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return parameters["noise.white"] ** 2 + known_variance(frame)

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

    step: float
    scale: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = False
    law: ClassVar[str] = "quantised"

    def __post_init__(self) -> None:
        if not self.step > 0:
            raise ValueError(f"a rounding step must be positive, not {self.step}")

    def parameters(self) -> dict[str, Positive]:
        return {"noise.white": self.scale}

    def _before(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        return parameters["noise.white"] ** 2 + known_variance(frame)

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
