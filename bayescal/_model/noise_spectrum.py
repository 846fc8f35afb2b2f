"""Covariance of stationary noise on evenly spaced readings: diagonal in frequency, except for end corrections.

A run has n readings, a step h apart. The orthonormal cosine transform (DCT-II) diagonalises the path graph's Laplacian
L, with eigenvalues λ = 2 − 2·cos(πk/n), k = 0 … n − 1. Let e₊ and e₋ be (e₁ ± eₙ)/√2, the ends of the run. An
Ornstein–Uhlenbeck process of variance v and correlation time τ, with a = exp(−h/τ), has the tridiagonal precision

    K⁻¹ = c·[(1 − a)²·I + a·L] + c·a·(1 − a)·(e₊e₊ᵀ + e₋e₋ᵀ),   c = 1/(v·(1 − a²)),

so that, by Woodbury, K = N − Σ± m±·(N e±)(N e±)ᵀ with N = ν(L), ν(λ) = v·(1 − a²)/((1 − a)² + a·λ) and
1/m± = 1/(c·a·(1 − a)) + e±ᵀN e±. Every other term has this form too. A sum of terms has the covariance
Σ = D − U·M·Uᵀ with D diagonal in frequency and a few columns U, one for each end function and sign, and

    Σ⁻¹ = D⁻¹ + D⁻¹U·(I − M·Z)⁻¹·M·UᵀD⁻¹,   Z = UᵀD⁻¹U,   |Σ| = |D|·|I − M·Z|.

All functions of λ are smooth in log λ. Parameters are arrays (s, 1), for s sets of parameters.

Source: derived here; the precision of an autoregression of first order is in M. Kac, W. Murdock and G. Szegő, J.
Rational Mech. Anal. 2 (1953) 767.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

Eigenvalues = Float[np.ndarray, "j"]
COMPLEX_STEP = 1 + 1e-30j  # factor of an argument, whose real part it leaves unchanged


class SpectralTerm(NamedTuple):
    """Cosine transform of a noise term's covariance on a run, diag(symbol) − Σ± U·M±·Uᵀ; notation of the module."""

    symbol: Any  # Toeplitz symbol, the diagonal in frequency (s, j), output unit squared
    # q functions of λ (s, j): multiplied by the transform of e± they are the columns of U
    ends: tuple[Any, ...]
    correction: Callable[[int, int], Any]  # (run length, sign ±1) → M± (q, q, s)


def compute_eigenvalues(n: int, k: Float[np.ndarray, "j"]) -> Eigenvalues:
    """Return the Laplacian's eigenvalues λ = 2 − 2·cos(πk/n) of a run of n readings, for real frequency indices k."""
    return 4 * np.sin(0.5 * np.pi * k / n) ** 2


def transform_end(n: int, sign: int) -> Float[np.ndarray, "n"]:
    """Return the orthonormal cosine transform (DCT-II) of (e₁ + sign·eₙ)/√2, the end vector of a run of n readings."""
    k = np.arange(n)
    first = np.sqrt(2 / n) * np.cos(0.5 * np.pi * k / n)  # transform of e₁; eₙ: times (−1)ᵏ
    first[0] = math.sqrt(1 / n)
    return np.where(k % 2 == (0 if sign == 1 else 1), math.sqrt(2) * first, 0.0)


def transform_exponential(variance: Any, rate: Any, step: float, lam: Eigenvalues) -> SpectralTerm:
    """Return the transformed covariance for the correlation Re exp(−rate·Δt); a complex rate, 1/s, is a narrow line."""
    x = -np.asarray(rate) * step
    symbol = variance * _compute_symbol(x, lam)
    end_count = 2 if np.iscomplexobj(x) else 1

    def compute_correction(n: int, sign: int) -> Any:
        m = _compute_end_coefficient(variance, x, n, sign)
        return np.array([[m.real, -m.imag], [-m.imag, -m.real]])[:end_count, :end_count]

    return SpectralTerm(symbol.real, (symbol.real, symbol.imag)[:end_count], compute_correction)


def _compute_symbol(x: Any, lam: Eigenvalues) -> Any:
    """Return the Toeplitz symbol ν(λ), λ = 2 − 2·cos ω, of the unit-variance correlation aᵏ at lag k, a = exp(x)."""
    one_minus_a = -np.expm1(x)
    return one_minus_a * (2 - one_minus_a) / (one_minus_a**2 + (1 - one_minus_a) * lam)


def _compute_end_coefficient(variance: Any, x: Any, n: int, sign: int) -> Any:
    """Return the end coefficient m± (s,), as in the module's formulas, of the correlation aᵏ at lag k, a = exp(x)."""
    a, end_correlation = np.exp(x), np.exp((n - 1) * x)
    # e±ᵀN e± for v = 1, by the method of images: the sum over reflections of the run.
    images = (1 + a) * (1 + np.exp((2 * n - 1) * x)) + sign * end_correlation * (1 + a) ** 2
    end_variance = images / -np.expm1(2 * n * x)
    return np.reshape(1 / (variance * ((1 + a) / a + end_variance)), -1)


def transform_matern(variance: Any, time: Any, step: float, lam: Eigenvalues) -> SpectralTerm:
    """Return the transformed covariance of a Matérn-3/2 process: correlation (1 + x)·exp(−x), x = √3·Δt/time.

    With x = r·Δt, (1 + x)·e⁻ˣ = e⁻ˣ − ∂e⁻ˣ/∂log r: formulas of e⁻ˣ minus their complex-step derivatives ∂/∂log r.
    """
    x = -math.sqrt(3) * step / time * COMPLEX_STEP
    symbol, derivative = differentiate(variance * _compute_symbol(x, lam))

    def compute_correction(n: int, sign: int) -> Any:
        m, dm = differentiate(_compute_end_coefficient(variance, x, n, sign))
        return np.array([[m - dm, -m], [-m, np.zeros_like(m)]])

    return SpectralTerm(symbol - derivative, (symbol, derivative), compute_correction)


def differentiate(values: Any) -> tuple[Any, Any]:
    """Return f(x) and ∂f/∂log x from values f(x·COMPLEX_STEP), without the digits that a difference would lose."""
    return values.real, values.imag / COMPLEX_STEP.imag


def transform_moving_average(sd: Any, theta: float, lam: Eigenvalues) -> SpectralTerm:
    """Return the transformed covariance of a moving average eₜ + θ·eₜ₋₁, θ = ±1, of errors e of standard deviation sd.

    The covariance of differences is sd²·(L + e₊e₊ᵀ + e₋e₋ᵀ), of sums sd²·(4·I − L − e₊e₊ᵀ − e₋e₋ᵀ).
    """
    square = np.asarray(sd) ** 2
    symbol, correction = square * (4 - lam if theta > 0 else lam), theta * square.reshape(1, 1, -1)
    return SpectralTerm(symbol, (np.ones_like(lam),), lambda n, sign: correction)
