"""The closed form of a composed model is the integral of its density."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import bayescal as bc
from bayescal import effects
from bayescal._inference import block_elimination, gaussian, laplace
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from bayescal_models import ng_accelerometer
from bayescal_models.mems_gyro import INSTRUMENT
from bayescal_models.mems_gyro.effects import THERMOMETER
from tests.support.made_up.rich_gyro import bound, readings

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
    point = gaussian.Point(b.x, b.rows)
    prior = gaussian.prior_of(b.layout, b.hyper, jnp.ones(b.layout.size))
    gram = gaussian.gram_function(b.layout, b.frame, b.y, point)(b.hyper, b.v)
    found = gaussian.condition(gram, b.frame.size, prior, b.x)

    line = forward.linearise(b.layout, b.frame, b.x, b.rows, b.hyper)
    J, D = np.asarray(line.jacobian), np.diag(np.asarray(prior.sd) ** 2)
    noise = b.layout.model.noise.variance(b.hyper, b.frame)
    S = np.diag(noise + jnp.sum((line.rows * forward.row_sd(b.layout)) ** 2, axis=1))
    centre = line.mean - jnp.sum(line.rows * b.rows, axis=1) + J @ (prior.mean - b.x)
    V = S + J @ D @ J.T
    normal = multivariate_normal(np.asarray(centre), V)  # pyright: ignore[reportArgumentType]
    direct = normal.logpdf(np.asarray(b.y))  # pyright: ignore[reportAttributeAccessIssue]
    assert float(found.log_marginal) == pytest.approx(direct, rel=1e-9, abs=1e-7)
    gain = D @ J.T @ np.linalg.inv(V)
    mean = prior.mean + gain @ (b.y - centre)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(
        found.covariance, D - gain @ J @ D, atol=1e-8 * max(1.0, D.max(initial=0))
    )


@pytest.mark.slow
def test_members_eliminated_first_and_products_between_nodes_change_nothing() -> None:
    readings = ng_accelerometer.simulate(seed=4)
    layout, _ = bind(ng_accelerometer.INSTRUMENT.baseline(), readings)
    layout = layout.promote("fixture_tilt.constant")
    frame = build_frame(readings, reference_of(readings))
    point = laplace.start_point(layout, frame)
    expected = forward.mean(layout, frame, point.x, point.rows, hyper_at(layout, 0.0))
    y = expected + np.random.default_rng(4).standard_normal(len(readings))
    products = gaussian.gram_function(layout, frame, y, point)
    for v in (-2.3, 0.4, 4.1):
        hyper = hyper_at(layout, v)
        prior = gaussian.prior_of(layout, hyper, jnp.ones(layout.size))
        gram = products(hyper, jnp.full(len(layout.hypers), v))
        assert isinstance(gram.jtj, block_elimination.ArrowMatrix)
        found = gaussian.condition(gram, frame.size, prior, point.x)
        line = forward.linearise(layout, frame, point.x, point.rows, hyper)
        whole = layout.model.noise.gram(line.jacobian, y - line.mean, 0.0, hyper, frame)
        direct = gaussian.condition(whole, frame.size, prior, point.x)
        assert float(found.log_marginal) == pytest.approx(float(direct.log_marginal), abs=1e-4)
        sd = np.sqrt(np.diag(direct.covariance))
        assert np.max(np.abs(found.mean - direct.mean) / sd) < 1e-5
        assert np.max(np.abs(found.covariance - direct.covariance) / np.outer(sd, sd)) < 1e-5
        assert float(found.log_jacobian) == pytest.approx(float(direct.log_jacobian), abs=1e-6)
        normal = jnp.linspace(-1, 1, layout.size)
        back = found.factor.back(normal)
        pulled = prior.sd * (whole.jtj @ (prior.sd * back)) + prior.weight * back
        np.testing.assert_allclose(found.factor.forward(pulled), normal, atol=1e-5)


def hyper_at(layout, v: float):
    return forward.hyper_values(layout, jnp.full(len(layout.hypers), v))


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
    found = [
        gaussian.condition(
            gaussian.gram_function(b.layout, b.frame, b.y, gaussian.Point(b.x, b.rows))(
                b.hyper, b.v
            ),
            b.frame.size,
            gaussian.prior_of(b.layout, b.hyper, jnp.full(2, scale)),
            b.x,
        )
        for scale in (1.0, 30.0)
    ]
    # The same, whatever the scale of the flat column …
    assert float(found[0].log_marginal) == pytest.approx(float(found[1].log_marginal), abs=1e-10)
    np.testing.assert_allclose(found[0].mean, found[1].mean, rtol=1e-9)
    # … and ∫ N(y; a·1, V) da is N(y; â·1, V) times √(2π/1ᵀV⁻¹1).
    t, y = np.asarray(b.frame.centred()), np.asarray(b.y - b.frame["rate_input"])
    V = sigma**2 * np.eye(14) + sd**2 * np.outer(t, t)
    one = np.linalg.solve(V, np.ones(14))
    direct = multivariate_normal(np.full(14, one @ y / one.sum()), V).logpdf(y)
    direct += 0.5 * np.log(2 * np.pi / one.sum())
    assert float(found[0].log_marginal) == pytest.approx(direct, abs=1e-8)
