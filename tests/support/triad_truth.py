"""What the simulated sensors of three axes are made with: coefficients by name, and the matrix that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayescal_models.gyro_triad.simulator import BASELINE
from bayescal_models.triad import simulator

TRUE = {
    f"{name}[{part}]": value
    for name, parts in (
        ("bias.constant", "xyz"),
        ("scale.constant", "xyz"),
        ("misalignment.constant", ("xy", "xz", "yz", "yx", "zx", "zy")),
    )
    for part, value in zip(parts, BASELINE[name], strict=True)
}


def matrix_of(baseline: Mapping[str, Sequence[float]]) -> np.ndarray:
    """Of the outputs by what acts, of scale factors in ppm and misalignments in mrad."""
    scale, angles = (np.array(baseline[f"{n}.constant"]) for n in ("scale", "misalignment"))
    return simulator.axis_matrix(1e-6 * scale, 1e-3 * angles)
