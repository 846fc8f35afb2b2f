"""Stationary noise on evenly spaced readings, diagonal in frequency but for the two ends of a run.

A run has n readings, a step h apart. The orthonormal cosine transform (DCT-II) makes the path's Laplacian L diagonal,
λ = 2 − 2·cos(πk/n), k = 0 … n − 1. Let e₊ and e₋ be (e₁ ± eₙ)/√2, the ends of the run. An Ornstein–Uhlenbeck process of
variance v, with a = exp(−h/τ), has the tridiagonal precision

    K⁻¹ = c·[(1 − a)²·I + a·L] + c·a·(1 − a)·(e₊e₊ᵀ + e₋e₋ᵀ),   c = 1/(v·(1 − a²)),

so that, by Woodbury, K = N − Σ± m±·(N e±)(N e±)ᵀ with N = ν(L), ν(λ) = v·(1 − a²)/((1 − a)² + a·λ) and
1/m± = 1/(c·a·(1 − a)) + e±ᵀN e±. Every other term has this form too. A sum is Σ = D − U·M·Uᵀ with D diagonal in
frequency and a few columns U, one for each end function and sign, and

    Σ⁻¹ = D⁻¹ + D⁻¹U·(I − M·Z)⁻¹·M·UᵀD⁻¹,   Z = UᵀD⁻¹U,   |Σ| = |D|·|I − M·Z|.

All functions of λ are smooth in log λ. Parameters are arrays (s, 1): s settings at once.

Source: derived here; the precision of an autoregression of first order is in M. Kac, W. Murdock and G. Szegő, J.
Rational Mech. Anal. 2 (1953) 767.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

Lambda = Float[np.ndarray, "j"]


class SpectralTerm(NamedTuple):
    """One term of a covariance, diag(symbol) − Σ± U·M±·Uᵀ in frequency."""

    symbol: Any  # its diagonal (s, j), output unit squared
    # functions of λ (s, j) each, q of them; times the transform of e± they are the columns of U
    ends: tuple[Any, ...]
    correction: Callable[[int, int], Any]  # of a run's length and a sign, +1 or −1, M (q, q, s)


def eigenvalues(n: int, k: Float[np.ndarray, "j"]) -> Lambda:
    """Return λ = 2 − 2·cos(πk/n) of a run of n readings at places k, of which 0 … n − 1 are its frequencies."""
    return 4 * np.sin(0.5 * np.pi * k / n) ** 2


def end_transform(n: int, sign: int) -> Float[np.ndarray, "n"]:
    """Return the cosine transform of e₊ (sign 1) or e₋ (sign −1) of a run of n readings."""
    k = np.arange(n)
    first = np.sqrt(2 / n) * np.cos(0.5 * np.pi * k / n)  # of e₁; of eₙ with the sign (−1)ᵏ
    first[0] = math.sqrt(1 / n)
    return np.where(k % 2 == (0 if sign == 1 else 1), math.sqrt(2) * first, 0.0)


def exponential(variance: Any, time: Any, step: float, lam: Lambda) -> SpectralTerm:
    """Return an Ornstein–Uhlenbeck process of correlation exp(−Δt/time)."""
    x = -step / np.asarray(time)
    symbol = variance * _symbol(x, lam)
    return SpectralTerm(symbol, (symbol,), lambda n, sign: _inner(variance, x, n, sign)[None, None])


def tone(variance: Any, time: Any, frequency: Any, step: float, lam: Lambda) -> SpectralTerm:
    """Return a narrow line of correlation exp(−Δt/time)·cos(2πf·Δt): the real part of a complex exponential."""
    x = -step / np.asarray(time) + 2j * math.pi * np.asarray(frequency) * step
    symbol = variance * _symbol(x, lam)

    def correction(n: int, sign: int) -> Any:
        m = _inner(variance, x, n, sign)
        return np.array([[m.real, -m.imag], [-m.imag, -m.real]])

    return SpectralTerm(symbol.real, (symbol.real, symbol.imag), correction)


def _symbol(x: Any, lam: Lambda) -> Any:
    """Return ν(λ) of a unit variance with a = exp(x)."""
    gap = -np.expm1(x)
    return gap * (2 - gap) / (gap**2 + (1 - gap) * lam)


def _inner(variance: Any, x: Any, n: int, sign: int) -> Any:
    """Return m± of an exponential correlation with a = exp(x), (s,)."""
    a = np.exp(x)
    return np.reshape(1 / (variance * ((1 + a) / a + _end_of_exponential(x, n, sign)[0])), -1)


def matern(variance: Any, time: Any, step: float, lam: Lambda) -> SpectralTerm:
    """Return Matérn's process of order 3/2 of correlation (1 + x)·exp(−x), x = √3·Δt/time.

    (1 + x)·e⁻ˣ is e⁻ˣ − ∂e⁻ˣ/∂log r, x = r·Δt: the exponential's formulas less their slopes by log r.
    """
    x = -math.sqrt(3) * step / time
    a, gap = np.exp(x), -np.expm1(x)
    slope_of_a = x * a  # ∂a/∂log r, and of 1 − a with the other sign
    top, slope_of_top = gap * (2 - gap), -2 * a * slope_of_a
    low, slope_of_low = gap**2 + a * lam, (lam - 2 * gap) * slope_of_a
    symbol = variance * top / low
    slope = variance * (slope_of_top / low - top * slope_of_low / low**2)

    def correction(n: int, sign: int) -> Any:
        at_end, slope_at_end = _end_of_exponential(x, n, sign)
        inverse = (1 + a) / a + at_end
        m = 1 / (variance * inverse)
        slope_of_m = m * (slope_of_a / a**2 - slope_at_end) / inverse
        flat = [np.reshape(entry, -1) for entry in (m - slope_of_m, -m)]
        return np.array([[flat[0], flat[1]], [flat[1], np.zeros_like(flat[1])]])

    return SpectralTerm(symbol - slope, (symbol, slope), correction)


def _end_of_exponential(x: Any, n: int, sign: int) -> tuple[Any, Any]:
    """Return e±ᵀN e± of a unit variance with a = exp(x), in closed form by images, and its slope by log(−x)."""
    a, far = np.exp(x), np.exp((n - 1) * x)
    inside, whole = np.exp((2 * n - 1) * x), -np.expm1(2 * n * x)
    top = (1 + a) * (1 + inside) + sign * far * (1 + a) ** 2
    slope_of_top = x * (
        a * (1 + inside)
        + (1 + a) * (2 * n - 1) * inside
        + sign * far * ((n - 1) * (1 + a) ** 2 + 2 * (1 + a) * a)
    )
    slope_of_whole = -2 * n * x * (1 - whole)
    return top / whole, (slope_of_top - top * slope_of_whole / whole) / whole


def errors(size: Any, passed: float, lam: Lambda) -> SpectralTerm:
    """Return independent errors, passed on to the next reading: their differences (−1), or their sums (1).

    Differences are size²·(L + e₊e₊ᵀ + e₋e₋ᵀ), sums size²·(4·I − L − e₊e₊ᵀ − e₋e₋ᵀ).
    """
    square = np.asarray(size) ** 2
    symbol, ends = square * (4 - lam if passed > 0 else lam), passed * square.reshape(1, 1, -1)
    return SpectralTerm(symbol, (np.ones_like(lam),), lambda n, sign: ends)
