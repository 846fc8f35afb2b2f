"""Noise laws on the host: what makes readings independent and of unit variance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Integer
from scipy.special import gammaln, ndtri, stdtr

from bayescal._core.gaussian_algebra import LOG_2PI
from bayescal._core.tridiagonal import Tridiagonal
from bayescal._engine.record import Record
from bayescal._model.correlated_noise import CORRELATION_TIME, DIFFUSION, OrnsteinUhlenbeck
from bayescal._model.noise_laws import Heteroscedastic, Noise, StudentT, White
from bayescal._readings.column import UNCERTAINTY

Values = dict[str, float]
Each = Mapping[str, np.ndarray]  # φ by name, one value a draw
Batch = Mapping[str, np.ndarray | float]  # the same, where what is held may be one for all draws
BY_DRAW = (
    10  # readings a draw, from which it is faster to whiten draw by draw than reading by reading
)
LEAST_FREEDOM = 2.1  # below 2 Student's variance does not exist


class Recursion(NamedTuple):
    """What is new in each reading of correlated noise, y[i] − carry[i]·y[i−1]: correlated with its neighbours alone.

    Attributes:
        order: of the readings: that of time within runs, if it is another.
        step: s to the reading before; below zero at a run's first.
        carry: what passes from one reading to the next; 0 at a run's first.
        fresh: part of the correlated noise's variance that is new.
        white: variance of each reading's own noise.
        factor: of the covariance of what is new.
    """

    order: Integer[np.ndarray, "n"] | slice
    step: Float[np.ndarray, "n"]
    carry: Float[np.ndarray, "n"]
    fresh: Float[np.ndarray, "n"]
    white: Float[np.ndarray, "n"]
    factor: Tridiagonal

    @classmethod
    def of(cls, record: Record, white: Float[np.ndarray, "n"], variance: float, tau: float):
        """Of white noise (n,) in the readings' order, and correlated noise of a variance and a time."""
        order, step = record.in_time
        order = slice(None) if record.is_in_time else order
        white = white[order]
        carry = np.where(step < 0, 0.0, np.exp(-step / tau))
        fresh = np.where(step < 0, 1.0, -np.expm1(-2 * step / tau))
        diagonal = variance * fresh + white
        diagonal[1:] += carry[1:] ** 2 * white[:-1]
        factor = Tridiagonal.of(diagonal, -carry[1:] * white[:-1])
        return cls(order, step, carry, fresh, white, factor)


class Whitening(NamedTuple):
    """L⁻¹ of LLᵀ = Σ: a standard deviation for each reading, after a recursion where readings are correlated.

    Attributes:
        sd: of each reading given those before it, in the order of time within runs where there is a recursion.
        recursion: of correlated noise; None for independent readings.
        beyond: what a heavy-tailed law counts beside the squares of whitened residuals.
    """

    sd: Float[np.ndarray, "n"]
    recursion: Recursion | None = None
    beyond: float = 0.0

    @property
    def order(self) -> Integer[np.ndarray, "n"] | slice | None:
        """Of the rows of what is whitened; None for that of the readings."""
        return None if self.recursion is None else self.recursion.order

    @property
    def logdet(self) -> float:
        return 2.0 * float(np.sum(np.log(self.sd)))

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """L⁻¹ times a table, in the order of the readings (in that of time, where they are correlated)."""
        if self.recursion is None:
            return table / self.sd[:, None]
        if not table.shape[1]:
            return table
        table = table[self.recursion.order]
        values = np.array(table, order="F")
        values[1:] -= self.recursion.carry[1:, None] * table[:-1]
        values = self.recursion.factor.forward(values)
        values /= self.sd[:, None]
        return values


def known_variance(record: Record) -> Float[np.ndarray, "n"] | float:
    """Variance of each reading that is known beforehand; zero for all where none is."""
    columns = record.frame.columns
    return np.asarray(columns[UNCERTAINTY]) ** 2 if UNCERTAINTY in columns else 0.0


def variance_of(
    noise: Noise, values: Any, record: Record, extra: Float[np.ndarray, "n"] | float
) -> Float[np.ndarray, "... n"]:
    """Of each reading about the expected output, with the variance `extra` beside it; φ one number, or a column."""
    if isinstance(noise, (White, OrnsteinUhlenbeck, Heteroscedastic, StudentT)):
        own = _squared_scale(noise, values, record)
        if isinstance(noise, OrnsteinUhlenbeck):
            own = own + correlated_variance(values)
        elif isinstance(noise, StudentT):
            freedom = np.maximum(values["noise.freedom"], LEAST_FREEDOM)
            own = own * freedom / (freedom - 2)
    else:
        own = np.asarray(noise.variance(values, record.frame))
    total = np.asarray(own + extra)
    return np.broadcast_to(total, np.broadcast_shapes(total.shape, (record.size,)))


def _squared_scale(noise: Noise, values: Any, record: Record) -> Any:
    """Squared scale of each reading's own noise; what is known beforehand included."""
    own = values["noise.white"] ** 2
    if isinstance(noise, Heteroscedastic):
        own = own * np.exp(2 * noise.log_scale(values, record.position(noise.column)))
    return own + known_variance(record)


def correlated_variance(values: Values) -> float:
    """Variance of the correlated part."""
    return 0.5 * values[DIFFUSION] ** 2 * values[CORRELATION_TIME]


class Robust(NamedTuple):
    """The log density of readings under a heavy-tailed law, at what the expected output leaves of them.

    It is −½·(n·log 2π + logdet + squares), with the slope ψ by the expected output. As a Gaussian scale mixture a
    reading has the precision `weight` w = ψ/r; `curvature` −∂ψ/∂r is less, and negative for an outlier.
    """

    squares: float
    logdet: float
    slope: Float[np.ndarray, "n"]
    weight: Float[np.ndarray, "n"]
    curvature: Float[np.ndarray, "n"]


def robust(noise: Noise, values: Values, record: Record, left: Float[np.ndarray, "n"]) -> Robust:
    """Of Student's law; of others that are not Gaussian, as if they were, of the same variance."""
    n = len(left)
    if not isinstance(noise, StudentT):
        variance = variance_of(noise, values, record, 0.0)
        weight, squares = 1 / variance, float(np.sum(left**2 / variance))
        return Robust(squares, float(np.sum(np.log(variance))), weight * left, weight, weight)
    nu, scale = values["noise.freedom"], _squared_scale(noise, values, record)
    wide = nu * scale + left**2
    weight = (nu + 1) / wide
    norm = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(math.pi * nu * scale)
    squares = (nu + 1) * float(np.sum(np.log1p(left**2 / (nu * scale))))
    logdet = -2 * float(np.sum(np.broadcast_to(norm, n))) - n * LOG_2PI
    curvature = weight * (nu * scale - left**2) / wide
    return Robust(squares, logdet, weight * left, weight, curvature)


def normal_scores(
    noise: Noise, values: Values, record: Record, left: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """What independent readings show, as standard normal numbers if the law is right: Φ⁻¹ of their probabilities."""
    if not isinstance(noise, StudentT):
        return left / np.sqrt(variance_of(noise, values, record, 0.0))
    scale = np.sqrt(_squared_scale(noise, values, record))
    tail = np.maximum(stdtr(values["noise.freedom"], -np.abs(left) / scale), np.finfo(float).tiny)
    return -np.sign(left) * ndtri(tail)


def whitening(
    noise: Noise,
    values: Values,
    record: Record,
    extra: Float[np.ndarray, "n"] | float,
    left: Float[np.ndarray, "n"] | None = None,
) -> Whitening:
    """Of a noise law at its parameters, with the variance `extra` beside it.

    Args:
        noise: the law.
        values: φ by name.
        record: the readings.
        extra: further variance.
        left: what the expected output leaves of the readings: under a heavy-tailed law each has the precision that it
            then shows (Gaussian scale mixture). None whitens by the variance.
    """
    if isinstance(noise, StudentT) and left is not None:
        terms = robust(noise, values, record, left)
        beyond = terms.squares - float(terms.slope @ left)
        return Whitening(1 / np.sqrt(terms.weight), beyond=beyond)
    if not isinstance(noise, OrnsteinUhlenbeck):
        return Whitening(np.sqrt(variance_of(noise, values, record, extra)))
    white = np.broadcast_to(_squared_scale(noise, values, record) + extra, (record.size,))
    recursion = Recursion.of(record, white, correlated_variance(values), values[CORRELATION_TIME])
    return Whitening(np.sqrt(recursion.factor.pivots), recursion)


def gram_matrices(
    noise: OrnsteinUhlenbeck, record: Record, tables: Float[np.ndarray, "... n m"], hyper: Each
) -> tuple[Float[np.ndarray, "b m m"], Float[np.ndarray, "b"]]:
    """TᵀΣ⁻¹T and log|Σ| at each of several φ.

    Args:
        noise: the law.
        record: the readings.
        tables: T, one for each φ, or one for all.
        hyper: φ by name, one value a draw.
    """
    count = len(hyper[CORRELATION_TIME])
    found = np.empty((count, tables.shape[-1], tables.shape[-1]))
    volume = np.empty(count)
    for b, table in enumerate(np.broadcast_to(tables, (count, *tables.shape[-2:]))):
        white = whitening(noise, {k: float(v[b]) for k, v in hyper.items()}, record, 0.0)
        one = white(table)
        found[b], volume[b] = one.T @ one, white.logdet
    return found, volume


def log_densities(
    noise: Noise, record: Record, left: Float[np.ndarray, "b n"], hyper: Batch
) -> Float[np.ndarray, "b n"]:
    """Log density of each reading under independent noise, given what the expected output leaves of it."""
    columns: Any = {name: np.asarray(value)[..., None] for name, value in hyper.items()}
    if isinstance(noise, StudentT):
        nu, scale = columns["noise.freedom"], _squared_scale(noise, columns, record)
        norm = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(math.pi * nu * scale)
        return norm - 0.5 * (nu + 1) * np.log1p(left**2 / (nu * scale))
    variance = variance_of(noise, columns, record, 0.0)
    return -0.5 * (left**2 / variance + np.log(variance) + LOG_2PI)


def log_likelihood(
    noise: Noise, record: Record, left: Float[np.ndarray, "b n"], hyper: Batch
) -> Float[np.ndarray, "b"]:
    """Log density of all readings, given what the expected output leaves of them."""
    if not isinstance(noise, OrnsteinUhlenbeck):
        return np.sum(log_densities(noise, record, left, hyper), axis=1)
    (order, step), count = record.in_time, len(left)
    if len(step) > BY_DRAW * count:
        each = {name: np.broadcast_to(value, count) for name, value in hyper.items()}
        squares, volume = gram_matrices(noise, record, left[:, :, None], each)
        return -0.5 * (squares[:, 0, 0] + volume + len(step) * LOG_2PI)
    # By the Kalman filter, one reading after the other, all draws at once.
    white = {"noise.white": np.asarray(hyper["noise.white"])[..., None]}
    white = _squared_scale(noise, white, record)
    tau = np.broadcast_to(hyper[CORRELATION_TIME], count)
    size = np.broadcast_to(0.5 * np.asarray(hyper[DIFFUSION]) ** 2 * tau, count)
    white = np.ascontiguousarray(np.broadcast_to(white, left.shape)[:, order].T)
    left = np.ascontiguousarray(left[:, order].T)
    state, variance, squares, volume = np.zeros(count), size, np.zeros(count), np.zeros(count)
    for i, h in enumerate(step):
        if h < 0:
            state, variance = np.zeros(count), size
        elif h > 0:
            carry = np.exp(-h / tau)
            state, variance = carry * state, size + carry**2 * (variance - size)
        total = variance + white[i]
        new = left[i] - state
        gain = variance / total
        squares += new * new / total
        volume += np.log(total)
        state = state + gain * new
        variance = gain * white[i]
    return -0.5 * (squares + volume + len(step) * LOG_2PI)
