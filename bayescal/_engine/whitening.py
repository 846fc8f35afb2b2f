"""Whitening on the host: what makes readings independent and of unit variance, for noise that is Gaussian.

Also triangular factors of many small matrices at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpttrf, dpttrs, dtbtrs  # pyright: ignore[reportAttributeAccessIssue]

from bayescal._engine.record import Record
from bayescal._model.noise_laws import (
    CORRELATION_TIME,
    DIFFUSION,
    Noise,
    OrnsteinUhlenbeck,
    White,
)
from bayescal._readings.column import UNCERTAINTY

Values = dict[str, float]
Batch = Mapping[str, np.ndarray]  # φ by name, one value a draw
LOG_2PI = math.log(2 * math.pi)


class Whitening(NamedTuple):
    """L⁻¹ of LLᵀ = Σ: a standard deviation for each reading, after a recursion where readings hang together.

    Attributes:
        sd: of each reading given those before it, in the order of time within runs where there is a recursion.
        order: that order; None for independent readings.
        band: the unit lower factor of what is new in each reading, for LAPACK.
        carry: what passes from one reading to the next; 0 at a run's first.
    """

    sd: Float[np.ndarray, "n"]
    order: np.ndarray | None = None
    band: np.ndarray | None = None
    carry: np.ndarray | None = None

    @property
    def logdet(self) -> float:
        return 2.0 * float(np.sum(np.log(self.sd)))

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """L⁻¹ times a table, in the order of the readings (in that of time, where they hang together)."""
        if self.order is None:
            return table / self.sd[:, None]
        if not table.shape[1]:
            return table
        values = np.asfortranarray(table[self.order])
        values[1:] -= self.carry[1:, None] * values[:-1]  # pyright: ignore[reportOptionalSubscript]
        return dtbtrs(self.band, values, uplo="L", diag="U")[0] / self.sd[:, None]


def known_variance(record: Record) -> Float[np.ndarray, "n"] | float:
    """Variance of each reading that is known beforehand; zero for all where none is."""
    columns = record.frame.columns
    return np.asarray(columns[UNCERTAINTY]) ** 2 if UNCERTAINTY in columns else 0.0


def variance_of(
    noise: Noise, values: Values, record: Record, extra: Float[np.ndarray, "n"] | float
) -> Float[np.ndarray, "... n"]:
    """Of each reading about the expected output, with the variance `extra` beside it; φ one number, or a column."""
    if not isinstance(noise, (White, OrnsteinUhlenbeck)):
        own = np.asarray(noise.variance(values, record.frame))  # pyright: ignore[reportArgumentType]
    else:
        own = values["noise.white"] ** 2 + known_variance(record)
        if isinstance(noise, OrnsteinUhlenbeck):
            own = own + _wandering(values)
    total = np.asarray(own + extra)
    return np.broadcast_to(total, np.broadcast_shapes(total.shape, (record.size,)))


def _wandering(values: Values) -> float:
    """Variance of the correlated part."""
    return 0.5 * values[DIFFUSION] ** 2 * values[CORRELATION_TIME]


def whitening(
    noise: Noise, values: Values, record: Record, extra: Float[np.ndarray, "n"] | float
) -> Whitening:
    """Of a noise law at its parameters, with the variance `extra` beside it."""
    if not isinstance(noise, (White, OrnsteinUhlenbeck)):  # as if Gaussian, of the same variance
        return Whitening(np.sqrt(variance_of(noise, values, record, extra)))
    white = np.broadcast_to(
        values["noise.white"] ** 2 + known_variance(record) + extra, (record.size,)
    )
    if isinstance(noise, White):
        return Whitening(np.sqrt(white))
    order, step = record.in_time
    tau, variance = values[CORRELATION_TIME], _wandering(values)
    white = white[order]
    # What is new in a reading, y[i] − carry[i]·y[i−1], hangs together with its neighbours alone.
    carry = np.where(step < 0, 0.0, np.exp(-step / tau))
    fresh = np.where(step < 0, 1.0, -np.expm1(-2 * step / tau))  # part of the variance that is new
    diagonal = variance * fresh + white
    diagonal[1:] += carry[1:] ** 2 * white[:-1]
    pivots, below, failed = dpttrf(diagonal, -carry[1:] * white[:-1])
    if failed:
        pivots = np.full(record.size, np.nan)
    band = np.zeros((2, record.size), order="F")
    band[0], band[1, :-1] = 1.0, below
    return Whitening(np.sqrt(pivots), order, band, carry)


def gram_matrices(
    noise: OrnsteinUhlenbeck, record: Record, tables: Float[np.ndarray, "... n m"], hyper: Batch
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


def wander_given(
    values: Values,
    time: Float[np.ndarray, "n"],
    left: Float[np.ndarray, "n"],
    white: Float[np.ndarray, "n"],
    at: Float[np.ndarray, "m"],
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Mean and variance of a wander at some times of a run, given what a model leaves of its readings.

    Args:
        values: φ by name.
        time: of the readings, s.
        left: of the readings, output unit.
        white: variance of each reading's own noise.
        at: where it is asked for, s.

    Source: H. Rue and L. Held, Gaussian Markov Random Fields (2005), ch. 2: the wander's precision over sorted times
    has three diagonals.
    """
    grid = np.union1d(time, at)
    variance, step = _wandering(values), np.diff(grid) / values[CORRELATION_TIME]
    kept, fresh = np.exp(-step), -np.expm1(-2 * step)
    diagonal = np.ones(grid.size)
    diagonal[1:] = 1 / fresh
    diagonal[:-1] += kept**2 / fresh
    place, pull, diagonal = np.searchsorted(grid, time), np.zeros(grid.size), diagonal / variance
    np.add.at(diagonal, place, 1 / white)
    np.add.at(pull, place, left / white)
    pivots, below, _ = dpttrf(diagonal, -kept / fresh / variance)
    mean = dpttrs(pivots, below, pull[:, None])[0][:, 0]
    spread, beyond = 1 / pivots, 0.0
    for i in range(grid.size - 1, -1, -1):  # the diagonal of the inverse
        spread[i] += beyond
        beyond = below[i - 1] ** 2 * spread[i] if i else 0.0
    asked = np.searchsorted(grid, at)
    return mean[asked], spread[asked]


def log_likelihood(
    noise: Noise, record: Record, left: Float[np.ndarray, "b n"], hyper: Batch
) -> Float[np.ndarray, "b"]:
    """Log density of all readings, given what the expected output leaves of them."""
    known = known_variance(record)
    white = np.asarray(hyper["noise.white"])[..., None] ** 2 + known
    if not isinstance(noise, OrnsteinUhlenbeck):
        white = np.broadcast_to(white, left.shape)
        return -0.5 * np.sum(left**2 / white + np.log(white) + LOG_2PI, axis=1)
    # By the Kalman filter, one reading after the other, all draws at once.
    (order, step), count = record.in_time, len(left)
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


def factors(matrices: Float[np.ndarray, "b p p"]) -> Float[np.ndarray, "b p p"]:
    """Lower factors; NaN where there is none."""
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        pass
    found = np.full_like(matrices, np.nan)
    for one, into in zip(matrices, found, strict=True):
        try:
            into[...] = np.linalg.cholesky(one)
        except np.linalg.LinAlgError:
            continue
    return found


def solve_lower(chol: Float[np.ndarray, "b p p"], right: Float[np.ndarray, "b p"]) -> np.ndarray:
    """L⁻¹ times vectors."""
    z = np.empty_like(right)
    for i in range(right.shape[1]):
        known = np.einsum("bj,bj->b", chol[:, i, :i], z[:, :i])
        z[:, i] = (right[:, i] - known) / chol[:, i, i]
    return z


def solve_upper(chol: Float[np.ndarray, "b p p"], right: Float[np.ndarray, "b p"]) -> np.ndarray:
    """Lᵀ⁻¹ times vectors."""
    z = np.empty_like(right)
    for i in reversed(range(right.shape[1])):
        known = np.einsum("bj,bj->b", chol[:, i + 1 :, i], z[:, i + 1 :])
        z[:, i] = (right[:, i] - known) / chol[:, i, i]
    return z
