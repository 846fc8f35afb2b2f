"""What a frame derives from time: elapsed time, rate and lag of the temperature; and the constants of its bases."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT
from tests.support.inside import constants_of, frame_of


def thermal(time, temperature, run=None) -> bc.Measurements:
    run = np.full(len(time), "1") if run is None else run
    return bc.Measurements.from_arrays(
        INSTRUMENT, run=run, time=time, temperature=temperature, output=np.arange(len(time)) * 0.1
    )


def framed(data: bc.Measurements):
    return frame_of(data)


def test_lag_of_a_ramp_and_a_hold_is_the_analytic_one() -> None:
    # 0.1 °C/s for 300 s, then held; read at irregular times, the corner among them.
    rng = np.random.default_rng(0)
    time = np.unique(np.concatenate([[0.0, 300.0], rng.uniform(0.0, 900.0, 30)]))
    temperature = 20 + 0.1 * np.minimum(time, 300.0)
    tau = 120.0
    on_ramp = -0.1 * tau * (1 - np.exp(-time / tau))
    corner = -0.1 * tau * (1 - np.exp(-300.0 / tau))
    exact = np.where(time <= 300, on_ramp, corner * np.exp(-(time - 300) / tau))
    lag = framed(thermal(time, temperature)).lag(jnp.asarray(tau))
    np.testing.assert_allclose(lag, exact, atol=1e-10)


def test_over_a_silence_a_body_settles_at_the_temperature_found_after_it() -> None:
    """Soaks of a tumble: four readings three minutes apart, then two hours to the next temperature."""
    soak, tau = np.arange(4) * 180.0, 900.0
    time = np.concatenate([soak, soak + 7200.0])
    temperature = np.repeat([25.0, -40.0], 4)
    lag = np.asarray(framed(thermal(time, temperature)).lag(jnp.asarray(tau)))
    assert np.all(lag[:4] == 0)  # left at 25 °C, 6,660 s to settle
    np.testing.assert_allclose(lag[4:], 65.0 * np.exp(-(6660.0 + soak) / tau), rtol=1e-12)
    ramp = np.linspace(25.0, -40.0, 8)  # one reading left out of a ramp is no silence
    kept = [0, 1, 2, 4, 5, 6, 7]
    steady = np.arange(8) * 180.0
    whole, gap = (
        framed(thermal(steady[i], ramp[i])).lag(jnp.asarray(tau)) for i in ([*range(8)], kept)
    )
    np.testing.assert_allclose(gap, np.asarray(whole)[kept], rtol=1e-12)


def test_lag_of_a_sine_follows_its_phase_and_gain() -> None:
    time = np.arange(0.0, 20000.0, 2.0)
    omega, tau = 2 * np.pi / 2000.0, 300.0
    lag = framed(thermal(time, 40 + 10 * np.sin(omega * time))).lag(jnp.asarray(tau))
    gain, phase = 1 / np.hypot(1, omega * tau), np.arctan(omega * tau)
    steady = 10 * gain * np.sin(omega * time - phase) - 10 * np.sin(omega * time)
    late = time > 5000
    np.testing.assert_allclose(np.asarray(lag)[late], steady[late], atol=1e-3)


def test_each_run_starts_without_lag_and_in_any_order_of_rows() -> None:
    time = np.concatenate([np.arange(0.0, 600.0, 60.0), np.arange(0.0, 600.0, 60.0) + 9000.0])
    temperature = np.concatenate([np.linspace(20, 40, 10), np.linspace(70, 30, 10)])
    run = np.repeat(["a", "b"], 10)
    whole = framed(thermal(time, temperature, run))
    tau = jnp.asarray(150.0)
    for half in (slice(0, 10), slice(10, 20)):
        alone = framed(thermal(time[half], temperature[half], run[half]))
        np.testing.assert_allclose(whole.lag(tau)[half], alone.lag(tau), atol=1e-12)
        np.testing.assert_allclose(whole.rate()[half], alone.rate(), atol=1e-15)
        np.testing.assert_allclose(whole.elapsed[half], time[half] - time[half][0])
        assert whole.lag(tau)[half][0] == whole.rate()[half][0] == 0
    mixed = np.argsort(np.tile(np.arange(10), 2), kind="stable")  # a, b, a, b …
    shuffled = framed(thermal(time[mixed], temperature[mixed], run[mixed]))
    np.testing.assert_allclose(shuffled.lag(tau), whole.lag(tau)[mixed], atol=1e-12)
    np.testing.assert_allclose(shuffled.rate(), whole.rate()[mixed], atol=1e-15)


def test_two_readings_at_one_time_do_not_start_a_run() -> None:
    time = np.arange(0.0, 900.0, 60.0)
    temperature = 20 + 20 * (1 - np.exp(-time / 300.0))
    once = framed(thermal(time, temperature))
    twice = framed(thermal(np.repeat(time, 2), np.repeat(temperature, 2)))
    tau = jnp.asarray(200.0)
    np.testing.assert_allclose(twice.lag(tau)[::2], once.lag(tau), atol=1e-12)
    np.testing.assert_allclose(twice.lag(tau)[1::2], once.lag(tau), atol=1e-12)
    # Both readings of a time see the same past; of the first time, none.
    np.testing.assert_allclose(twice.rate()[3::2], once.rate()[1:], rtol=1e-9)
    assert twice.rate()[0] == twice.rate()[1] == 0


def test_constants_of_the_bases_are_those_of_the_fit() -> None:
    time = np.arange(20) * 120.0
    data = thermal(time, 50 + 20 * np.sin(time / 900.0), np.repeat(["up", "down"], 10))
    found = bc.fit(INSTRUMENT.baseline(), data, bc.LeastSquares(), strict=False)
    later = data.select(data["run"] == "down").with_column(
        "temperature", data["temperature"][10:] + 30
    )
    old, new = found.frame, found.frame_of(later)
    for name, value in old.reference.items():
        assert new.reference[name] == value
    assert constants_of(later)["T0"] != found.reference["T0"]
    np.testing.assert_array_equal(new.progress, old.progress[10:])
    np.testing.assert_allclose(new.centred(), old.centred()[10:] + 30, rtol=1e-14)
    # Later in a run, a run is still as old as it was; and its coefficients are found by name.
    tail = found.frame_of(data.select(np.arange(14, 20)))
    np.testing.assert_array_equal(tail.elapsed, old.elapsed[14:])
    np.testing.assert_array_equal(tail.codes["run"], old.codes["run"][14:])
    stranger = found.frame_of(data.with_column("run", np.full(20, "third")))
    assert (np.asarray(stranger.codes["run"]) == -1).all()


@pytest.mark.parametrize("step", [0.1, 4.0, 70.0])  # s: 600 readings a window, 15, and two
def test_slopes_of_a_long_record_are_those_of_the_formula(step: float) -> None:
    rng = np.random.default_rng(5)
    time = 9e8 + np.cumsum(rng.exponential(step, 900))  # uneven, and on a clock that began long ago
    time[300:] += 50 * step  # a short gap
    time[600:] += 3000 * step  # one after which nothing is known
    time[10] = time[9]
    temperature = 20 + np.cumsum(rng.normal(0.0, 0.1, 900))
    temperature[200] += 200  # one wild reading must not cost digits elsewhere
    codes = rng.integers(0, 3, 900)  # runs that interleave
    rate = np.asarray(framed(thermal(time, temperature, codes.astype(str))).rate())
    steps = [np.diff(time[codes == run]) for run in range(3)]
    window = max(60.0, np.median([s for s in np.concatenate(steps) if s > 0])) * (1 + 1e-9)
    for i in range(900):
        past = np.flatnonzero((codes == codes[i]) & (time <= time[i]) & (np.arange(900) <= i))
        inside = past[time[past] >= time[i] - window]
        if (time[inside] == time[i]).all():  # the last step then
            inside = past[-1 - np.sum(time[past] == time[i]) :]
        dt = time[inside] - time[i]
        dt -= dt.mean()
        known = np.sum(dt**2) > 0 and np.ptp(time[inside]) <= 10 * window
        expected = np.sum(dt * temperature[inside]) / np.sum(dt**2) if known else 0.0
        dy = np.abs(temperature[inside] - temperature[inside].mean()).max()
        assert rate[i] == pytest.approx(expected, rel=1e-9, abs=1e-11 * dy)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(20.2, 60.4, 40.0), (25.3, 25.7, 25.5), (24.61, 24.69, 24.65), (25.3, 25.3, 25.3)],
)
def test_reference_temperature_lies_in_the_record(low: float, high: float, expected: float) -> None:
    temperature = np.linspace(low, high, 50)
    data = thermal(np.arange(50) * 60.0, np.linspace(20, 30, 50))
    narrow = data.with_column("temperature", temperature)
    assert constants_of(narrow)["T0"] == pytest.approx(expected, rel=1e-14)
    skew = narrow.with_column("temperature", np.where(np.arange(50) < 49, low, high + 1))
    assert low <= float(constants_of(skew)["T0"]) <= high + 1  # pyright: ignore[reportArgumentType]


def test_a_narrow_record_does_not_swell_the_constant() -> None:
    rng = np.random.default_rng(6)
    temperature = rng.uniform(25.3, 25.7, 400)
    data = bc.Measurements.from_arrays(
        INSTRUMENT, temperature=temperature, output=rng.normal(0.0, 0.1, 400)
    )
    model, how = INSTRUMENT.baseline(), bc.LeastSquares()
    own = bc.fit(model, data, how, strict=False)
    centred = bc.fit(model, data, how, strict=False, reference={"T0": float(np.mean(temperature))})
    assert np.std(own.samples("bias.constant")) < 1.02 * np.std(centred.samples("bias.constant"))
