"""Magnetometers in a field of any size: stated, not stated, stated wrongly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import magnetometer_triad
from bayescal_models.magnetometer_triad import Campaign, simulate
from bayescal_models.magnetometer_triad.simulator import BASELINE
from tests.support.tiers import slow_but

INSTRUMENT = magnetometer_triad.INSTRUMENT
MODEL = INSTRUMENT.baseline()
SCALE = 1 + 1e-6 * np.array(BASELINE["scale.constant"])
FIELDS = (20.0, 31.0, 50.0, 65.0)  # µT; 20 is less than the hard iron
DIAGONAL = [3, 7, 11]


def table(field: float, folder: Path, stated: float | None = None) -> Path:
    """A file of poses in a field, with a column that states it or without."""
    made = simulate(seed=1, campaign=Campaign(magnitude=field))
    columns = [made[f"output_{a}"] for a in "xyz"]
    header = "mag_x [uT],mag_y [uT],mag_z [uT]"
    if stated is not None:
        columns.append(np.full(len(made), stated))
        header += ",magnitude [uT]"
    path = folder / "poses.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="")
    return path


def corrected(path: Path, **how: Any) -> bc.VectorCorrection:
    return bc.vector_correction(bc.fit(MODEL, bc.read(path, INSTRUMENT, **how), bc.LeastSquares()))


@pytest.mark.slow
@pytest.mark.parametrize("field", FIELDS)
def test_a_field_that_is_stated(field: float, tmp_path: Path) -> None:
    correct = corrected(table(field, tmp_path), local_field=f"{1000 * field} nT")
    off = np.diag(correct.matrix) - SCALE
    assert np.all(np.abs(off) < 4 * correct.uncertainty[0, DIAGONAL])
    assert np.all(
        np.abs(correct.offset - BASELINE["bias.constant"]) < 4 * correct.uncertainty[0, :3]
    )
    assert np.all(correct.uncertainty[0, DIAGONAL] < 0.005)


@pytest.mark.parametrize("field", slow_but(FIELDS[:1], FIELDS))
def test_unstated_field_identifies_ratios_of_scale_factors_only(
    field: float, tmp_path: Path
) -> None:
    """The absolute scale is as uncertain as data sheets leave it; a direction is as sure as in a known field."""
    path = table(field, tmp_path)
    bc.read(path, INSTRUMENT)
    correct, known = corrected(path), corrected(path, local_field=f"{field} uT")
    found, slopes = np.diag(correct.matrix), np.zeros((2, correct.terms.size))
    slopes[:, 3] = -found[1:] / found[0] ** 2
    slopes[[0, 1], [7, 11]] = 1 / found[0]
    sd = np.sqrt(np.diag(slopes @ correct.covariance @ slopes.T))
    assert np.all(np.abs(found[1:] / found[0] - SCALE[1:] / SCALE[0]) < 4 * sd)
    assert np.all(sd < 0.01)
    assert np.all(
        np.abs(correct.offset - BASELINE["bias.constant"]) < 4 * correct.uncertainty[0, :3]
    )
    output = np.array([[30.0, -10.0, 20.0]])
    one, other = correct(output, noise=0.0), known(output, noise=0.0)
    size, of_size = one.magnitude
    assert 0.04 < of_size[0] / size[0] < 0.06
    for angle in ("roll", "pitch"):
        assert one.tilt[angle][0][0] == pytest.approx(other.tilt[angle][0][0], abs=1e-3)
        assert one.tilt[angle][1][0] == pytest.approx(other.tilt[angle][1][0], rel=0.1)


@pytest.mark.parametrize("field", slow_but(FIELDS[1:2], FIELDS))
def test_wrongly_stated_field_is_reported(field: float, tmp_path: Path) -> None:
    wrong = 50.0 if field != 50.0 else 65.0
    correct = corrected(table(field, tmp_path, wrong))
    (_said,) = (note for note in correct.notes if "differ from nominal by one factor" in note)
    ratios = np.diag(correct.matrix) / np.mean(np.diag(correct.matrix))
    assert np.allclose(ratios, SCALE / SCALE.mean(), atol=0.02)


def test_poses_of_a_log_keep_what_its_outputs_read() -> None:
    random = np.random.default_rng(2)
    field = random.standard_normal((12, 3))
    field *= 31.0 / np.linalg.norm(field, axis=1)[:, None]
    still = np.repeat(field, 300, axis=0)
    outputs = still * SCALE + BASELINE["bias.constant"] + 0.3 * random.standard_normal(still.shape)
    columns: dict[str, Any] = {f"output_{a}": outputs[:, i] for i, a in enumerate("xyz")}
    log = bc.Measurements.from_arrays(INSTRUMENT, time=np.arange(len(still)) / 100, **columns)
    poses = bc.poses(log, INSTRUMENT, min_duration=1.0)
    assert len(poses) == 12
    assert not poses.has("magnitude")
    assert poses["magnitude_read"] == pytest.approx(log["magnitude_read"][0])
    assert log["magnitude_read"][0] == pytest.approx(31.0 * np.prod(SCALE) ** (1 / 3), rel=0.01)
