"""Products of unknowns and nonlinear models: the posterior is right, by promotion or by falling back, and says how."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from arviz_stats.base.array import array_stats
from scipy.signal import lfilter

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro
from tests.support.inside import smooth

COLUMNS = (
    bc.Column("run", None, "label", required=False),
    bc.Column("stimulus", "V", "input"),
    bc.Column("output", "V", "output"),
)
# A lever: a scale factor and a zero offset *before* it, so that their product counts.
LEVER = bc.Instrument(
    name="lever",
    title="scale factor times stimulus with offset",
    columns=COLUMNS,
    slots=(bc.Slot("scale", "1"), bc.Slot("offset", "V")),
    response=lambda slots, r: (1 + slots["scale"]) * (r["stimulus"] + slots["offset"]),
    effects=(
        effects.constant("scale", 0.5, "1", source="none"),
        effects.constant("offset", 5.0, "V", source="none"),
    ),
    noise=bc.White(bc.HalfNormal(0.3)),
)
# A valve: the output is exponential in a deviation of each run; too many of them to be promoted.
RUNS = 24
VALVE = bc.Instrument(
    name="valve",
    title="exponential in the deviation of a run",
    columns=COLUMNS,
    slots=(bc.Slot("opening", "1"),),
    response=lambda slots, r: r["stimulus"] * jnp.exp(slots["opening"]),
    effects=(
        bc.Effect(
            "opening.run",
            "opening",
            basis=lambda r: 1.0,
            coefficients=(bc.Coefficient("1", bc.Normal(0.0, 1.0), per="run"),),
            columns=("run",),
            equation="d[run]",
            source="none",
        ),
    ),
    noise=bc.White(bc.HalfNormal(1.0)),
)


def lever_readings(noise: float, seed: int = 4) -> bc.Measurements:
    rng = np.random.default_rng(seed)
    stimulus = np.linspace(-1.0, 1.0, 10)
    output = 1.2 * (stimulus + 4.0) + noise * rng.standard_normal(10)
    return bc.Measurements.from_arrays(LEVER, stimulus=stimulus, output=output)


@pytest.fixture(scope="module")
def lever() -> bc.Measurements:
    return lever_readings(0.3)


@pytest.fixture(scope="module")
def valve() -> bc.Measurements:
    rng = np.random.default_rng(5)
    opening = np.repeat(rng.normal(0.0, 1.0, RUNS), 2)
    run = np.repeat([f"r{k}" for k in range(RUNS)], 2)
    stimulus = np.ones(2 * RUNS)
    output = np.exp(opening) + rng.standard_normal(2 * RUNS)
    return bc.Measurements.from_arrays(VALVE, run=run, stimulus=stimulus, output=output)


def scattered(mean: float, sd: float, other_mean: float, other_sd: float, draws: float) -> float:
    """Difference of two means in Monte-Carlo errors."""
    return abs(mean - other_mean) / np.sqrt((sd**2 + other_sd**2) / draws)


def exact_moments(data: bc.Measurements) -> dict[str, tuple[float, float]]:
    """Posterior means and sds of the lever on a grid of the scale and the noise; the offset in closed form."""
    scale = np.linspace(-0.9, 3.0, 1200)[:, None]
    noise = np.linspace(0.02, 1.5, 600)[None, :]
    y, s = data["output"], data["stimulus"]
    gain = 1 + scale
    # y − gain·s = gain·b + noise, b ~ N(0, 5²): a normal in b given both.
    r = y[None, None, :] - gain[..., None] * s
    total, square, n = r.sum(-1), (r**2).sum(-1), len(y)
    precision = n * gain**2 / noise**2 + 1 / 25
    centre = gain * total / noise**2 / precision
    log = -n * np.log(noise) - 0.5 * square / noise**2 + 0.5 * precision * centre**2
    log = log - 0.5 * np.log(precision) - 0.5 * (scale / 0.5) ** 2 - 0.5 * (noise / 0.3) ** 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()

    def moments(mean: np.ndarray, variance: np.ndarray | float = 0.0) -> tuple[float, float]:
        first = np.sum(weight * mean)
        return float(first), float(np.sqrt(np.sum(weight * (variance + mean**2)) - first**2))

    return {
        "scale.constant": moments(scale + 0 * noise),
        "offset.constant": moments(centre, 1 / precision),
        "noise.white": moments(noise + 0 * scale),
    }


def effective(found: bc.Calibration) -> float:
    """How many independent draws the fit says that its own are worth."""
    assert found.verdict.ess is not None
    return found.verdict.ess


def pareto_k(found: bc.Calibration) -> float:
    assert found.verdict.pareto_k is not None
    return found.verdict.pareto_k


def assert_exact(found: bc.Calibration, exact: dict[str, tuple[float, float]], size: float) -> None:
    for name, (mean, sd) in exact.items():
        draws = found.samples(name)
        assert abs(draws.mean() - mean) < 4 * sd / np.sqrt(size), name
        assert draws.std() == pytest.approx(sd, rel=0.03 + 4 / np.sqrt(size)), name


@pytest.fixture(scope="module")
def found(lever) -> bc.Calibration:
    return bc.fit(LEVER.baseline(), lever)


def test_a_strong_product_is_promoted_and_the_posterior_is_exact(found, lever) -> None:
    assert len(found.layout.promoted) == 1
    (name,) = found.layout.promoted
    assert name in ("scale.constant", "offset.constant")
    assert f"{name} is sampled, not linearised" in found.verdict.notes[0]
    assert found.verdict.sampler == "importance sampling"
    assert pareto_k(found) < 0.5
    assert_exact(found, exact_moments(lever), effective(found) / 2)
    straight = bc.fit(LEVER.baseline().fix({"scale.constant": 0.2}), lever)
    assert straight.layout.promoted == () and straight.verdict.notes == ()
    # What the posterior looks like: a bent ridge, which no Gaussian in (scale, offset) follows.
    product = (1 + found.samples("scale.constant")) * found.samples("offset.constant")
    assert product.std() < 0.2 * found.samples("offset.constant").std()


def test_the_prior_of_a_promoted_coefficient_is_its_own(found) -> None:
    prior = found.tree["prior"].to_dataset()
    for name, sd in (("scale.constant", 0.5), ("offset.constant", 5.0)):
        assert prior[name].std() == pytest.approx(sd, rel=0.12)


def test_importance_weights_correct_a_slight_nonlinearity() -> None:
    data = lever_readings(0.05, seed=1)
    found = bc.fit(LEVER.baseline(), data, bc.Marginal(promote=()))
    assert found.layout.promoted == ()
    assert found.verdict.sampler == "importance sampling"
    assert 0 < pareto_k(found) < 0.7
    assert_exact(found, exact_moments(data), effective(found) / 2)


@pytest.mark.slow
def test_without_promotion_weights_are_rejected_and_the_fallback_is_right(lever) -> None:
    found = bc.fit(LEVER.baseline(), lever, bc.Marginal(promote=()))
    assert found.layout.promoted == ()
    assert found.verdict.sampler == "NUTS on whitened unknowns"
    (note,) = found.verdict.notes
    assert "too nonlinear for importance weights" in note
    assert float(note.partition("k̂ = ")[2].partition(",")[0]) > 0.5
    assert_exact(found, exact_moments(lever), 0.5 * effective(found))


@pytest.mark.slow
def test_long_nuts_agrees_with_the_grid(lever) -> None:
    found = bc.fit(LEVER.baseline(), lever, bc.NUTS(draws=2500), strict=False)
    assert_exact(found, exact_moments(lever), 0.5 * effective(found))


@pytest.mark.slow
def test_strongly_nonlinear_model_falls_back_to_nuts_and_is_right(valve) -> None:
    found = bc.fit(VALVE.baseline(), valve)
    assert found.verdict.sampler == "NUTS on whitened unknowns"
    assert any("too nonlinear for importance weights" in note for note in found.verdict.notes)
    assert found.verdict.ok
    reference = bc.fit(VALVE.baseline(), valve, bc.NUTS(draws=2500), seed=3)
    ours, theirs = found.samples("opening.run"), reference.samples("opening.run")
    draws = min(effective(found), effective(reference))
    for a, b in zip(ours.T, theirs.T, strict=True):
        assert scattered(a.mean(), a.std(), b.mean(), b.std(), draws) < 4.5
        assert a.std() == pytest.approx(b.std(), rel=0.05 + 6 / np.sqrt(draws))
    assert found.samples("noise.white").mean() == pytest.approx(
        reference.samples("noise.white").mean(), rel=0.03
    )


def test_identified_sum_of_two_coefficients_under_heavy_tails() -> None:
    """Each of three constants keeps its prior's width in least squares, whatever the noise law.

    Steps along single coefficients, some of many times the noise, made 0.45 of the third one's 5.
    """
    given = mems_gyro.simulate({}, seed=1, campaign=mems_gyro.Campaign(average=60))
    random = np.random.default_rng(3)
    count = len(given)
    off = np.where(random.random(count) < 0.1, 0.3 * random.standard_normal(count), 0.0)
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        time=given["time"],
        temperature=given["temperature"],
        output=given["output"] + off,
    )
    sizes = {"bias.second": (0.7, 500.0), "bias.third": (1.0, 5.0)}
    model = mems_gyro.INSTRUMENT.baseline() + [
        bc.Effect(
            name,
            "bias",
            basis=lambda r, times=times: times,
            coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, size)),),
        )
        for name, (times, size) in sizes.items()
    ]
    white, tails = (
        bc.fit(one, readings, bc.LeastSquares(draws=2000))
        for one in (model, model.with_noise(bc.StudentT(bc.HalfCauchy(0.1))))
    )
    for name in ("bias.constant", *sizes):
        assert tails.samples(name).std() == pytest.approx(white.samples(name).std(), rel=0.01)
    known = [c.samples("bias.temperature").std() for c in (tails, white)]
    assert known[0] < 0.7 * known[1], "outliers weigh less under heavy tails"


@pytest.mark.parametrize("noise", ["white", "ornstein_uhlenbeck"])
def test_least_squares_of_what_is_not_linear_under_any_gaussian_noise(noise: str) -> None:
    readings = mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=1)
    model = mems_gyro.INSTRUMENT.baseline() + "bias.thermal_lag"
    if noise != "white":
        model = model.with_noise(bc.OrnsteinUhlenbeck(30.0, 3000.0, bc.HalfCauchy(0.1)))
    found = bc.fit(model, readings, bc.LeastSquares())
    tau = found.samples("bias.thermal_lag.tau")
    assert abs(tau.mean() - 300.0) < 4 * tau.std()


# Least squares where an estimate lies at an edge.


def test_noise_estimate_at_zero_is_finite() -> None:
    """Readings of a wander without white noise beside it: the logarithm of that would go on for ever."""
    random, n = np.random.default_rng(3), 200
    time = 10.0 * np.arange(n)
    ripple = lfilter([0.3], [1.0, -0.8], random.standard_normal(n))  # as no white noise lets it be
    wander = lfilter([0.05], [1.0, -0.95], ripple)
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT, time=time, temperature=30 + 10 * np.sin(time / 300), output=wander
    )
    law = bc.OrnsteinUhlenbeck(20.0, 2000.0)
    found = bc.fit(mems_gyro.INSTRUMENT.baseline().with_noise(law), readings, bc.LeastSquares())
    assert found.mode.v.min() >= -30.0
    assert found.samples("noise.white").max() < 0.01 * wander.std()
    assert np.isfinite(bc.predict(found).model_sd).all()


# Pareto smoothing against ArviZ's.


@pytest.mark.parametrize("count", [30, 225, 226, 4000])  # ArviZ 1.3 smooths none of fewer
@pytest.mark.parametrize("freedom", [2, 30])
@pytest.mark.parametrize("size", [1e-3, 0.3, 3.0])
def test_smoothed_weights_are_those_of_arviz(count: int, freedom: float, size: float) -> None:
    log_weight = size * np.random.default_rng(count).standard_t(freedom, count)
    weights, k_hat = smooth(log_weight)
    theirs, their_k_hat = array_stats.psislw(-log_weight)
    assert weights == pytest.approx(np.exp(theirs) / np.exp(theirs).sum(), rel=1e-10)
    assert k_hat == pytest.approx(float(their_k_hat), abs=1e-10)
