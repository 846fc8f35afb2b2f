"""The closed form of a composed model is the integral of its density."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import bayescal as bc
from bayescal import effects
from bayescal._inference.assembly import Assembly, Point
from bayescal._inference.density import Density
from bayescal._inference.record import Record
from bayescal._model import forward
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
    assembly, v = on_record(b), np.asarray(b.v)
    density = Density(
        assembly, Point(np.asarray(b.x), np.asarray(b.rows)), np.ones(b.layout.size), v
    )
    total, found = density.at(v)
    assert found is not None
    prior = assembly.prior(assembly.hyper(v), density.flat)

    line = forward.linearise(b.layout, b.frame, b.x, b.rows, b.hyper)
    J, D = np.asarray(line.jacobian), np.diag(np.asarray(prior.sd) ** 2)
    noise = b.layout.model.noise.variance(b.hyper, b.frame)
    S = np.diag(noise + jnp.sum((line.rows * forward.row_sd(b.layout)) ** 2, axis=1))
    centre = line.mean - jnp.sum(line.rows * b.rows, axis=1) + J @ (prior.mean - b.x)
    V = S + J @ D @ J.T
    normal = multivariate_normal(np.asarray(centre), V)  # pyright: ignore[reportArgumentType]
    direct = normal.logpdf(np.asarray(b.y))  # pyright: ignore[reportAttributeAccessIssue]
    assert total - assembly.log_prior(v) == pytest.approx(direct, rel=1e-8, abs=1e-6)
    gain = D @ J.T @ np.linalg.inv(V)
    mean = prior.mean + gain @ (b.y - centre)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(
        found.covariance, D - gain @ J @ D, atol=1e-8 * max(1.0, D.max(initial=0))
    )


def on_record(b) -> Assembly:
    return Assembly(b.layout, Record(b.layout.model.instrument, b.frame, np.asarray(b.y)))


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
    assembly, v = on_record(b), np.asarray(b.v)
    point = Point(np.asarray(b.x), np.asarray(b.rows))
    found = [Density(assembly, point, np.full(2, scale), v).at(v) for scale in (1.0, 30.0)]
    values = [total - assembly.log_prior(v) for total, _ in found]
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
