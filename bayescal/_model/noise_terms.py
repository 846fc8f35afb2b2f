"""Terms of correlated noise: stationary state-space models with spectrum and Allan variance.

A term defines the transition matrix over a time step, the process-noise covariance and the observed states; each run
starts in the stationary distribution. IEEE Std 952-1997, Annex C, defines the noise coefficients.
"""

from __future__ import annotations

import abc
import itertools
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jnp
from bayescal._core.xp import get_special_functions
from bayescal._data.records import EVEN_STEPS
from bayescal._model import noise_spectrum
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_spectrum import COMPLEX_STEP, SpectralTerm, differentiate
from bayescal._model.prior import LogUniform, Normal, Positive, scale_prior
from bayescal._model.state_space import Block, build_exponential, stack_2x2
from bayescal._model.static import static

Values = Mapping[str, Any]
# Parameters of a single Ornstein–Uhlenbeck term: random-walk coefficient q, correlation time, standard deviation.
DIFFUSION, CORRELATION_TIME = "noise.diffusion", "noise.correlated.time"
CORRELATED = "noise.correlated"
WALK_TIME_SPANS = 30.0  # correlation time of a "random walk", record lengths: variance within 2 %
FLICKER_TIME_RATIO = 8.0  # ratio of successive correlation times: spectrum within 3.5 % of 1/f
SHORTEST_TIME_STEPS = 0.25  # correlation time of flicker noise, in steps: below Nyquist period/2π
ALLAN_SERIES_LIMIT = 1e-3  # λ·τ below which the Matérn Allan variance is computed by a series
SERIES_LIMIT = 0.1  # 2·λ·Δt below which the Matérn process noise is computed by a series
SLOPE_NAMES = ("noise.tone.slope", "noise.tone.bend")  # a and b of a tone's f + a·z + b·z²
WINDOW_SIZE = 32  # readings per spectrum; a drifting line stays in its frequency bin
ZERO_PADDING = 2  # frequency bins per independent bin of a spectrum
MIN_WINDOWS = 8  # fewest spectra whose mean shows a line
SLOPE_COUNT = 16  # trial slopes of the line frequency, up to twice the Nyquist frequency over half the column's range
MAX_RELATIVE_POWER = 20.0  # bound on a window's relative power, against spikes
# Averaging time over correlation time below which the Allan variance is that of a random walk to 5 digits.
WALK_LIMIT = 1e-5
FLICKER_FLOOR = 2 * math.log(2) / math.pi  # Allan variance of flicker noise over B²


@static
class NoiseTerm(abc.ABC):
    """One term of a sum of noise processes, with bounds and priors for one record.

    Attributes:
        shortest, longest: bounds of the correlation time, s: the median time step, and the duration of the longest run.
        correlated: prior of a correlated term's standard deviation, output unit.
        column: covariate of a tone's frequency; empty: constant frequency.
    """

    shortest: float
    longest: float
    correlated: Positive
    column: str
    label: ClassVar[str]  # name in printed text
    needs_bounds: ClassVar[bool] = False  # whether its states depend on `shortest` or `longest`

    @property
    def diffusion(self) -> Positive:
        """Return the prior of the coefficient q for which q·√(τ/2) has the prior `correlated`, τ the geometric mean."""
        mean_time = math.sqrt(self.shortest * self.longest)
        return scale_prior(self.correlated, math.sqrt(2 / mean_time))

    @abc.abstractmethod
    def parameters(self) -> dict[str, tuple[Any, str]]:
        """Return (prior, unit) of each parameter, by name, the amplitude first; "{}" in a unit is the output unit."""

    @abc.abstractmethod
    def block(self, values: Values, h: Float[Array, "n"]) -> Block:
        """Return the state-space form over time steps h, s; `values` includes the covariate scaled to −1 … 1 (n,)."""

    @abc.abstractmethod
    def variance(self, values: Values) -> Any:
        """Return the stationary variance of the term at values of its parameters, output unit squared."""

    def spectrum(
        self, values: Values, step: float, lam: Float[np.ndarray, "j"]
    ) -> list[SpectralTerm]:
        """Return the cosine transform of the covariance of readings `step` seconds apart, at eigenvalues `lam`.

        Optional: a sum with a term that does not define it is evaluated by the Kalman filter alone.
        """
        raise NotImplementedError(f"{self.label} noise has no spectrum here")

    @property
    def has_spectrum(self) -> bool:
        return type(self).spectrum is not NoiseTerm.spectrum

    @abc.abstractmethod
    def allan(self, values: Values, m: Float[np.ndarray, "k"], step: float) -> Any:
        """Return the Allan variance at averaging factors m of readings `step` seconds apart; values (…, 1)."""

    def starts(
        self,
        step: Float[np.ndarray, "n"],
        residuals: Float[np.ndarray, "n"],
        z: Float[np.ndarray, "n"] | None,
    ) -> list[dict[str, float]]:
        """Return starting points of an optimisation, name → value, by residuals; z: covariate scaled to −1 … 1."""
        return [{}]

    def derived(self, values: Values) -> dict[str, Any]:
        """Return quantities computed from the parameters, such as a standard deviation, by name."""
        return {}


class ExponentialTerm(NoiseTerm):
    """A sum of independent processes of exponential correlation: Ornstein–Uhlenbeck, or a narrow spectral line."""

    @abc.abstractmethod
    def processes(self, values: Values) -> list[tuple[Any, Any]]:
        """Return (variance, rate) of each process: output unit squared, 1/s; its correlation is Re exp(−rate·Δt)."""

    def variance(self, values):
        return sum(variance for variance, _ in self.processes(values))

    def block(self, values, h):
        variances, rates = map(jnp.asarray, zip(*self.processes(values), strict=True))
        return build_exponential(1 / rates, variances, h)

    def spectrum(self, values, step, lam):
        transform = noise_spectrum.transform_exponential
        return [transform(variance, rate, step, lam) for variance, rate in self.processes(values)]

    def allan(self, values, m, step):
        pairs = self.processes(values)
        return sum(variance * evaluate_allan(m, step * rate).real for variance, rate in pairs)


@static
class CorrelatedTerm(ExponentialTerm):
    """Ornstein–Uhlenbeck noise; several terms are ordered by correlation time, to be identifiable.

    After a term of correlation time τ' the next has τ = τ'·(longest/τ')^u, u uniform from 0 to 1.
    """

    rank: int  # 1, 2, … in order of correlation time; 0: single term, unnumbered in parameter names
    label: ClassVar[str] = "Ornstein–Uhlenbeck"

    def _name(self, quantity: str, rank: int | None = None) -> str:
        if not self.rank:
            return {"diffusion": DIFFUSION, "time": CORRELATION_TIME, "size": CORRELATED}[quantity]
        return f"noise.correlated{rank or self.rank}.{quantity}"

    def parameters(self):
        amplitude = {self._name("diffusion"): (self.diffusion, "{}/s^0.5")}
        if self.rank < 2:
            return amplitude | {self._name("time"): (LogUniform(self.shortest, self.longest), "s")}
        return amplitude | {self._name("place"): (Normal(0.0, 1.0), "1")}

    def time(self, values: Values) -> Any:
        """Return the correlation time, s."""
        time = values[self._name("time", 1)]
        for rank in range(2, self.rank + 1):
            v = values[self._name("place", rank)]
            # log τ = (1 − u)·log τ' + u·log longest, with u = Φ(v) uniform for standard normal v.
            fraction = get_special_functions(v).ndtr(v)
            time = time ** (1 - fraction) * self.longest**fraction
        return time

    def processes(self, values):
        time = self.time(values)
        return [(0.5 * values[self._name("diffusion")] ** 2 * time, 1 / time)]

    @property
    def needs_bounds(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.rank > 1

    def derived(self, values):
        sds = {self._name("size"): np.sqrt(self.variance(values))}
        return sds if self.rank < 2 else {**sds, self._name("time"): self.time(values)}


class RandomWalkTerm(ExponentialTerm):
    """A random walk (IEEE 952: rate random walk, K), approximated by a stationary process of long correlation time."""

    label: ClassVar[str] = "random walk"
    needs_bounds: ClassVar[bool] = True

    def parameters(self):
        return {"noise.walk": (self.diffusion, "{}/s^0.5")}

    # An Ornstein–Uhlenbeck process of correlation time 30 record lengths: stationary, and within the record a random
    # walk of coefficient K, since K² = 2·σ²/τ.
    def processes(self, values):
        time = WALK_TIME_SPANS * self.longest
        return [(0.5 * values["noise.walk"] ** 2 * time, 1 / time)]


class FlickerTerm(ExponentialTerm):
    """Flicker (1/f) noise (IEEE 952: bias instability, B), a sum of processes with geometric correlation times.

    Equal variances s² at correlation times in ratio r have about the one-sided spectrum s²/(f·ln r); flicker noise has
    B²/(π·f), so that s² = B²·ln r/π.
    Source: F. Hooge and P. Bobbert, Physica B 239 (1997) 223 (1/f as a sum of Lorentzian spectra).
    """

    label: ClassVar[str] = "flicker"
    needs_bounds: ClassVar[bool] = True

    def parameters(self):
        return {"noise.flicker": (self.correlated, "{}")}

    def times(self) -> Float[np.ndarray, "k"]:
        """Return the correlation times, s: from a quarter of a step to beyond the longest run."""
        shortest_time = SHORTEST_TIME_STEPS * self.shortest
        count = math.ceil(math.log(self.longest / shortest_time, FLICKER_TIME_RATIO)) + 1
        return shortest_time * FLICKER_TIME_RATIO ** np.arange(count)

    # One-sided, a term of variance s² and time τ has the spectrum 4·s²·τ/(1 + (2πfτ)²). Summed over times whose
    # logarithms are ln r apart: ∫ 4·s²/(1 + (2πfτ)²)·dτ/ln r = s²/(f·ln r), which is B²/(π·f) for s² = B²·ln r/π.
    def processes(self, values):
        variance = values["noise.flicker"] ** 2 * math.log(FLICKER_TIME_RATIO) / math.pi
        return [(variance, 1 / time) for time in self.times()]


class SmoothTerm(NoiseTerm):
    """A Matérn process of smoothness ν = 3/2, with the correlation (1 + λ·Δt)·exp(−λ·Δt), λ = √3/time.

    States: the process f, and its scaled derivative f′/λ.
    Source: J. Hartikainen and S. Särkkä, Kalman filtering and smoothing solutions to temporal Gaussian process
    regression models (MLSP 2010).
    """

    label: ClassVar[str] = "Matérn-3/2"

    def parameters(self):
        time = LogUniform(self.shortest, self.longest)
        return {"noise.smooth": (self.correlated, "{}"), "noise.smooth.time": (time, "s")}

    def variance(self, values):
        return values["noise.smooth"] ** 2

    def block(self, values, h):
        sd, x = values["noise.smooth"], math.sqrt(3) * h / values["noise.smooth.time"]
        # f and g = f′/λ obey f′ = λ·g, g′ = −λ·f − 2λ·g and noise. Its matrix M has (M + λ)² = 0, so that over a step
        # x = λ·Δt exp(M·Δt) = e⁻ˣ·(1 + (M + λ)·Δt) ends after two terms: e⁻ˣ·[[1 + x, x], [−x, 1 − x]] = A.
        decay, z = jnp.exp(-x), 2 * x
        transition = decay[:, None, None] * stack_2x2(1 + x, x, -x, 1 - x)
        # For states of variance one the process noise is 1 − A·Aᵀ; its element ff is 1 − e⁻ᶻ·(1 + z + z²/2), z = 2x,
        # or for small z e⁻ᶻ·(z³/6 + z⁴/24 + …); fg = 2x²·e⁻²ˣ; gg = 1 − e⁻²ˣ·(x² + (1 − x)²).
        series = z**3 / 6 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7 * (1 + z / 8)))))
        closed_form = -jnp.expm1(-z) - decay**2 * (z + z**2 / 2)
        value_variance = jnp.where(z < SERIES_LIMIT, decay**2 * series, closed_form)
        cross_term = decay**2 * z**2 / 2
        slope_variance = -jnp.expm1(-z) + decay**2 * (z - z**2 / 2)
        covariance = sd**2 * stack_2x2(value_variance, cross_term, cross_term, slope_variance)
        return Block(transition, covariance, sd**2 * jnp.eye(2))

    def spectrum(self, values, step, lam):
        arguments = self.variance(values), values["noise.smooth.time"]
        return [noise_spectrum.transform_matern(*arguments, step, lam)]

    def allan(self, values, m, step):
        """Return the Allan variance c − ∂c/∂log a, c(a) that of correlation exp(−a·k); by complex step or series."""
        a = np.asarray(math.sqrt(3) * step / values["noise.smooth.time"], float)
        c, slope = differentiate(evaluate_allan(m + 0j, a * COMPLEX_STEP))
        x = m * a
        series = x**2 / 2 - 7 * x**3 / 15
        unit_variance = np.where(x < ALLAN_SERIES_LIMIT, series, c - slope)
        return values["noise.smooth"] ** 2 * unit_variance


class ToneTerm(ExponentialTerm):
    """A narrow spectral line: a damped stochastic oscillator, whose two states are its quadratures.

    With a covariate z, scaled to −1 … 1 over the readings of the fit, the frequency is f + a·z + b·z². A frequency
    above the Nyquist frequency is aliased, in the model as in the readings.
    """

    label: ClassVar[str] = "tone"

    def parameters(self):
        min_frequency, nyquist = 1 / self.longest, 0.5 / self.shortest
        return {
            "noise.tone": (self.correlated, "{}"),
            "noise.tone.frequency": (LogUniform(min(min_frequency, 0.5 * nyquist), nyquist), "Hz"),
            "noise.tone.time": (LogUniform(self.shortest, self.longest), "s"),
            **dict.fromkeys(SLOPE_NAMES if self.column else (), (Normal(0.0, nyquist), "Hz")),
        }

    def processes(self, values, z=0.0):
        slope, bend = (values[name] if self.column else 0.0 for name in SLOPE_NAMES)
        frequency = values["noise.tone.frequency"] + slope * z + bend * z**2
        rate = 1 / values["noise.tone.time"] + 2j * math.pi * frequency
        return [(values["noise.tone"] ** 2, rate)]

    def block(self, values, h):
        ((variance, rate),) = self.processes(values, values[self.column] if self.column else 0.0)
        # Two quadratures rotated by 2πf·Δt and damped as an Ornstein–Uhlenbeck process: half width 1/(2π·time).
        phase = rate.imag * h
        c, s = jnp.cos(phase), jnp.sin(phase)
        ou = build_exponential(values["noise.tone.time"], variance, h)
        eye = jnp.eye(2)
        return Block(ou.transition * stack_2x2(c, s, -s, c), ou.noise * eye, ou.start * eye)

    def allan(self, values, m, step):
        """Return the Allan variance of a tone, averaged over the covariate's range if its frequency has a covariate."""
        positions = np.linspace(-1, 1, 33) if self.column else [0.0]
        pairs = [pair for z in positions for pair in self.processes(values, z)]
        return np.mean([v * evaluate_allan(m, step * rate).real for v, rate in pairs], axis=0)

    def starts(self, step, residuals, z):
        """Return the spectrogram's strongest line, frequency quadratic in z, as starting point; [] if too short."""
        period = float(np.median(step[step > 0]))
        is_even = np.abs(step / period - 1) < EVEN_STEPS
        is_complete = np.convolve(is_even, np.ones(WINDOW_SIZE - 1), "valid")[1:] == WINDOW_SIZE - 1
        window_starts = np.arange(0, len(residuals) - WINDOW_SIZE + 1, WINDOW_SIZE // 2)
        rows = window_starts[is_complete[window_starts]][:, None] + np.arange(WINDOW_SIZE)
        if len(rows) < MIN_WINDOWS:
            return []
        window = np.hanning(WINDOW_SIZE + 2)[1:-1]
        power = _compute_relative_power(residuals[rows], window, is_varying=z is not None)
        positions = np.zeros(len(rows)) if z is None else z[rows].mean(axis=1)
        slopes = np.linspace(-1, 1, 4 * SLOPE_COUNT + 1) if z is not None else np.zeros(1)
        bin_count, line = ZERO_PADDING * WINDOW_SIZE, (-math.inf, 0.0, 0.0, 0.0)
        bins = np.arange(1, bin_count // 2)
        # Two periods of the discrete spectrum, whose upper half mirrors the lower, so that shifted indices stay valid.
        spectra = np.minimum(np.hstack([power, power[:, -2:0:-1]] * 2), MAX_RELATIVE_POWER)
        offsets = bins[:, None] + spectra.shape[1] * np.arange(len(rows))
        # The frequency is nearly constant within a window: its bin is that at the window's mean z.
        for a, b in itertools.product(slopes, slopes[::2] / 2):
            shifts = np.rint(bin_count * (a * positions + b * positions**2)).astype(int) % bin_count
            means = np.mean(spectra.ravel()[offsets + shifts], axis=1)
            line = max(line, (float(means.max()), float(bins[np.argmax(means)] / bin_count), a, b))
        peak_power, frequency, a, b = line
        # Differences of neighbours have √2 times the standard deviation; the median |difference| is 0.6745 of that.
        sd = float(np.median(np.abs(np.diff(residuals)[is_even[1:]]))) / (0.6745 * math.sqrt(2))
        # A line of variance s² in white noise of variance w² has the relative power (Σh)²·s²/(2·w²·Σh²), h the window.
        ratio = max(peak_power - 1, 0.1) * 2 * float(np.sum(window**2) / np.sum(window) ** 2)
        line_fraction = ratio / (1 + ratio)
        start = {
            WHITE: sd * math.sqrt(1 - line_fraction),
            "noise.tone": sd * math.sqrt(line_fraction),
            "noise.tone.frequency": frequency / period,
            "noise.tone.time": WINDOW_SIZE * period,
        }
        if z is not None:
            start |= dict(zip(SLOPE_NAMES, (float(a) / period, float(b) / period), strict=True))
        return [start]


def _compute_relative_power(
    residuals: Float[np.ndarray, "w r"], window: Float[np.ndarray, "r"], is_varying: bool
) -> Float[np.ndarray, "w f"]:
    """Return the power of detrended windows (w, f) relative to the background power at each frequency.

    The background is the median over windows if a line's frequency varies, otherwise over adjacent frequencies.
    """
    ramp = np.vander(np.linspace(-1, 1, len(window)), 2)
    detrended = residuals - residuals @ ramp @ np.linalg.pinv(ramp)
    power = np.abs(np.fft.rfft(detrended * window, ZERO_PADDING * len(window), axis=1)) ** 2
    background = np.median(power, axis=0) / math.log(2)  # the mean of an exponential distribution
    if not is_varying:
        slices = [slice(max(0, k - WINDOW_SIZE), k + WINDOW_SIZE) for k in range(background.size)]
        background = np.array([np.median(background[window_slice]) for window_slice in slices])
    return power / background


class MovingAverageTerm(NoiseTerm):
    """Moving average eₜ + θ·eₜ₋₁ of evenly spaced readings, e independent and homoscedastic; states eₜ and θ·eₜ₋₁."""

    theta: ClassVar[float]

    @abc.abstractmethod
    def error_sd(self, values: Values) -> Any:
        """Return the standard deviation of the errors, output unit."""

    def variance(self, values):
        return 2 * self.error_sd(values) ** 2

    def block(self, values, h):
        square, zero = self.error_sd(values) ** 2, 0.0 * h
        transition = stack_2x2(zero, zero, self.theta + zero, zero)
        noise = stack_2x2(square + zero, zero, zero, zero)
        return Block(transition, noise, square * jnp.eye(2), observes_all=True)

    def spectrum(self, values, step, lam):
        return [noise_spectrum.transform_moving_average(self.error_sd(values), self.theta, lam)]


class QuantisationTerm(MovingAverageTerm):
    """Quantisation noise (IEEE 952, Q): readings are differences of angles with independent errors."""

    label: ClassVar[str] = "quantisation"
    needs_bounds: ClassVar[bool] = True
    theta: ClassVar[float] = -1.0

    def parameters(self):
        return {"noise.quantisation": (scale_prior(self.correlated, self.shortest), "{}*s")}

    def error_sd(self, values):
        return values["noise.quantisation"] / self.shortest

    def allan(self, values, m, step):
        # IEEE 952: σ²(τ) = 3·Q²/τ², τ = m·step.
        return 3 * (values["noise.quantisation"] / (m * step)) ** 2


class AveragingTerm(MovingAverageTerm):
    """White noise after a sensor's low-pass filter: means of two successive independent errors.

    Only adjacent readings are correlated: with white noise added, by 0 to ½. The amplitude is the standard deviation
    before averaging, which leaves the spectral density at low frequencies unchanged.
    Source: G. Box and G. Jenkins, Time Series Analysis (1976), §3.3 (moving averages of first order).
    """

    label: ClassVar[str] = "averaging"
    theta: ClassVar[float] = 1.0

    def parameters(self):
        return {"noise.averaging": (self.correlated, "{}")}

    def error_sd(self, values):
        return 0.5 * values["noise.averaging"]

    def allan(self, values, m, step):
        # A mean of m readings has variance (2m − 1)/2m²·s², and covariance s²/4m² with the next.
        return values["noise.averaging"] ** 2 * (m - 0.75) / m**2


def evaluate_allan(m: Float[np.ndarray, "k"], a: Any) -> Any:
    """Return the Allan variance at averaging factors m of readings of unit variance and correlation exp(−a·k) at lag k.

    With ρ = exp(−a) and E = 1 − ρᵐ it is [(1 + ρ)/(1 − ρ) − ρ·E·(2 + E)/(m·(1 − ρ)²)]/m = 2·V(m) − 2·V(2m), V the
    variance of a mean of m readings. For averaging times far below the correlation time it is that of a random walk,
    a·(2m² + 1)/(3m). IEEE 952 gives the limits of continuous averages. For an oscillating correlation a is complex, and
    the real part of the result is the variance.
    """
    rho, decay, one_minus_rho = np.exp(-a), -np.expm1(-m * a), -np.expm1(-a)
    exact = ((1 + rho) / one_minus_rho - rho * decay * (2 + decay) / (m * one_minus_rho**2)) / m
    return np.where(np.abs(m * a) < WALK_LIMIT, a * (2 * m**2 + 1) / (3 * m), exact)


TERMS: dict[str, type[NoiseTerm]] = {
    "correlated": CorrelatedTerm,
    "smooth": SmoothTerm,
    "walk": RandomWalkTerm,
    "flicker": FlickerTerm,
    "tone": ToneTerm,
    "quantisation": QuantisationTerm,
    "averaging": AveragingTerm,
}
