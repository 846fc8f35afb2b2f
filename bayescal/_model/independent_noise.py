"""Independent noise laws: white, heteroscedastic, Student-t, quantised."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._core.xp import get_special_functions, xp
from bayescal._data.column import UNCERTAINTY
from bayescal._model.frame import Frame, name_reference
from bayescal._model.noise_law import WHITE, Noise, Parameters, offered, white_variance
from bayescal._model.prior import HalfCauchy, LogNormal, Normal, Positive

SLOPE, CURVATURE = "noise.slope", "noise.curvature"
PROPORTIONAL = "noise.proportional"
# Least ratio of max |x| to min |x| of a column: below it, noise in proportion to |x| resembles an exponential law.
MIN_SIZE_RATIO = 3.0
DOF = "noise.freedom"
MIN_PROBABILITY = 1e-300  # lower bound, so that its logarithm is finite
MIN_DOF = 2.1  # below 2 the variance does not exist


class White(Noise):
    """Independent Gaussian noise of one unknown standard deviation, in addition to each reading's known uncertainty.

    Attributes:
        scale: prior of the standard deviation, output unit.
    """

    scale: Positive = HalfCauchy(1.0)
    is_gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "white"
    looks_like: ClassVar[str] = "white noise"
    first: ClassVar[bool] = True

    def parameters(self) -> dict[str, Positive]:
        return {WHITE: self.scale}

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE,)

    def variance_coordinate(self, frame: Frame) -> np.ndarray | None:
        """Return log known uncertainties (n,), −∞ for all if none are known; None if one of them is zero."""
        sigma = frame.columns.get(UNCERTAINTY)
        if sigma is None:
            return np.array(-np.inf)
        return np.log(np.asarray(sigma)) if np.all(sigma > 0) else None

    def variance_at(self, values: Parameters, coordinate: np.ndarray) -> Any:
        return values[WHITE] ** 2 + np.exp(2 * coordinate)

    def variance(self, parameters: Parameters, frame: Frame) -> Array:
        return white_variance(parameters, frame)


class Heteroscedastic(Noise):
    """Independent Gaussian noise whose log standard deviation is quadratic in a column, or proportional noise.

    σᵢ = σ·exp(a·zᵢ + b·(3zᵢ² − 1)/2), in addition to each reading's known uncertainty; z is the column scaled to −1 … 1
    over its range at the fit, clipped outside. σ is `noise.white`, a `noise.slope`, b `noise.curvature`:
    with a = 1 the scatter grows by e² from one end to the other.
    Source: A. Harvey, Econometrica 44 (1976) 461 (multiplicative heteroscedasticity).

    If `proportional`, the noise grows with the column from a floor, as data sheets state it (% of reading, % of span):
    σᵢ² = σ² + p²·(x/x_max)², p `noise.proportional`, x_max the largest |x| at the fit.

    Attributes:
        column: a numeric column, "elapsed", or a rate such as "temperature rate".
        scale: prior of σ, and of p, output unit.
        slope, curvature: priors of a and b.
        proportional: whether the standard deviation is proportional to the column, with a floor.
    """

    column: str
    scale: Positive = HalfCauchy(1.0)
    slope: Normal = Normal(0.0, 1.0)
    curvature: Normal = Normal(0.0, 1.0)
    proportional: bool = False
    is_gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "heteroscedastic"

    @property
    def covariates(self) -> tuple[str, ...]:
        return (self.column,)

    @property
    def name(self) -> str:
        return f"{self.law}({self.column}{', proportional' * self.proportional})"

    @property
    def in_words(self) -> str:
        return f"scatter {'in proportion to' if self.proportional else 'follows'} {self.column}"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE, PROPORTIONAL) if self.proportional else (WHITE,)

    def parameters(self) -> dict[str, Positive | Normal]:
        if self.proportional:
            return {WHITE: self.scale, PROPORTIONAL: self.scale}
        return {WHITE: self.scale, SLOPE: self.slope, CURVATURE: self.curvature}

    def unit(self, name: str, output: str) -> str:
        return "1" if name in (SLOPE, CURVATURE) else output

    def _scale_column(self, frame: Frame) -> Float[Array, "n"]:
        """Return the column scaled to −1 … 1; if proportional, |x| over its maximum at the fit (n,)."""
        if not self.proportional:
            return scale_covariate(frame, self.column)
        ends = (xp.abs(frame.reference[f"{self.column}_{end}"]) for end in ("low", "high"))
        return xp.abs(frame.columns[self.column]) / xp.maximum(*ends)

    def variance_coordinate(self, frame: Frame) -> np.ndarray | None:
        position = None if UNCERTAINTY in frame.columns else np.asarray(self._scale_column(frame))
        if position is None or not self.proportional:
            return position
        # 1/variance has poles near |x| = 0, where a polynomial in |x| converges slowly; in log |x| it is smooth.
        return np.log(position) if np.all(position > 0) else None

    def variance_at(self, values: Parameters, coordinate: np.ndarray) -> Any:
        if self.proportional:
            return values[WHITE] ** 2 + (values[PROPORTIONAL] * np.exp(coordinate)) ** 2
        return (values[WHITE] * compute_relative_scatter(values, coordinate)) ** 2

    def variance(self, parameters: Parameters, frame: Frame) -> Array:
        position = self._scale_column(frame)
        if self.proportional:
            return white_variance(parameters, frame) + (parameters[PROPORTIONAL] * position) ** 2
        return white_variance(
            {WHITE: parameters[WHITE] * compute_relative_scatter(parameters, position)}, frame
        )


def scale_covariate(frame: Frame, column: str) -> Float[Array, "n"]:
    """Scale a covariate to −1 … 1 over its range at the fit, clipped (n,)."""
    return xp.clip(2 * frame.position(column) - 1, -1.0, 1.0)


def compute_relative_scatter(values: Parameters, position: Any) -> Any:
    """Return the standard deviation over its geometric mean, at values −1 … 1 of the scaled covariate."""
    # The Legendre polynomials P₁ and P₂ have zero mean over −1 … 1, so that log σ is the mean of log sd.
    return xp.exp(values[SLOPE] * position + values[CURVATURE] * (1.5 * position**2 - 0.5))


@offered
def _offer_heteroscedastic(scale: Positive, frame: Frame) -> list[Noise]:
    """Return a heteroscedastic law for each varying column or rate, and a proportional one if zero is not arbitrary."""
    reference, laws = frame.reference, list[Noise]()
    for column in (name.removesuffix("_low") for name in reference if name.endswith("_low")):
        low, high = (float(reference[f"{column}_{end}"]) for end in ("low", "high"))
        is_magnitude = column in frame.columns and column not in ("time", "elapsed")
        is_magnitude &= name_reference(column) not in reference  # no temperature
        if high > low:
            laws.append(Heteroscedastic(column, scale))
            if is_magnitude and (low * high <= 0 or max(high / low, low / high) > MIN_SIZE_RATIO):
                laws.append(Heteroscedastic(column, scale, proportional=True))
    return laws


class StudentT(Noise):
    """Independent Student-t noise: readings with outliers.

    Attributes:
        scale: prior of the scale, output unit.
        freedom: prior of the degrees of freedom; variances, which do not exist below 2, are computed with at least 2.1.
    """

    scale: Positive = HalfCauchy(1.0)
    freedom: Positive = LogNormal(8.0, 0.8)
    is_gaussian: ClassVar[bool] = False
    law: ClassVar[str] = "student_t"
    words: ClassVar[str] = "Student-t"
    looks_like: ClassVar[str] = "white noise with outliers (Student-t)"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE,)

    def parameters(self) -> dict[str, Positive]:
        return {WHITE: self.scale, DOF: self.freedom}

    def unit(self, name: str, output: str) -> str:
        return "1" if name == DOF else output

    def variance(self, parameters: Parameters, frame: Frame) -> Array:
        # Student-t of scale s and ν degrees of freedom has the variance s²·ν/(ν − 2).
        dof = xp.maximum(parameters[DOF], MIN_DOF)
        return white_variance(parameters, frame) * dof / (dof - 2)

    def log_density(self, y: Array, mean: Array, parameters: Parameters, frame: Frame) -> Array:
        dof, variance = parameters[DOF], white_variance(parameters, frame)
        half_dof, gammaln = 0.5 * (dof + 1), get_special_functions((dof, mean)).gammaln
        log_norm = gammaln(half_dof) - gammaln(0.5 * dof) - 0.5 * xp.log(xp.pi * dof * variance)
        return log_norm - half_dof * xp.log1p((y - mean) ** 2 / (dof * variance))

    def by_residual(self, residuals: Any, parameters: Parameters, frame: Frame) -> tuple[Any, Any]:
        dof = parameters[DOF]
        scale, squares = dof * white_variance(parameters, frame), residuals**2
        scale_sum = scale + squares
        return (dof + 1) * residuals / scale_sum, (dof + 1) * (scale - squares) / scale_sum**2

    def normal_scores(self, residuals: Array, parameters: Parameters, frame: Frame) -> Array:
        # P(T < −t) = ½·I_{ν/(ν + t²)}(ν/2, ½)
        dof = parameters[DOF]
        squares = residuals**2 / white_variance(parameters, frame)
        functions = get_special_functions((dof, squares))
        tail_probability = 0.5 * functions.betainc(0.5 * dof, 0.5, dof / (dof + squares))
        # Φ⁻¹ of the smaller tail probability avoids the cancellation of 1 − p far in the tail.
        return -xp.sign(residuals) * functions.ndtri(xp.maximum(tail_probability, MIN_PROBABILITY))

    def sample(self, key: Array, mean: Array, parameters: Parameters, frame: Frame) -> Array:
        draws = jax.random.t(key, parameters[DOF], mean.shape)
        return mean + jnp.sqrt(white_variance(parameters, frame)) * draws


@offered
def _offer_student_t(scale: Positive, frame: Frame) -> list[Noise]:
    return [StudentT(scale)]


class Quantised(Noise):
    """White noise rounded to multiples of `step` by a converter or a printed table.

    The likelihood of a printed value is the probability of the interval that rounds to it.

    Attributes:
        step: rounding step, output unit.
        scale: prior of the standard deviation before rounding, output unit.
    """

    step: float
    scale: Positive = HalfCauchy(1.0)
    is_gaussian: ClassVar[bool] = False
    law: ClassVar[str] = "quantised"
    looks_like: ClassVar[str] = "rounding and white noise"

    def __post_init__(self) -> None:
        if not self.step > 0:
            raise ValueError(f"a rounding step must be positive, not {self.step}")

    def parameters(self) -> dict[str, Positive]:
        return {WHITE: self.scale}

    def why_not(self, output: np.ndarray) -> str:
        span = float(np.ptp(output))
        if not 0 < span < self.step:
            return ""
        return f"the outputs span {span:.3g}, less than the rounding step {self.step:.3g}"

    def variance(self, parameters: Parameters, frame: Frame) -> Array:
        # A rounding error is about uniform over a step, of variance step²/12 (B. Widrow and I. Kollár, Quantization
        # Noise, 2008).
        return white_variance(parameters, frame) + self.step**2 / 12

    def log_density(self, y: Array, mean: Array, parameters: Parameters, frame: Frame) -> Array:
        sd = xp.sqrt(white_variance(parameters, frame))
        # Reflected to the lower tail, where the difference of two small probabilities does not cancel.
        standardised, half_step = -xp.abs(y - mean) / sd, 0.5 * self.step / sd
        log_tail = get_special_functions((standardised, half_step)).log_ndtr
        upper, lower = log_tail(standardised + half_step), log_tail(standardised - half_step)
        # log(Φ(u) − Φ(l)) = log Φ(u) + log(1 − exp(log Φ(l) − log Φ(u))); divided by the step it is a density.
        log_complement = xp.log(-xp.expm1(xp.minimum(lower - upper, -1e-300)))
        return upper + log_complement - math.log(self.step)

    def sample(self, key: Array, mean: Array, parameters: Parameters, frame: Frame) -> Array:
        sd = jnp.sqrt(white_variance(parameters, frame))
        unrounded_values = mean + sd * jax.random.normal(key, mean.shape)
        return jnp.round(unrounded_values / self.step) * self.step
