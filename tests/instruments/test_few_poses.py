"""Fewer poses than coefficients: what they determine is measured, the rest stays as its prior has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_triad
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


@pytest.mark.parametrize(("faces", "count"), [(True, 6), (False, 7), (False, 8)])
def test_offsets_and_scale_factors_of_few_poses_hold_the_truth(faces: bool, count: int) -> None:
    """Seeds 0 to 4, each six coefficients."""
    away = []
    for seed in range(5):
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
@pytest.mark.parametrize(("faces", "count", "added"), [(True, 6, 3), (False, 8, 1)])
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
