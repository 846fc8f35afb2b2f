"""What is integrated out of a NumPyro program, and what is sampled and why."""

# What numpyro.sample returns is an array to its users, and a union of types to pyright.
# pyright: reportOperatorIssue=false, reportIndexIssue=false, reportArgumentType=false

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.infer.reparam import LocScaleReparam

from bayescal._numpyro.gaussian_sites import Split, split
from bayescal._numpyro.survey import survey
from tests.support.made_up.programs import SCHOOLS, eight_schools


def divided(model, readings, keep=()) -> Split:
    return split(survey(model, readings), keep)


def names(sites) -> list[str]:
    return [site.name for site in sites]


def test_what_is_not_affine_is_sampled() -> None:
    def zoo(y):
        def normal(name, **more):
            return numpyro.sample(name, dist.Normal(0.0, 1.0), **more)

        straight, top = normal("straight"), normal("top")
        below = numpyro.sample("below", dist.Normal(2.0 * top - straight, 0.5))
        through = jnp.exp(normal("exp"))
        kink, stair = jnp.maximum(normal("kink"), 0.2), jnp.round(3 * normal("stair"))
        slight = normal("slight")
        product = normal("one") * numpyro.sample("other", dist.Normal(0, 1).expand([3]).to_event())
        width, seen = normal("width"), normal("seen")
        positive = numpyro.sample("positive", dist.LogNormal(0.0, 1.0))
        mean = straight + 1e6 + positive * below + through + kink + stair + jnp.sum(product)
        numpyro.sample("y", dist.Normal(mean + slight + 1e-3 * slight**2, 1.0), obs=y)
        numpyro.sample("z", dist.Normal(0.0, jnp.exp(width)), obs=y)
        numpyro.sample("n", dist.Poisson(jnp.exp(seen)), obs=jnp.array(3))
        wide = numpyro.sample("wide", dist.Normal(0.0, 1e3))  # exp of its draws overflows
        numpyro.factor("penalty", -jnp.exp(wide))

    found = divided(zoo, {"y": np.ones(4)})
    assert names(found.inside) == ["straight", "top", "below", "other"]
    # Summed up once: one scale, and a location that nothing sampled moves. That of 'y' moves with 'positive'.
    assert found.fixed == ("z",)
    said = " ".join(found.reasons)
    for words in (
        "'exp' is sampled: the location of 'y' is not affine in it",
        "'slight' is sampled: the location of 'y' is not affine",
        "'one' is sampled: a location holds its product with 'other'",
        "'width' is sampled: the scale of 'z' depends on it",
        "'seen' is sampled: 'n' (Poisson) depends on it",
        "'wide' is sampled: 'penalty' (a factor) depends on it",
    ):
        assert words in said


@pytest.mark.slow
def test_a_reparametrised_program_is_seen_through() -> None:
    other = handlers.reparam(eight_schools, config={"theta": LocScaleReparam(0.0)})
    assert names(divided(other, SCHOOLS).inside) == ["mu", "theta_decentered"]
