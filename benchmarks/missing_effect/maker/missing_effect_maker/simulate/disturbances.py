"""Noise laws with their covariances, and disturbances of a record that no candidate describes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from missing_effect.draws import Array, Draws
from scipy.signal import lfilter


class Noise(NamedTuple):
    """Noise of a record: values and covariance, relative to a white standard deviation of 1.

    Attributes:
        law: name of the law.
        values: (n,).
        covariance: (n, n); (n,) if diagonal.
    """

    law: str
    values: Array
    covariance: Array


def white(draws: Draws, count: int) -> Noise:
    return Noise("white", draws.normal(count), np.ones(count))


def student(draws: Draws, count: int) -> Noise:
    """Draw Student-t noise of four degrees of freedom and unit standard deviation; its covariance is white noise's."""
    first, second = draws.uniform(count), draws.uniform(count)
    chi_squared = -2 * np.log(first * second)  # of four degrees of freedom
    return Noise(
        "student", draws.normal(count) / np.sqrt(chi_squared / 4) / np.sqrt(2), np.ones(count)
    )


def correlated(draws: Draws, count: int) -> Noise:
    """Draw white plus Ornstein–Uhlenbeck noise of similar size, correlated over 5 to 30 readings."""
    size, tau = draws.between(0.5, 1.0), draws.ratio(5.0, 30.0)
    slow = size * _ornstein_uhlenbeck(draws, count, tau)
    spacing = _spacing(count)
    covariance = 0.6 * np.eye(count) + size**2 * np.exp(-spacing / tau)
    return Noise("correlated", np.sqrt(0.6) * draws.normal(count) + slow, covariance)


def walk(draws: Draws, count: int) -> Noise:
    """Draw white noise plus a random walk with steps of standard deviation 0.03 to 0.15 per reading."""
    step = draws.ratio(0.03, 0.15)
    at = np.arange(1, count + 1)
    covariance = np.eye(count) + step**2 * np.minimum(at[:, None], at[None, :])
    return Noise("walk", draws.normal(count) + step * np.cumsum(draws.normal(count)), covariance)


def flicker(draws: Draws, count: int) -> Noise:
    """Draw white noise plus 1/f noise, a sum of Ornstein–Uhlenbeck processes an octave apart."""
    size, spacing = draws.between(0.15, 0.35), _spacing(count)
    values, covariance = draws.normal(count), np.eye(count)
    for octave in range(1, 9):
        values = values + size * _ornstein_uhlenbeck(draws, count, 2.0**octave)
        covariance = covariance + size**2 * np.exp(-spacing / 2.0**octave)
    return Noise("flicker", values, covariance)


def tones(draws: Draws, count: int) -> Noise:
    """Draw white noise plus one or two tones with periods of 4 to 25 readings, as of a pump or an aliased supply."""
    values, covariance, at = draws.normal(count), np.eye(count), np.arange(count)
    for _ in range(draws.one_of((1, 2))):
        size, turn, phase = draws.between(0.4, 1.2), draws.ratio(4.0, 25.0), draws.between(0, 1)
        values = values + size * np.cos(2 * np.pi * (at / turn + phase))
        covariance = covariance + size**2 / 2 * np.cos(2 * np.pi * _spacing(count) / turn)
    return Noise("tones", values, covariance)


NOT_WHITE = (correlated, student, walk, flicker, tones)


def smooth(draws: Draws, time: Array, temperature: Array) -> Array:
    """Draw the response to a resonance that the temperature passes through."""
    middle = draws.between(0.25, 0.75)
    at = (temperature - temperature.min()) / np.ptp(temperature) - middle
    return at / (0.006 + at**2)


def step(draws: Draws, time: Array, temperature: Array) -> Array:
    """Draw a step at a random time: a mount slips."""
    at = np.quantile(time, draws.between(0.2, 0.6))
    return np.where(time > at, 1.0, -1.0)


def tone(draws: Draws, time: Array, temperature: Array) -> Array:
    """Draw a slow sinusoidal pick-up with four to twelve periods in the record."""
    turns, phase = draws.between(4.0, 12.0), draws.between(0.0, 1.0)
    return np.sin(2 * np.pi * (turns * (time - time[0]) / np.ptp(time) + phase))


def shock(draws: Draws, time: Array, temperature: Array) -> Array:
    """Draw a shock, after which the mount creeps back within a twentieth of the record's readings."""
    since = np.arange(time.size) / time.size - draws.between(0.1, 0.6)
    return np.where(since > 0, np.exp(-np.maximum(since, 0.0) / 0.05), 0.0)


OUTSIDE: tuple[Callable[[Draws, Array, Array], Array], ...] = (smooth, step, tone, shock)


def _ornstein_uhlenbeck(draws: Draws, count: int, tau: float) -> Array:
    """Draw Ornstein–Uhlenbeck noise of unit variance, correlated over tau readings."""
    decay = np.exp(-1.0 / tau)
    kicks = draws.normal(count)
    kicks[1:] *= np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], kicks))


def _spacing(count: int) -> Array:
    at = np.arange(count)
    return np.abs(at[:, None] - at[None, :])
