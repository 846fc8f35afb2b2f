"""Noise laws that are sums of white and correlated terms, whitened by one Kalman filter."""

from __future__ import annotations

import itertools
import math
from collections import ChainMap, Counter
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from bayescal._core.jit import compiled
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._data import unit_conversion
from bayescal._model.frame import Frame
from bayescal._model.independent_noise import (
    CURVATURE,
    SLOPE,
    followed_columns,
    place_along,
    scattered_variance,
)
from bayescal._model.noise_law import WHITE, Noise, Parameters, offered, own_variance
from bayescal._model.noise_spectrum import SpectralTerm
from bayescal._model.noise_terms import TERMS, Bounds, CorrelatedTerm, NoiseTerm
from bayescal._model.prior import HalfCauchy, Normal, Positive
from bayescal._model.state_space import States, drawn, filtered, smoothed, states_of
from bayescal._model.static import set_once

# Fewest readings of the longest run that can distinguish a second correlated noise from the first.
MIN_SECOND_TERM_READINGS = 150

OFFERED = (  # what measured records show beside white noise (IEEE 952, and a unit on a temperature ramp)
    ("walk",),
    ("flicker",),
    ("correlated", "correlated"),
    ("correlated", "smooth"),
)
LASTING = np.geomspace(0.1, 0.5, 9)  # parts of the longest run
MAX_CORRELATED_TERMS = 3  # Ornstein–Uhlenbeck: no record of a day distinguishes more


class SumOfTerms(Noise, interface=True):
    """Computations common to all sums of terms; see `SummedNoise`."""

    shortest: ClassVar[float]
    longest: ClassVar[float]
    terms: ClassVar[tuple[str, ...]]
    scale: ClassVar[Positive]
    correlated: ClassVar[Positive]
    column: ClassVar[str] = ""
    scatter: ClassVar[str] = ""

    def __post_init__(self) -> None:
        low, high = self.shortest, self.longest
        if not 0 < low < high:
            why = f"correlation times must be positive and in order, not {low} and {high}"
            raise ValueError(why)

    @property
    def parts(self) -> tuple[NoiseTerm, ...]:
        """Return its terms."""
        return _parts(self.terms)

    @property
    def bounds(self) -> Bounds:
        return Bounds(self.shortest, self.longest, self.correlated, self.column)

    @property
    def needs(self) -> tuple[str, ...]:
        columns = (self.column,) if self.column else ()
        columns += followed_columns(self.scatter) if self.scatter else ()
        return tuple(dict.fromkeys(("time", *columns)))

    @property
    def covariates(self) -> tuple[str, ...]:
        return tuple(name for name in (self.column, self.scatter) if name)

    def followed(self, frame: Frame) -> Array | None:
        return 2 * frame.position(self.column) - 1 if self.column else None

    def starts(self, frame: Frame, residuals: np.ndarray) -> list[dict[str, float]]:
        z = self.followed(frame)
        z = None if z is None else np.asarray(z)
        starts = [part.starts(np.asarray(frame.step), residuals, z) for part in self.parts]
        if self.scatter:
            starts.append([_start_of_scatter(frame, residuals, self.scatter)])
        return [dict(ChainMap(*chosen)) for chosen in itertools.product(*starts)]

    @property
    def plain(self) -> Noise:
        usual = super().plain
        if any(part.bounded for part in self.parts):
            return usual
        return replace(usual, shortest=1.0, longest=2.0)

    @property
    def in_words(self) -> str:
        counts = Counter(p.words for p in self.parts)
        white = f"white (scatter follows {self.scatter})" if self.scatter else "white"
        counted = (f"{c} {w}" if c > 1 else w for w, c in counts.items())
        return self.words or " + ".join((white, *counted))

    @property
    def stationary(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return not (self.column or self.scatter)

    def spectrum(
        self, values: Parameters, step: float, lam: Float[np.ndarray, "j"]
    ) -> list[SpectralTerm]:
        """Return its correlated terms in frequency on readings a step apart, if `stationary`; values (s, 1)."""
        return [t for p in self.parts for t in p.spectrum(values, self.bounds, step, lam)]

    def parameters(self) -> dict[str, Any]:
        priors: dict[str, Any] = {WHITE: self.scale}
        if self.scatter:
            priors |= dict.fromkeys((SLOPE, CURVATURE), Normal(0.0, 1.0))
        for part in self.parts:
            priors |= part.parameters(self.bounds)
        return priors

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE, *(next(iter(p.parameters(self.bounds))) for p in self.parts))

    def unit(self, name: str, output: str) -> str:
        if name in (SLOPE, CURVATURE):
            return "1"
        part = next((p for p in self.parts if name in p.parameters(self.bounds)), None)
        if part is None or (output == unit_conversion.ANY and name in self.amplitudes):
            return output
        return part.unit(name, output)

    def derived(self, values: Parameters) -> dict[str, Any]:
        host = {n: np.asarray(v, float) for n, v in values.items() if n in self.parameters()}
        numbers: dict[str, Any] = {}
        for part in self.parts:
            numbers |= part.derived(host, self.bounds)
        return numbers

    def slow_variance(self, values: Parameters) -> Any:
        """Return the variance of all terms except the white one, output unit squared."""
        return sum((p.variance(values, self.bounds) for p in self.parts), 0.0)

    def _own_variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
        if self.scatter:
            return scattered_variance(parameters, frame, self.scatter)
        return own_variance(parameters, frame)

    def variance(self, parameters: Parameters, frame: Frame) -> Array:
        return self._own_variance(parameters, frame) + self.slow_variance(parameters)

    @property
    def several_states(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(self.parts) > 1

    def states(self, parameters: Parameters, step: Float[Array, "n"], z: Any = None) -> States:
        """Return its states over steps, s; −1 where they begin. `z`: the column that is followed, from −1 to 1."""
        parameters = parameters if z is None else {**parameters, self.column: z}
        h = jnp.maximum(step, 0.0)
        blocks = [part.block(parameters, self.bounds, h) for part in self.parts]
        return states_of(blocks, step)

    def whiten(self, columns: Array, extra: Any, parameters: Parameters, frame: Frame) -> Any:
        states = self.states(parameters, frame.step, self.followed(frame))
        return filtered(states, self._own_variance(parameters, frame) + extra, columns)

    def sample(self, key: Array, mean: Array, parameters: Parameters, frame: Frame) -> Array:
        of_white, of_states = jax.random.split(key)
        slow = drawn(of_states, self.states(parameters, frame.step, self.followed(frame)))
        sd = jnp.sqrt(self._own_variance(parameters, frame))
        return mean + sd * jax.random.normal(of_white, mean.shape) + slow

    def allan_variance(
        self, values: Parameters, variance: Any, factors: np.ndarray, step: float
    ) -> np.ndarray:
        """Return σ²/m of white noise plus the Allan variance of each term."""
        phi = {n: np.asarray(values[n], float)[..., None] for n in self.parameters() if n in values}
        slow = np.asarray(self.slow_variance(phi), float)
        white = np.maximum(np.asarray(variance)[..., None] - slow, 0.0)
        return white / factors + sum(p.allan(phi, self.bounds, factors, step) for p in self.parts)

    def lasting_deviation(self, values: Parameters) -> float:
        factors = self.longest / self.shortest * LASTING
        phi = {n: np.float64(v) for n, v in values.items() if n in self.parameters()}
        slow = np.asarray(self.slow_variance(phi))
        return float(np.sqrt(np.max(self.allan_variance(phi, slow, factors, self.shortest))))

    def slow_part(
        self, values: Parameters, time: Any, residuals: Any, white: Any, at: Any, along: Any = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and variance by the Kalman smoother over all these times."""
        grid, first = np.unique(np.concatenate([time, at]), return_index=True)
        place = np.searchsorted(grid, time)
        weight, pull = np.zeros(grid.size), np.zeros((grid.size, residuals.shape[1]))
        np.add.at(weight, place, 1 / white)
        np.add.at(pull, place, residuals / white[:, None])
        with np.errstate(divide="ignore"):
            spread = 1 / weight  # infinite where there is no reading
        pull /= np.maximum(weight, np.finfo(float).tiny)[:, None]
        z = None if along is None else np.concatenate(along)[first]
        # Steps that pad to one of a few lengths, so that few are compiled, are runs of their own without readings.
        pad = (0, 2 ** math.ceil(math.log2(grid.size)) - grid.size)
        step = np.pad(np.diff(grid, prepend=grid[0] + 1.0), pad, constant_values=-1.0)
        spread = np.pad(spread, pad, constant_values=np.inf)
        z = None if z is None else np.pad(z, pad)
        rows = np.searchsorted(grid, at)
        values = {name: np.float64(values[name]) for name in self.parameters()}
        mean, variance = _smoothed(self.plain, values, step, z, spread, np.pad(pull, (pad, (0, 0))))
        return np.asarray(mean)[rows], np.asarray(variance)[rows]


@compiled
def _smoothed(law: SumOfTerms, values, step, z, white, columns):
    return smoothed(law.states(values, step, z), white, columns)


class SummedNoise(SumOfTerms):
    """White noise and further terms, each stationary and independent of the others within each run.

    Terms are, by name: "correlated" (Ornstein–Uhlenbeck; up to three, ordered by their times), "smooth" (Matérn-3/2),
    "walk" (K of IEEE 952), "flicker" (B), "tone", "quantisation" (Q), "averaging" (by the sensor itself). White noise
    is always among them. Readings are whitened by the Kalman filter, in time linear in their number, whatever their
    spacing.

        bc.SummedNoise(step, span, ("walk", "correlated"))

    Attributes:
        shortest, longest: the usual step and the longest run, s: what correlation times a record can tell.
        terms: which, beside white noise; none for white noise alone.
        scale: prior of the white part's standard deviation, output unit.
        correlated: prior of a correlated part's.
        column: that the frequency of a tone follows, as "temperature"; none if empty.
        scatter: a column, "elapsed" or a rate, that the white part's standard deviation follows as `Heteroscedastic`
            has it, by `noise.slope` and `noise.curvature`; none if empty.

    Raises:
        ValueError: unknown terms, one twice that is there once, quantisation beside averaging, or bounds not in order.

    Source: A. Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), ch. 3.
    """

    shortest: float
    longest: float
    terms: tuple[str, ...]
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    column: str = ""
    scatter: str = ""
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "sum"
    looks_like: ClassVar[str] = "noise that is correlated in time, over more than one time"
    independent: ClassVar[bool] = False
    refines: ClassVar[str] = "ornstein_uhlenbeck"

    def __post_init__(self) -> None:
        super().__post_init__()
        if unknown := [t for t in self.terms if t not in TERMS]:
            raise ValueError(
                f"no noise term is called {unknown[0]!r}: there are {', '.join(TERMS)}"
            )
        if self.column and "tone" not in self.terms:
            raise ValueError(f"a tone follows the column {self.column!r}, and the sum has no tone")
        if {"quantisation", "averaging"} <= {*self.terms}:
            raise ValueError(
                "quantisation and averaging correlate neighbouring readings by opposite signs: give one of them"
            )
        set_once(self, terms=tuple(sorted(self.terms, key=list(TERMS).index)))
        for name, count in Counter(self.terms).items():
            if count > (MAX_CORRELATED_TERMS if name == "correlated" else 1):
                raise ValueError(f"the noise term {name!r} is there {count} times")

    @property
    def name(self) -> str:
        along = f"; {self.column}" if self.column else ""
        along += f"; scatter({self.scatter})" if self.scatter else ""
        return f"{self.law}({', '.join(self.terms)}{along})"


class OrnsteinUhlenbeck(SumOfTerms):
    """White noise and correlated (Ornstein–Uhlenbeck) noise of unknown diffusion and time: the sum of this one term.

    The correlated part has the covariance (q²·τ/2)·exp(−|Δt|/τ) within a run; runs are independent. Readings close
    together against the time τ know only the diffusion q, the coefficient of the random walk (IEEE 952: rate random
    walk); hence τ is bounded.

    Attributes:
        shortest, longest: bounds of the correlation time, s, its logarithm uniform between; see `over_record`.
        scale: prior of the white part's standard deviation, output unit.
        correlated: prior of the correlated part's, output unit, at the geometric middle of the correlation times.

    Raises:
        ValueError: bounds not positive, or not in order.
    """

    shortest: float
    longest: float
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    terms: ClassVar[tuple[str, ...]] = ("correlated",)
    parts: ClassVar[tuple[NoiseTerm, ...]] = (CorrelatedTerm(0),)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "ornstein_uhlenbeck"
    words: ClassVar[str] = "Ornstein–Uhlenbeck"
    looks_like: ClassVar[str] = "noise that is correlated in time"
    independent: ClassVar[bool] = False


@cache
def _parts(terms: tuple[str, ...]) -> tuple[NoiseTerm, ...]:
    place = itertools.count(1)  # of Ornstein–Uhlenbeck terms, which it distinguishes
    return tuple(CorrelatedTerm(next(place)) if t == "correlated" else TERMS[t]() for t in terms)


def _start_of_scatter(frame: Frame, r: Float[np.ndarray, "n"], column: str) -> dict[str, float]:
    """Return slope and curvature of the white scatter: log squared differences of neighbours are linear in them."""
    jumps = np.diff(r)
    valid = (np.asarray(frame.step)[1:] >= 0) & (jumps != 0)
    z = np.asarray(place_along(frame, column))[1:][valid]
    design = np.column_stack([np.ones_like(z), 2 * z, 3 * z**2 - 1])
    _, slope, bend = np.linalg.lstsq(design, np.log(jumps[valid] ** 2), rcond=None)[0]
    return {SLOPE: float(slope), CURVATURE: float(bend)}


def over_record(scale: Positive, step: float, span: float) -> OrnsteinUhlenbeck:
    """Return white and correlated noise with a time that record can resolve: from its step to its longest run, s."""
    # A correlation time below a step is white noise to these readings, and one beyond the span a random walk.
    return OrnsteinUhlenbeck(step, max(span, 10 * step), scale, scale)


def over_octaves(
    scale: Positive,
    step: float,
    span: float,
    terms: tuple[str, ...],
    column: str = "",
    scatter: str = "",
) -> SummedNoise:
    """Return sum whose times a record can resolve. Bounds are whole octaves of a second: alike records share programs.

    A tone follows `column`, the white part's standard deviation `scatter`.
    """
    shortest, longest = 2.0 ** math.floor(math.log2(step)), 2.0 ** math.ceil(math.log2(span))
    return SummedNoise(shortest, longest, terms, scale, scale, column, scatter)


@offered
def _correlated(scale: Positive, frame: Frame) -> list[Noise]:
    """Offer one correlated term where there is time; sums of more where runs are long enough."""
    steps = np.asarray(frame.step)
    if not (steps > 0).any():
        return []
    step, span = float(np.median(steps[steps > 0])), float(np.max(frame.columns["elapsed"]))
    laws: list[Noise] = [over_record(scale, step, span)]
    longest = int(np.max(np.diff(np.append(np.flatnonzero(steps < 0), steps.size))))
    if longest < MIN_SECOND_TERM_READINGS:
        return laws
    laws += [over_octaves(scale, step, span, terms) for terms in OFFERED]
    column = "temperature" if "temperature" in frame.columns else ""
    laws.append(over_octaves(scale, step, span, ("correlated", "tone"), column))
    # What shakes or warms a sensor moves the temperature too: of all columns it is the one weighed with a sum.
    if column and frame.reference["temperature_high"] > frame.reference["temperature_low"]:
        laws.append(over_octaves(scale, step, span, ("correlated",), scatter=column))
    return laws
