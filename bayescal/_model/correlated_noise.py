"""Correlated (Ornstein–Uhlenbeck) noise beside white noise."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg.lapack import dpttrf, dpttrs  # pyright: ignore[reportAttributeAccessIssue]

from bayescal._data import unit_conversion
from bayescal._model.frame import Frame
from bayescal._model.noise_law import WHITE, Noise, Parameters, offered, own_variance
from bayescal._model.prior import HalfCauchy, LogUniform, Positive, multiplied
from bayescal._model.state_space import drawn, exponential, filtered, states_of

DIFFUSION, CORRELATION_TIME = "noise.diffusion", "noise.correlated.time"
SHORT = 1e-5  # correlation times, below which correlated noise is a random walk to as many digits


class OrnsteinUhlenbeck(Noise):
    """White noise and correlated (Ornstein–Uhlenbeck) noise of unknown diffusion and time within each run.

    The correlated part has the covariance (q²·τ/2)·exp(−|Δt|/τ) within a run; runs are independent. Readings close
    together against the time τ know only the diffusion q, the coefficient of the random walk (IEEE 952: rate random
    walk); hence τ is bounded. Readings are whitened by the Kalman filter, in time linear in their number.

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
    words: ClassVar[str] = "Ornstein–Uhlenbeck"
    looks_like: ClassVar[str] = "noise that is correlated in time"
    independent: ClassVar[bool] = False

    @property
    def plain(self) -> Noise:
        return OrnsteinUhlenbeck(1.0, 2.0)

    def __post_init__(self) -> None:
        if not 0 < self.shortest < self.longest:
            raise ValueError(
                f"correlation times must be positive and in order, not {self.shortest} and {self.longest}"
            )

    def parameters(self) -> dict[str, Positive]:
        # σ² = q²·τ/2: a prior of σ at the middle time is one of the diffusion q, σ·√(2/τ), which readings close
        # together know.
        middle = math.sqrt(self.shortest * self.longest)
        return {
            WHITE: self.scale,
            DIFFUSION: multiplied(self.correlated, math.sqrt(2 / middle)),
            CORRELATION_TIME: LogUniform(self.shortest, self.longest),
        }

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE, DIFFUSION)

    def unit(self, name: str, output: str) -> str:
        if name == CORRELATION_TIME:
            return "s"
        spread_in_time = name == DIFFUSION and output != unit_conversion.ANY
        return f"{output}/s^0.5" if spread_in_time else output

    @property
    def coefficients_in_time(self) -> dict[str, str]:
        return {DIFFUSION: "K"}

    def slow_variance(self, values: Parameters) -> Any:
        """σ² = q²·τ/2, the stationary variance of the correlated part."""
        return 0.5 * values[DIFFUSION] ** 2 * values[CORRELATION_TIME]

    def derived(self, values):
        return {"noise.correlated": np.sqrt(np.asarray(self.slow_variance(values), float))}

    def fresh_variance(self, values, step):
        return values[WHITE] ** 2 + step * values[DIFFUSION] ** 2

    def variance(self, parameters, frame):
        return own_variance(parameters, frame) + self.slow_variance(parameters)

    def _states(self, parameters: Parameters, frame: Frame) -> tuple[Any, ...]:
        """Its one block; over which steps; and that readings show its state."""
        h, time = jnp.maximum(frame.step, 0.0), parameters[CORRELATION_TIME]
        return [exponential(time, self.slow_variance(parameters), h)], frame.step, np.ones(1)

    def whiten(self, columns, extra, parameters, frame):
        """By the Kalman filter: each reading less what those before it in its run say of it."""
        states = states_of(*self._states(parameters, frame))
        return filtered(states, own_variance(parameters, frame) + extra, columns)

    def sample(self, key: Array, mean, parameters, frame):
        of_white, of_slow = jax.random.split(key)
        slow = drawn(of_slow, *self._states(parameters, frame))
        own = jnp.sqrt(own_variance(parameters, frame))
        return mean + own * jax.random.normal(of_white, mean.shape) + slow

    def allan_variance(self, values, variance, factors, step):
        """White noise of variance σ² has σ²/m; the correlated part, s² times `allan_of_exponential`."""
        q, time = (np.asarray(values[n], float)[..., None] for n in (DIFFUSION, CORRELATION_TIME))
        size = 0.5 * q**2 * time
        white = np.maximum(np.asarray(variance)[..., None] - size, 0.0)
        return white / factors + size * allan_of_exponential(factors, step / time)

    def slow_part(self, values, time, left, white, at, along=None):
        """Its precision over sorted times has three diagonals.

        Source: H. Rue and L. Held, Gaussian Markov Random Fields (2005), ch. 2.
        """
        grid = np.union1d(time, at)
        variance = float(self.slow_variance(values))
        step = np.diff(grid) / values[CORRELATION_TIME]
        # The process is Markov: its density is a product of N(xᵢ; aᵢ·xᵢ₋₁, σ²·(1 − aᵢ²)). Of its exponent come 1/(1 −
        # aᵢ²) and aᵢ₊₁²/(1 − aᵢ₊₁²) on the diagonal of the precision and −aᵢ/(1 − aᵢ²) beside it, all over σ².
        kept, fresh = np.exp(-step), -np.expm1(-2 * step)
        diagonal = np.ones(grid.size)
        diagonal[1:] = 1 / fresh
        diagonal[:-1] += kept**2 / fresh
        place, diagonal = np.searchsorted(grid, time), diagonal / variance
        pull = np.zeros((grid.size, left.shape[1]))
        np.add.at(diagonal, place, 1 / white)
        np.add.at(pull, place, left / white[:, None])
        pivots, below, _ = dpttrf(diagonal, -kept / fresh / variance)
        mean = dpttrs(pivots, below, pull)[0]
        # With A = L·D·Lᵀ, L of one diagonal below: (A⁻¹)ᵢᵢ = 1/dᵢ + lᵢ²·(A⁻¹)ᵢ₊₁,ᵢ₊₁, from the end.
        spread, beyond = 1 / pivots, 0.0
        for i in range(grid.size - 1, -1, -1):  # the diagonal of the inverse
            spread[i] += beyond
            beyond = below[i - 1] ** 2 * spread[i] if i else 0.0
        asked = np.searchsorted(grid, at)
        return mean[asked], spread[asked]


def allan_of_exponential(m: Float[np.ndarray, "k"], a: Any) -> Any:
    """Allan variance of evenly spaced readings of unit variance whose correlation is exp(−a·k), k readings apart.

    With ρ = exp(−a) and a fall E = 1 − ρᵐ it is [(1 + ρ)/(1 − ρ) − ρ·E·(2 + E)/(m·(1 − ρ)²)]/m: from the variance V of
    a mean of m readings of such a sequence, as 2·V(m) − 2·V(2m). Over times short against the correlation's it is a
    random walk's, a·(2m² + 1)/(3m); IEEE 952 has the limits of continuous averages.

    Args:
        m: readings averaged.
        a: step over correlation time; complex for a correlation that turns, of which the real part is then taken.
    """
    rho, fall, gap = np.exp(-a), -np.expm1(-m * a), -np.expm1(-a)
    stationary = ((1 + rho) / gap - rho * fall * (2 + fall) / (m * gap**2)) / m
    return np.where(np.abs(m * a) < SHORT, a * (2 * m**2 + 1) / (3 * m), stationary)


def over_record(scale: Positive, step: float, span: float) -> OrnsteinUhlenbeck:
    """White noise beside correlated noise whose correlation time the record can tell: from one step to its span.

    Args:
        scale: prior of the standard deviation of either part, output unit.
        step: usual time between neighbours, s.
        span: of the longest run, s.
    """
    # A correlation time below a step is white noise to these readings, and one beyond the span a random walk.
    return OrnsteinUhlenbeck(step, max(span, 10 * step), scale, scale)


@offered
def _within_runs(scale: Positive, frame: Frame) -> list[Noise]:
    """Where there is time."""
    steps = np.asarray(frame.step)
    if not (steps > 0).any():
        return []
    span = float(np.max(np.asarray(frame.columns["elapsed"])))
    return [over_record(scale, float(np.median(steps[steps > 0])), span)]
