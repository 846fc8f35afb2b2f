"""A NumPyro program that cannot be used is refused, in words that say what to change."""

# What numpyro.sample returns is an array to its users, and a union of types to pyright.
# pyright: reportOperatorIssue=false, reportIndexIssue=false, reportArgumentType=false

from __future__ import annotations

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import bayescal as bc
from tests.support.made_up.programs import AT, LINE, line


def blind(y=None):
    numpyro.sample("y", dist.Normal(numpyro.sample("a", dist.Normal(0, 1)), 1.0), obs=y)


def discrete(y):
    side = numpyro.sample("side", dist.Bernoulli(0.5))
    numpyro.sample("y", dist.Normal(1.0 * side, 1.0), obs=y)


def learned(y):
    numpyro.sample("y", dist.Normal(numpyro.param("weight", 0.0), 1.0), obs=y)


def partial(y):
    a = numpyro.sample("a", dist.Normal(0, 1))
    with numpyro.plate("batch", 10, subsample_size=2):
        numpyro.sample("y", dist.Normal(a, 1.0), obs=y)


def branches(y):
    a = numpyro.sample("a", dist.Normal(0, 1))
    numpyro.sample("y", dist.Normal(a if a > 0 else 0.0, 1.0), obs=y)


@pytest.mark.parametrize(
    ("model", "readings", "words"),
    [
        (blind, {}, r"'blind' observes nothing: .* \('a', 'y'\) is unknown. Give one of them obs="),
        (discrete, (0.5,), r"'side' of 'discrete' is discrete \(BernoulliProbs\): sum over"),
        (learned, (0.5,), "'weight' of 'learned' is a numpyro.param, which has no prior"),
        (partial, (np.zeros(2),), "'batch' of 'partial' takes 2 of 10 at random"),
        (branches, (0.5,), "'branches' branches in Python on a value"),
        (line, {"x": AT}, r"line\(at, y, noise=None\) does not take these readings \(x\)"),
        (line, {**LINE, "y": np.full(30, np.nan)}, r"'y' of 'line' holds nan at \[0\]"),
    ],
)
def test_a_program_that_cannot_be_used_is_refused(model, readings, words: str) -> None:
    with pytest.raises(bc.ModelError, match=words):
        bc.fit(model, readings)


def test_what_does_not_go_with_a_program_is_refused() -> None:
    with pytest.raises(bc.ModelError, match=r"by Marginal\(\) or NUTS\(\), not by LeastSquares"):
        bc.fit(line, LINE, bc.LeastSquares())
    with pytest.raises(bc.ModelError, match="'line' has no unknown site 'c'; it has: b, sigma"):
        bc.fit(line, LINE, bc.Marginal(promote=("c",)))
    with pytest.raises(bc.ModelError, match="checkpoint is for bayescal's own models"):
        bc.fit(line, LINE, checkpoint="run.nc")  # pyright: ignore[reportCallIssue]
    with pytest.raises(bc.ModelError, match="or a NumPyro program; this is a float"):
        bc.fit(1.0, LINE)  # pyright: ignore[reportCallIssue]
