"""Correlated noise is the Gaussian process that it claims to be, alone or in a sum, in time linear in the readings."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import bayescal as bc
from bayescal._inference.noise_nodes import EvenSpectrum
from bayescal._model.noise_terms import FLICKER_TIME_RATIO, SHORTEST_TIME_STEPS, WALK_TIME_SPANS
from bayescal_models import still_sensor
from tests.support.inside import frame_of
from tests.support.tiers import slow_but

SENSOR = still_sensor.instrument("ug", size=30.0, constant=300.0, span=20.0)
STEP, SPAN = 2.0, 150.0  # s
VALUES = {
    "noise.white": 0.3, "noise.diffusion": 0.2, "noise.correlated.time": 7.0,
    "noise.correlated1.diffusion": 0.2, "noise.correlated1.time": 7.0,
    "noise.correlated2.diffusion": 0.1, "noise.correlated2.place": -0.3,
    "noise.correlated3.diffusion": 0.05, "noise.correlated3.place": 0.6, "noise.smooth": 0.5,
    "noise.smooth.time": 30.0, "noise.walk": 0.04, "noise.flicker": 0.25, "noise.tone": 0.4,
    "noise.tone.frequency": 0.07, "noise.tone.time": 60.0, "noise.quantisation": 0.35,
    "noise.averaging": 0.45,
}  # fmt: skip
ALONE = ("Ornstein–Uhlenbeck",)  # the law of its own
SUMS = [
    ("correlated",), ("walk",), ("flicker",), ("smooth",), ("tone",), ("correlated", "correlated"),
    ("correlated", "walk"), ("smooth", "correlated"),
    ("tone", "smooth", "flicker", "walk", "correlated", "correlated", "correlated"),
]  # fmt: skip
name_of = "+".join


def law_of(terms: tuple[str, ...]) -> Any:
    return bc.OrnsteinUhlenbeck(STEP, SPAN) if terms == ALONE else bc.SummedNoise(STEP, SPAN, terms)


def exponential(variance: float, time: float) -> Callable[[Any], Any]:
    return lambda lag: variance * np.exp(-np.abs(lag) / time)


def ladder_times() -> list[float]:
    times = [SHORTEST_TIME_STEPS * STEP]
    while times[-1] < SPAN:
        times.append(times[-1] * FLICKER_TIME_RATIO)
    return times


def covariance_of(term: str, place: int = 1) -> Callable[[Any], Any]:
    """Of two readings some seconds apart, by the term's definition."""
    at = VALUES
    if term in ALONE:
        time = at["noise.correlated.time"]
        return exponential(0.5 * at["noise.diffusion"] ** 2 * time, time)
    if term == "correlated":
        time = at["noise.correlated1.time"]
        for k in range(2, place + 1):
            share = 0.5 * math.erfc(-at[f"noise.correlated{k}.place"] / math.sqrt(2))
            time = math.exp((1 - share) * math.log(time) + share * math.log(SPAN))
        return exponential(0.5 * at[f"noise.correlated{place}.diffusion"] ** 2 * time, time)
    if term == "walk":
        time = WALK_TIME_SPANS * SPAN
        return exponential(0.5 * at["noise.walk"] ** 2 * time, time)
    if term == "flicker":
        each = at["noise.flicker"] ** 2 * math.log(FLICKER_TIME_RATIO) / math.pi
        return lambda lag: sum(exponential(each, time)(lag) for time in ladder_times())
    if term == "smooth":
        rate = math.sqrt(3) / at["noise.smooth.time"]
        return lambda lag: (
            at["noise.smooth"] ** 2 * (1 + rate * np.abs(lag)) * np.exp(-rate * np.abs(lag))
        )
    if term in ("quantisation", "averaging"):
        size, sign = (0.35 / STEP, -1) if term == "quantisation" else (0.5 * 0.45, 1)
        near = [lambda lag, k=k: np.isclose(np.abs(lag), k * STEP) for k in (0, 1)]
        return lambda lag: size**2 * (2.0 * near[0](lag) + sign * near[1](lag))
    turn = 2 * math.pi * at["noise.tone.frequency"]
    fading = exponential(at["noise.tone"] ** 2, at["noise.tone.time"])
    return lambda lag: fading(lag) * np.cos(turn * lag)


def slow_covariance(terms: tuple[str, ...], lag: np.ndarray) -> np.ndarray:
    places = [terms[: i + 1].count(term) for i, term in enumerate(terms)]
    parts = [covariance_of(t, p)(lag) for t, p in zip(terms, places, strict=True)]
    return sum(parts, np.zeros(lag.shape))


def two_runs(seed: int = 3) -> tuple[bc.Frame, np.ndarray, np.ndarray]:
    """60 readings at uneven times, three of them at one; 40 in one run, 19 in another, and one alone."""
    random = np.random.default_rng(seed)
    time = np.concatenate(
        [np.sort(random.uniform(0, 90, 40)), np.sort(random.uniform(200, 260, 20))]
    )
    time[5] = time[6] = time[4]
    time[21] = time[20] + 1e-4
    labels = np.repeat(["a", "b", "c"], [40, 19, 1])
    data = bc.Measurements.from_arrays(
        SENSOR, run=labels, time=time, temperature=np.linspace(10.0, 50.0, 60), output=np.zeros(60)
    )
    return frame_of(data).sort_by_time(), time, labels


def in_jax(law: bc.Noise) -> dict[str, Any]:
    return {name: jnp.asarray(VALUES[name]) for name in law.parameters()}


@pytest.mark.parametrize(
    "terms", slow_but([ALONE, ("walk",), ("tone",)], [ALONE, *SUMS]), ids=name_of
)
def test_whitened_by_the_filter_is_whitened_by_the_dense_covariance(terms, rng) -> None:
    frame, _, _ = two_runs()
    time, codes = np.asarray(frame["time"]), np.asarray(frame.codes["run"])
    within = codes[:, None] == codes
    extra = rng.uniform(0.0, 0.1, frame.size)
    law = law_of(terms)
    dense = within * slow_covariance(terms, time[:, None] - time)
    dense += VALUES["noise.white"] ** 2 * np.eye(frame.size)
    np.testing.assert_allclose(law.variance(in_jax(law), frame), np.diag(dense), 1e-12)
    columns = rng.standard_normal((frame.size, 3))
    y = jnp.asarray(columns[:, 0])
    density = law.log_density(y, jnp.zeros(frame.size), in_jax(law), frame)
    normal: Any = stats.multivariate_normal
    exact = normal.logpdf(columns[:, 0], np.zeros(frame.size), dense)
    assert float(density.sum()) == pytest.approx(exact, rel=1e-10)
    dense += np.diag(extra)
    white, log_sd = law.whiten(jnp.asarray(columns), jnp.asarray(extra), in_jax(law), frame)
    np.testing.assert_allclose(
        white, np.linalg.solve(np.linalg.cholesky(dense), columns), rtol=1e-9, atol=1e-9
    )
    assert 2 * float(log_sd.sum()) == pytest.approx(np.linalg.slogdet(dense)[1], abs=1e-9)


@pytest.mark.parametrize(
    "terms",
    slow_but(
        [("averaging",)],
        [("quantisation",), ("averaging",), ("correlated", "averaging"), ("tone", "quantisation")],
    ),
    ids=name_of,
)
def test_noise_of_neighbouring_readings_alone(terms, rng) -> None:
    """Drawn, whitened and averaged as its covariance says, by itself and beside states of either kind."""
    n, factors = 40, 2.0 ** np.arange(5)
    data = bc.Measurements.from_arrays(
        SENSOR, time=STEP * np.arange(n), temperature=np.linspace(10.0, 50.0, n), output=np.zeros(n)
    )
    frame, law = frame_of(data), law_of(terms)
    time = np.asarray(frame["time"])
    dense = slow_covariance(terms, time[:, None] - time) + VALUES["noise.white"] ** 2 * np.eye(n)
    draw = jax.jit(jax.vmap(lambda k: law.sample(k, jnp.zeros(n), in_jax(law), frame)))
    made = np.asarray(draw(jax.random.split(jax.random.key(4), 8000)))
    np.testing.assert_allclose(np.cov(made.T), dense, atol=5 * dense.max() * math.sqrt(2 / 8000))
    columns = rng.standard_normal((n, 2))
    white, _ = law.whiten(jnp.asarray(columns), 0.0, in_jax(law), frame)
    np.testing.assert_allclose(white, np.linalg.solve(np.linalg.cholesky(dense), columns), 1e-9)
    values = {name: VALUES[name] for name in law.parameters()}
    found = law.allan_variance(values, dense[0, 0], factors, STEP)
    for m, one in zip(factors.astype(int), found, strict=True):
        weight = np.repeat([1 / m, -1 / m, 0.0], [m, m, n - 2 * m])
        assert one == pytest.approx(0.5 * weight @ dense @ weight, rel=1e-9)


@pytest.mark.parametrize("terms", slow_but([("walk",)], [("walk",), *SUMS[-2:]]), ids=name_of)
def test_slopes_of_the_log_density_are_those_of_differences(terms, rng) -> None:
    frame, _, _ = two_runs()
    law, y = law_of(terms), jnp.asarray(rng.standard_normal(60))

    def value(at: dict[str, Any]) -> Any:
        return jnp.sum(law.log_density(y, jnp.zeros(60), at, frame))

    at = in_jax(law)
    slopes, compiled = jax.jit(jax.grad(value))(at), jax.jit(value)
    for name, here in at.items():
        step = 1e-5 * max(abs(float(here)), 0.1)
        up, down = (compiled({**at, name: here + s}) for s in (step, -step))
        assert float(slopes[name]) == pytest.approx(
            float(up - down) / (2 * step), rel=1e-5, abs=1e-5
        )


@pytest.mark.parametrize(
    "terms", slow_but([ALONE], [ALONE, ("smooth", "flicker"), ("tone", "correlated")]), ids=name_of
)
def test_samples_have_the_covariance(terms, key) -> None:
    frame, _, _ = two_runs()
    time, codes = np.asarray(frame["time"]), np.asarray(frame.codes["run"])
    law = law_of(terms)
    exact = (codes[:, None] == codes) * slow_covariance(terms, time[:, None] - time)
    exact += VALUES["noise.white"] ** 2 * np.eye(60)
    draw = jax.jit(jax.vmap(lambda k: law.sample(k, jnp.zeros(60), in_jax(law), frame)))
    made = np.asarray(draw(jax.random.split(key, 8000)))
    # Five standard errors of the largest of 1830 covariances.
    np.testing.assert_allclose(np.cov(made.T), exact, atol=5 * exact.max() * math.sqrt(2 / 8000))


@pytest.mark.parametrize("terms", [ALONE, *SUMS], ids=name_of)
def test_the_allan_variance_is_that_of_the_covariance(terms) -> None:
    law, factors, step = law_of(terms), 2.0 ** np.arange(6), 1.5
    values = {name: VALUES[name] for name in law.parameters()}
    found = law.allan_variance(values, 0.09 + law.slow_variance(values), factors, step)
    for m, one in zip(factors.astype(int), found, strict=True):
        time = step * np.arange(2 * m)
        weight = np.repeat([1 / m, -1 / m], m)
        dense = slow_covariance(terms, time[:, None] - time) + 0.09 * np.eye(2 * m)
        assert one == pytest.approx(0.5 * weight @ dense @ weight, rel=1e-7)


def test_allan_variances_of_the_coefficients_of_ieee_952() -> None:
    """K²·τ/3, (2·ln 2/π)·B² and 3·Q²/τ², within what steps of the ladder and sampling leave."""
    m, step = np.array([128.0]), 1.0
    cases = {"walk": 0.04**2 * 128 / 3, "flicker": 2 * math.log(2) / math.pi * 0.25**2}
    for term, expected in cases.items():
        law = bc.SummedNoise(step, 4000.0, (term,))
        found = law.allan_variance(VALUES, law.slow_variance(VALUES), m, step)
        assert float(found[0]) == pytest.approx(expected, rel=0.015)
    law = bc.SummedNoise(step, 4000.0, ("quantisation",))
    found = law.allan_variance(VALUES, law.slow_variance(VALUES), m, step)
    assert float(found[0]) == pytest.approx(3 * (0.35 / 128) ** 2, rel=1e-12)


def test_a_smooth_process_has_its_series_where_exponentials_cancel() -> None:
    law = law_of(("smooth",))
    slow = {"noise.white": 0.3, "noise.smooth": 0.5, "noise.smooth.time": math.sqrt(3) * STEP}
    found = []
    for time in (0.999e3, 1.001e3):  # on both sides of where the series takes over, m = 1
        values = {**slow, "noise.smooth.time": math.sqrt(3) * STEP * time}
        made = law.allan_variance(values, law.slow_variance(values), np.array([1.0]), STEP)
        found.append(float(made[0]) * time**2)
    assert found[0] == pytest.approx(found[1], rel=3e-4)


@pytest.mark.parametrize(
    "terms", slow_but([ALONE, ("walk",), ("tone",)], [ALONE, *SUMS]), ids=name_of
)
def test_the_slow_part_between_and_beyond_readings_is_that_of_the_dense_process(terms, rng) -> None:
    time = np.sort(rng.uniform(0, 100, 30))
    time[5] = time[4]
    at = np.concatenate([rng.uniform(-10, 130, 9), time[7:9], time[4:5]])
    left, white = rng.normal(size=(30, 2)), rng.uniform(0.02, 0.2, 30)
    law = law_of(terms)
    values = {name: VALUES[name] for name in law.parameters()}
    across = slow_covariance(terms, at[:, None] - time)
    dense = slow_covariance(terms, time[:, None] - time) + np.diag(white)
    share = across @ np.linalg.inv(dense)
    mean, variance = law.slow_part(values, time, left, white, at)
    np.testing.assert_allclose(mean, share @ left, rtol=1e-8, atol=1e-10)
    own = slow_covariance(terms, at[:, None] - at)
    np.testing.assert_allclose(variance, np.diag(own - share @ across.T), rtol=1e-7)


def steered() -> tuple[bc.SummedNoise, dict[str, float], bc.Frame, np.ndarray]:
    """A tone whose frequency follows the temperature; its phase at each of the readings of two runs."""
    law = bc.SummedNoise(STEP, SPAN, ("correlated", "tone"), column="temperature")
    values = {**VALUES, "noise.tone.slope": 0.2, "noise.tone.bend": -0.05}
    frame, time, _ = two_runs()
    z = np.linspace(-1, 1, 60)
    turns = (0.07 + 0.2 * z - 0.05 * z**2)[1:] * np.diff(time)
    own = {name: values[name] for name in law.parameters()}
    return law, own, frame, 2 * math.pi * np.cumsum(np.append(0.0, turns))


def steered_covariance(time: np.ndarray, phase: np.ndarray) -> np.ndarray:
    lag = time[:, None] - time
    fading = exponential(VALUES["noise.tone"] ** 2, VALUES["noise.tone.time"])(lag)
    return covariance_of("correlated")(lag) + fading * np.cos(phase[:, None] - phase)


def test_a_tone_turns_by_the_frequency_that_its_column_has(rng) -> None:
    law, own, frame, phase = steered()
    time, codes = np.asarray(frame["time"]), np.asarray(frame.codes["run"])
    dense = (codes[:, None] == codes) * steered_covariance(time, phase)
    dense += VALUES["noise.white"] ** 2 * np.eye(60)
    columns = rng.standard_normal((60, 3))
    white, log_sd = law.whiten(jnp.asarray(columns), 0.0, own, frame)
    np.testing.assert_allclose(white, np.linalg.solve(np.linalg.cholesky(dense), columns), 1e-8)
    assert 2 * float(log_sd.sum()) == pytest.approx(np.linalg.slogdet(dense)[1], abs=1e-9)


def test_a_tone_between_readings_is_where_its_column_puts_it(rng) -> None:
    law, own, frame, phase = steered()
    time, z = np.asarray(frame["time"])[:40], np.linspace(-1, 1, 60)[:40]
    known = np.arange(40) % 4 != 2
    dense = steered_covariance(time, phase[:40])
    left, white = rng.normal(size=(30, 2)), rng.uniform(0.02, 0.2, 30)
    inside = dense[np.ix_(known, known)] + np.diag(white)
    share = dense[np.ix_(~known, known)] @ np.linalg.inv(inside)
    mean, variance = law.slow_part(
        own, time[known], left, white, time[~known], (z[known], z[~known])
    )
    np.testing.assert_allclose(mean, share @ left, rtol=1e-8, atol=1e-10)
    expected = np.diag(dense[np.ix_(~known, ~known)] - share @ dense[np.ix_(known, ~known)])
    np.testing.assert_allclose(variance, expected, rtol=1e-7)


@pytest.mark.parametrize(
    "terms",
    [
        *(s for s in SUMS if "smooth" not in s),
        ("quantisation",),
        ("correlated", "averaging"),
        ("tone", "averaging"),
    ],
    ids=name_of,
)
def test_products_in_frequency_give_the_restricted_likelihood(terms, rng) -> None:
    """Two runs of one length and one of another, longer than single nodes reach; a column and levels taken out."""
    lengths, law = (130, 130, 310), law_of(terms)
    time = STEP * np.concatenate([np.arange(n) for n in lengths])
    run = np.repeat(np.arange(3), lengths)
    dense = (run[:, None] == run) * slow_covariance(terms, time[:, None] - time)
    dense += VALUES["noise.white"] ** 2 * np.eye(time.size)
    columns = np.column_stack([np.exp(-time / 40), rng.standard_normal(time.size).cumsum()])
    levels = (run[:, None] == np.arange(3)) / np.sqrt(lengths)
    whole = np.column_stack([levels, columns])
    gram = whole.T @ np.linalg.solve(dense, whole)
    known = gram[:-1, :-1]
    rss = gram[-1, -1] - gram[-1, :-1] @ np.linalg.solve(known, gram[:-1, -1])
    expected = -0.5 * (np.linalg.slogdet(dense)[1] + np.linalg.slogdet(known)[1] + rss)
    parts = [columns[run == k] for k in range(3)]
    nodes = EvenSpectrum(parts, STEP, [VALUES["noise.tone.frequency"]])
    values = {name: np.full(2, VALUES[name]) for name in law.parameters()}
    assert nodes.log_likelihood(law, values) == pytest.approx(expected, rel=1e-7)
