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

from bayescal._core.jit import compile_lazily
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._data import unit_conversion
from bayescal._model.frame import Frame
from bayescal._model.independent_noise import (
    CURVATURE,
    SLOPE,
    Heteroscedastic,
    White,
    scale_covariate,
)
from bayescal._model.noise_law import WHITE, Noise, Parameters, offered
from bayescal._model.noise_terms import TERMS, CorrelatedTerm, NoiseTerm
from bayescal._model.prior import HalfCauchy, Positive
from bayescal._model.state_space import States, assemble_states, draw_states, kalman_whiten, smooth
from bayescal._model.static import set_fields

# Fewest readings of the longest run that can distinguish a second correlated noise from the first.
MIN_SECOND_TERM_READINGS = 150

OFFERED_SUMS = (  # terms found in measured records (IEEE 952, and a sensor on a temperature ramp)
    ("walk",),
    ("flicker",),
    ("correlated", "correlated"),
    ("correlated", "smooth"),
)
MAX_CORRELATED_TERMS = 3  # Ornstein–Uhlenbeck: no record of a day distinguishes more


class SumOfTerms(Noise, interface=True):
    """Base class of noise laws that are sums of terms; its attributes are those of `SummedNoise`."""

    shortest: ClassVar[float]
    longest: ClassVar[float]
    terms: ClassVar[tuple[str, ...]]
    scale: ClassVar[Positive]
    correlated: ClassVar[Positive]
    column: ClassVar[str] = ""
    scatter: ClassVar[str] = ""
    first_rank: ClassVar[int] = 1  # of Ornstein–Uhlenbeck terms; 0: its parameters are not numbered

    def __post_init__(self) -> None:
        low, high = self.shortest, self.longest
        if not 0 < low < high:
            message = f"correlation times must be positive and in order, not {low} and {high}"
            raise ValueError(message)

    @property
    def parts(self) -> tuple[NoiseTerm, ...]:
        fields = self.shortest, self.longest, self.correlated, self.column
        return _build_terms(self.terms, self.first_rank, *fields)

    @property
    def white_law(self) -> White | Heteroscedastic:
        """Return the law of the independent noise to which the terms are added."""
        return Heteroscedastic(self.scatter, self.scale) if self.scatter else White(self.scale)

    @property
    def covariates(self) -> tuple[str, ...]:
        return tuple(name for name in (self.column, self.scatter) if name)

    def covariate(self, frame: Frame) -> Array | None:
        return 2 * frame.position(self.column) - 1 if self.column else None

    def starts(self, frame: Frame, residuals: np.ndarray) -> list[dict[str, float]]:
        z = self.covariate(frame)
        z = None if z is None else np.asarray(z)
        starts = [part.starts(np.asarray(frame.step), residuals, z) for part in self.parts]
        if self.scatter:
            starts.append([_estimate_scatter(frame, residuals, self.scatter)])
        return [dict(ChainMap(*combination)) for combination in itertools.product(*starts)]

    @property
    def plain(self) -> Noise:
        default_law = super().plain
        if any(part.needs_bounds for part in self.parts):
            return default_law
        return replace(default_law, shortest=1.0, longest=2.0)

    @property
    def in_words(self) -> str:
        label_counts = Counter(p.label for p in self.parts)
        name = f"white ({self.white_law.in_words})" if self.scatter else "white"
        term_texts = (f"{c} {w}" if c > 1 else w for w, c in label_counts.items())
        return self.words or " + ".join((name, *term_texts))

    def parameters(self) -> dict[str, Any]:
        priors = {n: prior for part in self.parts for n, (prior, _) in part.parameters().items()}
        return self.white_law.parameters() | priors

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE, *(next(iter(part.parameters())) for part in self.parts))

    def unit(self, name: str, output: str) -> str:
        units = {n: unit for part in self.parts for n, (_, unit) in part.parameters().items()}
        if name not in units:
            return self.white_law.unit(name, output)
        is_any_unit = output == unit_conversion.ANY and "{}" in units[name]
        return output if is_any_unit else units[name].format(output)

    def variance(self, parameters: Parameters, frame: Frame) -> Array:
        return self.white_law.variance(parameters, frame) + self.slow_variance(parameters)

    def states(self, parameters: Parameters, step: Float[Array, "n"], z: Any = None) -> States:
        """Return the state-space form over time steps, s (−1 begins a run); z: covariate scaled to −1 … 1 (n,)."""
        parameters = parameters if z is None else {**parameters, self.column: z}
        blocks = [part.block(parameters, jnp.maximum(step, 0.0)) for part in self.parts]
        return assemble_states(blocks, step)

    def whiten(self, columns: Array, extra: Any, parameters: Parameters, frame: Frame) -> Any:
        states = self.states(parameters, frame.step, self.covariate(frame))
        return kalman_whiten(states, self.white_law.variance(parameters, frame) + extra, columns)

    def sample(self, key: Array, mean: Array, parameters: Parameters, frame: Frame) -> Array:
        white_key, state_key = jax.random.split(key)
        path = draw_states(state_key, self.states(parameters, frame.step, self.covariate(frame)))
        sd = jnp.sqrt(self.white_law.variance(parameters, frame))
        return mean + sd * jax.random.normal(white_key, mean.shape) + path

    def slow_part(self, values, time, residuals, white_var, new_time, covariates=None):
        """Return the smoothed mean and variance of the correlated noise at times `new_time`, by a Kalman smoother."""
        times = np.concatenate([time, new_time])
        grid, first_index, index = np.unique(times, return_index=True, return_inverse=True)
        index, rows = np.split(index, [len(time)])
        precision, weighted_sums = np.zeros(grid.size), np.zeros((grid.size, residuals.shape[1]))
        np.add.at(precision, index, 1 / white_var)  # 0 where there is no reading
        np.add.at(weighted_sums, index, residuals / white_var[:, None])
        z = None if covariates is None else np.concatenate(covariates)[first_index]
        # Padded to powers of two, so that few programs are compiled: padding is runs of one step without a reading.
        padding = (0, 2 ** math.ceil(math.log2(grid.size)) - grid.size)
        step = np.pad(np.diff(grid, prepend=grid[0] + 1.0), padding, constant_values=-1.0)
        z = None if z is None else np.pad(z, padding)
        values = {name: np.float64(values[name]) for name in self.parameters()}
        inputs = step, z, np.pad(precision, padding), np.pad(weighted_sums, (padding, (0, 0)))
        mean, variance = _smooth(self.plain, values, *inputs)
        return np.asarray(mean)[rows], np.asarray(variance)[rows]


@compile_lazily
def _smooth(law: SumOfTerms, values, step, z, precision, weighted_residuals):
    return smooth(law.states(values, step, z), precision, weighted_residuals)


class SummedNoise(SumOfTerms):
    """White noise and further terms, each stationary and independent of the others within each run.

    Terms are, by name: "correlated" (Ornstein–Uhlenbeck; up to three, ordered by their times), "smooth" (Matérn-3/2),
    "walk" (K of IEEE 952), "flicker" (B), "tone", "quantisation" (Q), "averaging" (by the sensor itself). White noise
    is always among them. A Kalman filter whitens readings of any spacing, in time linear in their number.

        bc.SummedNoise(step, span, ("walk", "correlated"))

    Attributes:
        shortest, longest: bounds of correlation times, s: the median step and the longest run.
        terms: names of the terms added to white noise.
        scale: prior of the white noise's standard deviation, output unit.
        correlated: prior of a correlated term's standard deviation, output unit.
        column: covariate of the frequency of a tone, such as "temperature"; none if empty.
        scatter: covariate of the white noise's standard deviation, by `noise.slope` and `noise.curvature` of
            `Heteroscedastic`; none if empty.

    Raises:
        ValueError: unknown or repeated terms, quantisation together with averaging, or bounds not in order.

    Source: A. Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), ch. 3.
    """

    shortest: float
    longest: float
    terms: tuple[str, ...]
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    column: str = ""
    scatter: str = ""
    is_gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "sum"
    looks_like: ClassVar[str] = "noise that is correlated in time, over more than one time"
    independent: ClassVar[bool] = False
    refines: ClassVar[str] = "ornstein_uhlenbeck"

    def __post_init__(self) -> None:
        super().__post_init__()
        if unknown_terms := [t for t in self.terms if t not in TERMS]:
            raise ValueError(
                f"{unknown_terms[0]!r} is not a noise term; the terms are {', '.join(TERMS)}"
            )
        if self.column and "tone" not in self.terms:
            raise ValueError(f"column {self.column!r} is for a tone, but `terms` has no 'tone'")
        if {"quantisation", "averaging"} <= {*self.terms}:
            raise ValueError(
                "quantisation and averaging correlate neighbouring readings by opposite signs: give one of them"
            )
        set_fields(self, terms=tuple(sorted(self.terms, key=list(TERMS).index)))
        for name, count in Counter(self.terms).items():
            if count > (MAX_CORRELATED_TERMS if name == "correlated" else 1):
                raise ValueError(f"the noise term {name!r} occurs {count} times")

    @property
    def name(self) -> str:
        covariates = f"; {self.column}" if self.column else ""
        covariates += f"; scatter({self.scatter})" if self.scatter else ""
        return f"{self.law}({', '.join(self.terms)}{covariates})"


class OrnsteinUhlenbeck(SumOfTerms):
    """White noise plus one Ornstein–Uhlenbeck term of unknown diffusion coefficient and correlation time.

    The correlated part has the covariance (q²·τ/2)·exp(−|Δt|/τ) within a run; runs are independent. Over times far
    below τ it is a random walk of coefficient q (IEEE 952: rate random walk), and τ unidentified: hence τ is bounded.

    Attributes:
        shortest, longest: bounds of the correlation time, s; its logarithm has a uniform prior between them.
        scale: prior of the white noise's standard deviation, output unit.
        correlated: prior of the correlated part's standard deviation at τ = √(shortest·longest), output unit.

    Raises:
        ValueError: bounds not positive, or not in order.
    """

    shortest: float
    longest: float
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    terms: ClassVar[tuple[str, ...]] = ("correlated",)
    first_rank: ClassVar[int] = 0
    is_gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "ornstein_uhlenbeck"
    words: ClassVar[str] = "Ornstein–Uhlenbeck"
    looks_like: ClassVar[str] = "noise that is correlated in time"
    independent: ClassVar[bool] = False


@cache
def _build_terms(terms: tuple[str, ...], first_rank: int, *fields: Any) -> tuple[NoiseTerm, ...]:
    rank = itertools.count(first_rank)
    return tuple(
        CorrelatedTerm(*fields, next(rank)) if term == "correlated" else TERMS[term](*fields)
        for term in terms
    )


def _estimate_scatter(frame: Frame, residuals: np.ndarray, column: str) -> dict[str, float]:
    """Estimate `noise.slope` and `noise.curvature` by least squares, from log squared differences of residuals."""
    changes = np.diff(residuals)
    is_usable = (np.asarray(frame.step)[1:] >= 0) & (changes != 0)
    z = np.asarray(scale_covariate(frame, column))[1:][is_usable]
    design = np.column_stack([np.ones_like(z), 2 * z, 3 * z**2 - 1])
    _, slope, curvature = np.linalg.lstsq(design, np.log(changes[is_usable] ** 2), rcond=None)[0]
    return {SLOPE: float(slope), CURVATURE: float(curvature)}


def build_sum(
    scale: Positive,
    step: float,
    span: float,
    terms: tuple[str, ...],
    column: str = "",
    scatter: str = "",
) -> SummedNoise:
    """Build a sum of noise terms; correlation times range from `step` to `span`, s.

    The range is rounded outwards to powers of two, so that sums share compiled programs. column: covariate of a tone's
    frequency. scatter: covariate of the white noise's standard deviation.
    """
    shortest, longest = 2.0 ** math.floor(math.log2(step)), 2.0 ** math.ceil(math.log2(span))
    return SummedNoise(shortest, longest, terms, scale, scale, column, scatter)


@offered
def _offer_correlated(scale: Positive, frame: Frame) -> list[Noise]:
    """Return Ornstein–Uhlenbeck noise if there is a time column, and sums of terms if a run is long enough."""
    steps = np.asarray(frame.step)
    if not (steps > 0).any():
        return []
    step, span = float(np.median(steps[steps > 0])), float(np.max(frame.columns["elapsed"]))
    # A correlation time below a step is white noise to these readings, and one beyond the span a random walk.
    laws: list[Noise] = [OrnsteinUhlenbeck(step, max(span, 10 * step), scale, scale)]
    max_run_size = int(np.max(np.diff(np.append(np.flatnonzero(steps < 0), steps.size))))
    if max_run_size < MIN_SECOND_TERM_READINGS:
        return laws
    laws += [build_sum(scale, step, span, terms) for terms in OFFERED_SUMS]
    column = "temperature" if "temperature" in frame.columns else ""
    laws.append(build_sum(scale, step, span, ("correlated", "tone"), column))
    # Temperature is the most probable covariate of the scatter, and the only one tried in a sum.
    if column and frame.reference["temperature_high"] > frame.reference["temperature_low"]:
        laws.append(build_sum(scale, step, span, ("correlated",), scatter=column))
    return laws
