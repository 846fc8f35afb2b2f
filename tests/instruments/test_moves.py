"""Gyroscopes by moves between poses: what closes, what is measured, what is found, what leaves."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal.workshop import UNCERTAINTY
from bayescal_models import accelerometer_triad, gyro_triad
from bayescal_models.accelerometer_triad.simulator import BASELINE as ACCELEROMETERS
from bayescal_models.gyro_triad import MovesByHand, simulate_log
from bayescal_models.gyro_triad.simulator import BASELINE
from tests.support.triad_truth import TRUE, matrix_of

FORCE, TURNS = accelerometer_triad.INSTRUMENT, gyro_triad.INSTRUMENT
FEW = MovesByHand(poses=12, still=3.0, move=2.0)


def both(log: dict[str, np.ndarray]) -> tuple[bc.Measurements, bc.Measurements]:
    """The log as read with each instrument: accelerometers, gyroscopes."""

    def of(instrument: bc.Instrument, name: str) -> bc.Measurements:
        outputs: dict[str, Any] = {f"output_{a}": log[f"{name}_{a}"] for a in "xyz"}
        return bc.Measurements.from_arrays(instrument, time=log["time"], **outputs)

    return of(FORCE, "accel"), of(TURNS, "gyro")


def exact() -> bc.VectorCorrection:
    """The correction of the simulated accelerometers, without uncertainty."""
    bias = 1e-3 * np.array(ACCELEROMETERS["bias.constant"])
    terms = np.concatenate([bias, matrix_of(ACCELEROMETERS).ravel()])[None]
    names = ("output_x", "output_y", "output_z")
    return bc.VectorCorrection(names, "g", 25.0, 25.0, 25.0, terms, np.zeros((12, 12)), 0.0)


def left(rows: bc.Measurements) -> np.ndarray:
    """Outputs less what the true gyroscopes give, °/s, by what the columns say."""
    matrix = matrix_of(BASELINE)
    expected = sum(
        rows[f"across_{a}"] * b for a, b in zip("xyz", BASELINE["bias.constant"], strict=True)
    )
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            expected = expected + rows[f"turned_{a}{b}"] * matrix[i, j]
    return rows["output"] - expected


@cache
def calibrated(seed: int = 1) -> tuple[bc.Measurements, bc.VectorCorrection, bc.Calibration]:
    forces, log = both(simulate_log(seed=seed))
    correct = bc.vector_correction(bc.fit(FORCE.baseline(), bc.poses(forces, FORCE)))
    rows = bc.moves(log, TURNS, forces, correct)
    return rows, correct, bc.fit(gyro_triad.moved(), rows)


def test_a_move_without_noise_closes_at_the_true_gyroscopes() -> None:
    """The simulator's attitudes come of steps sixteen times as fine; its gyroscopes are 1 % off, linearised once."""
    quiet = MovesByHand(poses=12, gyro_noise=1e-7, force_noise=1e-9, latitude=None)
    forces, log = both(simulate_log(seed=3, campaign=quiet))
    rows = bc.moves(log, TURNS, forces, exact())
    assert np.max(np.abs(left(rows))) < 1e-5  # °/s, of rates up to 100


@pytest.mark.slow
def test_closure_residuals_are_white_with_the_stated_uncertainty() -> None:
    """Each pose ends one move and begins the next, and yet readings are independent of each other."""
    z = []
    for seed in range(8):
        plan = MovesByHand(poses=16, still=3.0, move=1.5, latitude=None)
        forces, log = both(simulate_log(seed=50 + seed, campaign=plan))
        rows = bc.moves(log, TURNS, forces, exact())
        surest = re.search(r"estimated from scatter as ([\d.e-]+) deg/s", rows.flags[0])
        assert surest is not None
        sd = np.hypot(rows[UNCERTAINTY], float(surest[1]))
        z.append((left(rows) / sd)[3 * plan.poses :].reshape(-1, 2))
    together = np.array(z)
    count = together.size
    assert abs(np.mean(together**2) - 1) < 4 * np.sqrt(2 / count) + 0.1  # and noise is estimated
    after = np.mean(together[:, 1:] * together[:, :-1])
    assert abs(after) < 4 / np.sqrt(count)


@pytest.mark.slow
def test_scale_and_misalignment_without_a_rate_table() -> None:
    _, _, calibration = calibrated()
    draws = np.stack([calibration.samples(name) for name in TRUE])
    mean, sd = draws.mean(axis=1), draws.std(axis=1)
    assert np.all(np.abs(mean - list(TRUE.values())) < 4 * sd)
    assert np.all(sd[3:6] < 120)  # ppm
    assert np.all(sd[6:] < 0.15)  # mrad


@pytest.mark.slow
def test_the_accelerometers_own_uncertainty_counts() -> None:
    """Axes of the accelerometers known to 1 mrad about z are axes of the gyroscopes known no better.

    (What distorts them, moves tell themselves.)
    """
    forces, log = both(simulate_log(seed=2, campaign=FEW))
    sure, covariance = exact(), np.zeros((12, 12))
    turned = sure.matrix @ np.cross(np.eye(3)[2], np.eye(3)).T
    covariance[3:, 3:] = 1e-6 * np.outer(turned, turned)
    unsure = bc.VectorCorrection(
        sure.outputs, "g", 25.0, 25.0, 25.0, sure.terms, covariance, sure.noise
    )
    name = "misalignment.constant[xy]"
    sds = [
        bc.fit(gyro_triad.moved(), bc.moves(log, TURNS, forces, c)).samples(name).std()
        for c in (sure, unsure)
    ]
    assert sds[0] < 0.3  # mrad
    assert 0.5 < sds[1] < 1.3


@pytest.mark.slow
def test_a_hidden_sensitivity_to_gravity_is_found_and_corrected() -> None:
    forces, log = both(simulate_log({"bias.g_sensitivity": 0.03}, seed=4))
    correct = bc.vector_correction(bc.fit(FORCE.baseline(), bc.poses(forces, FORCE)))
    first = bc.fit(gyro_triad.moved(), bc.moves(log, TURNS, forces, correct))
    found = bc.discover(first).best
    assert [effect.name for effect in found] == ["bias.g_sensitivity"]
    turned = bc.vector_correction(bc.fit(first.model + found, first.readings))
    assert turned.secondary_columns == ("gravity_x", "gravity_y", "gravity_z")


@pytest.mark.slow
def test_no_effect_is_invented_and_all_coefficients_are_identified() -> None:
    rows, _, calibration = calibrated()
    assert not bc.discover(calibration).best
    assert not bc.undetermined(gyro_triad.moved(), rows).add


@pytest.mark.slow
def test_independent_pose_errors_widen_the_gyroscopes_uncertainty() -> None:
    """Accelerometers whose outputs creep by 0.4 mg from pose to pose: angles of moves are known no better."""
    chi = []
    for seed in range(4):
        log = simulate_log(seed=90 + seed)
        random, pose = np.random.default_rng(seed), np.arange(len(log["time"])) // 700
        for a in "xyz":
            log[f"accel_{a}"] = log[f"accel_{a}"] + 4e-4 * random.standard_normal(24)[pose]
        forces, turns = both(log)
        correct = bc.vector_correction(bc.fit(FORCE.baseline(), bc.poses(forces, FORCE)))
        calibration = bc.fit(gyro_triad.moved(), bc.moves(turns, TURNS, forces, correct))
        draws = np.stack([calibration.samples(name) for name in list(TRUE)[3:]])
        off = draws.mean(axis=1) - list(TRUE.values())[3:]
        # In axes of the accelerometers, which are off by as much as they are known: scale factors are not.
        chi.append((off[:3] / draws.std(axis=1)[:3]) ** 2)
    assert np.mean(chi) < 2.1  # 12 of mean one: 99.5 %
