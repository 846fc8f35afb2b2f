"""A composed model: its Jacobian is the derivative of its mean, and three forms of it have one density."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import bayescal as bc
from bayescal import effects
from bayescal._inference.density import Density
from bayescal._inference.nuts import program
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model import forward
from bayescal_models.mems_gyro import INSTRUMENT
from bayescal_models.mems_gyro.model import THERMOMETER
from tests.support.made_up.rich_gyro import RICH, bound, readings

GAUSSIAN = {
    "line": INSTRUMENT.baseline(),
    "runs": INSTRUMENT.baseline() + "bias.run",
    "thermometer": INSTRUMENT.baseline().fix({"bias.temperature": 0.05}) + THERMOMETER,
    "lag and drift": INSTRUMENT.baseline() + ["bias.thermal_lag", "bias.drift"],
    "nothing unknown": INSTRUMENT.baseline().fix({"bias.constant": 1.0, "bias.temperature": 0.05}),
}


@pytest.mark.parametrize("known", [False, True], ids=["one variance", "known uncertainties"])
@pytest.mark.parametrize("model", GAUSSIAN.values(), ids=GAUSSIAN)
def test_closed_form_is_the_multivariate_normal(model, known) -> None:
    more: dict[str, Any] = (
        {"output_uncertainty": np.random.default_rng(9).uniform(0.1, 0.5, 14)} if known else {}
    )
    b = bound(model, readings(**more))
    problem, v = on_record(b), np.asarray(b.v)
    density = Density(problem, np.asarray(b.x), np.ones(b.layout.size), v)
    total, found = density.at(v)
    assert found is not None
    prior = problem.prior(problem.hyper(v), density.flat)

    line = forward.linearise(b.layout, b.frame, b.x, b.hyper)
    J, D = np.asarray(line.jacobian), np.diag(np.asarray(prior.sd) ** 2)
    noise = b.layout.model.noise.variance(b.hyper, b.frame)
    S = np.diag(noise + jnp.sum((line.inputs * width_of_inputs(b.layout)) ** 2, axis=1))
    centre = line.mean + J @ (prior.mean - b.x)
    V = S + J @ D @ J.T
    normal = multivariate_normal(np.asarray(centre), V)  # pyright: ignore[reportArgumentType]
    direct = normal.logpdf(np.asarray(b.y))  # pyright: ignore[reportAttributeAccessIssue]
    assert total - problem.log_prior(v) == pytest.approx(direct, rel=1e-8, abs=1e-6)
    gain = D @ J.T @ np.linalg.inv(V)
    mean = prior.mean + gain @ (b.y - centre)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(
        found.covariance, D - gain @ J @ D, atol=1e-8 * max(1.0, D.max(initial=0))
    )


def width_of_inputs(layout) -> np.ndarray:
    return np.array([block.coefficient.size for block in layout.blocks if block.place == "input"])


def on_record(b) -> Problem:
    return Problem(b.layout, Record(b.layout.model.instrument, b.frame, np.asarray(b.y)))


def test_flat_coefficients_are_integrated_over_the_whole_line() -> None:
    flat = bc.Model(
        INSTRUMENT,
        (
            effects.constant("bias", None, "deg/s", source="none"),
            INSTRUMENT.effect("bias.temperature"),
        ),
        bc.White(),
    )
    b = bound(flat, readings())
    sigma, sd = (
        b.hyper["noise.white"],
        INSTRUMENT.effect("bias.temperature").coefficients[0].size,
    )
    problem, v = on_record(b), np.asarray(b.v)
    found = [Density(problem, np.asarray(b.x), np.full(2, scale), v).at(v) for scale in (1.0, 30.0)]
    values = [total - problem.log_prior(v) for total, _ in found]
    # The same, whatever the scale of the flat column …
    assert values[0] == pytest.approx(values[1], abs=1e-8)
    one, other = (given for _, given in found)
    assert one is not None and other is not None
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-7)
    # … and ∫ N(y; a·1, V) da is N(y; â·1, V) times √(2π/1ᵀV⁻¹1).
    t, y = np.asarray(b.frame.centred()), np.asarray(b.y - b.frame["rate_input"])
    V = sigma**2 * np.eye(14) + sd**2 * np.outer(t, t)
    one = np.linalg.solve(V, np.ones(14))
    direct = multivariate_normal(np.full(14, one @ y / one.sum()), V).logpdf(y)
    direct += 0.5 * np.log(2 * np.pi / one.sum())
    assert values[0] == pytest.approx(direct, abs=1e-7)


@pytest.mark.parametrize(
    "promoted", [(), ("bias.temperature", "scale.constant")], ids=["x", "promoted"]
)
def test_jacobian_is_the_derivative_of_the_mean(promoted) -> None:
    b = bound(RICH, readings())
    layout = b.layout.promote(*promoted)
    rng = np.random.default_rng(1)
    v = jnp.asarray(rng.normal(0.0, 0.5, len(layout.hypers)))
    hyper = forward.hyper_values(layout, v)
    x = forward.prior_sd(layout, hyper) * rng.normal(size=layout.size)

    def mean(x, error):
        there = b.frame.with_column("temperature", b.frame["temperature"] + error)
        return forward.mean(layout, there, x, hyper)

    none = jnp.zeros(b.frame.size)
    line = eqx.filter_jit(forward.linearise)(layout, b.frame, x, hyper)
    by_x, by_error = jax.jit(jax.jacfwd(mean, argnums=(0, 1)))(x, none)
    np.testing.assert_allclose(line.mean, mean(x, none), rtol=1e-13)
    width = np.abs(by_x).max(axis=0)
    np.testing.assert_allclose(line.jacobian / width, by_x / width, rtol=1e-11, atol=1e-12)
    # A thermometer error moves its own reading and no other, so that one number a reading says all.
    np.testing.assert_allclose(np.diag(line.inputs[:, 0]), by_error, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    "model",
    [
        RICH,
        pytest.param(
            RICH.with_noise(bc.StudentT()).fix(
                {"bias.thermal_lag.tau": 200.0, "bias.constant": 3.0}
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["white", "student, some fixed"],
)
def test_numpyro_program_has_the_same_density(model) -> None:
    from numpyro.infer.util import log_density

    b = bound(model, readings())
    rng = np.random.default_rng(4)
    differences = []
    for _ in range(4):
        v = jnp.asarray(rng.normal(0.0, 0.7, len(b.layout.hypers)))
        hyper = forward.hyper_values(b.layout, v)
        sites = {h.name: hyper[h.name] for h in b.layout.hypers}
        x, ours = [], forward.hyper_log_prior(b.layout, v)
        for i, h in enumerate(b.layout.hypers):
            ours -= jnp.log(
                jax.grad(h.prior.value)(v[i])
            )  # density in the value, not in its coordinate
        for block in b.layout.x_blocks:
            z = jnp.asarray(rng.normal(size=block.size))
            c = block.coefficient
            spread = hyper[block.group_sd_name] if c.group_sd is not None else c.size
            sites[f"{block.name}.standard"] = z
            x.append(c.mean + spread * z)
            ours += block.size * jnp.log(spread)  # likewise: x is written in units of its spread
        x = jnp.concatenate(x)
        ours += forward.log_prior_x(b.layout, x, hyper)
        ours += jnp.sum(forward.log_likelihood(b.layout, b.frame, b.y, x, hyper))
        theirs, trace = log_density(program(b.layout, b.frame), (b.y,), {}, sites)
        np.testing.assert_allclose(trace["x"]["value"], x, rtol=1e-12)
        np.testing.assert_allclose(trace["v"]["value"], v, rtol=1e-9, atol=1e-12)
        differences.append(float(theirs - ours))
    np.testing.assert_allclose(differences, 0.0, atol=1e-7)
