"""The Kalman filter's slopes, whatever its states say of each other."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from bayescal._model.state_space import States, filtered
from tests.support.tiers import slow_but

N, COLUMNS = 12, 2


@pytest.mark.parametrize("kind", slow_but(["apart"], ["one", "apart", "last", "together"]))
def test_slopes_of_the_filter_are_those_of_differences(kind: str, rng) -> None:
    count = 1 if kind == "one" else 3
    root = rng.normal(size=(N, count, count))
    carry, fresh = rng.uniform(0.3, 0.9, (N, count)), rng.uniform(0.1, 1.0, (N, count))
    if kind == "together":
        carry = 0.3 * rng.normal(size=(N, count, count))
    last = rng.uniform(-0.5, 0.5, (N, count)) if kind == "last" else None
    shown = np.ones(count)
    shown[1:-1] = 0.0

    def value(carry, fresh, last, white, columns):
        if kind in ("last", "together"):
            fresh = fresh[:, :, None] * jnp.eye(count) + root @ np.swapaxes(root, 1, 2)
        return filtered(States(carry, fresh, shown, last), white, columns)

    given = carry, fresh, last, rng.uniform(0.1, 1.0, N), rng.normal(size=(N, COLUMNS))
    check_grads(value, given, order=1, modes=["rev"], rtol=1e-5)
