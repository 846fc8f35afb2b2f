"""Fewer poses than coefficients: what they determine is measured, the rest stays as its prior has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_triad
from bayescal_models.accelerometer_triad import Campaign
from bayescal_models.accelerometer_triad.simulator import BASELINE
from tests.support.command_line import needs_installation, run

INSTRUMENT = accelerometer_triad.INSTRUMENT
AXES = ("x", "y", "z")


def triad(
    seed: int, faces: bool, count: int = 6, tilt: float = 0.02
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outputs in poses, g; offsets, mg, and scale factors less one, ppm. Faces are tilted by `tilt`, rad."""
    rng = np.random.default_rng(seed)
    offset, scale, angle = rng.normal(0, 0.03, 3), rng.normal(0, 0.02, 3), rng.normal(0, 0.01, 3)
    matrix = np.diag(1 + scale)
    matrix[0, 1], matrix[0, 2], matrix[1, 2] = angle
    acts = rng.normal(size=(count, 3))
    if faces:
        acts = np.concatenate([np.eye(3), -np.eye(3)]) + tilt * acts[:6]
    acts /= np.linalg.norm(acts, axis=1)[:, None]
    outputs = acts @ matrix.T + offset + 3e-4 * rng.normal(size=acts.shape)
    return outputs, 1e3 * offset, 1e6 * scale


def fitted(outputs: np.ndarray) -> bc.Calibration:
    columns: dict[str, Any] = {f"output_{a}": outputs[:, i] for i, a in enumerate(AXES)}
    return bc.fit(
        INSTRUMENT.baseline(), bc.Measurements.from_arrays(INSTRUMENT, **columns), bc.LeastSquares()
    )


@pytest.mark.parametrize(
    ("faces", "count"), [(True, 6), (False, 8), pytest.param(False, 7, marks=pytest.mark.slow)]
)
def test_offsets_and_scale_factors_of_few_poses_hold_the_truth(faces: bool, count: int) -> None:
    """Seeds 0 to 2, each six coefficients."""
    away = []
    for seed in range(3):
        outputs, offset, scale = triad(seed, faces, count)
        found = fitted(outputs)
        for name, truth in (("bias.constant", offset), ("scale.constant", scale)):
            for axis, true in zip(AXES, truth, strict=True):
                draws = found.samples(f"{name}[{axis}]")
                away.append((draws.mean() - true) / draws.std())
    assert np.max(np.abs(away)) < 3


def test_offsets_of_six_faces_are_half_sums_and_misalignments_their_priors() -> None:
    outputs, _, _ = triad(1, faces=True, tilt=0.0)
    found = fitted(outputs)
    for i, axis in enumerate(AXES):
        half = 500 * (outputs[i, i] + outputs[i + 3, i])
        assert found.samples(f"bias.constant[{axis}]").mean() == pytest.approx(half, abs=0.2)
    for pair in ("xy", "xz", "yz"):
        assert found.samples(f"misalignment.constant[{pair}]").std() == pytest.approx(20, rel=0.05)


@needs_installation
@pytest.mark.parametrize(
    ("faces", "count", "added"), [(True, 6, 3), pytest.param(False, 8, 1, marks=pytest.mark.slow)]
)
def test_the_command_names_the_poses_to_add(
    faces: bool, count: int, added: int, tmp_path: Path
) -> None:
    outputs, offset, _ = triad(3, faces, count)
    header = ",".join(f"a{a} [g]" for a in AXES)
    np.savetxt(tmp_path / "poses.csv", outputs, "%.6f", ",", header=header, comments="")
    asked = ("triad", tmp_path / "poses.csv", "--poses", "--out", tmp_path / "unit")
    planned = run(*asked, "--dry-run")
    assert planned.status == 0 and not (tmp_path / "unit").exists()
    done = run(*asked)
    assert done.status == 1  # the noise cannot be told
    result = bc.load(tmp_path / "unit" / "calibration.nc")
    for axis, true in zip(AXES, offset, strict=True):
        draws = result.samples(f"bias.constant[{axis}]")
        assert abs(draws.mean() - true) < 3 * draws.std()
    columns: dict[str, Any] = {f"output_{a}": outputs[:, i] for i, a in enumerate(AXES)}
    readings = bc.Measurements.from_arrays(INSTRUMENT, **columns)
    add = bc.undetermined(INSTRUMENT.baseline(), readings).add
    assert len(add) == added and all(str(pose) in done.err for pose in add)


# What belongs to the test, a drift and the deviation of a run, and a correction of three axes: it is wider by them.


MODEL = accelerometer_triad.INSTRUMENT.baseline()
QUICK = bc.LeastSquares()
BIAS = 1e-3 * np.array(BASELINE["bias.constant"])  # g
DRIFT = (3.0, -2.0, 2.5)  # mg over the test


def drifting(campaign: Campaign | None = None) -> bc.Measurements:
    hidden: Any = {"bias.drift": DRIFT}
    return accelerometer_triad.simulate(hidden, seed=1, campaign=campaign or Campaign(poses=60))


def test_the_uncertainty_of_a_compensated_vector_is_tabulated() -> None:
    """At 1 g, from offsets of sd 0.3 mg and a matrix of sd 0.4 mg/g; with the noise of 1.2 mg."""
    terms = np.concatenate([np.zeros(3), np.eye(3).ravel()])[None]
    covariance = np.diag(np.repeat([9e-8, 16e-8], [3, 9]))
    made = bc.VectorCorrection(AXES, "g", 25.0, 25.0, 25.0, terms, covariance, noise=1.2e-3)
    _, table = bc.VectorCorrection.from_data(made.to_json_data()).tabulate_uncertainty()
    assert [[*row] for row in table.rows] == [[a, "0.0005", "0.001", "0.0026"] for a in AXES]


@pytest.mark.slow
def test_a_drift_widens_the_correction_by_what_it_moves_over_the_test() -> None:
    readings = drifting()
    plain = bc.vector_correction(bc.fit(MODEL, readings, QUICK))
    calibration = bc.fit(MODEL + "bias.drift", readings, QUICK)
    correct = bc.vector_correction(calibration)
    own = np.array([calibration.samples(f"bias.constant[{a}]").std() for a in "xyz"])
    progress = (readings["time"] - readings["time"].mean()) / np.ptp(readings["time"])
    sizes = [np.sqrt(np.mean(calibration.samples(f"bias.drift[{a}]") ** 2)) for a in "xyz"]
    expected = 1e-3 * np.hypot(own, np.std(progress) * np.array(sizes))
    assert np.allclose(correct.uncertainty[0, :3], expected, rtol=0.05)
    # What the drift was as noise to is surer, what it belongs to is not.
    assert np.all(correct.uncertainty[0, :3] > 2 * plain.uncertainty[0, :3])
    assert np.all(correct.uncertainty[0, [3, 7, 11]] < plain.uncertainty[0, [3, 7, 11]])
    bias = BIAS + 1e-3 * progress[:, None] * DRIFT
    inside = np.abs(bias - correct.offset) < 2 * correct.uncertainty[0, :3]
    assert inside.mean() > 0.9
    assert any("bias.drift" in note and "is in the uncertainty" in note for note in correct.notes)


def test_a_lag_counts_about_equilibrium() -> None:
    """A test that only ever warms up is behind throughout: a unit in equilibrium is not, and stays in the interval."""
    rising = Campaign(poses=20, temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0), noise=1e-4)
    readings = accelerometer_triad.simulate({"bias.thermal_lag": 0.5}, seed=2, campaign=rising)
    correct = bc.vector_correction(bc.fit(MODEL + "bias.thermal_lag", readings, QUICK))
    assert np.all(correct.uncertainty[0, :3] > 1e-3)
    assert np.all(np.abs(correct.offset - BIAS) < 0.2 * correct.uncertainty[0, :3])


@pytest.mark.slow
def test_effects_beyond_the_polynomial_widen_the_uncertainty() -> None:
    """Of a curve of x, found by a search, the correction holds the cubic part."""
    plan = Campaign(poses=14, temperatures=(-20.0, -5.0, 10.0, 25.0, 40.0, 55.0, 70.0))
    readings = accelerometer_triad.simulate(seed=2, campaign=plan)
    wave = 5e-3 * np.sin(readings["temperature"] / 8)
    outputs = {f"output_{a}": readings[f"output_{a}"] + wave * (a == "x") for a in "xyz"}
    given = {n: readings[n] for n in ("time", "temperature", "magnitude")}
    bent = bc.Measurements.from_arrays(accelerometer_triad.INSTRUMENT, **given, **outputs)
    correct = bc.vector_correction(bc.fit(MODEL + "unknown(temperature)", bent, QUICK))
    assert correct.terms.shape == (4, 12)
    off = (
        (correct.powers(np.asarray(plan.temperatures)) @ correct.terms)[:, 0]
        - BIAS[0]
        - 5e-3 * np.sin(np.array(plan.temperatures) / 8)
    )
    assert np.max(np.abs(off)) > 1e-3
    assert np.sqrt(np.mean(off**2)) < 2 * correct.uncertainty[0, 0]
    assert correct.uncertainty[0, 1] < 5e-4
