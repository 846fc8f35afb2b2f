"""What is exported computes what Python computes: C99 in double and single precision, Python, JSON."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from tests.support.export_check import inputs_of, needs_compiler, random_rows, run_header, tilted
from tests.support.made_up import bent_sensor, split_search

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


MADE = {
    "bent": lambda: bc.compensator(bent_sensor.calibration()),
    "gyro": lambda: bc.compensator(bent_sensor.gyro()),
    "inclinometer": lambda: tilted()[0],
    "averaged over structures": lambda: bc.compensator(split_search.trail().calibration),
}


@pytest.fixture(scope="module", params=list(MADE))
def compensator(request) -> bc.Compensator:
    """One with memory, shapes, a user's own effect and no closed inverse; a straight line; angles."""
    return MADE[request.param]()


@pytest.fixture(scope="module")
def rows(compensator) -> np.ndarray:
    return random_rows(compensator, 10_000)


def expected(compensator: bc.Compensator, rows: np.ndarray) -> np.ndarray:
    """By JAX: value, uncertainty without and with noise."""
    given = inputs_of(compensator, rows)
    plain = compensator(output=rows[:, 0], method="first order", noise=False, **given)
    noisy = compensator(output=rows[:, 0], method="first order", **given)
    return np.column_stack([plain.value, plain.uncertainty, noisy.uncertainty])


@pytest.mark.slow
@needs_compiler
def test_the_header_in_double_precision_agrees_to_twelve_digits(
    compensator, rows, tmp_path
) -> None:
    found = run_header(compensator, rows, tmp_path)
    want = expected(compensator, rows)
    np.testing.assert_allclose(found[:, 1:3], want[:, 1:], rtol=1e-12)
    # A value near zero is a difference of large numbers: its digits are those of the reading, in the value's unit.
    value, wanted = found[:, 0], want[:, 0]
    np.testing.assert_array_equal(np.isnan(value), np.isnan(wanted))
    floor = 1e-3 * np.abs(wanted).max()
    assert np.max(np.abs(value - wanted) / np.maximum(np.abs(wanted), floor)) < 1e-12


@needs_compiler
def test_the_header_in_single_precision_agrees_to_its_own_rounding(
    compensator, rows, tmp_path
) -> None:
    found = run_header(compensator, rows, tmp_path, "float")
    value, uncertainty, inclination = compensator.program.run(
        rows[:, 0], inputs_of(compensator, rows), np.float32
    )
    noise = compensator.program.noise_variance(value, inputs_of(compensator, rows))
    noisy = np.hypot(uncertainty, np.sqrt(noise) * inclination)
    eps = float(np.finfo(np.float32).eps)
    # The same operations rounded the same way; libraries may differ in the last bits of tanh and exp.
    reading = np.abs(rows[:, 0])
    size = inclination * (reading + 1000 * eps * reading.max())  # in the value's unit
    assert np.max(np.abs(found[:, 0] - value) / size) < 8 * eps
    np.testing.assert_allclose(found[:, 1], uncertainty, rtol=64 * eps)
    np.testing.assert_allclose(found[:, 2], noisy, rtol=64 * eps)
    want = expected(compensator, rows)
    assert np.max(np.abs(found[:, 0] - want[:, 0]) / (inclination * reading.max())) < 16 * eps


@needs_compiler
def test_the_header_flags_each_input_outside_its_range(compensator, rows, tmp_path) -> None:
    row = np.array([np.median(rows, axis=0)] * (1 + len(compensator.inputs)))
    for k, i in enumerate(compensator.inputs):
        row[1 + k, 1 + k] = i.high + 0.5 * (i.high - i.low)
    flags = run_header(compensator, row, tmp_path)[:, 3].astype(int)
    own = (1 << len(compensator.inputs)) - 1
    bits = [0 if i.settled else 1 << k for k, i in enumerate(compensator.inputs)]
    assert [f & own for f in flags] == [0, *bits]


@needs_compiler
def test_lags_of_a_record_carry_the_uncertainty_of_their_time_into_firmware(tmp_path) -> None:
    """The state of a lag and of its slope by the recursions in the header; then C against Python on that record."""
    compensator = bc.compensator(bent_sensor.calibration())
    record = bent_sensor.readings(2)
    time, temperature = record["time"], record["temperature"]
    (lag,) = (i for i in compensator.inputs if i.kind == "lag")
    state, slope = np.zeros(len(time)), np.zeros(len(time))
    for n in range(1, len(time)):
        x, change = (time[n] - time[n - 1]) / lag.tau, temperature[n] - temperature[n - 1]
        shape = np.expm1(-x) / x
        state[n] = np.exp(-x) * state[n - 1] + shape * change
        slope[n] = np.exp(-x) * (slope[n - 1] + x * state[n - 1] / lag.tau)
        slope[n] += (np.exp(-x) + shape) * change / lag.tau
    own = {
        **{n: record[n] for n in ("humidity", "temperature")},
        "elapsed": time - time[0],
        lag.name: state,
        f"{lag.name}_by_tau": slope,
    }
    rows = np.column_stack([record["output"], *(own[i.name] for i in compensator.inputs)])
    found = run_header(compensator, rows, tmp_path)
    want = compensator(record, method="first order", noise=False)
    np.testing.assert_allclose(found[:, 0], want.value, rtol=0, atol=1e-9 * np.ptp(want.value))
    np.testing.assert_allclose(found[:, 1], want.uncertainty, rtol=1e-9)
    as_given = {n: v for n, v in own.items() if n != f"{lag.name}_by_tau"}
    without = compensator(output=record["output"], method="first order", noise=False, **as_given)
    assert np.max(np.abs(without.uncertainty / want.uncertainty - 1)) > 1e-3  # it does matter


def test_an_effect_that_firmware_cannot_compute_is_refused(tmp_path) -> None:
    gyro = bent_sensor.gyro()
    sorting = bc.Effect(
        "bias.sorted",
        "bias",
        basis=lambda r: jnp.sort(jnp.stack([r["temperature"], r["temperature"] ** 2]), axis=0)[0],
        coefficients=(bc.Coefficient("deg/s/degC"),),
        columns=("temperature",),
    )
    fit = bc.fit(gyro.model + sorting, gyro.readings, bc.LeastSquares(draws=40), strict=False)
    with pytest.raises(bc.ModelError):
        bc.compensator(fit).export(tmp_path / "gyro.h")
