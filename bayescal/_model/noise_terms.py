"""Terms of correlated noise: each a small stationary state-space block, with its Allan variance.

A term defines the transition of its states over a step, their innovation covariance, and the states observed. All
start stationary, so that any of them may begin a run. IEEE Std 952-1997, Annex C, defines the coefficients.
"""

from __future__ import annotations

import abc
import itertools
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jnp
from bayescal._core.xp import special_of
from bayescal._data.records import EVEN_STEPS
from bayescal._model import noise_spectrum
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_spectrum import SpectralTerm
from bayescal._model.prior import LogUniform, Normal, Positive, multiplied
from bayescal._model.state_space import Block, exponential, pairs
from bayescal._model.static import static

Values = Mapping[str, Any]
# Of an Ornstein–Uhlenbeck process alone: q, the coefficient of the random walk; its time; its standard deviation.
DIFFUSION, CORRELATION_TIME = "noise.diffusion", "noise.correlated.time"
CORRELATED = "noise.correlated"
ENDLESS = 30.0  # spans, after which a random walk returns: within 2 % of an endless one in a record of one span
RUNGS = 8.0  # from one time of a ladder to the next: its spectrum within 3.5 % of 1/f
FASTEST = 0.25  # steps, the shortest of these times: below a period of two steps, the shortest there is, over 2π
SMOOTH = 1e-3  # times λ·h, below which a smooth process is told by the first terms of its series
REACH = 0.1  # λ·h, below which a small difference of exponentials is summed as a series
MOVING = ("noise.tone.slope", "noise.tone.bend")  # of a tone's frequency along a column
WINDOW = 32  # readings of a spectrum, in which a line that moves stays in its place
FINE = 2  # places of a spectrum to each that its readings tell apart
FEWEST_WINDOWS = 8  # whose mean spectrum is even enough for a line to stand out
GRID = 16  # slopes of a frequency, from none to twice the Nyquist frequency over half the column's range
LOUDEST = 20.0  # times the usual, as much as a window counts: a spike is no line
# Of the correlation time, below which correlated noise is a random walk to as many digits.
SHORT_TIMES = 1e-5
FLAT = 2 * math.log(2) / math.pi  # Allan variance of flicker noise over B²


class Bounds(NamedTuple):
    """Correlation times that a record can resolve, and the prior of a correlated part's size."""

    shortest: float  # of correlation times, s: the usual step and the longest run
    longest: float
    correlated: Positive  # prior of a correlated part's standard deviation, output unit
    column: str = ""  # that the frequency of a tone follows; none if empty

    @property
    def middle(self) -> float:
        return math.sqrt(self.shortest * self.longest)

    @property
    def diffusion(self) -> Positive:
        """Return prior of a coefficient per √s that gives the correlated part its size at the middle of the times."""
        return multiplied(self.correlated, math.sqrt(2 / self.middle))


@static
class NoiseTerm(abc.ABC):
    """One term of a sum. Its unknowns have names of their own, in the output unit or as `units` says of it, "{}"."""

    words: ClassVar[str]  # as a person reads it
    units: ClassVar[Mapping[str, str]] = {}
    bounded: ClassVar[bool] = False  # whether its states hang on the bounds of the record

    @abc.abstractmethod
    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        """Return names and priors; the first is its amplitude."""

    def unit(self, name: str, output: str) -> str:
        return self.units.get(name, "{}").format(output)

    @abc.abstractmethod
    def block(self, values: Values, bounds: Bounds, h: Float[Array, "n"]) -> Block:
        """Return its states over steps h, s; `values` includes the column that is followed, from −1 to 1 (n,)."""

    @abc.abstractmethod
    def variance(self, values: Values, bounds: Bounds) -> Any:
        """Return the variance of a reading, output unit squared."""

    def spectrum(
        self, values: Values, bounds: Bounds, step: float, lam: Float[np.ndarray, "j"]
    ) -> list[SpectralTerm]:
        """Return its covariance in frequency on readings a step apart, where it is stationary; values (s, 1)."""
        raise NotImplementedError(f"{self.words} noise has no spectrum here")

    @abc.abstractmethod
    def allan(self, values: Values, bounds: Bounds, m: Float[np.ndarray, "k"], step: float) -> Any:
        """Return the Allan variance of means of m evenly spaced readings; values with a last axis of one."""

    def starts(
        self,
        step: Float[np.ndarray, "n"],
        residuals: Float[np.ndarray, "n"],
        z: Float[np.ndarray, "n"] | None,
    ) -> list[dict[str, float]]:
        """Return starting values of its unknowns; those not named may be anything."""
        return [{}]

    def derived(self, values: Values, bounds: Bounds) -> dict[str, Any]:
        """Return further quantities derived from its unknowns."""
        return {}


class ExponentialTerm(NoiseTerm):
    """A sum of independent Ornstein–Uhlenbeck processes, which a reading shows together."""

    @abc.abstractmethod
    def processes(self, values: Values, bounds: Bounds) -> list[tuple[Any, Any]]:
        """Return the variance, output unit squared, and the correlation time, s, of each."""

    def variance(self, values, bounds):
        return sum(variance for variance, _ in self.processes(values, bounds))

    def block(self, values, bounds, h):
        variances, times = map(jnp.asarray, zip(*self.processes(values, bounds), strict=True))
        return exponential(times, variances, h)

    def spectrum(self, values, bounds, step, lam):
        processes = self.processes(values, bounds)
        return [noise_spectrum.exponential(variance, t, step, lam) for variance, t in processes]

    def allan(self, values, bounds, m, step):
        processes = self.processes(values, bounds)
        return sum(variance * allan_of_exponential(m, step / time) for variance, time in processes)


@static
class CorrelatedTerm(ExponentialTerm):
    """Ornstein–Uhlenbeck noise; of several, each has a longer time than the one before.

    Of one before it with the time τ' it has τ = τ'·(longest/τ')^u, u uniform from 0 to 1: so they cannot exchange.
    """

    place: int  # 1 for the first, and so on; 0 for one that is alone, whose names have no number
    words: ClassVar[str] = "Ornstein–Uhlenbeck"

    def _name(self, what: str, place: int | None = None) -> str:
        if not self.place:
            return {"diffusion": DIFFUSION, "time": CORRELATION_TIME, "size": CORRELATED}[what]
        return f"noise.correlated{place or self.place}.{what}"

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        priors: dict[str, Any] = {self._name("diffusion"): bounds.diffusion}
        if self.place < 2:
            return {**priors, self._name("time"): LogUniform(bounds.shortest, bounds.longest)}
        return {**priors, self._name("place"): Normal(0.0, 1.0)}

    def unit(self, name: str, output: str) -> str:
        units = {self._name("diffusion"): f"{output}/s^0.5", self._name("time", 1): "s"}
        return units.get(name, "1")

    def time(self, values: Values, bounds: Bounds) -> Any:
        """Return its correlation time, s."""
        time = values[self._name("time", 1)]
        for place in range(2, self.place + 1):
            v = values[self._name("place", place)]
            # log τ uniform from the time before to the longest: a share u = Φ(v) of the way, v standard normal.
            share = special_of(v).ndtr(v)
            time = time ** (1 - share) * bounds.longest**share
        return time

    def processes(self, values, bounds):
        time = self.time(values, bounds)
        return [(0.5 * values[self._name("diffusion")] ** 2 * time, time)]

    @property
    def bounded(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.place > 1

    def derived(self, values, bounds):
        size = {self._name("size"): np.sqrt(self.variance(values, bounds))}
        return size if self.place < 2 else {**size, self._name("time"): self.time(values, bounds)}


class WalkTerm(ExponentialTerm):
    """A random walk (IEEE 952: rate random walk, K) that has gone on for long before the record."""

    words: ClassVar[str] = "random walk"
    units: ClassVar[Mapping[str, str]] = {"noise.walk": "{}/s^0.5"}
    bounded: ClassVar[bool] = True

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        return {"noise.walk": bounds.diffusion}

    # An Ornstein–Uhlenbeck process that returns after thirty spans: stationary as the other terms, and within a
    # record of one span a walk of the diffusion K, since K² = 2·σ²/τ.
    def processes(self, values, bounds):
        time = ENDLESS * bounds.longest
        return [(0.5 * values["noise.walk"] ** 2 * time, time)]


class FlickerTerm(ExponentialTerm):
    """Flicker (1/f) noise over the record's octaves (IEEE 952: bias instability, B), a ladder of equal steps in time.

    Equal variances s² at times apart by a factor r have about the spectrum s²/(f·ln r), one-sided; flicker noise has
    B²/(π·f), so that s² = B²·ln r/π.
    Source: F. Hooge and P. Bobbert, Physica B 239 (1997) 223 (1/f as a sum of Lorentzian spectra).
    """

    words: ClassVar[str] = "flicker"
    bounded: ClassVar[bool] = True

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        return {"noise.flicker": bounds.correlated}

    def times(self, bounds: Bounds) -> Float[np.ndarray, "k"]:
        """Return the times of the ladder, s: from a quarter of a step to beyond the longest run."""
        first = FASTEST * bounds.shortest
        count = math.ceil(math.log(bounds.longest / first, RUNGS)) + 1
        return first * RUNGS ** np.arange(count)

    # One-sided, a term of variance s² and time τ has the spectrum 4·s²·τ/(1 + (2πfτ)²). Summed over times whose
    # logarithms are ln r apart: ∫ 4·s²/(1 + (2πfτ)²)·dτ/ln r = s²/(f·ln r), which is B²/(π·f) for s² = B²·ln r/π.
    def processes(self, values, bounds):
        size = values["noise.flicker"] ** 2 * math.log(RUNGS) / math.pi
        return [(size, time) for time in self.times(bounds)]


class SmoothTerm(NoiseTerm):
    """A smooth process: Matérn's of order 3/2, with the correlation (1 + λ·Δt)·exp(−λ·Δt), λ = √3/time.

    States: itself, and its slope over λ.
    Source: J. Hartikainen and S. Särkkä, Kalman filtering and smoothing solutions to temporal Gaussian process
    regression models (MLSP 2010).
    """

    words: ClassVar[str] = "Matérn-3/2"
    units: ClassVar[Mapping[str, str]] = {"noise.smooth.time": "s"}

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        return {
            "noise.smooth": bounds.correlated,
            "noise.smooth.time": LogUniform(bounds.shortest, bounds.longest),
        }

    def variance(self, values, bounds):
        return values["noise.smooth"] ** 2

    def block(self, values, bounds, h):
        size, x = values["noise.smooth"], math.sqrt(3) * h / values["noise.smooth.time"]
        # f and g = f′/λ obey f′ = λ·g, g′ = −λ·f − 2λ·g and noise. Its matrix M has (M + λ)² = 0, so that over a step
        # x = λ·Δt exp(M·Δt) = e⁻ˣ·(1 + (M + λ)·Δt) ends after two terms: e⁻ˣ·[[1 + x, x], [−x, 1 − x]] = A.
        decay, z = jnp.exp(-x), 2 * x
        carry = decay[:, None, None] * pairs(1 + x, x, -x, 1 - x)
        # The process noise is 1 − A·Aᵀ, both states of variance one. Of f itself 1 − e⁻ᶻ·(1 + z + z²/2), z = 2x,
        # which is e⁻ᶻ·(z³/6 + z⁴/24 + …) where z is small;
        series = z**3 / 6 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7 * (1 + z / 8)))))
        far = -jnp.expm1(-z) - decay**2 * (z + z**2 / 2)
        fresh = jnp.where(z < REACH, decay**2 * series, far)
        # beside the diagonal 2x²·e⁻²ˣ,
        cross = decay**2 * z**2 / 2
        # and of g 1 − e⁻²ˣ·(x² + (1 − x)²).
        slope = -jnp.expm1(-z) + decay**2 * (z - z**2 / 2)
        return Block(carry, size**2 * pairs(fresh, cross, cross, slope), size**2 * jnp.eye(2))

    def spectrum(self, values, bounds, step, lam):
        arguments = self.variance(values, bounds), values["noise.smooth.time"]
        return [noise_spectrum.matern(*arguments, step, lam)]

    def allan(self, values, bounds, m, step):
        """Return c − a·∂c/∂a, c(a) the Allan variance of exp(−a·k), the slope by a complex step; over short times that
        of a ramp, of slopes of the variance λ²: (x²/2 − 7x³/15), x = λ·τ."""
        a = np.asarray(math.sqrt(3) * step / values["noise.smooth.time"], float)
        # c − a·∂c/∂a in one evaluation: c(a·(1 + i·ε)) = c + i·ε·a·∂c/∂a, and its imaginary part keeps the digits
        # that a difference of two c would lose.
        tiny = 1e-30
        turned = allan_of_exponential(m + 0j, a * (1 + 1j * tiny))
        whole, x = turned.real - turned.imag / tiny, m * a
        shape = np.where(x < SMOOTH, x**2 / 2 - 7 * x**3 / 15, whole)
        return values["noise.smooth"] ** 2 * shape


class ToneTerm(NoiseTerm):
    """A narrow line: a pair of states that turns with a frequency and forgets its phase within a time.

    Where a column z is followed the frequency is f + a·z + b·z², z from −1 to 1 over the readings of the fit. Readings
    show a line above their Nyquist frequency folded; the pair turns by as much between them.
    """

    words: ClassVar[str] = "tone"
    units: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("noise.tone.frequency", *MOVING), "Hz"),
        "noise.tone.time": "s",
    }

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        slowest, fastest = 1 / bounds.longest, 0.5 / bounds.shortest
        moving = dict.fromkeys(MOVING, Normal(0.0, fastest)) if bounds.column else {}
        return {
            "noise.tone": bounds.correlated,
            "noise.tone.frequency": LogUniform(min(slowest, 0.5 * fastest), fastest),
            "noise.tone.time": LogUniform(bounds.shortest, bounds.longest),
            **moving,
        }

    def variance(self, values, bounds):
        return values["noise.tone"] ** 2

    def _frequency(self, values: Values, bounds: Bounds, z: Any) -> Any:
        slope, bend = (values[name] if bounds.column else 0.0 for name in MOVING)
        return values["noise.tone.frequency"] + slope * z + bend * z**2

    def block(self, values, bounds, h):
        z = values[bounds.column] if bounds.column else 0.0
        # A pair of quadratures turned by 2πf·Δt that decays as an Ornstein–Uhlenbeck process: its line has the half
        # width 1/(2π·time).
        turn = 2 * math.pi * self._frequency(values, bounds, z) * h
        c, s = jnp.cos(turn), jnp.sin(turn)
        plain = exponential(values["noise.tone.time"], values["noise.tone"] ** 2, h)
        eye = jnp.eye(2)
        return Block(plain.carry * pairs(c, s, -s, c), plain.fresh * eye, plain.start * eye)

    def spectrum(self, values, bounds, step, lam):
        arguments = (values[f"noise.tone{part}"] for part in (".time", ".frequency"))
        return [noise_spectrum.tone(self.variance(values, bounds), *arguments, step, lam)]

    def allan(self, values, bounds, m, step):
        """Return the Allan variance; of a frequency that follows a column, the mean over the column's range."""
        places = np.linspace(-1, 1, 33) if bounds.column else [0.0]
        fall, curves = step / values["noise.tone.time"], []
        for z in places:
            turn = 2j * math.pi * step * self._frequency(values, bounds, z)
            curves.append(allan_of_exponential(m + 0j, fall - turn).real)
        return values["noise.tone"] ** 2 * np.mean(curves, axis=0)

    def starts(self, step, residuals, z):
        """Return values at strongest line of a spectrogram, its frequency a quadratic of the column; none if few."""
        usual = float(np.median(step[step > 0]))
        even = np.abs(step / usual - 1) < EVEN_STEPS
        within = np.convolve(even, np.ones(WINDOW - 1), "valid")[1:] == WINDOW - 1
        begins = np.arange(0, len(residuals) - WINDOW + 1, WINDOW // 2)
        rows = begins[within[begins]][:, None] + np.arange(WINDOW)
        if len(rows) < FEWEST_WINDOWS:
            return []
        window = np.hanning(WINDOW + 2)[1:-1]
        excess = _excess(residuals[rows], window, moves=z is not None)
        place = np.zeros(len(rows)) if z is None else z[rows].mean(axis=1)
        slopes = np.linspace(-1, 1, 4 * GRID + 1) if z is not None else np.zeros(1)
        count, best = FINE * WINDOW, (-math.inf, 0.0, 0.0, 0.0)
        middles = np.arange(1, count // 2)
        # Twice around the circle of frequencies, whose second half is the first one's mirror image.
        circle = np.minimum(np.hstack([excess, excess[:, -2:0:-1]] * 2), LOUDEST)
        at = middles[:, None] + circle.shape[1] * np.arange(len(rows))
        # Along a window the frequency hardly moves: its bin is that at the window's mean z.
        for a, b in itertools.product(slopes, slopes[::2] / 2):
            turns = np.rint(count * (a * place + b * place**2)).astype(int) % count
            totals = np.mean(circle.ravel()[at + turns], axis=1)
            best = max(best, (float(totals.max()), float(middles[np.argmax(totals)] / count), a, b))
        level, middle, a, b = best
        # Differences of neighbours have √2 of the standard deviation, and 0.6745 of it as median absolute value.
        noise = float(np.median(np.abs(np.diff(residuals)[even[1:]]))) / (0.6745 * math.sqrt(2))
        # A line of variance s² beside white noise w² has (Σh)²·s²/(2·w²·Σh²) times the noise's power under a window h.
        ratio = max(level - 1, 0.1) * 2 * float(np.sum(window**2) / np.sum(window) ** 2)
        share = ratio / (1 + ratio)
        start = {
            WHITE: noise * math.sqrt(1 - share),
            "noise.tone": noise * math.sqrt(share),
            "noise.tone.frequency": middle / usual,
            "noise.tone.time": WINDOW * usual,
        }
        if z is not None:
            start |= dict(zip(MOVING, (float(a) / usual, float(b) / usual), strict=True))
        return [start]


def _excess(
    residuals: Float[np.ndarray, "w r"], window: Float[np.ndarray, "r"], moves: bool
) -> Float[np.ndarray, "w f"]:
    """Return the power of windows at each frequency, relative to the usual power there, straight lines removed.

    The usual power is that of all windows at the frequency, if a line moves; else that of its neighbours.
    """
    ramp = np.vander(np.linspace(-1, 1, len(window)), 2)
    flat = residuals - residuals @ ramp @ np.linalg.pinv(ramp)
    power = np.abs(np.fft.rfft(flat * window, FINE * len(window), axis=1)) ** 2
    usual = np.median(power, axis=0) / math.log(2)  # the mean of an exponential distribution
    if not moves:
        some = [slice(max(0, k - WINDOW), k + WINDOW) for k in range(usual.size)]
        usual = np.array([np.median(usual[part]) for part in some])
    return power / usual


class ErrorsTerm(NoiseTerm):
    """Independent errors of one size, each shown by its own reading and, times `passed`, by the next.

    States: an error, and the one before, times `passed`. It takes readings as evenly spaced.
    """

    passed: ClassVar[float]

    @abc.abstractmethod
    def size(self, values: Values, bounds: Bounds) -> Any:
        """Return their standard deviation, output unit."""

    def variance(self, values, bounds):
        return 2 * self.size(values, bounds) ** 2

    def block(self, values, bounds, h):
        square, zero = self.size(values, bounds) ** 2, 0.0 * h
        carry = pairs(zero, zero, self.passed + zero, zero)
        fresh = pairs(square + zero, zero, zero, zero)
        return Block(carry, fresh, square * jnp.eye(2), observed=True)

    def spectrum(self, values, bounds, step, lam):
        return [noise_spectrum.errors(self.size(values, bounds), self.passed, lam)]


class RoundedAngleTerm(ErrorsTerm):
    """Quantisation noise of IEEE 952, Q: readings are differences of an angle that each has an error of its own."""

    words: ClassVar[str] = "quantisation"
    units: ClassVar[Mapping[str, str]] = {"noise.quantisation": "{}*s"}
    bounded: ClassVar[bool] = True
    passed: ClassVar[float] = -1.0

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        return {"noise.quantisation": multiplied(bounds.correlated, bounds.shortest)}

    def size(self, values, bounds):
        return values["noise.quantisation"] / bounds.shortest

    def allan(self, values, bounds, m, step):
        # IEEE 952: σ²(τ) = 3·Q²/τ², τ = m·step.
        return 3 * (values["noise.quantisation"] / (m * step)) ** 2


class AveragingTerm(ErrorsTerm):
    """White noise under the sensor's own low-pass, which takes into a reading a part of what the one before has shown.

    Readings are means of an error each and of the one before: neighbours are correlated, and no others. Beside white
    noise this is a moving average of any length up to two steps, with correlations of neighbours from 0 to ½. The first
    unknown is the white noise that is averaged, as a reading would have it: at low frequencies its density is the same.
    Source: G. Box and G. Jenkins, Time Series Analysis (1976), §3.3 (moving averages of first order).
    """

    words: ClassVar[str] = "averaging"
    passed: ClassVar[float] = 1.0

    def parameters(self, bounds: Bounds) -> dict[str, Any]:
        return {"noise.averaging": bounds.correlated}

    def size(self, values, bounds):
        return 0.5 * values["noise.averaging"]

    def allan(self, values, bounds, m, step):
        # A mean of m readings has (2m − 1)/2m² of s², and shares 1/4m² with the next.
        return values["noise.averaging"] ** 2 * (m - 0.75) / m**2


def allan_of_exponential(m: Float[np.ndarray, "k"], a: Any) -> Any:
    """Return the Allan variance of evenly spaced readings of unit variance and correlation exp(−a·k), k readings apart.

    With ρ = exp(−a) and a fall E = 1 − ρᵐ it is [(1 + ρ)/(1 − ρ) − ρ·E·(2 + E)/(m·(1 − ρ)²)]/m: from the variance V of
    a mean of m readings of such a sequence, as 2·V(m) − 2·V(2m). Over times short against the correlation's it is a
    random walk's, a·(2m² + 1)/(3m); IEEE 952 has the limits of continuous averages. Of a correlation that turns, a
    complex, the real part is then taken.
    """
    rho, fall, gap = np.exp(-a), -np.expm1(-m * a), -np.expm1(-a)
    stationary = ((1 + rho) / gap - rho * fall * (2 + fall) / (m * gap**2)) / m
    return np.where(np.abs(m * a) < SHORT_TIMES, a * (2 * m**2 + 1) / (3 * m), stationary)


TERMS: dict[str, type[NoiseTerm]] = {
    "correlated": CorrelatedTerm,
    "smooth": SmoothTerm,
    "walk": WalkTerm,
    "flicker": FlickerTerm,
    "tone": ToneTerm,
    "quantisation": RoundedAngleTerm,
    "averaging": AveragingTerm,
}
