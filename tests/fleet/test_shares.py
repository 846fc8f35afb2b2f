"""Shares of a fleet: substitutes that no device tells apart are told apart by many, and intervals cover."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import logsumexp

from tests.support.inside import DeviceStructure, estimate_shares, find_favoured_effects

NAMES, PRIOR, POINTS = ("lag", "voltage", "run"), 0.02, 40
SETS = [s for count in range(4) for s in itertools.combinations(NAMES, count)]


def fleet(rng: np.random.Generator, devices: int, true: dict[str, float], size: float):
    """Devices whose effects have curves that correlate by 0.94; a curve's size is known, the noise is one."""
    curves = 0.97 * rng.standard_normal(POINTS) + 0.24 * rng.standard_normal((3, POINTS))
    curves *= size / np.linalg.norm(curves, axis=1, keepdims=True)
    told, held = [], []
    for _ in range(devices):
        has = rng.random(3) < [true.get(name, 0.0) for name in NAMES]
        output = has @ curves + rng.standard_normal(POINTS)
        log = {s: -0.5 * np.sum((output - _sum(curves, s)) ** 2) for s in SETS}
        told.append(DeviceStructure(dict.fromkeys(NAMES, PRIOR), log))
        held.append(has)
    return told, np.sum(held, axis=0)


def _sum(curves: np.ndarray, effects: tuple[str, ...]) -> np.ndarray:
    return curves[[NAMES.index(name) for name in effects]].sum(axis=0)


def test_a_fleet_of_one_device_is_its_search(rng) -> None:
    log = {s: float(rng.normal(0, 3)) for s in SETS}
    found = estimate_shares([DeviceStructure(dict.fromkeys(NAMES, 0.2), log)], seed=1, size=20_000)
    weight = {s: v + len(s) * np.log(0.2 / 0.8) for s, v in log.items()}
    for name in NAMES:
        inside = logsumexp([v for s, v in weight.items() if name in s])
        exact = np.exp(inside - logsumexp(list(weight.values())))  # pyright: ignore[reportOperatorIssue]
        assert found.expected[name] == pytest.approx(exact, abs=0.02)


def test_substitutes_are_told_apart_by_many_devices(rng) -> None:
    told, (held, *_) = fleet(rng, 60, {"lag": 0.3}, size=5.0)
    found = estimate_shares(told)
    alone = [_alone(device, "lag") for device in told]
    assert sum(0.05 < p < 0.95 for p in alone) > held / 3  # of one device it is open
    assert found["in fleet"]["lag"] > 0.99 and found["in fleet"]["voltage"] < 0.1
    assert found.expected["lag"] == pytest.approx(held, abs=2)
    assert found.high["voltage"] < 0.1


def _alone(device: DeviceStructure, name: str) -> float:
    weight = {s: v + len(s) * np.log(PRIOR / (1 - PRIOR)) for s, v in device.log_evidence.items()}
    inside = logsumexp([v for s, v in weight.items() if name in s])
    return float(np.exp(inside - logsumexp(list(weight.values()))))  # pyright: ignore[reportOperatorIssue]


def test_intervals_of_shares_cover() -> None:
    rng, covered = np.random.default_rng(7), []
    for seed in range(60):
        true = {"lag": rng.random(), "voltage": rng.random() * (seed % 2)}
        found = estimate_shares(fleet(rng, 30, true, size=6.0)[0], seed, size=400)
        covered += [found.low[n] <= share <= found.high[n] for n, share in true.items() if share]
    # of 95 %, less than one time in a hundred fewer
    assert len(covered) == 90 and sum(covered) >= 79


def test_an_effect_that_a_device_cannot_show_is_not_counted_there() -> None:
    shows = DeviceStructure({"lag": PRIOR}, {(): 0.0, ("lag",): 40.0})
    cannot = DeviceStructure({}, {(): 0.0})
    found = estimate_shares([shows] * 5 + [cannot] * 45).loc["lag"]
    assert found.expected == pytest.approx(5) and found.low > 0.5


def test_a_device_gets_the_effects_that_the_fleet_favours() -> None:
    prior = dict.fromkeys(NAMES, PRIOR)
    sure = DeviceStructure(prior, {(): -40.0, ("lag",): 0.0}, ("lag",), frozenset({"lag"}))
    log = {(): -40.0, ("lag",): -1.0, ("voltage",): 0.0}
    open_one = DeviceStructure(prior, log, ("voltage",), frozenset({"voltage"}))
    table = estimate_shares([*[sure] * 8, open_one]).rename_axis("effect").reset_index()
    assert table.set_index("effect")["in fleet"]["voltage"] < 0.5
    assert find_favoured_effects(open_one, table) == ("lag",)
    assert find_favoured_effects(sure, table) == ("lag",)
