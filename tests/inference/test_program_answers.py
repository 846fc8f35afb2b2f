"""The answers to NumPyro programs are right: against closed forms, quadrature and NumPyro's own sampler."""

# What numpyro.sample returns is an array to its users, and a union of types to pyright.
# pyright: reportOperatorIssue=false, reportIndexIssue=false, reportArgumentType=false

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

import bayescal as bc
from bayescal._numpyro.program_fit import ProgramFit
from tests.support.made_up.programs import AT, LINE, SCHOOLS, eight_schools, line, traced


def varying(x, group, y):
    """Intercepts and slopes that vary, correlated, from group to group."""
    mean = numpyro.sample("mean", dist.MultivariateNormal(jnp.zeros(2), 4.0 * jnp.eye(2)))
    spread = numpyro.sample("spread", dist.HalfNormal(1.0).expand([2]).to_event(1))
    turn = numpyro.sample("turn", dist.LKJCholesky(2, 2.0))
    sigma = numpyro.sample("sigma", dist.HalfNormal(1.0))
    with numpyro.plate("group", int(group.max()) + 1):
        own = numpyro.sample(
            "own", dist.MultivariateNormal(mean, scale_tril=spread[:, None] * turn)
        )
    with numpyro.plate("reading", len(y)):
        expected = own[group, 0] + own[group, 1] * x
        numpyro.sample("y", dist.Normal(expected, sigma), obs=y)


def decay(t, y):
    """Linear in size and floor, not in the rate."""
    size = numpyro.sample("size", dist.Normal(0.0, 5.0))
    floor = numpyro.sample("floor", dist.Normal(0.0, 5.0))
    rate = numpyro.sample("rate", dist.Normal(1.0, 0.5))
    sigma = numpyro.sample("sigma", dist.HalfNormal(1.0))
    numpyro.sample("y", dist.Normal(floor + size * jnp.exp(-rate * t), sigma), obs=y)


def counts(x, n):
    a = numpyro.sample("a", dist.Normal(0.0, 2.0))
    b = numpyro.sample("b", dist.Normal(0.0, 2.0))
    numpyro.sample("n", dist.Poisson(jnp.exp(a + b * x)), obs=n)


def assert_moments(fit: ProgramFit, name: str, mean, sd) -> None:
    """Within five standard errors of independent draws."""
    draws = fit.samples(name)
    error = sd / np.sqrt(len(draws))
    assert np.all(np.abs(draws.mean(axis=0) - mean) < 5 * error), name
    assert np.all(np.abs(draws.std(axis=0) / sd - 1) < 5 / np.sqrt(len(draws))), name


def log_gaussian(y, cov) -> float:
    """Log density at y of a Gaussian about zero."""
    _, logdet = np.linalg.slogdet(2 * np.pi * cov)
    return -0.5 * (logdet + y @ np.linalg.solve(cov, y))


def test_a_gaussian_program_is_solved_in_closed_form() -> None:
    fit = bc.fit(line, {**LINE, "noise": 0.3}, seed=1)
    design = np.column_stack([np.ones(AT.size), AT])
    precision = design.T @ design / 0.09 + np.eye(2) / 4.0
    mean = np.linalg.solve(precision, design.T @ LINE["y"] / 0.09)
    cov = np.linalg.inv(precision)
    assert_moments(fit, "b", mean, np.sqrt(np.diag(cov)))
    assert_moments(fit, "at_one", mean.sum(), np.sqrt(cov.sum()))
    whole = 0.09 * np.eye(AT.size) + 4.0 * design @ design.T
    evidence = log_gaussian(LINE["y"], whole)
    assert fit.log_evidence is not None
    assert fit.log_evidence[0] == pytest.approx(evidence, abs=1e-9)
    assert fit.verdict.sampler == "independent draws"
    assert fit.marginalised == ("b",)


@pytest.fixture(scope="module")
def schools() -> ProgramFit:
    traced.clear()
    return bc.fit(eight_schools, SCHOOLS, seed=1)


def test_eight_schools_against_quadrature(schools: ProgramFit) -> None:
    y, sigma = SCHOOLS["y"], SCHOOLS["sigma"]
    log_tau = np.linspace(-15.0, 8.0, 4001)
    tau = np.exp(log_tau)
    value, of_mu = np.empty(tau.size), np.empty((tau.size, 2))
    for i, t in enumerate(tau):
        cov = np.diag(sigma**2 + t**2)
        value[i] = log_gaussian(y, cov + 25.0)
        precision = 1 / 25.0 + np.sum(1 / np.diag(cov))
        of_mu[i] = np.sum(y / np.diag(cov)) / precision, 1 / precision
    value += np.log(2 / (5 * np.pi * (1 + (tau / 5) ** 2))) + log_tau
    evidence = logsumexp(value) + np.log(log_tau[1] - log_tau[0])
    weight = np.exp(value - logsumexp(value))
    mu = weight @ of_mu[:, 0]
    sd = np.sqrt(weight @ (of_mu[:, 1] + of_mu[:, 0] ** 2) - mu**2)
    assert_moments(schools, "mu", mu, sd)
    for low in (0.5, 2.0, 5.0, 10.0):  # the distribution function of tau
        p, draws = weight[tau < low].sum(), schools.samples("tau")
        assert abs(np.mean(draws < low) - p) < 5 * np.sqrt(p * (1 - p) / len(draws))
    assert schools.log_evidence is not None
    value, error = schools.log_evidence
    assert error is not None
    assert abs(value - evidence) < 5 * error < 0.1


def test_what_a_fit_says_and_holds(schools: ProgramFit) -> None:
    assert schools.verdict.ok and schools.verdict.sampler == "importance sampling"
    assert "Integrated out in closed form: mu, theta." in str(schools)
    assert schools.marginalised == ("mu", "theta")
    assert schools.sampled == ("tau",)
    assert schools.samples("theta").shape[1:] == (8,)
    assert schools.tree["posterior"]["theta"].dims == ("chain", "draw", "school")
    assert np.array_equal(schools.tree["observed_data"]["y"], SCHOOLS["y"])
    with pytest.raises(bc.InputError, match=r"'eight_schools' is called 'eta'; there are: mu, tau"):
        schools.samples("eta")


def test_a_program_is_traced_a_bounded_number_of_times(schools: ProgramFit) -> None:
    assert 0 < len(traced) < 50


@pytest.mark.slow
def test_a_line_with_unknown_noise_against_quadrature() -> None:
    fit = bc.fit(line, LINE, seed=1)
    design = np.column_stack([np.ones(AT.size), AT])
    log_sigma = np.linspace(-4.0, 2.0, 1201)
    value = np.empty(log_sigma.size)
    means, variances = np.empty((log_sigma.size, 2)), np.empty((log_sigma.size, 2))
    for i, s in enumerate(np.exp(log_sigma)):
        whole = s**2 * np.eye(AT.size) + 4.0 * design @ design.T
        value[i] = log_gaussian(LINE["y"], whole)
        cov = np.linalg.inv(design.T @ design / s**2 + np.eye(2) / 4.0)
        means[i], variances[i] = cov @ design.T @ LINE["y"] / s**2, np.diag(cov)
    value += np.log(2) + norm.logpdf(np.exp(log_sigma)) + log_sigma
    weight = np.exp(value - logsumexp(value))
    mean = weight @ means
    assert_moments(fit, "b", mean, np.sqrt(weight @ (variances + means**2) - mean**2))
    assert fit.log_evidence is not None
    evidence = logsumexp(value) + np.log(log_sigma[1] - log_sigma[0])
    assert fit.log_evidence[0] == pytest.approx(evidence, abs=0.05)


def test_a_likelihood_that_is_not_gaussian_goes_to_nuts() -> None:
    x = np.linspace(-1.0, 1.0, 12)
    n = np.random.default_rng(3).poisson(np.exp(1.0 + 0.5 * x))
    fit = bc.fit(counts, (x, n), bc.Marginal(draws=1200), seed=1)
    assert fit.verdict.sampler == "NUTS"
    assert fit.marginalised == () and fit.sampled == ("a", "b")
    assert fit.log_evidence is None
    assert "'a' is sampled: 'n' (Poisson) depends on it and is not Gaussian." in fit.verdict.notes
    assert "NumPyro's NUTS on every unknown." in str(fit.verdict)
    a, b = np.meshgrid(np.linspace(-1, 3, 400), np.linspace(-2, 3, 400), indexing="ij")
    rate = np.exp(a[..., None] + b[..., None] * x)
    value = np.sum(n * np.log(rate) - rate, axis=2) - (a**2 + b**2) / 8
    weight = np.exp(value - value.max()) / np.exp(value - value.max()).sum()
    mean = np.sum(weight * a)
    sd = np.sqrt(np.sum(weight * a**2) - mean**2)
    assert fit.verdict.ess is not None
    assert abs(fit.samples("a").mean() - mean) < 5 * sd / np.sqrt(fit.verdict.ess)


@pytest.mark.slow
@pytest.mark.parametrize("model", [varying, decay])
def test_agrees_with_numpyro(model) -> None:
    random = np.random.default_rng(5)
    if model is varying:
        group = np.repeat(np.arange(12), 8)
        x = random.standard_normal(group.size)
        own = np.array([1.0, -0.5]) + random.standard_normal((12, 2)) * [0.8, 0.3]
        y = own[group, 0] + own[group, 1] * x + 0.4 * random.standard_normal(group.size)
        readings = {"x": x, "group": group, "y": y}
    else:
        t = np.linspace(0.0, 4.0, 25)
        y = 0.3 + 2.0 * np.exp(-1.2 * t) + 0.1 * random.standard_normal(t.size)
        readings = {"t": t, "y": y}
    ours = bc.fit(model, readings, seed=1)
    assert ours.marginalised == (("mean", "own") if model is varying else ("size", "floor"))
    theirs = bc.fit(model, readings, bc.NUTS(draws=2000), seed=1)
    assert theirs.marginalised == ()
    ess = [f.verdict.ess for f in (ours, theirs)]
    assert ess[0] is not None and ess[1] is not None
    error = np.sqrt(1 / len(ours.samples("sigma")) + 1 / ess[1])
    for name in (*ours.marginalised, *ours.sampled):
        a, b = ours.samples(name), theirs.samples(name)
        sd = b.std(axis=0)
        assert np.all(np.abs(a.mean(axis=0) - b.mean(axis=0)) <= 5 * error * sd + 1e-12), name
        assert np.all(np.abs(a.std(axis=0) - sd) <= 6 * error * sd + 1e-12), name


@pytest.mark.slow
def test_a_kink_that_no_point_met_is_found_by_the_draws() -> None:
    """The location bends at 40 prior standard deviations, which is where the reading lies."""

    def far(y):
        a = numpyro.sample("a", dist.Normal(0.0, 1.0))
        numpyro.sample("y", dist.Normal(jnp.where(a > 40.0, 40.0 + 3 * (a - 40.0), a), 0.1), obs=y)

    fit = bc.fit(far, (np.array(40.4),), seed=1, strict=False)
    assert fit.verdict.sampler == "NUTS"
    assert "not where the readings point to" in str(fit.verdict)
