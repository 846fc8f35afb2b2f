"""The core against brute force: outputs and Jacobians of the composition, dense covariances, differences."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

import bayescal as bc
from bayescal import effects
from bayescal._calibration.leave_group_out import RecordSubset
from bayescal._inference import nuts
from bayescal._inference.density import Density
from bayescal._inference.gaussian import LOG_2PI, compute_column_scales
from bayescal._inference.laplace import find_mode, make_scan_grids
from bayescal._inference.linear_model import fill_amplitudes
from bayescal._inference.noise_on_record import total_log_density, whitening
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record, record_of
from bayescal._inference.sampling import BatchedDensity, Mixture, draw_weighted
from bayescal._model import composition, forward
from bayescal._model.parameters import bind
from bayescal._model.terms import ColumnSpec
from bayescal.effects.thermal import BODIES
from bayescal_models import (
    differential_pair,
    inclinometer,
    mems_gyro,
    ng_accelerometer,
    quartz_beam_accelerometer,
    still_sensor,
)
from tests.support.inside import constants_of, frame_of
from tests.support.tiers import slow_but

GYRO = mems_gyro.INSTRUMENT
WANDER = bc.OrnsteinUhlenbeck(10.0, 3000.0, bc.HalfCauchy(0.1), bc.HalfCauchy(0.1))
KNOWN = np.random.default_rng(9).uniform(0.1, 0.5, 14)
SCATTER = bc.Heteroscedastic("temperature rate", bc.HalfCauchy(0.1))
LAG = GYRO.baseline() + "bias.thermal_lag" + "bias.run"


# A model with everything in it that bends: a corrected column, a square, a lag, a scale factor, groups.
RICH = GYRO.baseline() + [
    "bias.temperature_quadratic",
    "bias.thermal_lag",
    "scale.constant",
    "scale.temperature",
    "bias.run",
    mems_gyro.model.THERMOMETER,
]


def two_runs(rows: int = 14, seed: int = 5, **more: Any) -> bc.Measurements:
    """Two runs over temperature on a rate table, irregular in time."""
    rng = np.random.default_rng(seed)
    half = rows // 2
    time = np.cumsum(rng.uniform(20.0, 400.0, rows)) + np.repeat([0.0, 3000.0], half)
    columns = {
        "run": np.repeat(["up", "down"], half),
        "time": time,
        "temperature": 50 + 20 * np.sin(time / 900.0) + rng.normal(0.0, 1.0, rows),
        "rate_input": rng.uniform(-100.0, 100.0, rows),
        "output": rng.normal(0.0, 1.0, rows),
        **more,
    }
    return bc.Measurements.from_arrays(GYRO, **columns)


def still(readings: bc.Measurements) -> bc.Model:
    return still_sensor.INSTRUMENT.for_readings(readings).baseline() + "bias.warm_up"


def simulated(module: Any, **how: Any) -> Callable[[], bc.Measurements]:
    return partial(module.simulate, {}, seed=1, **how)


PLAIN, BASE = simulated(mems_gyro), GYRO.baseline()
THERMOMETER = mems_gyro.model.THERMOMETER
SLOW_NOISE = bc.OrnsteinUhlenbeck(10.0, 3000.0, bc.HalfCauchy(10), bc.HalfCauchy(10))
CASES: dict[str, tuple[Any, Any]] = {
    "gyro": (LAG, PLAIN),
    "gyro, wandering": (LAG.with_noise(WANDER), PLAIN),
    "gyro, scatter": (LAG.with_noise(SCATTER), PLAIN),
    "gyro, tails": (LAG.with_noise(bc.StudentT(bc.HalfCauchy(0.1))), PLAIN),
    "gyro, rounded": ((BASE + "bias.run").with_noise(bc.Quantised(0.1, bc.HalfCauchy(0.1))), PLAIN),
    "gyro, thermometer": (BASE + THERMOMETER + "bias.temperature_quadratic", PLAIN),
    "gyro, thermometer, scatter": ((LAG + THERMOMETER).with_noise(SCATTER), PLAIN),
    "gyro, unknown": (BASE + "unknown(time)" + "unknown(time, jump)", PLAIN),
    "gyro, known uncertainties": (LAG, lambda: two_runs(output_uncertainty=KNOWN)),
    "gyro, nothing unknown": (BASE.fix({"bias.constant": 1.0, "bias.temperature": 0.05}), two_runs),
    "gyro, rich": (RICH, two_runs),
    **{
        f"gyro, {form}": (
            BASE + ["bias.temperature_quadratic", f"bias.thermal_lag.{form}", "bias.run"],
            PLAIN,
        )
        for form in BODIES
    },
    "gyro, held": (LAG.fix({"bias.temperature": 0.1}), PLAIN),
    "quartz": (
        quartz_beam_accelerometer.INSTRUMENT.baseline() + "bias.thermal_lag",
        simulated(quartz_beam_accelerometer),
    ),
    "ng": (ng_accelerometer.INSTRUMENT.baseline() + "second_order", simulated(ng_accelerometer)),
    "pair": (differential_pair.INSTRUMENT.baseline(), simulated(differential_pair)),
    "inclinometer": (inclinometer.INSTRUMENT.baseline(), simulated(inclinometer)),
    "still": (still, simulated(still_sensor)),
    "still, wandering": (
        lambda readings: still(readings).with_noise(SLOW_NOISE),
        simulated(still_sensor, noise_law="ornstein_uhlenbeck"),
    ),
}

FAST = ("gyro", "gyro, wandering", "gyro, scatter", "gyro, thermometer", "inclinometer")
FAST = (*FAST, "gyro, known uncertainties", "gyro, nothing unknown")
FORMS = [f"gyro, {form}" for form in BODIES]


def assembled(case: str, *promoted: str) -> Problem:
    model, simulate = CASES[case]
    readings = simulate()
    model = model if isinstance(model, bc.Model) else model(readings)
    record = record_of(model.instrument, readings, constants_of(readings))
    model = fill_amplitudes(model, readings, record)
    layout = bind(model, readings)[0].promote(*promoted)
    return Problem(layout, record.with_frame())


def bound(model: bc.Model, readings: bc.Measurements) -> Problem:
    return Problem(bind(model, readings)[0], record_of(GYRO, readings, constants_of(readings)))


def somewhere(a: Problem, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """An x and a coordinate of φ at random, within the priors."""
    random = np.random.default_rng(seed)
    v = 0.5 * random.standard_normal(len(a.hypers))
    sd = a.sizes.evaluate(a.hyper(v)) * 0.3
    return a.mean_of_x + sd * random.standard_normal(a.size), v


compile_lazily = eqx.filter_jit(forward.linearise)  # a program, not one for each step of it


def composed(a: Problem, x: np.ndarray, hyper: forward.Values) -> composition.Linearisation:
    """What the composition itself says at an x."""
    return compile_lazily(a.layout, a.record.frame, jnp.asarray(x), hyper)


@pytest.mark.parametrize("case", slow_but((*FAST, *FORMS), CASES))
def test_outputs_and_jacobians_are_those_of_the_composition(case: str) -> None:
    a = assembled(case)
    point, v = somewhere(a)
    found = a.linearise(point, a.hyper(v))
    hyper = a.layout.hyper(jnp.asarray(v))
    line = composed(a, point, hyper)
    scale = np.max(np.abs(line.mean))
    np.testing.assert_allclose(found.mean, line.mean, rtol=1e-9, atol=1e-9 * scale)
    columns = np.max(np.abs(line.jacobian), axis=0) + 1e-300
    np.testing.assert_allclose(found.jacobian / columns, line.jacobian / columns, atol=1e-8)
    np.testing.assert_allclose(found.inputs, line.inputs, rtol=1e-9)


def dense(a: Problem, v: np.ndarray, flat: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """log p(y, φ) about the start, and mean and covariance of x, by the covariance of all readings: Σ + J·D·Jᵀ."""
    start, hyper = a.start, a.layout.hyper(jnp.asarray(v))
    line = composed(a, start, hyper)
    extra = np.broadcast_to(a.extra(line), a.record.size)
    one = jnp.eye(a.record.size)
    white, _ = a.noise.whiten(one, jnp.asarray(extra), hyper, a.record.frame)
    sd = np.asarray(forward.prior_sd(a.layout, hyper, jnp.asarray(flat)))
    j = np.asarray(line.jacobian)
    covariance = np.linalg.inv(np.asarray(white.T @ white)) + (j * sd**2) @ j.T
    left = a.record.y - np.asarray(line.mean) + j @ (start - a.mean_of_x)
    volume = np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left)
    density = -0.5 * (volume + a.record.size * LOG_2PI)
    gain = np.linalg.solve(covariance, j * sd**2).T
    mean, known = a.mean_of_x + gain @ left, np.diag(sd**2) - gain @ (j * sd**2)
    return float(density + a.layout.log_prior(jnp.asarray(v))), mean, known


@pytest.mark.parametrize(
    "case", slow_but(FAST, sorted(CASES.keys() - {"gyro, tails", "gyro, rounded", *FORMS}))
)
def test_densities_are_those_of_the_dense_covariance(case: str) -> None:
    a = assembled(case)
    _, v = somewhere(a)
    flat = compute_column_scales(a.linearise(a.start, a.hyper(v)).jacobian)
    found, given = Density(a, a.start, flat, v).condition_at(v)
    density, mean, covariance = dense(a, v, flat)
    assert found == pytest.approx(density, rel=1e-7, abs=1e-4)
    assert given is not None
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(given.mean / sd, mean / sd, atol=1e-5)
    np.testing.assert_allclose(
        given.covariance / sd / sd[:, None], covariance / sd / sd[:, None], atol=1e-5
    )


def test_flat_coefficients_are_integrated_over_the_whole_line() -> None:
    flat = bc.Model(
        GYRO,
        (effects.constant("bias", None, "deg/s", source="none"), GYRO.effect("bias.temperature")),
        bc.White(),
    )
    problem = bound(flat, two_runs())
    _, v = somewhere(problem)
    sigma, frame = problem.hyper(v)["noise.white"], problem.record.frame
    sd = GYRO.effect("bias.temperature").coefficients[0].size
    found = [Density(problem, np.ones(2), np.full(2, s), v).condition_at(v) for s in (1.0, 30.0)]
    values = [total - problem.log_prior(v) for total, _ in found]
    # The same, whatever the scale of the flat column …
    assert values[0] == pytest.approx(values[1], abs=1e-8)
    one, other = (given for _, given in found)
    assert one is not None and other is not None
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-7)
    # … and ∫ N(y; a·1, V) da is N(y; â·1, V) times √(2π/1ᵀV⁻¹1).
    t, y = np.asarray(frame.centred()), problem.record.y - np.asarray(frame["rate_input"])
    V = sigma**2 * np.eye(14) + sd**2 * np.outer(t, t)
    one = np.linalg.solve(V, np.ones(14))
    direct = multivariate_normal(np.full(14, one @ y / one.sum()), V).logpdf(y)
    direct += 0.5 * np.log(2 * np.pi / one.sum())
    assert values[0] == pytest.approx(direct, abs=1e-7)


TABULATED = ("gyro", "gyro, wandering", "gyro, scatter", "gyro, known uncertainties", "gyro, held")
TABULATED = (*TABULATED, "gyro, unknown", "gyro, paths", "quartz", "inclinometer", "still", "pair")


@pytest.mark.parametrize("case", TABULATED)
def test_tabulated_density_is_that_of_the_readings(monkeypatch, case: str) -> None:
    a = assembled(case)
    x, v = somewhere(a)
    flat = compute_column_scales(a.linearise(a.start, a.hyper(v)).jacobian)
    table, readings = (Density(a, a.start if a.is_affine else x, flat, v) for _ in range(2))
    monkeypatch.setitem(vars(readings), "tabulated", None)
    ours, exact = table.condition_at(v), readings.condition_at(v)
    assert ours[0] == pytest.approx(exact[0], rel=1e-8, abs=1e-5)
    np.testing.assert_allclose(ours[1].mean, exact[1].mean, rtol=1e-5, atol=1e-7)  # pyright: ignore[reportOptionalMemberAccess]
    vs = v + 0.3 * np.random.default_rng(2).standard_normal((3, len(v)))
    vs = vs if a.is_affine else v[None]
    one_by_one = [table.condition_at(one)[0] for one in vs]
    np.testing.assert_allclose(table.values(vs), one_by_one, rtol=1e-8, atol=1e-5)


@pytest.mark.parametrize("case", TABULATED)
def test_tabulated_curvature_is_the_difference_of_slopes(case: str) -> None:
    a = assembled(case)
    x, v = somewhere(a)
    flat = compute_column_scales(a.linearise(a.start, a.hyper(v)).jacobian)
    density = Density(a, a.start if a.is_affine else x, flat, v)
    found, step = density.evaluate(v), 1e-4
    assert found is not None and found.curvature is not None
    for row, unit in zip(found.curvature, step * np.eye(len(v)), strict=True):
        ends = (density.evaluate(v + sign * unit).gradient for sign in (-1, 1))
        difference = -np.diff(np.array([*ends]), axis=0)[0] / (2 * step)
        np.testing.assert_allclose(row, difference, rtol=1e-3, atol=1e-3)
    if (
        case == "gyro, paths"
    ):  # its columns have kinks, over which the table's slopes are differences of 0.002
        return
    ends = density.values(np.concatenate([v + step * np.eye(len(v)), v - step * np.eye(len(v))]))
    slopes = -np.diff(ends.reshape(2, -1), axis=0)[0] / (2 * step)
    np.testing.assert_allclose(found.gradient, slopes, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize(
    "case", slow_but(FAST, ["gyro", "gyro, wandering", "gyro, scatter", "gyro, stages"])
)
def test_table_about_a_mode_is_the_density(case: str) -> None:
    a = assembled(case)
    mode = find_mode(a)
    random, root = np.random.default_rng(1), np.linalg.cholesky(mode.covariance)
    vs = mode.v + random.standard_normal((5, len(mode.v))) @ root.T
    many = BatchedDensity(a, mode)
    assert many.table is not None
    found, _ = many.draw_at(vs, np.zeros((5, a.size)))
    np.testing.assert_allclose(found, many.density.values(vs), atol=0.02)


@pytest.mark.parametrize(
    "model",
    [
        LAG.fix({"noise.white": 0.1}),
        LAG.with_noise(SCATTER).fix({"noise.white": 0.1}),
        LAG.with_noise(WANDER).fix({"noise.white": 0.1, "bias.thermal_lag.tau": 300.0}),
    ],
    ids=["white", "scatter", "wander"],
)
def test_cached_terms_are_equal_for_several_draws(monkeypatch, model: bc.Model) -> None:
    monkeypatch.setitem(CASES, "held", (model, PLAIN))
    a = assembled("held")
    mode = find_mode(a)
    v = mode.v + 0.1 * np.random.default_rng(0).standard_normal((3, len(a.hypers)))
    there = Density(a, mode.x, mode.flat, mode.v)
    here, _ = BatchedDensity(a, mode).draw_at(v, np.zeros((3, a.size)))
    np.testing.assert_allclose(here, there.values(v), atol=0.05)
    left = np.tile(a.record.y, (3, 1))
    both = [whitening(a.noise, a.hyper(one), a.record, 0.0).whiten(left.T) for one in v]
    sums = [np.sum(w**2, axis=0)[0] + volume + a.record.size * LOG_2PI for w, volume in both]
    found = total_log_density(a.noise, a.record, left, a.hyper(v.T))
    np.testing.assert_allclose(found, -0.5 * np.array(sums), rtol=1e-9)


def test_mode_maximises_the_density() -> None:
    a = assembled("gyro")
    mode = find_mode(a)
    density = Density(a, mode.x, mode.flat, mode.v)
    best = minimize(lambda v: -density.condition_at(v)[0], mode.v, method="Nelder-Mead")
    assert -best.fun < mode.log_density + 1e-3
    np.testing.assert_allclose(mode.v, best.x, atol=2e-3)


def stepped(place: float) -> Problem:
    """A step at a place of a record of correlated noise: few prior draws come near it."""
    random, t = np.random.default_rng(7), 10.0 * np.arange(600)
    wander = np.cumsum(0.02 * random.standard_normal(600))
    output = wander + 0.5 * (t > place * t[-1]) + 0.05 * random.standard_normal(600)
    columns = {"time": t, "temperature": 25 + np.sin(t / 900), "output": output}
    sensor, units = still_sensor.INSTRUMENT, {"output": "dps"}
    readings = bc.Measurements.from_arrays(sensor, units=units, **columns)
    model = (still(readings) + "unknown(time, jump)").with_noise(WANDER)
    record = record_of(model.instrument, readings, constants_of(readings))
    return Problem(bind(fill_amplitudes(model, readings, record), readings)[0], record)


@pytest.mark.parametrize("place", slow_but([0.61], [0.23, 0.61, 0.88]))
def test_of_many_maxima_the_highest_is_the_mode(place: float) -> None:
    a = stepped(place)
    mode = find_mode(a)
    density = Density(a, mode.x, mode.flat)
    (along,) = make_scan_grids(a, mode.v)
    assert density.condition_at(mode.v)[0] > max(density.condition_at(v)[0] for v in along) - 1e-3
    assert a.hyper(mode.v)["unknown(time, jump).place"] == pytest.approx(place, abs=0.01)


@pytest.mark.slow
def test_search_restarts_at_a_higher_maximum_found_by_draws() -> None:
    a = stepped(0.61)
    top, at = find_mode(a), [h.name for h in a.hypers].index("unknown(time, jump).place")
    low = find_mode(a, [np.where(np.arange(len(top.v)) == at, top.v - 0.5, top.v)])
    assert low.log_density < top.log_density - 5
    drawn, right = (draw_weighted(a, mode, 0, 4096, 12) for mode in (low, top))
    np.testing.assert_allclose(drawn.mode.v, top.v, atol=0.02)
    error = float(np.hypot(drawn.log_evidence_error, right.log_evidence_error))
    assert drawn.log_evidence == pytest.approx(right.log_evidence, abs=4 * error)


def test_two_sided_proposals_are_drawn_by_their_density() -> None:
    axes, down, up = 2 * np.eye(6), 0.3, np.linspace(0.5, 3, 6)
    mixture = Mixture(np.zeros((1, 6)), axes, np.zeros(6), axes, 0.95, (down, up), 15.0)
    v = mixture.draw(np.random.default_rng(0), 20_000)
    true = multivariate_normal.logpdf(0.5 * v / np.where(v < 0, down, up), np.zeros(6))
    weight = np.exp(true - np.sum(np.log(down + up)) - mixture.log_density(v))
    assert abs(weight.mean() - 1) < 4 * weight.std() / np.sqrt(len(v))


@pytest.mark.parametrize("tau", [61.0, 300.0, 1150.0])
def test_interpolated_columns_equal_computed_ones(tau: float) -> None:
    a = assembled("gyro")
    effect = ColumnSpec.from_effect(GYRO.effect("bias.thermal_lag"))
    v = np.array([effect.priors[0].coordinate(tau)])
    box = a.record.expansions(effect, (None,)).get(v + 0.2, True)
    exact = a.record.columns(effect, (tau,))
    assert box.half > 0 and box.distance(v) < 1
    assert np.max(np.abs(box.columns @ box.factors(v).value - exact)) < 1e-7 * np.max(np.abs(exact))


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("share", [1, 2], ids=["whole", "half"])
def test_wandering_noise_is_whitened_as_its_covariance_says(known: bool, share: int) -> None:
    """Of a part, what is left out says nothing, and its time still passes."""
    record, random = assembled("gyro, wandering").record, np.random.default_rng(0)
    rows = np.sort(random.permutation(record.size)[: record.size // share])
    record = record if share == 1 else RecordSubset(record, rows)
    extra = random.uniform(0.0, 0.01, record.size) if known else 0.0
    values = {"noise.white": 0.05, "noise.diffusion": 0.002, "noise.correlated.time": 400.0}
    table = random.standard_normal((record.size, 3))
    white = whitening(WANDER, values, record, extra)
    frame = assembled("gyro, wandering").record.frame
    time, run = np.asarray(frame["time"])[rows], np.asarray(frame.codes["run"])[rows]
    apart = np.abs(time[:, None] - time)
    same = run[:, None] == run
    covariance = same * 0.5 * 0.002**2 * 400.0 * np.exp(-apart / 400.0)
    covariance += np.diag(0.05**2 + extra * np.ones(record.size))
    made, log_volume = white.whiten(table)
    np.testing.assert_allclose(made.T @ made, table.T @ np.linalg.solve(covariance, table))
    assert log_volume == pytest.approx(np.linalg.slogdet(covariance)[1])


def test_a_response_without_a_slope_somewhere_is_not_taken_for_affine() -> None:
    """An arcsine has no slope beyond one: at tilts of verification data a large random slot leads there."""
    instrument, count = inclinometer.INSTRUMENT, 40
    tilt = np.deg2rad(np.linspace(-40.0, 40.0, count))
    readings = bc.Measurements.from_arrays(
        instrument,
        axis=np.repeat("x", count),
        run=np.repeat("x1", count),
        placement_angle=np.zeros(count),
        true_angle=tilt,
        output=np.rad2deg(tilt) * 3600,
    )
    frame = frame_of(readings)
    assert Record(instrument, frame, readings["output"]).affine_map is None
    assert assembled("inclinometer").record.affine_map is not None  # no tilt: a sum


@pytest.mark.parametrize(
    "model",
    [
        RICH,
        pytest.param(
            RICH.with_noise(bc.StudentT()).fix(
                {"bias.thermal_lag.tau": 200.0, "bias.constant": 3.0}
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["white", "student, some fixed"],
)
def test_numpyro_program_has_the_same_density(model) -> None:
    from numpyro.infer.util import log_density

    a, rng = bound(model, two_runs()), np.random.default_rng(4)
    layout, frame, y = a.layout, a.record.frame, jnp.asarray(a.record.y)
    differences = []
    for _ in range(4):
        v = jnp.asarray(rng.normal(0.0, 0.7, len(layout.hypers)))
        hyper = layout.hyper(v)
        sites = {h.name: hyper[h.name] for h in layout.hypers}
        x, ours = [], layout.log_prior(v)
        for i, h in enumerate(layout.hypers):
            # density in the value, not in its coordinate
            ours -= jnp.log(jax.grad(h.prior.value)(v[i]))
        for block in layout.x_blocks:
            z = jnp.asarray(rng.normal(size=block.size))
            c = block.coefficient
            spread = hyper[block.group_sd_name] if c.group_sd is not None else c.size
            sites[f"{block.name}.standard"] = z
            x.append(c.mean + spread * z)
            ours += block.size * jnp.log(spread)  # likewise: x is written in units of its spread
        x = jnp.concatenate(x)
        ours += forward.log_prior_x(layout, x, hyper)
        ours += jnp.sum(forward.log_likelihood(layout, frame, y, x, hyper))
        theirs, trace = log_density(nuts.build_program(layout, frame), (y,), {}, sites)
        np.testing.assert_allclose(trace["x"]["value"], x, rtol=1e-12)
        np.testing.assert_allclose(trace["v"]["value"], v, rtol=1e-9, atol=1e-12)
        differences.append(float(theirs - ours))
    np.testing.assert_allclose(differences, 0.0, atol=1e-7)
