"""Many devices at once: each as if fitted alone, none spoiled by another, and what they have in common."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize_scalar

import bayescal as bc
from bayescal._fleet import closed_form, stacks
from bayescal._fleet.population import pool
from bayescal._model.frame import Reference
from bayescal_models import mems_gyro
from tests.support.command_line import GYRO, needs_installation, run

MODEL = mems_gyro.INSTRUMENT.baseline()
SEED, COUNT, NOISE = 11, 24, 0.2
UNITS = {"temperature": "degC", "output": "deg/s"}


def table(seed: int = SEED, count: int = COUNT, least: int = 12, most: int = 30) -> pd.DataFrame:
    """Devices with lines of their own about a common one; other numbers of readings each."""
    rng = np.random.default_rng(seed)
    rows = []
    for d in range(count):
        n = int(rng.integers(least, most + 1))
        temperature = rng.uniform(-40, 85, n)
        constant, slope = rng.normal(2.0, 1.5), rng.normal(0.03, 0.01)
        output = constant + slope * (temperature - 20.0) + rng.normal(0, NOISE, n)
        frame = {"device": f"D{d:02d}", "temperature [degC]": temperature, "output [deg/s]": output}
        rows.append(pd.DataFrame(frame))
    return pd.concat(rows, ignore_index=True)


@pytest.fixture(scope="module")
def readings(tmp_path_factory) -> bc.Devices:
    file = tmp_path_factory.mktemp("lot") / "lot.parquet"
    made = table()
    order = np.random.default_rng(1).permutation(len(made))  # devices need not stand in order
    made.iloc[order].to_parquet(file)
    return bc.split_devices(file, mems_gyro.INSTRUMENT)


@pytest.fixture(scope="module")
def result(readings) -> bc.BatchResult:
    return bc.fit_batch(MODEL, readings)


def restricted(one: bc.Measurements) -> tuple[np.ndarray, np.ndarray, float]:
    """x̂, its covariance and σ of the gyro's line, by the textbook's formulas and a scalar minimiser."""
    t, y = one["temperature"], one["output"]
    j = np.column_stack([np.ones(len(t)), t - np.round(t.mean())])
    d = np.diag([e.coefficients[0].prior.sd ** 2 for e in MODEL.effects])  # pyright: ignore

    def negative(log_sd: float) -> float:
        v = np.exp(2 * log_sd) * np.eye(len(y)) + j @ d @ j.T
        return 0.5 * (np.linalg.slogdet(v)[1] + y @ np.linalg.solve(v, y))

    low = np.log(NOISE) - 2
    best = minimize_scalar(
        negative, bounds=(low, low + 4), method="bounded", options={"xatol": 1e-10}
    )
    sd = float(np.exp(best.x))
    covariance = np.linalg.inv(j.T @ j / sd**2 + np.linalg.inv(d))
    return covariance @ j.T @ y / sd**2, covariance, sd


def test_each_device_is_as_if_it_were_alone(readings, result) -> None:
    assert result.ok.all()
    for name in readings.names:
        x, covariance, sd = restricted(readings[name])
        one = result[name]
        np.testing.assert_allclose(one.mean[:2], x, rtol=1e-7)
        np.testing.assert_allclose(one.covariance[:2, :2], covariance, rtol=1e-5)
        assert one["noise.white"][0] == pytest.approx(sd, rel=5e-6)


def test_the_quick_way_is_least_squares(readings, monkeypatch) -> None:
    few = {name: readings[name].select(np.arange(12)) for name in readings.names[:3]}
    fast = bc.fit_batch(MODEL, few)
    monkeypatch.setattr(closed_form, "applies", lambda *_: False)
    ordinary = bc.fit_batch(MODEL, few)
    assert ordinary.ok.all()
    for one, other in zip(fast, ordinary, strict=True):
        np.testing.assert_allclose(one.mean, other.mean, rtol=2e-4)
        np.testing.assert_allclose(one.covariance[:2, :2], other.covariance[:2, :2], rtol=5e-4)


def test_flat_priors_give_ordinary_least_squares(readings) -> None:
    flat = [
        bc.Effect(e.name, e.slot, e.basis, (bc.Coefficient(e.coefficients[0].unit, bc.Flat()),))
        for e in MODEL.effects
    ]
    model = bc.Model(mems_gyro.INSTRUMENT, tuple(flat), MODEL.noise)
    found = bc.fit_batch(model, [readings[name] for name in readings.names])
    for name in readings.names:
        t, y = readings[name]["temperature"], readings[name]["output"]
        j = np.column_stack([np.ones(len(t)), t - np.round(t.mean())])
        x, rest = np.linalg.lstsq(j, y)[:2]
        variance = rest[0] / (len(y) - 2)
        np.testing.assert_allclose(found[name].mean[:2], x, rtol=1e-9)
        assert found[name]["noise.white"][0] == pytest.approx(np.sqrt(variance), rel=1e-9)
        expected = variance * np.linalg.inv(j.T @ j)
        np.testing.assert_allclose(found[name].covariance[:2, :2], expected, rtol=1e-8)


def test_chunks_change_nothing(readings, result) -> None:
    for name, one in zip(readings.names, bc.fit_batch(MODEL, readings, chunk=5), strict=True):
        np.testing.assert_allclose(one.mean, result[name].mean, rtol=1e-12)


def test_bad_devices_are_refused_by_themselves(tmp_path, result) -> None:
    made = table()
    first = made.groupby("device").head(1).index
    made = made.astype({"output [deg/s]": object})
    made.loc[first[2], "output [deg/s]"] = float("nan")
    made.loc[first[5], "output [deg/s]"] = "broken"
    made.loc[made.device == "D07", "temperature [degC]"] = 25.0
    made.loc[first[9], "temperature [degC]"] = 4000.0
    made = made.drop(made.index[made.device == "D11"][2:])  # two readings are left
    file = tmp_path / "lot.csv"
    made.to_csv(file, index=False)
    found = bc.fit_batch(MODEL, file)
    said = {
        "D02": "column 'output .deg/s.': is empty or NaN",
        "D05": "reads 'broken', a number in °/s was expected",
        "D07": "reads 25 °C, one temperature only",
        "D09": "plausible is",
        "D11": "leave no scatter about the model",
    }
    for name, message in said.items():
        assert re.search(message, found[name].reason), found[name].reason
        assert not found[name].ok
    good = sorted(n for n in result.devices if n not in said)
    assert [n for n in found.devices if found[n].ok] == good
    for name in good:
        np.testing.assert_allclose(found[name].mean, result[name].mean, rtol=1e-10)


def test_measurements_that_differ_do_not_stop_each_other(readings, result) -> None:
    lacking, broken = readings["D01"], readings["D02"]
    lacking = bc.Measurements(lacking.data.drop_vars("temperature"))
    broken = broken.with_column("output", np.where(np.arange(len(broken)) == 3, np.nan, 1.0))
    found = bc.fit_batch(
        MODEL,
        {"whole": readings["D00"], "lacking": lacking, "broken": broken, "last": readings["D03"]},
    )
    assert "needs the column 'temperature'" in found["lacking"].reason
    assert "reading 4 of device broken, column 'output': reads nan" in found["broken"].reason
    np.testing.assert_allclose(found["whole"].mean, result["D00"].mean, rtol=1e-12)
    np.testing.assert_allclose(found["last"].mean, result["D03"].mean, rtol=1e-12)


def test_what_is_wrong_with_all_is_said_at_once(tmp_path, readings) -> None:
    file = tmp_path / "lot.csv"
    table(count=3).drop(columns="temperature [degC]").to_csv(file, index=False)
    with pytest.raises(bc.InputError, match=r"'lot\.csv' lacks the column 'temperature'"):
        bc.fit_batch(MODEL, file)
    table(count=3).rename(columns={"output [deg/s]": "output [m]"}).to_csv(file, index=False)
    with pytest.raises(bc.InputError, match=r"its unit is \[m\]"):
        bc.fit_batch(MODEL, file)
    unnamed = table(count=3)
    unnamed.loc[4, "device"] = ""
    unnamed.to_csv(file, index=False)
    with pytest.raises(bc.InputError, match=r"line 6 of 'lot\.csv' names no device|row"):
        bc.fit_batch(MODEL, file)
    with pytest.raises(bc.ModelError, match="fit_batch maps"):
        bc.fit_batch(MODEL, readings, method=bc.NUTS())
    with pytest.raises(bc.ModelError, match="no coefficient that each device has one of"):
        bc.fit_batch(MODEL, readings, population=["bias.colour"])
    with pytest.raises(bc.InputError, match="there is no device"):
        bc.fit_batch(MODEL, [])


def test_files_are_devices_and_labels_may_have_another_name(tmp_path, result) -> None:
    made = table(count=3)
    for name, own in made.groupby("device"):
        own.drop(columns="device").to_csv(tmp_path / f"{name}.csv", index=False)
    files = sorted(tmp_path.glob("*.csv"))
    found = bc.fit_batch(MODEL, files)
    assert found.devices == ("D00", "D01", "D02")
    file = tmp_path / "serial.csv"
    made.rename(columns={"device": "serial"}).to_csv(file, index=False)
    split = bc.split_devices(file, mems_gyro.INSTRUMENT, columns={"device": "serial"})
    again = bc.fit_batch(MODEL, split)
    for name in found.devices:
        np.testing.assert_allclose(found[name].mean, result[name].mean, rtol=1e-10)
        np.testing.assert_allclose(again[name].mean, result[name].mean, rtol=1e-10)
    made.to_csv(tmp_path / "lot.csv", index=False)
    with pytest.raises(bc.InputError, match=r"'lot\.csv' holds device 'D00', which a file before"):
        bc.split_devices([*files, tmp_path / "lot.csv"], mems_gyro.INSTRUMENT)


def test_a_saved_batch_is_the_same(tmp_path, readings) -> None:
    broken = readings["D02"].with_column("output", np.full(len(readings["D02"]), np.nan))
    given = {
        "good": readings["D00"],
        "broken": broken,
        "also": readings["D01"],
        "3": readings["D03"],
    }
    found = bc.fit_batch(MODEL, given, population=["bias.temperature"])
    back = bc.load_batch(found.save(tmp_path / "lot_result.parquet"))
    pd.testing.assert_frame_equal(back.table(), found.table())
    np.testing.assert_array_equal(back["good"].covariance, found["good"].covariance)
    assert back.population is not None and found.population is not None
    pd.testing.assert_frame_equal(back.population.table, found.population.table)
    assert (back.about, back.devices) == (found.about, found.devices)
    assert str(back) == str(found)
    long = found.table()
    assert list(long.columns) == ["device", "coefficient", "mean", "sd", "unit", "ok", "reason"]
    assert list(dict.fromkeys(long.device)) == list(given)
    assert long[long.device == "broken"].shape[0] == 1
    (tmp_path / "other.parquet").write_bytes(b"nothing")
    with pytest.raises(bc.InputError, match=r"other\.parquet is no batch"):
        bc.load_batch(tmp_path / "other.parquet")
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "other.parquet")
    with pytest.raises(bc.InputError, match=r"other\.parquet is no batch"):
        bc.load_batch(tmp_path / "other.parquet")


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
    pooled = pool(np.stack([m for m, _ in alone]), np.stack([c for _, c in alone]), named, 3)
    assert pooled.population.ok
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
    found = pooled.population.table
    np.testing.assert_allclose(
        found["mean"], joint[:k], atol=0.05 * np.min(found["mean_sd"].to_numpy())
    )
    np.testing.assert_allclose(found["spread"], tau, rtol=0.03)


def _posterior(j, y, mean, covariance) -> tuple[np.ndarray, np.ndarray]:
    inner = np.linalg.inv(j.T @ j / 0.25 + np.linalg.inv(covariance))
    return inner @ (j.T @ y / 0.25 + np.linalg.solve(covariance, mean)), inner


def test_devices_with_few_readings_lean_on_the_others(readings) -> None:
    few = {name: readings[name] for name in readings.names}
    few["D00"] = few["D00"].select([0, 1, 2])
    common: Reference = {"T0": 20.0}
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
            c.unit, bc.Normal(0.0, 1.0), per="device", spread=bc.HalfCauchy(c.size)
        )
        return bc.Effect(f"{effect.name}_device", effect.slot, effect.basis, (own,))

    joint_model = (MODEL + of_each(constant) + of_each(line)).fix({"noise.white": NOISE})
    whole = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        temperature=made["temperature [degC]"].to_numpy(),
        output=made["output [deg/s]"].to_numpy(),
        device=made["device"].to_numpy(),
    )
    common: Reference = {"T0": 20.0}
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
        spread = joint.samples(f"{name}_device.spread")
        assert abs(row.spread - spread.mean()) < 0.2 * spread.std()
        assert row.spread_sd == pytest.approx(spread.std(), rel=0.15)


@pytest.mark.slow
def test_marginal_carries_the_noise_and_padding_weighs_nothing(readings, monkeypatch) -> None:
    """Against the posterior in closed form at each noise, summed over a grid of it; padded and not."""
    own = {name: readings[name].select(np.arange(11)) for name in readings.names[:3]}
    for padded in (False, True):
        monkeypatch.setattr(stacks, "EXACT", 0 if padded else 3)
        found = bc.fit_batch(MODEL, own, method=bc.Marginal(proposals=4096, rounds=2))
        assert found.ok.all()
        for name, one in own.items():
            mean, covariance = _over_noise(one)
            sd = np.sqrt(np.diag(covariance))
            np.testing.assert_allclose((found[name].mean[:2] - mean) / sd, 0, atol=0.1)
            np.testing.assert_allclose(found[name].sd[:2], sd, rtol=0.06)


def _over_noise(one: bc.Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the gyro's line, its noise integrated out under its half-Cauchy prior."""
    t, y = one["temperature"], one["output"]
    j = np.column_stack([np.ones(len(t)), t - np.round(t.mean())])
    d = np.diag([e.coefficients[0].size ** 2 for e in MODEL.effects])
    scale = 0.1  # of the half-Cauchy
    assert MODEL.noise.parameters()["noise.white"] == bc.HalfCauchy(scale)
    logs, means, inners = [], [], []
    for sd in np.exp(np.linspace(np.log(0.03), np.log(3.0), 400)):
        v = sd**2 * np.eye(len(y)) + j @ d @ j.T
        logs.append(-0.5 * (np.linalg.slogdet(v)[1] + y @ np.linalg.solve(v, y)))
        logs[-1] += np.log(sd / (scale**2 + sd**2))
        inners.append(np.linalg.inv(j.T @ j / sd**2 + np.linalg.inv(d)))
        means.append(inners[-1] @ j.T @ y / sd**2)
    w = np.exp(np.array(logs) - max(logs))
    w /= w.sum()
    mean, apart = w @ np.array(means), np.array(means) - w @ np.array(means)
    return mean, np.einsum("k,kij->ij", w, inners) + np.einsum("k,ki,kj->ij", w, apart, apart)


@pytest.mark.slow
def test_records_in_time_are_fitted_as_alone() -> None:
    model = MODEL + "bias.thermal_lag"
    made = {f"G{s}": mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=s) for s in range(3)}
    found = bc.fit_batch(model, made)
    assert found.ok.all()
    for name, one in made.items():
        alone = bc.fit(model, one, bc.LeastSquares())
        for unknown in ("bias.constant", "bias.temperature", "bias.thermal_lag"):
            draws = alone.samples(unknown)
            np.testing.assert_allclose(
                found[name][unknown], (draws.mean(), draws.std(ddof=1)), rtol=1e-3
            )


@needs_installation
def test_the_command_writes_the_table(tmp_path) -> None:
    made = table(count=4)
    made.loc[made.device == "D02", "temperature [degC]"] = 25.0
    lot, out = tmp_path / "lot.csv", tmp_path / "result.parquet"
    made.to_csv(lot, index=False)
    ended = run("batch", lot, *GYRO, "-o", out)
    assert ended.status == 1  # for D02; the others are written
    assert "1 of 4 devices have no result, or none to rely on" in ended.err
    assert "D02: device D02, column 'temperature': reads 25 °C" in ended.out
    assert bc.load_batch(out).ok.tolist() == [True, True, False, True]
    wrong = run("batch", lot, *GYRO, "-o", tmp_path / "result.csv")
    assert wrong.status == 2
    assert "a batch is saved as Parquet" in wrong.err
    other = tmp_path / "other.parquet"
    wrong = run("batch", tmp_path / "none.csv", *GYRO, "-o", other)
    assert wrong.status == 2
    assert "none.csv' cannot be read" in wrong.err
    assert not other.exists()
