"""The NumPyro program of a composed model has the density that the closed form integrates."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal._inference.nuts import program
from bayescal._model import forward
from tests.support.made_up.rich_gyro import RICH, bound, readings


@pytest.mark.parametrize(
    "model",
    [
        RICH,
        RICH.with_noise(bc.StudentT()).fix({"bias.thermal_lag.tau": 200.0, "bias.constant": 3.0}),
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
        e = jnp.asarray(rng.normal(size=b.rows.shape))
        rows = e * forward.row_sd(b.layout)
        sites["rows.standard"] = e
        x = jnp.concatenate(x)
        ours += forward.log_prior_x(b.layout, x, rows, hyper)
        ours += jnp.sum(forward.log_likelihood(b.layout, b.frame, b.y, x, rows, hyper))
        ours += b.rows.shape[0] * jnp.sum(jnp.log(forward.row_sd(b.layout)))
        theirs, trace = log_density(program(b.layout, b.frame), (b.y,), {}, sites)
        np.testing.assert_allclose(trace["x"]["value"], x, rtol=1e-12)
        np.testing.assert_allclose(trace["v"]["value"], v, rtol=1e-9, atol=1e-12)
        differences.append(float(theirs - ours))
    np.testing.assert_allclose(differences, 0.0, atol=1e-7)
