"""The Jacobian of a composed model is the derivative of its mean."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayescal._model import forward
from tests.support.made_up.rich_gyro import RICH, bound, readings


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

    def mean(x, rows):
        return forward.mean(layout, b.frame, x, rows, hyper)

    line = forward.linearise(layout, b.frame, x, b.rows, hyper)
    by_x, by_rows = jax.jacfwd(mean, argnums=(0, 1))(x, b.rows)
    np.testing.assert_allclose(line.mean, mean(x, b.rows), rtol=1e-13)
    width = np.abs(by_x).max(axis=0)
    np.testing.assert_allclose(line.jacobian / width, by_x / width, rtol=1e-11, atol=1e-12)
    # A thermometer error moves its own reading and no other, so that one number a reading says all.
    diagonal = jnp.einsum("ij,ik->ijk", jnp.eye(b.frame.size), line.rows)
    np.testing.assert_allclose(diagonal, by_rows, rtol=1e-11, atol=1e-12)


def test_jacobian_agrees_with_finite_differences() -> None:
    b = bound(RICH, readings())
    line = forward.linearise(b.layout, b.frame, b.x, b.rows, b.hyper)
    mean = jax.jit(lambda x, rows: forward.mean(b.layout, b.frame, x, rows, b.hyper))
    step = 1e-4 * np.asarray(forward.prior_sd(b.layout, b.hyper))
    shift = np.diag(step)
    difference = [
        (mean(b.x + s, b.rows) - mean(b.x - s, b.rows)) / (2 * h)
        for s, h in zip(shift, step, strict=True)
    ]
    np.testing.assert_allclose(line.jacobian.T, difference, rtol=1e-6, atol=1e-7)
    moved = (mean(b.x, b.rows + 1e-4) - mean(b.x, b.rows - 1e-4)) / 2e-4
    np.testing.assert_allclose(line.rows[:, 0], moved, rtol=1e-6)
