"""Prior distributions of unknowns.

Coefficients take `Normal`, `Flat` or `Known`; group and noise standard deviations `HalfNormal`, `HalfCauchy` or `Flat`;
positive quantities known to an order of magnitude `LogNormal`, bounded ones `LogUniform`.
A hyper-parameter is sampled in a coordinate v on the whole real line; each positive prior here gives its
value at v and its log density *in v* (the Jacobian included): no other code transforms values. Values and
coordinates are JAX's arrays within programs, NumPy's arrays or numbers on the host.
"""

from __future__ import annotations

import math
from dataclasses import field
from typing import Any, ClassVar

import numpy as np

from bayescal._core.errors import ModelError
from bayescal._core.xp import get_special_functions, is_traced, xp
from bayescal._model.static import static

_LOG_2 = math.log(2.0)
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
DIFF_STEP = 1e-3  # step of numerical derivatives with respect to a coordinate v
_TAIL = 1e-15  # tail probability to which Φ(v) is clipped at a bound: v = ±7.9


class _StandardNormalPrior:
    """Base class of priors with a standard normal coordinate."""

    coordinate_variance: ClassVar[float] = 1.0  # infinite if improper

    def log_density(self, v: Any) -> Any:
        """Return the log density of the coordinate at v."""
        return -0.5 * v**2 - _HALF_LOG_2PI


@static
class _ScaledPrior:
    """Base class of priors of a positive quantity with a scale, in its own unit; the coordinate is log(value/scale)."""

    scale: float = 1.0

    def value(self, v: Any) -> Any:
        """Return the value at a coordinate, in its own unit."""
        return self.scale * xp.exp(v)

    def coordinate(self, value: Any) -> Any:
        return xp.log(value / self.scale)


@static
class Normal(_StandardNormalPrior):
    """A Gaussian prior; `mean` and `sd` in the coefficient's own unit."""

    mean: float = 0.0
    sd: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and math.isfinite(self.sd) and self.sd > 0):
            raise ValueError(f"Normal needs a finite mean and a positive sd, not {self}")

    def value(self, v: Any) -> Any:
        return self.mean + self.sd * v

    def coordinate(self, value: Any) -> Any:
        return (value - self.mean) / self.sd


@static
class Known:
    """Prior of a constant coefficient, which is not estimated, such as 1 for a body's temperature."""

    mean: float = 1.0  # value of the constant
    # whether the coefficient is zero in draws of structures without the effect (model average)
    averaged: bool = False
    sd: float = field(default=0.0, init=False, repr=False)


@static
class LogNormal(_StandardNormalPrior):
    """Prior of a positive quantity with a Gaussian logarithm; `median` in its own unit, `sd` of the logarithm."""

    median: float
    sd: float

    def value(self, v: Any) -> Any:
        return self.median * xp.exp(self.sd * v)

    def coordinate(self, value: Any) -> Any:
        return xp.log(value / self.median) / self.sd


@static
class LogUniform(_StandardNormalPrior):
    """Prior of a positive quantity between two bounds with a uniform logarithm; `low` and `high` in its own unit.

    Its coordinate is standard normal: value = low·(high/low)^Φ(v), within the bounds for every v.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (0 < self.low < self.high and math.isfinite(self.high)):
            raise ValueError(f"LogUniform needs finite bounds with 0 < low < high, not {self}")

    def value(self, v: Any) -> Any:
        fraction = get_special_functions(v).ndtr(v)
        return self.low * xp.exp(math.log(self.high / self.low) * fraction)

    def coordinate(self, value: Any) -> Any:
        """Return the coordinate of a value; finite also for a value at a bound."""
        fraction = xp.log(value / self.low) / math.log(self.high / self.low)
        return get_special_functions(value).ndtri(xp.clip(fraction, _TAIL, 1 - _TAIL))


@static
class NumpyroPrior(_StandardNormalPrior):
    """Prior of a positive quantity by a NumPyro distribution: value icdf(Φ(v)) at a standard normal coordinate v."""

    name: str
    parameters: tuple[tuple[str, float], ...]

    @property
    def distribution(self) -> Any:
        import numpyro.distributions as dist  # only where a prior is one of these

        return getattr(dist, self.name)(**dict(self.parameters))

    def value(self, v: Any) -> Any:
        value = self.distribution.icdf(xp.clip(get_special_functions(v).ndtr(v), _TAIL, 1 - _TAIL))
        return value if is_traced(v) else np.asarray(value)

    def coordinate(self, value: Any) -> Any:
        probability = xp.clip(self.distribution.cdf(value), _TAIL, 1 - _TAIL)
        return get_special_functions(probability).ndtri(probability)


@static
class HalfNormal(_ScaledPrior):
    """The positive half of N(0, scale²), for standard deviations."""

    coordinate_variance: ClassVar[float] = math.pi**2 / 8  # variance of log|N(0, 1)|

    def log_density(self, v: Any) -> Any:
        return _LOG_2 - _HALF_LOG_2PI - 0.5 * xp.exp(2 * v) + v


@static
class HalfCauchy(_ScaledPrior):
    """The positive half of a Cauchy distribution, for a scale known to within one or two orders of magnitude."""

    coordinate_variance: ClassVar[float] = math.pi**2 / 4

    def log_density(self, v: Any) -> Any:
        return math.log(2 / math.pi) - xp.logaddexp(0.0, 2 * v) + v


@static
class Flat(_ScaledPrior):
    """A flat, improper prior: the evidence of a model that has one is undefined.

    For a coefficient: flat on the real line. For a group or noise standard deviation: flat on the positive half line;
    `scale` only sets the unit of its coordinate.
    """

    coordinate_variance: ClassVar[float] = math.inf

    def log_density(self, v: Any) -> Any:
        return v + math.log(self.scale)


@static
class FlatLine:
    """A flat prior on the whole line, for a flat coefficient that is sampled with the hyper-parameters."""

    scale: float = 1.0
    coordinate_variance: ClassVar[float] = math.inf

    def value(self, v: Any) -> Any:
        return self.scale * v

    def coordinate(self, value: Any) -> Any:
        return value / self.scale

    def log_density(self, v: Any) -> Any:
        return 0.0 * v + math.log(self.scale)


def compute_sd(prior: Any) -> float | None:
    """Return the standard deviation of a prior, in the value's unit; None for half-Cauchy, flat and NumPyro priors."""
    match prior:
        case Normal():
            return prior.sd
        case HalfNormal():
            return prior.scale * math.sqrt(1 - 2 / math.pi)
        case LogNormal(median, sd):
            return median * math.sqrt(math.expm1(sd**2) * math.exp(sd**2))
        case LogUniform(low, high):
            log_ratio = math.log(high / low)
            return math.sqrt((high**2 - low**2) / (2 * log_ratio) - ((high - low) / log_ratio) ** 2)
    return None


def convert(prior: Any, is_shape: bool = False) -> Any:
    """Convert a NumPyro distribution to a prior of this module, without importing NumPyro; return others unchanged.

    Raises:
        ModelError: it is not a scalar normal or positive distribution with cdf and icdf, or `is_shape` and not for one.
    """
    name, fault = type(prior).__name__, "a shape cannot have it"
    if not type(prior).__module__.startswith("numpyro."):
        if not is_shape or isinstance(prior, Normal | LogNormal | NumpyroPrior):
            return prior
    else:
        names, base = {*prior.arg_constraints}, getattr(prior, "base_dist", prior)
        if name.endswith("TruncatedDistribution") and type(base).__name__ == "Normal":
            name, names = "TruncatedNormal", names | {"loc", "scale"}
        try:
            values = {n: float(getattr(prior, n, getattr(base, n, None))) for n in sorted(names)}
            lower_bound, fault = float(prior.icdf(_TAIL)), "it may be negative"
        except (TypeError, ValueError, NotImplementedError, ImportError) as error:
            lower_bound, values, fault = -1.0, {}, str(error).rstrip(".") or "it has no icdf"
        allowed_types = (Normal,) if is_shape else (Normal, HalfNormal, HalfCauchy)
        if values and (prior_class := next((k for k in allowed_types if k.__name__ == name), None)):
            return prior_class(*values.values())
        if lower_bound >= 0:
            return NumpyroPrior(name, tuple(values.items()))
    hint = "Coefficients take Normal, standard deviations HalfNormal or HalfCauchy, shapes"
    raise ModelError(f"prior {name}: {fault}. {hint} Normal or a positive distribution with icdf")


PRIORS = (Normal, LogNormal, LogUniform, HalfNormal, HalfCauchy, Flat, FlatLine)
Positive = HalfNormal | HalfCauchy | LogNormal | LogUniform | Flat


def scale_prior(prior: Positive, factor: float) -> Positive:
    """Return the prior of a positive quantity multiplied by a positive factor."""
    if isinstance(prior, LogNormal):
        return LogNormal(prior.median * factor, prior.sd)
    if isinstance(prior, LogUniform):
        return LogUniform(prior.low * factor, prior.high * factor)
    return type(prior)(prior.scale * factor)


def slope(prior: Any, v: Any) -> Any:
    """Return the derivative of a prior's value with respect to its coordinate, by fourth-order central differences."""
    value, h = prior.value, DIFF_STEP
    return (8 * (value(v + h) - value(v - h)) - (value(v + 2 * h) - value(v - 2 * h))) / (12 * h)
