"""What devices have in common is that of the joint fit, and helps those with few readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._fleet.population import estimates, learn
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, NOISE, SEED, table


@pytest.mark.slow
def test_a_population_is_the_joint_fit_of_one_table() -> None:
    """Against the same posterior in closed form at each pair of spreads, summed over a grid of them."""
    rng = np.random.default_rng(SEED)
    count, k, size = 12, 2, np.array([2.0, 0.1])
    named = {
        n: (bc.Coefficient("1", bc.Normal(0.0, float(s))), bc.HalfCauchy(float(s)))
        for n, s in zip("ab", size, strict=True)
    }
    truth = np.array([1.0, 0.05]) + rng.normal(0, 1, (count, k)) * [0.8, 0.03]
    designs = [np.column_stack([np.ones(6), rng.uniform(-30, 30, 6)]) for _ in range(count)]
    designs[0] = designs[0][:1]  # one reading: a line is not determined by it
    ys = [j @ c + rng.normal(0, 0.5, len(j)) for j, c in zip(designs, truth, strict=True)]
    alone = [
        _posterior(j, y, np.zeros(k), np.diag(size**2)) for j, y in zip(designs, ys, strict=True)
    ]
    own = estimates(np.stack([m for m, _ in alone]), np.stack([c for _, c in alone]), named)
    learned = learn(own, named, 3)
    pooled = learned.moments(own)
    assert learned.population.ok
    # All devices in one vector (m, c₁ … c_n), one table.
    grid = np.exp(np.linspace(-5.5, 2.5, 60))
    whole = np.zeros((sum(map(len, ys)), k * (count + 1)))
    row = 0
    for d, j in enumerate(designs):
        whole[row : row + len(j), k * (d + 1) : k * (d + 2)] = j
        row += len(j)
    link = np.concatenate([np.eye(k)] + [np.eye(k)] * count)
    means, spreads, weights = [], [], []
    for a in grid:
        for b in grid:
            tau = np.array([a, b]) * size
            inner = np.kron(np.diag([0.0] + [1.0] * count), np.diag(tau**2))
            prior = inner + link @ np.diag(size**2) @ link.T
            v = 0.25 * np.eye(row) + whole @ prior @ whole.T
            y = np.concatenate(ys)
            gain = prior @ whole.T @ np.linalg.inv(v)
            log_p = -0.5 * (np.linalg.slogdet(v)[1] + y @ np.linalg.solve(v, y))
            weights.append(log_p + sum(np.log(t / (1 + t**2)) for t in (a, b)))
            means.append(gain @ y)
            spreads.append(tau)
    w = np.exp(np.array(weights) - max(weights))
    w /= w.sum()
    joint, tau = w @ np.array(means), w @ np.array(spreads)
    sd = np.sqrt(np.diagonal(pooled.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose((pooled.mean - joint[k:].reshape(count, k)) / sd, 0, atol=0.03)
    found = learned.population.table
    np.testing.assert_allclose(
        found["mean"], joint[:k], atol=0.05 * np.min(found["mean_sd"].to_numpy())
    )
    np.testing.assert_allclose(found["group_sd"], tau, rtol=0.03)


def _posterior(j, y, mean, covariance) -> tuple[np.ndarray, np.ndarray]:
    inner = np.linalg.inv(j.T @ j / 0.25 + np.linalg.inv(covariance))
    return inner @ (j.T @ y / 0.25 + np.linalg.solve(covariance, mean)), inner


def test_devices_with_few_readings_lean_on_the_others(readings) -> None:
    few = {name: readings[name] for name in readings.names}
    few["D00"] = few["D00"].select([0, 1, 2])
    common: dict[str, Any] = {"T0": 20.0}
    alone = bc.fit_batch(MODEL, few, reference=common)
    pooled = bc.fit_batch(MODEL, few, population=True, reference=common)
    assert pooled.population is not None and pooled.population.ok
    mean = dict(
        zip(pooled.population.table.coefficient, pooled.population.table["mean"], strict=True)
    )
    name = "bias.temperature"
    shift = abs(pooled["D00"][name][0] - mean[name]) / abs(alone["D00"][name][0] - mean[name])
    others = [
        abs(pooled[d][name][0] - mean[name]) / abs(alone[d][name][0] - mean[name])
        for d in readings.names[1:]
    ]
    assert shift < np.median(others) < 1
    assert pooled["D00"][name][1] < alone["D00"][name][1]


@pytest.mark.slow
def test_a_population_agrees_with_effects_per_device() -> None:
    """One table, one model with `per="device"` coefficients of learned spread, sampled; noise known in both."""
    made = table(count=12, least=4, most=8)
    constant, line = MODEL.effects

    def of_each(effect: bc.Effect) -> bc.Effect:
        c = effect.coefficients[0]
        own = bc.Coefficient(
            c.unit, bc.Normal(0.0, 1.0), per="device", group_sd=bc.HalfCauchy(c.size)
        )
        return bc.Effect(f"{effect.name}_device", effect.slot, effect.basis, (own,))

    joint_model = (MODEL + of_each(constant) + of_each(line)).fix({"noise.white": NOISE})
    whole = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        temperature=made["temperature [degC]"].to_numpy(),
        output=made["output [deg/s]"].to_numpy(),
        device=made["device"].to_numpy(),
    )
    common: dict[str, Any] = {"T0": 20.0}
    joint = bc.fit(joint_model, whole, seed=1, reference=common)
    split = {
        d: whole.select(np.flatnonzero(whole["device"] == d)) for d in whole.groups("device")[0]
    }
    fixed = MODEL.fix({"noise.white": NOISE})
    pooled = bc.fit_batch(fixed, split, population=True, reference=common)
    assert pooled.population is not None
    for name in ("bias.constant", "bias.temperature"):
        draws = joint.samples(name)[:, None] + joint.samples(f"{name}_device")
        for i, device in enumerate(split):
            mean, sd = pooled[device][name]
            assert abs(mean - draws[:, i].mean()) < 0.12 * sd
            assert sd == pytest.approx(draws[:, i].std(), rel=0.1)
        row = pooled.population.table.set_index("coefficient").loc[name]
        spread = joint.samples(f"{name}_device.group_sd")
        assert abs(row.group_sd - spread.mean()) < 0.2 * spread.std()
        assert row.group_sd_sd == pytest.approx(spread.std(), rel=0.15)
