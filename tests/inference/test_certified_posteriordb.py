"""Reference posteriors are met: means within 0.05 sd, sds within 3 % and Monte-Carlo error.

Two small cases of our own have posteriors that are known without sampling.
"""

from __future__ import annotations

from math import gamma
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from benchmarks.accuracy import posteriordb

SHIFT, RATIO = 0.05, 0.03
# The others are slow only by their number.
FAST = (posteriordb.SCHOOLS,)


@pytest.fixture
def folder(certified_data: Path) -> Path:
    return certified_data / "posteriordb"


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in posteriordb.PROBLEMS],
)
def test_a_reference_posterior_is_met(name, folder) -> None:
    fit, rows = posteriordb.compare(name, folder)
    assert fit.verdict.ok
    for row in rows:
        assert abs(row.shift) < SHIFT, row
        assert abs(row.ratio - 1) < row.ratio_allowed, row


def test_every_reference_posterior_that_is_there_is_compared(folder) -> None:
    assert {p.name for p in folder.iterdir() if p.is_dir()} == set(posteriordb.PROBLEMS)


# Our own.


def met(problem: posteriordb.Problem, known: dict[str, tuple[float, float]]) -> None:
    """Means and standard deviations of a fit by `Marginal` are those known."""
    fit = bc.fit(problem.model, problem.readings, posteriordb.METHOD)
    draws = problem.draws(fit)
    assert set(draws) == set(known)
    for name, (mean, sd) in known.items():
        allowed = RATIO + 3 * posteriordb.sd_error(draws[name])
        assert abs(draws[name].mean() - mean) < SHIFT * sd, name
        assert abs(draws[name].std(ddof=1) / sd - 1) < allowed, name


def schools_by_quadrature(y: np.ndarray, sigma: np.ndarray, centre_sd: float, spread: float):
    """Mean and sd of every unknown of the schools' model: µ and θ in closed form given τ, τ on a
    grid that is even in the distribution function of its half-Cauchy prior."""
    tau = spread * np.tan(np.pi / 2 * (np.arange(20_000) + 0.5) / 20_000)
    variance = sigma**2 + tau[:, None] ** 2
    precision = 1 / centre_sd**2 + np.sum(1 / variance, axis=1)
    mu = np.sum(y / variance, axis=1) / precision
    log_weight = 0.5 * (
        mu**2 * precision - np.sum(y**2 / variance + np.log(variance), axis=1) - np.log(precision)
    )
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()

    def moments(mean, own_variance):
        centre = weight @ mean
        return centre, float(np.sqrt(weight @ (own_variance + mean**2) - centre**2))

    known = {"mu": moments(mu, 1 / precision), "tau": moments(tau, 0 * tau)}
    for j in range(len(y)):
        share = tau**2 / variance[:, j]
        mean = share * y[j] + (1 - share) * mu
        known[f"theta[{j + 1}]"] = moments(
            mean, share * sigma[j] ** 2 + (1 - share) ** 2 / precision
        )
    return known


def test_groups_of_known_uncertainty_are_pooled_as_by_quadrature() -> None:
    y = np.array([21.0, 3.0, -8.0, 11.0, 0.5, 6.0, 17.0, -4.0])
    sigma = np.array([6.0, 9.0, 7.0, 12.0, 5.0, 8.0, 10.0, 15.0])
    met(posteriordb.schools(y, sigma), schools_by_quadrature(y, sigma, 5.0, 5.0))


def test_a_regression_with_flat_priors_is_the_student_t_of_the_textbook() -> None:
    """Flat β and σ: β is Student-t about least squares, with n − p − 1 degrees of freedom."""
    x = np.linspace(20.0, 80.0, 25)
    y = 3.0 + 0.04 * x + 0.2 * np.cos(2.4 * np.arange(25))
    matrix = np.column_stack([np.ones_like(x), x])
    beta, squares, *_ = np.linalg.lstsq(matrix, y, rcond=None)
    freedom = len(y) - 2 - 1
    sd = np.sqrt(float(squares[0]) / (freedom - 2) * np.diag(np.linalg.inv(matrix.T @ matrix)))
    problem = posteriordb.regression(
        y, {"one": np.ones_like(x), "x": x}, [bc.Flat()] * 2, bc.Flat(), ["a", "b", "sigma"]
    )
    # σ² is scaled inverse χ² with the same degrees of freedom.
    root = np.sqrt(float(squares[0]) / 2)
    mean = root * gamma((freedom - 1) / 2) / gamma(freedom / 2)
    spread = np.sqrt(float(squares[0]) / (freedom - 2) - mean**2)
    met(problem, {"a": (beta[0], sd[0]), "b": (beta[1], sd[1]), "sigma": (mean, spread)})
