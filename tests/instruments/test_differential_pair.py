"""A differential pair: sensitivities are recovered, pairs are judged with probabilities, the printed rule is shown."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.environment import SHARED, order_names
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import devices_from
from bayescal_models.differential_pair.pairing.judgement import judge
from bayescal_models.differential_pair.pairing.selection import CRITERIA
from tests.support.command_line import GYRO, TABLE, needs_installation, run

SMALL = dp.Campaign(samples=20)
IN_PHI = bc.Marginal(promote=tuple(order_names(SHARED.name)))


def made_up(
    seed: int = 0, outer: int = 3, inner: int = 4, draws: int = 400, **changed
) -> dp.Devices:
    """Devices with draws about random truths; no fit."""
    random = np.random.default_rng(seed)
    count, time = outer + inner, np.linspace(0.0, 600.0, 30)
    u = 1000.0 * (0.6 + np.sin(time / 170.0 + random.uniform(0, 6)))
    sensitivity = (
        1 + 0.2 * random.standard_normal(count) + 0.02 * random.standard_normal((draws, count))
    )
    drift = np.stack([np.ones(30), time / 300 - 1], axis=0)
    own = 30.0 * random.standard_normal((count, 2)) + 8.0 * random.standard_normal(
        (draws, count, 2)
    )
    environment = sensitivity[:, :, None] * u + own @ drift
    scale = 1 + 2e-3 * random.standard_normal(count) + np.zeros((draws, 1))
    sign = np.repeat([1.0, -1.0], [outer, inner])
    known = sign[:, None] * 1e6 * np.linspace(1, 5, 30) * scale[0][:, None]
    values = {
        "names": tuple(
            f"{side} {i + 1}" for side, n in (("o", outer), ("i", inner)) for i in range(n)
        ),
        "outer": outer,
        "time": time,
        "weights": np.full(draws, 1 / draws),
        "scale": scale,
        "sensitivity": sensitivity,
        "shared": u + np.zeros((draws, 1)),
        "environment": environment,
        "departure": np.full(draws, 40.0),
        "bias": np.zeros((draws, count)),
        "noise": np.full(draws, 20.0),
        "commanded": 1e6 * np.linspace(1, 5, 30),
        "records": known + environment[0],
        "known": known,
    }
    return dp.Devices(**{**values, **changed})


@pytest.fixture(scope="module")
def batch() -> dp.SimulatedBatch:
    return dp.simulate_batch(seed=5, campaign=SMALL)


@pytest.fixture(scope="module")
def calibration(batch: dp.SimulatedBatch) -> bc.Calibration:
    return bc.fit(dp.INSTRUMENT.baseline(), batch.readings, IN_PHI)


def test_sensitivities_are_recovered(calibration, batch) -> None:
    drawn = calibration.samples("environment.shared[sensitivity]")
    assert calibration.verdict.sampler == "importance sampling" and calibration.verdict.ess > 1000
    z = (drawn.mean(axis=0) - batch.sensitivity) / drawn.std(axis=0)
    assert np.abs(z).max() < 3.5
    ratios = np.log(drawn[:, :3, None] / drawn[:, None, 3:])
    true = np.log(batch.sensitivity[:3, None] / batch.sensitivity[None, 3:])
    assert np.abs((ratios.mean(axis=0) - true) / ratios.std(axis=0)).max() < 3.5
    assert ratios.std(axis=0).max() < 0.12  # the spread over devices alone would leave 0.28


def test_the_environment_and_the_pairs_residual_are_recovered(calibration, batch) -> None:
    devices = dp.devices_of(calibration)
    assert devices.names == batch.names
    off = devices.environment.mean(axis=0) - batch.environment
    assert np.sqrt(np.mean(off**2)) < 25.0  # µg, of 1 mg; the noise of a reading is 18
    found = judge(devices)
    true = criteria.residual(batch.environment, batch.scale, found.calibrated)
    sd = found.residual.std(axis=0)
    assert np.abs((true - found.expected) / sd).max() < 4


def test_a_pair_measures_acceleration_within_its_uncertainty(calibration, batch) -> None:
    devices = dp.devices_of(calibration)
    outputs = batch.readings["output"].reshape(len(batch.names), -1)
    table = dp.select(devices)
    i, j = (batch.names.index(name) for name in table.best)
    found = dp.measure(devices, *table.best, outputs[i], outputs[j])
    error = found.acceleration - batch.acceleration
    rms = np.sqrt(np.mean(error**2))
    assert 0.3 < rms / found.sd.mean() < 2.0
    assert rms < 0.1 * np.sqrt(np.mean((outputs[i] - batch.acceleration) ** 2))


@pytest.mark.parametrize("criterion", CRITERIA)
def test_probabilities_add_up_and_the_first_pair_is_the_best(criterion: str) -> None:
    table = dp.select(made_up(), criterion=criterion)
    assert len(table.pairs) == 12
    for name in ("residual", "ratio_variance", "ratio_variance_raw"):
        assert sum(getattr(p, f"probability_{name}") for p in table.pairs) == pytest.approx(1)
    assert table.best == (table.pairs[0].outer, table.pairs[0].inner)
    if criterion == "residual":
        assert table.pairs[0].expected_loss == min(p.expected_loss for p in table.pairs) >= 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_set_of_pairs_is_disjoint_and_optimal(seed: int) -> None:
    devices = made_up(seed)
    table, cost = dp.select(devices), judge(devices).expected
    for side in zip(*table.matching, strict=True):
        assert len(set(side)) == 3
    total = sum(table.of(*pair).expected_residual for pair in table.matching)
    best = min(
        sum(cost[i, j] for i, j in enumerate(chosen)) for chosen in permutations(range(4), 3)
    )
    assert total == pytest.approx(best)


def test_the_residual_is_the_rms_that_its_formula_says() -> None:
    devices = made_up(draws=3)
    ratio = np.full((3, 4), 0.9)
    found = criteria.residual(devices.environment, devices.scale, ratio)
    one, two = devices.environment[1, 2], devices.environment[1, 5]
    left = (one - 0.9 * two) / (devices.scale[1, 2] + 0.9 * devices.scale[1, 5])
    assert found[1, 2, 2] == pytest.approx(np.sqrt(np.mean(left**2)))


def plateau(**changed) -> tuple[np.ndarray, dp.SimulatedBatch]:
    """Variances of ratios by the printed rule, on raw records at constant acceleration."""
    plan = replace(SMALL, profile="plateau", **changed)
    made = dp.simulate_batch(seed=11, campaign=plan)
    records = made.readings["output"].reshape(len(made.names), -1)
    return criteria.ratio_variance(criteria.polynomial(plan.time, records), made.outer), made


def test_ideal_pairs_have_a_raw_variance_near_three_quarters() -> None:
    found, _ = plateau(alike=True, noise=0.0)
    np.testing.assert_allclose(found, 0.75, atol=0.01)


def test_the_printed_rule_prefers_unlike_devices_on_raw_records() -> None:
    found, made = plateau(departure=0.0, noise=0.0, outer=6, inner=6)
    ratio = made.sensitivity[:6, None] / made.sensitivity[None, 6:]
    np.testing.assert_allclose(found, 3 / 16 * (1 + ratio) ** 2, rtol=0.02)
    chosen = np.unravel_index(np.argmin(found), found.shape)
    assert abs(np.log(ratio[chosen])) > 3 * np.abs(np.log(ratio)).min()
    # Without the commanded part every pair is ideal here: exact differencing.
    removed = criteria.polynomial(SMALL.time, made.environment)
    assert criteria.ratio_variance(removed, 6).max() < 1e-12


def test_disagreeing_criteria_and_denominators_near_zero_are_said() -> None:
    devices = made_up()
    random = np.random.default_rng(1)
    z = 2 * devices.time / devices.time[-1] - 1  # no cubic part, give or take noise
    environment = devices.sensitivity[:, :, None] * (500 + 300 * z - 200 * z**2)
    environment = environment + 20 * random.standard_normal((400, 7, 1)) * z**3
    table = dp.select(replace(devices, environment=environment))
    assert any("heavy-tailed" in said and "order 3 of i" in said for said in table.remarks)
    assert all(3 in pair.near_zero for pair in table.pairs)
    flat = dp.select(replace(devices, commanded=np.full(30, 5e6)))
    assert any("near 0.75" in said for said in flat.remarks)
    unsteady = replace(devices, environment=environment - environment.mean(axis=-1, keepdims=True))
    assert any("not to be trusted" in said for said in dp.select(unsteady).remarks)
    likeliest = max(table.pairs, key=lambda p: p.probability_ratio_variance)
    disagree = (likeliest.outer, likeliest.inner) != table.best
    assert disagree == any("criteria disagree" in said for said in table.remarks)


def test_the_table_is_plain_json_and_prints() -> None:
    table = dp.select(made_up())
    data = json.loads(json.dumps(table.data(), allow_nan=False))
    assert set(data) >= {"pairs", "best", "matching", "environment_ratio"}
    for pair in data["pairs"]:
        assert set(pair) >= {
            *("outer", "inner", "probability_ratio_variance", "probability_residual"),
            *("expected_residual", "unit", "expected_loss"),
        }
        assert pair["unit"] == "ug"
    assert data["best"] == [data["pairs"][0]["outer"], data["pairs"][0]["inner"]]
    ratio = data["environment_ratio"]
    assert ratio["low"] < ratio["median"] < ratio["high"]
    text = str(table)
    assert max(map(len, text.splitlines())) <= 110
    assert all(pair["outer"] in text and pair["inner"] in text for pair in data["pairs"])


def test_the_documents_ratio_needs_a_mean_and_takes_offsets_for_environment() -> None:
    time = np.linspace(0, 1, 50)
    u = 1000 * (0.5 + np.sin(5 * time))
    records = np.stack([1.2 * u, 0.8 * u])
    assert criteria.document_ratio(records, 1)[0, 0] == pytest.approx(1.5)
    assert abs(criteria.document_ratio(records + [[0], [300.0]], 1)[0, 0] - 1.5) > 0.2


def columns(**changed) -> dict[str, Any]:
    """Two records, as a file would have them."""
    given = {
        "device": np.repeat(["a", "b"], 10),
        "group": np.repeat(["outer", "inner"], 10),
        "time": np.tile(np.arange(10.0), 2),
        "acceleration": np.full(20, 1e6),
        "output": np.linspace(-1.0, 1.0, 20) ** 3,
    }
    return {**given, **changed}


DRAWN = {
    "environment.shared[sensitivity]": np.ones((5, 2)),
    "noise.white": np.ones(5),
    **{name: np.arange(5.0) for name in order_names(SHARED.name)},
}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"group": np.full(20, "outer")},
            "has outer devices only; a pair is one outer and one inner",
        ),
        (
            {"group": np.tile(["outer", "inner"], 10)},
            "device 'a' is in both groups, inner and outer",
        ),
        (
            {"time": np.r_[np.arange(10.0), np.arange(10.0) + 0.5]},
            r"device 'b' was read at other times than 'a' \(10 and 10 readings\)",
        ),
    ],
)
def test_readings_that_make_no_pairs_are_refused(changed, said: str) -> None:
    readings = bc.Measurements.from_arrays(dp.INSTRUMENT, **columns(**changed))
    with pytest.raises(bc.InputError, match=said):
        devices_from(DRAWN, readings)


def test_other_refusals_say_what_is_possible() -> None:
    with pytest.raises(bc.InputError, match=r"group.*'middle'"):
        bc.Measurements.from_arrays(dp.INSTRUMENT, **columns(group=np.full(20, "middle")))
    devices = made_up()
    with pytest.raises(bc.InputError, match="'best' is not one of residual, ratio-variance"):
        dp.select(devices, criterion="best")
    with pytest.raises(bc.InputError, match="no inner device is called 'o 1'; there are: i 1, i 2"):
        dp.measure(devices, "o 1", "o 1", np.ones(3), np.ones(3))
    with pytest.raises(bc.InputError, match=r"have shapes \(3,\) and \(4,\)"):
        dp.measure(devices, "o 1", "i 1", np.ones(3), np.ones(4))
    with pytest.raises(bc.InputError, match=r"timing\.skew.*no place for them"):
        dp.measure(replace(devices, others=("timing.skew",)), "o 1", "i 1", [1.0], [1.0])
    with pytest.raises(ValueError, match=r"'bias\.humidity' can be hidden"):
        dp.simulate({"bias.humidity": 1.0}, seed=0)


def test_every_candidate_can_be_hidden_under_the_same_noise() -> None:
    plain = dp.simulate(seed=2)["output"]
    np.testing.assert_array_equal(plain, dp.simulate(seed=2)["output"])
    for effect in dp.INSTRUMENT.candidates:
        size = effect.coefficients[0].size
        hidden = dp.simulate({effect.name: size}, seed=2)["output"] - plain
        assert np.sqrt(np.mean(hidden**2)) > 20, effect.name  # µg
        double = dp.simulate({effect.name: 2 * size}, seed=2)["output"] - plain
        assert np.std(double - 2 * hidden) < 0.05 * np.std(double), effect.name


def test_the_command_refuses_an_instrument_without_pairs() -> None:
    done = run("pairs", TABLE, *GYRO)
    assert done.status == 2
    assert done.said == ["bayescal: instrument 'mems_gyro' does not choose its devices in pairs"]


@needs_installation
@pytest.mark.slow
def test_the_command_answers_in_json_and_in_text(batch, tmp_path: Path) -> None:
    own = tmp_path / "pair.py"
    own.write_text("from bayescal_models.differential_pair import INSTRUMENT\n", encoding="utf-8")
    file = batch.readings.write(tmp_path / "batch.csv")
    done = run("pairs", file, "--instrument", f"{own}:INSTRUMENT", "--json")
    assert done.status == 0, done.err
    assert len(done.data["pairs"]) == 9
    text = run("pairs", file, "--instrument", f"{own}:INSTRUMENT", "--criterion", "ratio-variance")
    assert "best pair by ratio-variance" in text.out


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 4])
def test_a_factor_of_the_product_is_put_with_the_hyper_parameters(count: int) -> None:
    plan = replace(SMALL, outer=count, inner=count)
    found = bc.fit(dp.INSTRUMENT.baseline(), dp.simulate(seed=7, campaign=plan))
    assert set(found.layout.promoted) == set(order_names(SHARED.name))
    assert found.verdict.sampler == "importance sampling"
