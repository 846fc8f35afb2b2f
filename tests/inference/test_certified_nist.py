"""Regression data certified by NIST are met: 8 digits of parameters, 6 of standard deviations.

The data stand beside the checkout. Small cases of our own, whose answers are known exactly, hold
the same claims without them.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.accuracy import nist_linear, nist_nonlinear
from benchmarks.accuracy.nist import digits

PARAMETERS, DEVIATIONS = 8.0, 6.0  # digits
# Not to be met: of data without noise, standard deviations are rounding.
MEANINGLESS = ("Lanczos1", "wampler1", "wampler2")
# The hard ones; the others are slow only by their number.
FAST = ("MGH10", "MGH17", "Bennett5", "BoxBOD", "filip")


@pytest.fixture
def folder(certified_data: Path) -> Path:
    return certified_data / "nist_strd"


def some_fast(names):
    return [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in names]


# NIST's own.


@pytest.mark.parametrize("name", some_fast(nist_nonlinear.NONLINEAR))
def test_a_nonlinear_set_is_met_from_both_starts(name, folder) -> None:
    for row in nist_nonlinear.nonlinear_digits(name, folder):
        assert name in MEANINGLESS or row["converged"], row
        assert row["parameters"] >= PARAMETERS, row
        assert name in MEANINGLESS or row["sd"] >= DEVIATIONS, row


@pytest.mark.parametrize("name", some_fast(nist_linear.LINEAR))
def test_a_linear_set_is_met_through_the_public_api(name, folder) -> None:
    row = nist_linear.linear_digits(name, folder=folder)
    assert row["parameters"] >= PARAMETERS, row
    if name not in MEANINGLESS:
        assert row["converged"], row
        assert row["sd"] >= DEVIATIONS, row
        assert row["residual_sd"] >= DEVIATIONS, row


def test_all_sets_are_there(folder) -> None:
    assert len(nist_nonlinear.NONLINEAR) == 27
    assert len(nist_linear.LINEAR) == 11
    assert all(
        (folder / "nonlinear" / f"{name}.csv").is_file() for name in nist_nonlinear.NONLINEAR
    )
    assert all((folder / "linear" / f"{name}.csv").is_file() for name in nist_linear.LINEAR)


# Our own: nonlinear.


def settling(b, x):
    """A bias that settles after switch-on, beside a drift: b0 + b1·x + b2·exp(−x/b3)."""
    return b[0] + b[1] * x + b[2] * jnp.exp(-x / b[3])


def made_certain(expected, truth: np.ndarray, x: np.ndarray, size: float):
    """Readings whose least-squares fit is `truth` exactly: residuals are normal to the tangents.

    Returns:
        The readings, and the standard deviations that go with them.
    """
    jacobian = np.asarray(jax.jacfwd(lambda b: expected(b, x))(jnp.asarray(truth)))
    norm = np.linalg.norm(jacobian, axis=0)
    q, r = np.linalg.qr(jacobian / norm)
    wiggle = size * np.cos(7.3 * np.arange(x.size) ** 1.1)
    for _ in range(2):
        wiggle = wiggle - q @ (q.T @ wiggle)
    sigma = np.sqrt(wiggle @ wiggle / (x.size - truth.size))
    root = np.linalg.inv(r) / norm[:, None]
    return np.asarray(expected(jnp.asarray(truth), x)) + wiggle, sigma * np.linalg.norm(
        root, axis=1
    )


@pytest.mark.slow
def test_parameters_of_very_different_sizes_are_found_from_afar() -> None:
    truth = np.array([2500.0, 3e-5, -40.0, 900.0])
    x = np.linspace(0.0, 7200.0, 60)
    y, sd = made_certain(settling, truth, x, 0.3)
    starts = [np.array([2000.0, 1e-3, -1.0, 100.0]), np.array([1.0, 1.0, 1.0, 5000.0])]
    for fit in nist_nonlinear.fit_nonlinear(settling, (x,), y, starts):
        assert fit.converged
        assert digits(fit.parameters, truth) > 9
        assert digits(fit.sd, sd) > 8


# Our own: linear.


def exact_line(x: list[int], y: list[int], degree: int) -> tuple[list[float], list[float], float]:
    """Coefficients, standard deviations and residual standard deviation in rational arithmetic."""
    size = degree + 1
    rows = [[Fraction(v) ** k for k in range(size)] for v in x]
    normal = [[sum(r[i] * r[j] for r in rows) for j in range(size)] for i in range(size)]
    right = [sum(r[i] * v for r, v in zip(rows, y, strict=True)) for i in range(size)]
    table = [[*normal[i], right[i], *(Fraction(i == j) for j in range(size))] for i in range(size)]
    for i in range(size):  # Gauss and Jordan
        pivot = next(k for k in range(i, size) if table[k][i] != 0)
        table[i], table[pivot] = table[pivot], table[i]
        table[i] = [v / table[i][i] for v in table[i]]
        for k in range(size):
            if k != i:
                table[k] = [a - table[k][i] * b for a, b in zip(table[k], table[i], strict=True)]
    beta = [row[size] for row in table]
    left = [
        v - sum(a * b for a, b in zip(r, beta, strict=True)) for r, v in zip(rows, y, strict=True)
    ]
    variance = sum(v * v for v in left) / (len(x) - size)
    deviations = [float(variance * table[i][size + 1 + i]) ** 0.5 for i in range(size)]
    return [float(b) for b in beta], deviations, float(variance) ** 0.5


def test_a_steep_polynomial_keeps_its_digits_through_the_public_api() -> None:
    """Powers up to 5 of temperatures around 40 °C: normal equations would leave 5 digits."""
    x = list(range(30, 54))
    y = [v**5 // 100_000 - 9 * v**2 + (v * v * 7919) % 61 - 30 for v in x]
    beta, sd, residual_sd = exact_line(x, y, 5)
    fit = nist_linear.fit_linear({"x": np.array(x, float)}, np.array(y, float), tuple(range(6)))
    assert fit.converged
    assert digits(fit.parameters, beta) > PARAMETERS
    assert digits(fit.sd, sd) > DEVIATIONS
    assert digits(fit.residual_sd, residual_sd) > DEVIATIONS
