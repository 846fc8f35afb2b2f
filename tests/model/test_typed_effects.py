"""Effects from one typed line: fifteen that are right, fifteen that are refused with the place marked, none runs."""

from __future__ import annotations

import contextlib
import pickle
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.export_check import needs_compiler, run_header
from tests.support.golden import assert_golden
from tests.support.inside import frame_of

GYROSCOPE: bc.Instrument = mems_gyro.INSTRUMENT
N = 40


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    random = np.random.default_rng(4)
    time = np.arange(N) * 60.0
    temperature = 25 + 20 * np.sin(time / 500)
    columns = {
        "run": np.repeat(["a", "b"], N // 2),
        "time": time,
        "temperature": temperature,
        "rate_input": 100 * np.cos(time / 300),
        "supply_voltage": 5 + 0.2 * random.normal(size=N),
        "oven temp": temperature + 3,
        "humidity": 0.4 + 0.1 * random.random(N),
    }
    units = {"supply_voltage": "V", "oven temp": "degC", "humidity": "%", "temperature": "degC"}
    columns["humidity"] = 100 * columns["humidity"]
    return bc.Measurements.from_arrays(
        GYROSCOPE, units=units, output=20 + 0.05 * temperature, **columns
    )


# Line; unit of its first coefficient; the basis by hand, in base units; shapes at which.
RIGHT = {
    "supply: s * (supply_voltage - 5); s = 0.1 deg/s/V": (lambda r, e: r["supply_voltage"] - 5, {}),
    "bias.ratio: s * (V - 5) / V; s = 0.1 deg/s; V = supply_voltage": (
        lambda r, e: (r["supply_voltage"] - 5) / r["supply_voltage"], {},
    ),
    "warm: a * exp(-elapsed / tau); a = 0.1 deg/s; tau = 100 to 2000 s": (
        lambda r, e: np.exp(-e / 300.0), {"tau": 300.0},
    ),
    "warm: a * (1 - exp(-elapsed/tau)); a = 0.1 deg/s; tau = 5 min": (
        lambda r, e: 1 - np.exp(-e / 300.0), {"tau": 300.0},
    ),
    "square: k * (temperature - 25)^2; k = 1e-4 deg/s/degC^2": (
        lambda r, e: (r["temperature"] - 25) ** 2, {},
    ),
    "power: k * 2 * T ** 2 ** 1; k = 1e-4 deg/s/degC^2": (lambda r, e: 2 * r["temperature"] ** 2, {}),
    f"signs: -k * {'-' * 484}T / -2; k = 0.01 deg/s/degC": (lambda r, e: r["temperature"] / 2, {}),
    "gradient: g * (`oven temp` - temperature); g = 10 mdps/degC": (lambda r, e: 3 + 0 * e, {}),
    "damp: h * (humidity - 0.45); h = 0.01 deg/s/%": (lambda r, e: r["humidity"] - 0.45, {}),
    "hinge: h * max(0, T - 30); h = 0.01 deg/s/degC": (
        lambda r, e: np.maximum(0, r["temperature"] - 30), {},
    ),
    "late: h * step(elapsed - 600); h = 0.1 deg/s": (lambda r, e: 1.0 * (e > 600), {}),
    "wave: a * sin(2 * 3.14159 * t / p); a = 0.1 deg/s; p = 1000 s": (
        lambda r, e: np.sin(2 * 3.14159 * r["time"] / 1000.0), {"p": 1000.0},
    ),
    "scale.own: k * (T - 25) / 100; k = 500 ppm/degC": (lambda r, e: (r["temperature"] - 25) / 100, {}),
    "input: k * (rate_input - 50); k = 0.5 %": (lambda r, e: None, {}),
    "root: k * sqrt(abs(T - 25)) * (1.5e0 + .5); k = 0.1 deg/s/degC^0.5": (
        lambda r, e: 2 * np.sqrt(abs(r["temperature"] - 25)), {},
    ),
    "both: a + b * T; a = 0.5 ± 0.1 deg/s; b = 0.01 deg/s/degC": (
        lambda r, e: np.column_stack([1 + 0 * e, r["temperature"]]), {},
    ),
    "slope: k * rate(temperature); k = 0.1 deg/s/(degC/min)": (lambda r, e: None, {}),
    "behind: k * lag_difference(temperature, tau); k = 0.1 deg/s/degC; tau = 300 s": (
        lambda r, e: behind(r, "temperature"), {"tau": 300.0},
    ),
    "body: k * (body(temperature, tau) - 25)^2; k = 0.1 deg/s/degC^2; tau = 300 s": (
        lambda r, e: (r["temperature"] + behind(r, "temperature") - 25) ** 2, {"tau": 300.0},
    ),
    "input: k * body(rate_input, tau); k = 0.5 %; tau = 300 s": (  # base units are rad/s
        lambda r, e: np.pi / 180 * (r["rate_input"] + behind(r, "rate_input")), {"tau": 300.0},
    ),
}  # fmt: skip


def behind(readings: bc.Measurements, column: str, tau: float = 300.0) -> np.ndarray:
    """T̃ − T of a body that follows with τ."""
    frame = frame_of(readings)
    return np.asarray(frame.lag(jnp.array(tau), column))


@pytest.mark.parametrize("line", RIGHT, ids=lambda line: line[:40])
def test_formula_evaluates_to_its_expression(readings, line) -> None:
    by_hand, shapes = RIGHT[line]
    made = bc.effect(line, readings=readings, instrument=GYROSCOPE)
    frame = frame_of(readings)
    found = np.asarray(made.evaluate(frame, shapes))
    elapsed = np.asarray(frame.elapsed)
    expected = by_hand(readings, elapsed)
    if line.startswith("input: k * (rate"):
        expected = np.pi / 180 * (readings["rate_input"] - 50)  # base units are rad/s
    if line.startswith("slope"):
        expected = np.asarray(frame.rate("temperature"))
    np.testing.assert_allclose(found, np.reshape(expected, (N, -1)), rtol=1e-9, atol=1e-12)
    assert pickle.loads(pickle.dumps(made)) == made
    again = bc.effect(made.basis.text, readings=readings, instrument=GYROSCOPE)
    assert again == made and hash(again) == hash(made)


def test_slot_is_inferred_from_units(readings) -> None:
    def slot(line: str) -> str:
        return bc.effect(line, readings=readings, instrument=GYROSCOPE).slot

    assert slot("own: k * T; k = 1 ppm/degC") == "scale"
    assert slot("own: k * T; k = 1 dps/degC") == "bias"


def test_unstated_size_is_estimated_from_readings(readings) -> None:
    made = bc.effect("supply: s * (supply_voltage - 5)", readings=readings, instrument=GYROSCOPE)
    (own,) = made.coefficients
    spread = np.std(readings["output"]) / np.std(readings["supply_voltage"])
    assert own.unit == "deg/s/V" and own.size == pytest.approx(spread, rel=0.06)


REFUSED = (
    "supply: s * (supply_voltage - 5", "supply: s * * T", "supply: s * T T",
    "supply: s * suply_voltage", "supply: s * T # c", "supply: s * T.__class__",
    "supply: s * eval(T)", "supply: s * __import__(T)", "supply: s * T[0]",
    "supply: s * (supply_voltage - temperature)", "supply: s * exp(T); s = 1 deg/s",
    "supply: s * k * T", "supply: T - 25", "supply: s * T ^ humidity", "supply: s * body(T)",
    "supply: s * body(T, 300)", "supply: s * rate(T * 2)",
    "supply: s * exp(-elapsed / tau); s = 1 deg/s", "supply: s * 1e999", "supply: s * T * 10**-320",
    "supply: s * 1 / 0", "supply: s * 9**9**9**9", "supply: s * sqrt(-1)", "supply: s * run",
    "supply: s * pressure; s = 1 deg/s", "supply: s * min(T, supply_voltage)",
    "supply: " + "(" * 60, "supply: s * output",
)  # fmt: skip


def test_invalid_formula_is_refused_with_position_marked(readings) -> None:
    told = {}
    for line in REFUSED:
        with pytest.raises(bc.InputError) as refused:
            bc.effect(line, readings=readings, instrument=GYROSCOPE)
        told[line] = str(refused.value)
    assert_golden(Path(__file__).with_name("refused_formulas.txt"), told)


DIE = "die: b * body(T, tau) + c * (body(T, tau) - 25)^2 + d * lag_difference(T, tau)"
SIZES = "b = 0.1 deg/s/degC; c = 1e-3 deg/s/degC^2; d = 0.1 deg/s/degC; tau = 60 to 1200 s"


@pytest.mark.slow
@needs_compiler
def test_a_body_is_one_state_wherever_it_is_used(tmp_path: Path) -> None:
    """The output is a function of the body's temperature alone: the fit says so, and exports hold one state."""
    time, random = np.arange(200) * 30.0, np.random.default_rng(3)
    temperature = 25 + 20 * np.sin(time / 900)
    readings = bc.Measurements.from_arrays(
        GYROSCOPE, time=time, temperature=temperature, output=0 * time
    )
    warm = temperature + behind(readings, "temperature")
    noise = 0.02 * random.normal(size=time.size)
    output = 20 + 0.05 * warm + 2e-3 * (warm - 25) ** 2 + noise
    readings = readings.with_column("output", output)
    model = GYROSCOPE.baseline() - "bias.temperature"
    fit = bc.fit(
        model + bc.effect(f"{DIE}; {SIZES}", readings=readings), readings, bc.LeastSquares()
    )
    for name, true in (("[b]", 0.05), ("[c]", 2e-3), ("[d]", 0.0), (".tau", 300.0)):
        found = fit.samples(f"bias.die{name}")
        assert abs(found.mean() - true) < 4 * found.std(), name
    used = bc.compensator(fit)
    assert [i.name for i in used.inputs if i.kind == "lag"] == ["temperature_lag"]
    by_fit = used(readings, method="first order", noise=False)
    lag = behind(readings, "temperature", float(fit.samples("bias.die.tau").mean()))
    given = {"temperature": temperature, "temperature_lag": lag}
    rows = np.column_stack([output, *(given.get(i.name, 0 * lag) for i in used.inputs)])
    np.testing.assert_allclose(run_header(used, rows, tmp_path)[:, 0], by_fit.value, atol=1e-9)
    for suffix in ("py", "h"):
        text = used.export(tmp_path / f"die.{suffix}").read_text("utf-8")
        assert "temperature_lag" in text and "temperature_lag_2" not in text


FUNCTION = bc.Effect(
    "bias.own",
    "bias",
    basis=lambda r: 1 / (r["temperature"] - 25),
    coefficients=(bc.Coefficient("deg/s*degC", bc.Normal(0.0, 1.0)),),
    columns=("temperature",),
)


@pytest.mark.parametrize("own", ["s / (T - 25)", "s * sqrt(T / 1 - 25)", "s * T / 0", FUNCTION])
def test_basis_that_is_not_finite_in_a_reading_is_refused(readings, own) -> None:
    """In the model, and among the candidates of a search; typed, or a function."""
    data = readings.with_column("temperature", np.arange(N) + 5.0)
    if isinstance(own, str):
        own = bc.effect(f"own: {own}", readings=data, instrument=GYROSCOPE)
    with pytest.raises(bc.ModelError):
        bc.fit(GYROSCOPE.baseline() + own, data, bc.LeastSquares())
    plain = bc.fit(GYROSCOPE.baseline(), data, bc.LeastSquares(), strict=False)
    with pytest.raises(bc.ModelError):
        bc.discover(plain, effects=[own])


@given(st.text("0123456789.eE+-*/^() ,TVsk", max_size=24))
def test_no_line_ends_in_another_error_than_a_refusal(readings, text) -> None:
    with contextlib.suppress(bc.InputError):
        bc.effect(f"own: s * ({text})", readings=readings, instrument=GYROSCOPE)


@pytest.mark.parametrize(
    ("line", "shape", "low", "high"),
    [
        ("kink: c*tanh((temperature - 52)/w); c = 0.2 deg/s; w = 0.3 to 10 degC", "w", 0.3, 10.0),
        ("kink: c*exp(-(temperature - 52)/w); c = 0.2 deg/s; w = 9 to 18 degF", "w", 5.0, 10.0),
        ("kink: c*tanh((temperature - 52)/w); c = 0.2 deg/s; w = 1 to 3 K", "w", 1.0, 3.0),
        ("step: c*step(temperature - m); c = 0.2 deg/s; m = 50 to 122 degF", "m", 10.0, 50.0),
        (
            "bend: c*max(temperature, m); c = 0.2 deg/s/degC; m = 283.15 to 323.15 K",
            "m",
            10.0,
            50.0,
        ),
        ("step: c*step(temperature - m); c = 0.2 deg/s; m = -20 to 60 degC", "m", -20.0, 60.0),
    ],
)
def test_temperature_among_the_shapes_is_a_difference_or_a_place(line, shape, low, high) -> None:
    readings = mems_gyro.simulate({}, seed=1)
    made = bc.effect(line, readings=readings, instrument=mems_gyro.INSTRUMENT)
    (own,) = (s for s in made.shapes if s.name == shape)
    assert (own.low, own.high) == pytest.approx((low, high))


def test_kink_at_a_temperature_is_fitted_saved_and_loaded(tmp_path: Path) -> None:
    line = "kink: c*tanh((temperature - 52)/w); c = 0.2 deg/s; w = 0.3 to 10 degC"
    readings = mems_gyro.simulate({}, seed=1)
    kink = 0.3 * np.tanh((readings["temperature"] - 52) / 2.0)
    readings = readings.with_column("output", readings["output"] + kink)
    made = bc.effect(line, readings=readings, instrument=mems_gyro.INSTRUMENT)
    fitted = bc.fit(mems_gyro.INSTRUMENT.baseline() + made, readings, bc.LeastSquares(draws=200))
    again = bc.load(fitted.save(tmp_path / "c.nc"))
    for name, truth in (("bias.kink", 0.3), ("bias.kink.w", 2.0)):
        draws = again.samples(name)
        assert abs(draws.mean() - truth) < 4 * draws.std()


@pytest.mark.parametrize("name", ["unknown(run)", "unknown(run, jump)"])
def test_unknown_dependence_on_labels_is_refused(readings, name) -> None:
    with pytest.raises(bc.ModelError, match="run"):
        bc.fit(GYROSCOPE.baseline() + name, readings, bc.LeastSquares())
