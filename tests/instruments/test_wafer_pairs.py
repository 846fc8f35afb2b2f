"""The best pairs of many devices by bounds are those of the full table, and the certificate holds."""

from __future__ import annotations

import numpy as np
import pytest

from bayescal_models.differential_pair.environment import (
    DISTURBANCE,
    ORDERS,
    RATIO,
    SENSITIVITY_SPREAD,
    order_sizes,
)
from bayescal_models.differential_pair.pairing.selection import judge
from bayescal_models.differential_pair.pairing.wafer import Wafer, best_pairs, expected_residual
from tests.support.made_up.pairs import made_up

DRAWS = 100
SHARE = 0.05  # of a device's own departure, in parts of the environment
KNOWN, RATIO_KNOWN = 5.0, 0.002  # µg an order; of the sensitivity


def drawn(devices: int, seed: int) -> Wafer:
    """Draws of a wafer's devices, half of them outer ones."""
    rng = np.random.default_rng(seed)
    shared = order_sizes() * rng.standard_normal(ORDERS)
    own = RATIO ** np.arange(ORDERS)
    own = SHARE * DISTURBANCE * own / np.linalg.norm(own)
    sensitivity = np.exp(SENSITIVITY_SPREAD * rng.standard_normal(devices))
    departure = own * rng.standard_normal((devices, ORDERS))
    of_draws = sensitivity * (1 + RATIO_KNOWN * rng.standard_normal((DRAWS, devices)))
    errors = KNOWN * rng.standard_normal((DRAWS, devices, ORDERS))
    return Wafer(
        tuple(f"R{i:05d}" for i in range(devices)),
        devices // 2,
        np.full(DRAWS, 1 / DRAWS),
        1.0 + 1e-4 * rng.standard_normal((DRAWS, devices)),
        of_draws,
        (of_draws[..., None] * shared + departure + errors),
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_expected_residual_is_that_of_the_table(seed: int) -> None:
    devices = made_up(seed)
    full = judge(devices).expected
    found = best_pairs(Wafer.of(devices), count=full.size)
    ours = {(outer, inner): left for outer, inner, left, _ in found.pairs}
    names, outer = devices.names, devices.outer
    for i, j in np.ndindex(*full.shape):
        assert ours[names[i], names[outer + j]] == pytest.approx(full[i, j], rel=1e-9)
    assert found.pairs[0][2] == pytest.approx(full.min(), rel=1e-9)


@pytest.mark.parametrize("seed", [4, 5])
def test_bounds_exclude_no_pair_of_the_best(seed: int) -> None:
    wafer = drawn(160, seed)
    found = best_pairs(wafer)
    outer, inner = np.divmod(np.arange(80 * 80), 80)
    every, ratio = expected_residual(wafer, outer, inner)
    order = np.argsort(every, kind="stable")[:12]
    expected = [
        (wafer.names[outer[n]], wafer.names[80 + inner[n]], every[n], ratio[n]) for n in order
    ]
    for ours, theirs in zip(found.pairs, expected, strict=True):
        assert ours[:2] == theirs[:2]
        assert ours[2:] == pytest.approx(theirs[2:], rel=1e-12)
    assert found.evaluated < 80 * 80 / 4  # bounds, not a table
    assert found.least_excluded >= found.pairs[-1][2]
    assert found.bounded + found.evaluated == 80 * 80
    assert np.sum(every < found.least_excluded) <= found.evaluated
