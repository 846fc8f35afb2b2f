"""One composition: its Jacobian is the derivative of its mean, its closed form the integral of its density."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import bayescal as bc
from bayescal import effects
from bayescal._inference import block_elimination, gaussian, laplace
from bayescal._inference.nuts import program
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import Layout, bind
from bayescal_models import INSTRUMENTS, ng_accelerometer
from bayescal_models.mems_gyro import INSTRUMENT
from bayescal_models.mems_gyro.effects import THERMOMETER

# A model with everything in it that bends: a corrected column, a square, a lag, a scale factor, groups.
RICH = INSTRUMENT.baseline() + [
    "bias.temperature_quadratic",
    "bias.thermal_lag",
    "scale.constant",
    "scale.temperature",
    "bias.run",
    THERMOMETER,
]


def readings(rows: int = 14, seed: int = 5, **more) -> bc.Measurements:
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
    return bc.Measurements.from_arrays(INSTRUMENT, **columns)


def bound(model: bc.Model, data: bc.Measurements) -> SimpleNamespace:
    """A model bound to readings, a random point of all its unknowns, and an output drawn there."""
    layout, _ = bind(model, data)
    frame = build_frame(data, reference_of(data))
    rng = np.random.default_rng(8)
    v = jnp.asarray(rng.normal(0.0, 0.5, len(layout.hypers)))
    hyper = forward.hyper_values(layout, v)
    sd = forward.prior_sd(layout, hyper)
    x = forward.prior_mean(layout) + sd * rng.normal(size=layout.size)
    rows = forward.row_sd(layout) * rng.normal(size=(frame.size, len(layout.row_blocks)))
    y = forward.draw_readings(layout, frame, x, rows, v, jax.random.key(8))
    return SimpleNamespace(layout=layout, frame=frame, x=x, rows=rows, v=v, hyper=hyper, y=y)


# Derivatives.


@pytest.mark.parametrize(
    "promoted", [(), ("bias.temperature", "scale.constant")], ids=["x", "promoted"]
)
def test_jacobian_is_the_derivative_of_the_mean(promoted) -> None:
    b = bound(RICH, readings())
    layout = b.layout.promote(*promoted)
    rng = np.random.default_rng(1)
    v = jnp.asarray(rng.normal(0.0, 0.5, len(layout.hypers)))
    hyper = forward.hyper_values(layout, v)
    x = forward.prior_sd(layout, hyper) * rng.normal(size=layout.size)

    def mean(x, rows):
        return forward.mean(layout, b.frame, x, rows, hyper)

    line = forward.linearise(layout, b.frame, x, b.rows, hyper)
    by_x, by_rows = jax.jacfwd(mean, argnums=(0, 1))(x, b.rows)
    np.testing.assert_allclose(line.mean, mean(x, b.rows), rtol=1e-13)
    width = np.abs(by_x).max(axis=0)
    np.testing.assert_allclose(line.jacobian / width, by_x / width, rtol=1e-11, atol=1e-12)
    # A thermometer error moves its own reading and no other, so that one number a reading says all.
    diagonal = jnp.einsum("ij,ik->ijk", jnp.eye(b.frame.size), line.rows)
    np.testing.assert_allclose(diagonal, by_rows, rtol=1e-11, atol=1e-12)


def test_jacobian_agrees_with_finite_differences() -> None:
    b = bound(RICH, readings())
    line = forward.linearise(b.layout, b.frame, b.x, b.rows, b.hyper)
    mean = jax.jit(lambda x, rows: forward.mean(b.layout, b.frame, x, rows, b.hyper))
    step = 1e-4 * np.asarray(forward.prior_sd(b.layout, b.hyper))
    shift = np.diag(step)
    difference = [
        (mean(b.x + s, b.rows) - mean(b.x - s, b.rows)) / (2 * h)
        for s, h in zip(shift, step, strict=True)
    ]
    np.testing.assert_allclose(line.jacobian.T, difference, rtol=1e-6, atol=1e-7)
    moved = (mean(b.x, b.rows + 1e-4) - mean(b.x, b.rows - 1e-4)) / 2e-4
    np.testing.assert_allclose(line.rows[:, 0], moved, rtol=1e-6)


def test_columns_of_a_missing_effect_are_those_it_has_in_the_model() -> None:
    smaller, name = RICH - "scale.temperature", "scale.temperature"
    b = bound(smaller, readings())
    values = forward.coefficients(b.layout, b.x, b.rows, b.hyper)
    effect = INSTRUMENT.effect(name)
    ((column, size),) = forward.effect_columns(b.layout, b.frame, values, b.hyper, effect, {})
    larger = bound(smaller + effect, readings())
    x = jnp.append(b.x, 0.0)
    line = forward.linearise(larger.layout, larger.frame, x, b.rows, b.hyper)
    # The column sees the recorded temperature, the model the corrected one.
    corrected = np.asarray(b.frame.centred() + b.rows[:, 0])
    np.testing.assert_allclose(
        column[:, 0] / b.frame.centred(), line.jacobian[:, -1] / corrected, rtol=1e-12
    )
    assert size == effect.coefficients[0].prior.sd


# The contract of every effect of every instrument.


def instrument_effects() -> list:
    found = []
    for name in INSTRUMENTS:
        instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
        structural = [e for _, make in instrument.structures for e in make().effects]
        every = {e.name: e for e in (*instrument.effects, *instrument.candidates, *structural)}
        found += [pytest.param(instrument, e, id=f"{name}-{e.name}") for e in every.values()]
    return found


def made_up(instrument: bc.Instrument, rows: int = 12) -> bc.Measurements:
    """Readings of every column of an instrument, within its plausible ranges."""
    rng = np.random.default_rng(3)
    columns = {}
    for column in instrument.columns:
        if column.unit is None:
            columns[column.name] = np.resize(np.repeat(column.allowed or ["a", "b"], 3), rows)
        elif column.name == "time":
            columns[column.name] = np.cumsum(rng.uniform(20.0, 300.0, rows))
        elif column.name == "temperature_point":
            columns[column.name] = np.resize(np.repeat([20.0, 30.0, 40.0], 2), rows)
        else:
            low, high = (20.0, 50.0) if column.unit == "degC" else (0.05, 0.2)
            low = low if column.low is None else max(low, column.low)
            high = high if column.high is None else min(high, column.high)
            columns[column.name] = rng.uniform(low, high, rows)
    free = {c.name: "ug" for c in instrument.columns if c.unit == "any"}  # the file's to say
    return bc.Measurements.from_arrays(instrument, units=free, **columns)


@pytest.mark.parametrize(("instrument", "effect"), instrument_effects())
def test_slots_are_affine_in_the_coefficients_of_an_effect(instrument, effect) -> None:
    data = made_up(instrument)
    b = bound(bc.Model(instrument, (effect,), instrument.noise), data)
    names = {block.slot for block in b.layout.blocks}
    slots = {s.name for s in instrument.slots}

    def total(x, rows):
        """What the effect adds to its slots, or to the column it corrects."""

        def seen(filled, corrected):
            return sum(filled[n] if n in slots else corrected[n] for n in names)

        model = bc.Model(replaced(instrument, seen), (effect,), instrument.noise)
        return forward.mean(Layout(model, b.layout.counts), b.frame, x, rows, b.hyper)

    other = b.x[::-1] + 1.0
    both = total(b.x + other, b.rows) + total(0 * b.x, 0 * b.rows)
    apart = total(b.x, 0 * b.rows) + total(other, b.rows)
    scale = np.abs(apart).max()
    np.testing.assert_allclose(both, apart, rtol=1e-10, atol=1e-10 * scale)
    assert effect.equation
    assert effect.source
    assert np.isfinite(both).all()


@pytest.mark.parametrize(("instrument", "effect"), instrument_effects())
def test_an_effect_reads_only_the_columns_it_names(instrument, effect) -> None:
    data = made_up(instrument)
    b = bound(bc.Model(instrument, (effect,), instrument.noise), data)
    shapes = {s.name: b.hyper[effect.shape_name(s)] for s in effect.shapes}
    hidden = set(b.frame.columns) - set(effect.columns)
    if "time" in effect.columns:
        hidden.discard("elapsed")
    frame = eqx.tree_at(
        lambda f: [f.columns[n] for n in sorted(hidden)],
        b.frame,
        [jnp.full(b.frame.size, jnp.nan) for _ in hidden],
    )
    basis = effect.evaluate(frame, shapes)
    assert basis.shape == (b.frame.size, len(effect.coefficients))
    assert np.isfinite(basis).all()


def replaced(instrument: bc.Instrument, response) -> bc.Instrument:
    """The instrument with another response."""
    fields = {name: getattr(instrument, name) for name in instrument.__dataclass_fields__}
    return bc.Instrument(**{**fields, "response": response})


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_each_reading_responds_to_its_own_slots_alone(name) -> None:
    instrument = import_module(f"bayescal_models.{name}").INSTRUMENT
    data = made_up(instrument, rows=6)
    frame = build_frame(data, reference_of(data))
    slots = {s.name: jnp.full(frame.size, 1e-3) for s in instrument.slots}
    moves = jax.jacfwd(lambda s: instrument.response(s, frame))(slots)
    for slot, matrix in moves.items():
        off = np.asarray(matrix) - np.diag(np.diag(matrix))
        assert np.abs(off).max() == 0, slot
        assert np.isfinite(matrix).all(), slot


# The closed form against direct numbers.

GAUSSIAN = {
    "line": INSTRUMENT.baseline(),
    "runs": INSTRUMENT.baseline() + "bias.run",
    "thermometer": INSTRUMENT.baseline().fix({"bias.temperature": 0.05}) + THERMOMETER,
    "lag and drift": INSTRUMENT.baseline() + ["bias.thermal_lag", "bias.drift"],
    "nothing unknown": INSTRUMENT.baseline().fix({"bias.constant": 1.0, "bias.temperature": 0.05}),
}


@pytest.mark.parametrize("known", [False, True], ids=["one variance", "known uncertainties"])
@pytest.mark.parametrize("model", GAUSSIAN.values(), ids=GAUSSIAN)
def test_closed_form_is_the_multivariate_normal(model, known) -> None:
    more = {"output_uncertainty": np.random.default_rng(9).uniform(0.1, 0.5, 14)} if known else {}
    b = bound(model, readings(**more))
    point = gaussian.Point(b.x, b.rows)
    prior = gaussian.prior_of(b.layout, b.hyper, jnp.ones(b.layout.size))
    gram = gaussian.gram_function(b.layout, b.frame, b.y, point)(b.hyper, b.v)
    found = gaussian.condition(gram, b.frame.size, prior, b.x)

    line = forward.linearise(b.layout, b.frame, b.x, b.rows, b.hyper)
    J, D = np.asarray(line.jacobian), np.diag(np.asarray(prior.sd) ** 2)
    noise = b.layout.model.noise.variance(b.hyper, b.frame)
    S = np.diag(noise + jnp.sum((line.rows * forward.row_sd(b.layout)) ** 2, axis=1))
    centre = line.mean - jnp.sum(line.rows * b.rows, axis=1) + J @ (prior.mean - b.x)
    V = S + J @ D @ J.T
    direct = multivariate_normal(np.asarray(centre), V).logpdf(np.asarray(b.y))
    assert float(found.log_marginal) == pytest.approx(direct, rel=1e-9, abs=1e-7)
    gain = D @ J.T @ np.linalg.inv(V)
    mean = prior.mean + gain @ (b.y - centre)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(
        found.covariance, D - gain @ J @ D, atol=1e-8 * max(1.0, D.max(initial=0))
    )


def test_members_eliminated_first_and_products_between_nodes_change_nothing() -> None:
    readings = ng_accelerometer.simulate(seed=4)
    layout, _ = bind(ng_accelerometer.INSTRUMENT.baseline(), readings)
    layout = layout.promote("fixture_tilt.constant")
    frame = build_frame(readings, reference_of(readings))
    point = laplace.start_point(layout, frame)
    expected = forward.mean(layout, frame, point.x, point.rows, hyper_at(layout, 0.0))
    y = expected + np.random.default_rng(4).standard_normal(len(readings))
    products = gaussian.gram_function(layout, frame, y, point)
    for v in (-2.3, 0.4, 4.1):
        hyper = hyper_at(layout, v)
        prior = gaussian.prior_of(layout, hyper, jnp.ones(layout.size))
        gram = products(hyper, jnp.full(len(layout.hypers), v))
        assert isinstance(gram.jtj, block_elimination.Blocks)
        found = gaussian.condition(gram, frame.size, prior, point.x)
        line = forward.linearise(layout, frame, point.x, point.rows, hyper)
        whole = layout.model.noise.gram(line.jacobian, y - line.mean, 0.0, hyper, frame)
        direct = gaussian.condition(whole, frame.size, prior, point.x)
        assert float(found.log_marginal) == pytest.approx(float(direct.log_marginal), abs=1e-4)
        sd = np.sqrt(np.diag(direct.covariance))
        assert np.max(np.abs(found.mean - direct.mean) / sd) < 1e-5
        assert np.max(np.abs(found.covariance - direct.covariance) / np.outer(sd, sd)) < 1e-5
        assert float(found.log_jacobian) == pytest.approx(float(direct.log_jacobian), abs=1e-6)
        normal = jnp.linspace(-1, 1, layout.size)
        back = found.factor.back(normal)
        pulled = prior.sd * (whole.jtj @ (prior.sd * back)) + prior.weight * back
        np.testing.assert_allclose(found.factor.forward(pulled), normal, atol=1e-5)


def hyper_at(layout, v: float):
    return forward.hyper_values(layout, jnp.full(len(layout.hypers), v))


def test_flat_coefficients_are_integrated_over_the_whole_line() -> None:
    flat = bc.Model(
        INSTRUMENT,
        (
            effects.constant("bias", None, "deg/s", source="none"),
            INSTRUMENT.effect("bias.temperature"),
        ),
        bc.White(),
    )
    b = bound(flat, readings())
    sigma, sd = (
        b.hyper["noise.white"],
        INSTRUMENT.effect("bias.temperature").coefficients[0].prior.sd,
    )
    found = [
        gaussian.condition(
            gaussian.gram_function(b.layout, b.frame, b.y, gaussian.Point(b.x, b.rows))(
                b.hyper, b.v
            ),
            b.frame.size,
            gaussian.prior_of(b.layout, b.hyper, jnp.full(2, scale)),
            b.x,
        )
        for scale in (1.0, 30.0)
    ]
    # The same, whatever the scale of the flat column …
    assert float(found[0].log_marginal) == pytest.approx(float(found[1].log_marginal), abs=1e-10)
    np.testing.assert_allclose(found[0].mean, found[1].mean, rtol=1e-9)
    # … and ∫ N(y; a·1, V) da is N(y; â·1, V) times √(2π/1ᵀV⁻¹1).
    t, y = np.asarray(b.frame.centred()), np.asarray(b.y - b.frame["rate_input"])
    V = sigma**2 * np.eye(14) + sd**2 * np.outer(t, t)
    one = np.linalg.solve(V, np.ones(14))
    direct = multivariate_normal(np.full(14, one @ y / one.sum()), V).logpdf(y)
    direct += 0.5 * np.log(2 * np.pi / one.sum())
    assert float(found[0].log_marginal) == pytest.approx(direct, abs=1e-8)


# The NumPyro program says the same.


@pytest.mark.parametrize(
    "model",
    [
        RICH,
        RICH.with_noise(bc.StudentT()).fix({"bias.thermal_lag.tau": 200.0, "bias.constant": 3.0}),
    ],
    ids=["white", "student, some fixed"],
)
def test_numpyro_program_has_the_same_density(model) -> None:
    from numpyro.infer.util import log_density

    b = bound(model, readings())
    rng = np.random.default_rng(4)
    differences = []
    for _ in range(4):
        v = jnp.asarray(rng.normal(0.0, 0.7, len(b.layout.hypers)))
        hyper = forward.hyper_values(b.layout, v)
        sites = {h.name: hyper[h.name] for h in b.layout.hypers}
        x, ours = [], forward.hyper_log_prior(b.layout, v)
        for i, h in enumerate(b.layout.hypers):
            ours -= jnp.log(
                jax.grad(h.prior.value)(v[i])
            )  # density in the value, not in its coordinate
        for block in b.layout.x_blocks:
            z = jnp.asarray(rng.normal(size=block.size))
            c = block.coefficient
            spread = hyper[block.spread_name] if c.spread is not None else c.size
            sites[f"{block.name}.standard"] = z
            x.append(c.mean + spread * z)
            ours += block.size * jnp.log(spread)  # likewise: x is written in units of its spread
        e = jnp.asarray(rng.normal(size=b.rows.shape))
        rows = e * forward.row_sd(b.layout)
        sites["rows.standard"] = e
        x = jnp.concatenate(x)
        ours += forward.log_prior_x(b.layout, x, rows, hyper)
        ours += jnp.sum(forward.log_likelihood(b.layout, b.frame, b.y, x, rows, hyper))
        ours += b.rows.shape[0] * jnp.sum(jnp.log(forward.row_sd(b.layout)))
        theirs, trace = log_density(program(b.layout, b.frame), (b.y,), {}, sites)
        np.testing.assert_allclose(trace["x"]["value"], x, rtol=1e-12)
        np.testing.assert_allclose(trace["v"]["value"], v, rtol=1e-9, atol=1e-12)
        differences.append(float(theirs - ours))
    np.testing.assert_allclose(differences, 0.0, atol=1e-7)
