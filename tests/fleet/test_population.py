"""What devices have in common is that of the joint fit, and helps those with few readings."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, NOISE, table

COMMON: dict[str, Any] = {"T0": 20.0}


@pytest.mark.slow
def test_a_population_is_the_joint_fit_of_one_table() -> None:
    """Against the same posterior in closed form at each pair of spreads, summed over a grid of them; noise known."""
    made, count, k = table(count=12, least=4, most=8), 12, 2
    outputs = {
        n: made[f"{n} [{u}]"].to_numpy() for n, u in (("temperature", "degC"), ("output", "deg/s"))
    }
    devices = {
        name: bc.Measurements.from_arrays(
            mems_gyro.INSTRUMENT, **{n: v[at] for n, v in outputs.items()}
        )
        for name, at in made.groupby("device").indices.items()
    }
    devices["D00"] = devices["D00"].select([0])  # a line is not determined by it
    found = bc.fit_batch(
        MODEL.fix({"noise.white": NOISE}), devices, population=True, reference=COMMON
    )
    assert found.population is not None and found.population.ok
    # All devices in one vector (m, c₁ … c_n), one table.
    size = np.array([e.coefficients[0].size for e in MODEL.effects])
    ts, ys = ([one[n] for one in devices.values()] for n in ("temperature", "output"))
    y = np.concatenate(ys)
    whole = np.zeros((len(y), k * (count + 1)))
    for d, rows in enumerate(np.split(np.arange(len(y)), np.cumsum([len(t) for t in ts])[:-1])):
        whole[rows, k * (d + 1) : k * (d + 2)] = np.column_stack([np.ones(len(rows)), ts[d] - 20.0])
    link = np.concatenate([np.eye(k)] * (count + 1))
    means, spreads, weights = [], [], []
    for share in itertools.product(np.exp(np.linspace(-5.5, 2.5, 60)), repeat=2):
        tau = np.array(share) * size
        inner = np.kron(np.diag([0.0] + [1.0] * count), np.diag(tau**2))
        prior = inner + link @ np.diag(size**2) @ link.T
        v = NOISE**2 * np.eye(len(y)) + whole @ prior @ whole.T
        solved = np.linalg.solve(v, y)
        log_p = -0.5 * (np.linalg.slogdet(v)[1] + y @ solved)
        weights.append(log_p + sum(np.log(t / (1 + t**2)) for t in share))
        means.append(prior @ whole.T @ solved)
        spreads.append(tau)
    w = np.exp(np.array(weights) - max(weights))
    w /= w.sum()
    joint, tau = w @ np.array(means), w @ np.array(spreads)
    for name, own in zip(devices, joint[k:].reshape(count, k), strict=True):
        np.testing.assert_allclose((found[name].mean[:k] - own) / found[name].sd[:k], 0, atol=0.03)
    table_ = found.population.table
    np.testing.assert_allclose((table_["mean"] - joint[:k]) / table_["mean_sd"], 0, atol=0.05)
    np.testing.assert_allclose(table_["group_sd"], tau, rtol=0.03)


def test_devices_with_few_readings_lean_on_the_others(readings) -> None:
    few = {name: readings[name] for name in readings.names}
    few["D00"] = few["D00"].select([0, 1, 2])
    alone = bc.fit_batch(MODEL, few, reference=COMMON)
    pooled = bc.fit_batch(MODEL, few, population=True, reference=COMMON)
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
