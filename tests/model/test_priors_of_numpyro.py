"""Distributions of NumPyro as priors: of coefficients and shapes, in fits, in NumPyro's program, in saved files."""

from __future__ import annotations

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import bayescal as bc
from bayescal_models import mems_gyro

LONG = dist.TruncatedNormal(300.0, 200.0, low=0.0)


def lag(own_prior, prior=None) -> bc.Effect:
    coefficients = (bc.Coefficient("deg/s/degC", prior or bc.Normal(0.0, 0.1)),)
    shapes = (bc.Shape("tau", "s", own_prior=own_prior),)
    how = {"coefficients": coefficients, "shapes": shapes, "columns": ("time", "temperature")}
    return bc.Effect("bias.own", "bias", basis=lambda r, tau: r.lag(tau), **how)


def test_the_same_prior_in_both_words_has_the_same_posterior_and_another_is_kept(tmp_path) -> None:
    readings = mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=1)
    baseline = mems_gyro.INSTRUMENT.baseline()
    theirs = lag(dist.LogNormal(np.log(300.0), 0.8), dist.Normal(0.0, 0.1))
    quick = bc.LeastSquares(draws=400)
    pair = [bc.fit(baseline + e, readings, quick) for e in (lag(bc.LogNormal(300.0, 0.8)), theirs)]
    a, b = (c.to_pandas().loc[["bias.own", "bias.own.tau"], ["mean", "sd"]] for c in pair)
    assert np.allclose(a, b, rtol=1e-6)
    found = bc.fit(baseline + lag(LONG), readings, quick)
    saved = bc.load(found.save(tmp_path / "c.nc"), effects=[lag(LONG)])
    assert str(saved) == str(found)
    program = bc.numpyro_program(found.model, readings)
    sites = numpyro.handlers.trace(numpyro.handlers.seed(program, 0)).get_trace(readings["output"])
    assert sites["bias.own.tau"]["fn"].log_prob(250.0) == LONG.log_prob(250.0)


@pytest.mark.parametrize(
    "prior", [dist.Laplace(), dist.Normal(np.zeros(2), 1.0), dist.Weibull(1, 2)]
)
def test_unsupported_prior_of_a_shape_is_refused_with_supported_ones(prior) -> None:
    with pytest.raises(bc.ModelError, match=r"^prior \w+: .+\. Coefficients take Normal"):
        lag(prior)
    with pytest.raises(bc.ModelError, match="coefficient"):
        bc.Coefficient("V", dist.HalfNormal(1.0))
