"""Three axes by poses: what they measure and what not, against other methods, and what leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import bayescal as bc
from bayescal_models import accelerometer_triad, magnetometer_triad
from bayescal_models.accelerometer_triad.simulator import BASELINE
from tests.support.inside import compute_radial_residual, find_static_segments, invert_equation
from tests.support.references import shared
from tests.support.tiers import slow_but
from tests.support.triad_truth import matrix_of

Campaign = accelerometer_triad.Campaign
MODEL = accelerometer_triad.INSTRUMENT.baseline()
NAMES = [f"{n}[{p}]" for n in BASELINE for p in (("xy", "xz", "yz") if n[0] == "m" else "xyz")]
MATRIX, BIAS = matrix_of(BASELINE), 1e-3 * np.array(BASELINE["bias.constant"])
TRUE = np.concatenate([np.asarray(v) for v in BASELINE.values()])
THERMAL = Campaign(poses=14, temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0))


def estimates(calibration: bc.Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard uncertainty of the nine coefficients."""
    draws = np.stack([calibration.samples(name) for name in NAMES], axis=1)
    return draws.mean(axis=0), draws.std(axis=0)


@shared
def thermal() -> bc.Calibration:
    readings = accelerometer_triad.simulate(
        {"bias.temperature": 0.3, "square.constant": 1.0}, seed=3, campaign=THERMAL
    )
    model = MODEL + ["bias.temperature", "square.constant"]
    return bc.fit(model, readings, bc.LeastSquares())


@shared
def bent() -> bc.Calibration:
    """Second and third order, of axes that are strongly nonlinear; at 0.5 mg of noise K3 would be hardly visible."""
    campaign = replace(THERMAL, noise=1e-4)
    hidden = {"square.constant": 2.0, "cube.constant": 3.0}
    readings = accelerometer_triad.simulate(hidden, seed=3, campaign=campaign)
    return bc.fit(MODEL + ["square.constant", "cube.constant"], readings, bc.LeastSquares())


def outputs(readings: bc.Measurements) -> np.ndarray:
    return np.stack([readings[f"output_{a}"] for a in "xyz"], axis=1)


def test_the_inverse_undoes_terms_of_second_order() -> None:
    random = np.random.default_rng(1)
    matrix, square = np.eye(3) + 0.02 * random.standard_normal((3, 3)), 2e-3
    force = random.standard_normal((50, 3))
    force /= np.linalg.norm(force, axis=1)[:, None]

    def h(f):
        return f @ matrix.T + 0.03 + square * f**2

    found, inverse = invert_equation(h, jnp.asarray(h(force)))
    assert np.max(np.abs(found - force)) < 1e-12
    slopes = matrix + 2 * square * force[:, :, None] * np.eye(3)
    assert np.max(np.abs(inverse @ slopes - np.eye(3))) < 1e-12


def test_the_estimating_equation_is_unbiased_where_poses_are_noisy() -> None:
    """Residual times its slope has the mean zero at the truth, over noise of 30 mg; not so for |f̂| − 1."""
    random = np.random.default_rng(2)
    count, sd = 2_000_000, 0.03
    force = np.array([0.6, 0.0, 0.8])
    length = np.linalg.norm(y := force + sd * random.standard_normal((count, 3)), axis=1)
    along = y[:, 0] ** 2 / length**2  # −∂ log|f̂| and −∂ log s by the scale factor of x

    def score(residual: np.ndarray, slope: np.ndarray) -> tuple[float, float]:
        each = residual * (length * slope - residual) * along / sd**2
        return float(each.mean()), float(each.std() / np.sqrt(count))

    x = length - 1
    ours, error = score(compute_radial_residual(length), 0.5 + 2 / (2 + 4 * x / 3) ** 2)
    assert abs(ours) < 4 * error + 5 * sd**2
    assert score(x, np.ones(count))[0] > 0.2


@pytest.mark.parametrize("noise", slow_but([1e-3], [1e-4, 1e-3]))
def test_agrees_with_the_poses_by_hand(noise: float) -> None:
    """imu_tk's estimate: f̂ = T·K·(y − b) with |f̂| = 1, by least squares (Tedaldi, Pretto and Menegatti 2014)."""
    readings = accelerometer_triad.simulate(seed=4, campaign=Campaign(poses=40, noise=noise))
    y = outputs(readings)

    def left(p: np.ndarray) -> np.ndarray:
        turn = np.array([[1.0, p[0], p[1]], [0.0, 1.0, p[2]], [0.0, 0.0, 1.0]])
        return np.linalg.norm((p[3:6] * (y - p[6:9])) @ turn.T, axis=1) - 1

    p = least_squares(left, np.concatenate([np.zeros(3), np.ones(3), np.zeros(3)])).x
    own = np.array([[1.0, p[0], p[1]], [0.0, 1.0, p[2]], [0.0, 0.0, 1.0]]) * p[3:6]
    matrix = np.linalg.inv(own)
    theirs = np.concatenate(
        [1e3 * p[6:9], 1e6 * (np.diag(matrix) - 1), 1e3 * matrix[[0, 0, 1], [1, 2, 2]]]
    )
    mean, sd = estimates(bc.fit(MODEL, readings))
    assert np.max(np.abs(theirs - mean) / sd) < 0.15  # of the mean over 4,000 draws too
    assert np.max(np.abs(mean - TRUE) / sd) < 4


def test_agrees_with_an_ellipsoid() -> None:
    """Ten coefficients of a quadric through the readings, by its smallest singular vector (Li and Griffiths 2004)."""
    readings = magnetometer_triad.simulate(seed=5)
    y = outputs(readings) / 50.0
    x, yy, z = y.T
    table = np.stack(
        [x**2, yy**2, z**2, 2 * x * yy, 2 * x * z, 2 * yy * z, x, yy, z, 1 + 0 * x], axis=1
    )
    q = np.linalg.svd(table)[2][-1]
    form = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    centre = np.linalg.solve(form, -0.5 * q[6:9])
    calibration = bc.fit(magnetometer_triad.INSTRUMENT.baseline(), readings)
    found = np.stack([calibration.samples(f"bias.constant[{a}]") for a in "xyz"], axis=1)
    # An algebraic fit weighs readings otherwise: it agrees within what its own scatter allows.
    assert np.max(np.abs(50.0 * centre - found.mean(axis=0)) / found.std(axis=0)) < 1.0


@pytest.mark.parametrize("pose_uncertainty", slow_but([None], [None, 5e-3]))
def test_a_hard_iron_larger_than_the_field(pose_uncertainty: float | None) -> None:
    """The origin is outside the readings' ellipsoid: directions of the outputs are none of the field."""
    iron: Any = (150.0, -40.0, 90.0)  # µT, in a field of 50
    campaign = replace(magnetometer_triad.Campaign(), pose_uncertainty=pose_uncertainty)
    readings = magnetometer_triad.simulate({"bias.constant": iron}, seed=5, campaign=campaign)
    calibration = bc.fit(magnetometer_triad.INSTRUMENT.baseline(), readings)
    for name, true in (("bias", iron), ("scale", (6e4, -4e4, 9e4))):
        found = np.stack([calibration.samples(f"{name}.constant[{a}]") for a in "xyz"], axis=1)
        assert np.all(np.abs(found.mean(axis=0) - true) < 4 * found.std(axis=0))


@pytest.mark.slow
def test_known_directions_measure_the_frame_too() -> None:
    hidden = {"misalignment.frame": 5.0}
    campaign = Campaign(poses=16, noise=1e-3, pose_uncertainty=5e-4)
    readings = accelerometer_triad.simulate(hidden, seed=6, campaign=campaign)
    calibration = bc.fit(MODEL + "misalignment.frame", readings)
    for part, share in zip(("yx", "zx", "zy"), (1.0, -0.6, 0.8), strict=True):
        draws = calibration.samples(f"misalignment.frame[{part}]")
        assert draws.std() < 1.0
        assert abs(draws.mean() - 5.0 * share) < 4 * draws.std()


@pytest.mark.parametrize(
    ("kind", "told", "not_told"),
    [
        ("six", ["bias.constant[x]", "scale.constant[z]"], ["misalignment.constant[xy]"]),
        ("twelve", NAMES, []),
        (
            "planar",
            ["bias.constant[x]", "misalignment.constant[xz]"],
            ["scale.constant[y]", "misalignment.constant[xy]"],
        ),
        ("level", [], ["misalignment.constant[yz]"]),
    ],
)
@pytest.mark.parametrize(
    "method", [bc.LeastSquares(), pytest.param(bc.Marginal(), marks=pytest.mark.slow)]
)
def test_unidentified_coefficients_keep_their_prior_sd(
    kind: str, told: list[str], not_told: list[str], method: Any
) -> None:
    """Of level poses the marginal method ends in chains."""
    readings = accelerometer_triad.simulate(seed=1, campaign=Campaign(kind=kind))
    calibration = bc.fit(MODEL, readings, method)
    sizes = {"bias.constant": 50.0, "scale.constant": 30000.0, "misalignment.constant": 20.0}
    shares = {n: calibration.samples(n).std() / sizes[n.partition("[")[0]] for n in NAMES}
    assert all(shares[name] < 0.1 for name in told)
    assert all(0.8 < shares[name] < 1.2 for name in not_told)


@pytest.mark.slow
def test_a_family_is_found_as_one_effect() -> None:
    readings = accelerometer_triad.simulate({"bias.temperature": 0.3}, seed=7, campaign=THERMAL)
    found = bc.discover(bc.fit(MODEL, readings))
    assert "bias.temperature" in [effect.name for effect in found.best]
    nothing = bc.discover(bc.fit(MODEL, accelerometer_triad.simulate(seed=8, campaign=THERMAL)))
    assert not nothing.best


def test_a_corrected_vector_is_what_acts_within_its_uncertainty() -> None:
    correct = bc.vector_correction(thermal())
    random = np.random.default_rng(3)
    force = random.standard_normal((200, 3))
    force /= np.linalg.norm(force, axis=1)[:, None]
    bias = BIAS + 1e-3 * 0.3 * 15.0 * np.array([1.0, -0.6, 0.8])
    y = force @ MATRIX.T + bias + 1e-3 * np.array([1.0, -0.6, 0.8]) * force**2
    found = correct(y, temperature=40.0, noise=0.0)
    apart = found.vector - force
    chi = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(found.covariance), apart)
    assert np.mean(chi) < 9  # three expected, of errors that all vectors share
    assert not found.outside.any()
    assert correct(y[:1], temperature=90.0).outside.all()
    size, uncertainty = found.magnitude
    assert np.max(np.abs(size - 1) / uncertainty) < 5
    roll, sd = found.tilt["roll"]
    assert np.max(np.abs(np.sin(roll - np.arctan2(force[:, 1], force[:, 2]))) / sd) < 5


def test_third_order_is_measured_and_taken_out() -> None:
    draws = np.stack([bent().samples(f"cube.constant[{a}]") for a in "xyz"])
    true = 3.0 * np.array([1.0, -0.6, 0.8])
    assert np.all(np.abs(draws.mean(axis=1) - true) < 4 * draws.std(axis=1))
    assert np.all(draws.std(axis=1) < 0.5)  # of a prior of 1
    correct = bc.vector_correction(bent())
    force = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.48, 0.64, -0.6]])
    y = force @ MATRIX.T + BIAS
    y = y + 1e-3 * np.array([1.0, -0.6, 0.8]) * (2 * force**2 + 3 * force**3)
    found = correct(y, noise=0.0)
    apart = found.vector - force
    assert np.all(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(found.covariance), apart) < 20)


def test_slopes_of_tilt_and_heading() -> None:
    """Standard uncertainties of angles are those of vectors drawn about the mean."""
    random = np.random.default_rng(4)
    root = 1e-3 * random.standard_normal((3, 3))
    made = bc.vector_correction(thermal())(np.array([[0.3, -0.4, 0.8]]), 25.0)
    one = type(made)(made.vector, (root @ root.T)[None], made.unit, made.outside)
    drawn = made.vector + random.standard_normal((20_000, 3)) @ root.T
    many = type(made)(drawn, np.zeros((20_000, 3, 3)), made.unit, made.outside)
    for name in ("roll", "pitch"):
        assert one.tilt[name][1][0] == pytest.approx(many.tilt[name][0].std(), rel=0.03)
    assert one.magnitude[1][0] == pytest.approx(many.magnitude[0].std(), rel=0.03)


def raw_log(poses: int = 24, seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, three outputs of a unit that is turned by hand from pose to pose, noise filtered; and the poses' forces."""
    random = np.random.default_rng(seed)
    force = random.standard_normal((poses, 3))
    force /= np.linalg.norm(force, axis=1)[:, None]
    parts = []
    for here, there in zip(force, [*force[1:], force[-1]], strict=True):
        parts.append(np.repeat(here[None], 400, axis=0))
        a = np.linspace(0, 1, 100)[:, None]
        parts.append((1 - a) * here + a * there + 0.05 * np.sin(40 * a))
    f = np.concatenate(parts[:-1])
    noise, kicks = np.zeros_like(f), 1.2e-3 * random.standard_normal(f.shape)
    for i in range(1, len(f)):
        noise[i] = 0.8 * noise[i - 1] + kicks[i]
    matrix = np.eye(3) + np.diag([8e-3, -5e-3, 12e-3])
    return np.arange(len(f)) / 100.0, f @ matrix.T + [0.012, -0.020, 0.035] + noise, force


def test_static_segments_and_the_uncertainty_of_their_means() -> None:
    time, y, force = raw_log()
    found = find_static_segments(time, y, None)
    mean = np.array([y[a:b].mean(axis=0) for a, b in zip(found.first, found.last, strict=True)])
    assert len(mean) == len(force)
    matrix = np.eye(3) + np.diag([8e-3, -5e-3, 12e-3])
    apart = (mean - force @ matrix.T - [0.012, -0.020, 0.035]) / found.uncertainty[:, None]
    assert 0.75 < apart.std() < 1.25
    assert not found.omitted_durations
    for arguments in ((time, y, 10.0), (time[::50], y[::50], None)):
        with pytest.raises(bc.InputError):
            find_static_segments(*arguments)


def test_the_length_of_a_pose_is_chosen_from_the_log() -> None:
    """Held for 1.8 to 2 s by hand: shorter ones are taken where they are many, else named."""
    time, y, force = raw_log()
    at = np.arange(len(time))
    all_over = np.where(at // 500 % 3 == 0, 400, 190)  # samples that are kept of 400 of each pose
    at_first = np.where(at < 2500, all_over, 400)
    for held, count in ((all_over, 24), (at_first, 21)):
        kept = (at % 500 >= 400) | (at % 500 < held)
        found = find_static_segments(np.arange(kept.sum()) / 100, y[kept], None)
        assert len(found.first) == count
        assert len(found.omitted_durations) == len(force) - count


@pytest.mark.slow
def test_six_positions_are_as_uncertain_as_their_rests_show() -> None:
    deviations = 0.02 * np.random.default_rng(4).standard_normal((6, 3))
    sides = np.concatenate([np.eye(3), -np.eye(3)]) + deviations
    sides /= np.linalg.norm(sides, axis=1)[:, None]
    columns = dict(zip(accelerometer_triad.OUTPUTS, (sides @ MATRIX.T + BIAS).T, strict=True))
    stated = {"output_uncertainty": np.full(6, 2e-4)}
    general = accelerometer_triad.INSTRUMENT
    poses = bc.Measurements.from_arrays(general, **columns, **stated)
    own = general.for_readings(poses)
    assert dict(own.settings) == {"scatter": 2e-4}
    assert own.noise == bc.White(bc.LogNormal(2e-4, 1.0))
    biases = [f"bias.constant[{a}]" for a in "xyz"]
    fits = {i: bc.fit(i.baseline(), poses) for i in (general, own)}
    sd = {i: np.array([c.samples(b).std() for b in biases]) for i, c in fits.items()}
    # 0.2 mg, and as much again: below 1 mg; ±20 mrad of misalignment in sides off by 20 mrad are 0.4 mg
    assert np.all(sd[own] < 1.0) and np.all(sd[own] > 0.2) and np.all(sd[general] > 2 * sd[own])
    assert general.for_readings(bc.Measurements.from_arrays(general, **columns)) is general


def test_a_log_is_read_as_poses() -> None:
    time, y, force = raw_log()
    columns: dict[str, Any] = {f"output_{a}": y[:, i] for i, a in enumerate("xyz")}
    log = bc.Measurements.from_arrays(accelerometer_triad.INSTRUMENT, time=time, **columns)
    readings = bc.poses(log, accelerometer_triad.INSTRUMENT)
    assert len(readings) == len(force)
    mean, sd = estimates(bc.fit(MODEL, readings))
    true = np.array([12.0, -20.0, 35.0, 8000.0, -5000.0, 12000.0, 0.0, 0.0, 0.0])
    assert np.max(np.abs(mean - true) / sd) < 4
