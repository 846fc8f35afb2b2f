"""Exports of a correction of three axes compute what the correction does: JSON, Python and C99."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._use.vector_correction import VectorCorrection
from tests.support.export_check import COMPILER

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror")


def check_exports(
    correct: VectorCorrection,
    outputs: np.ndarray,
    temperature: float,
    folder: Path,
    beside: np.ndarray | None = None,
) -> None:
    """Of one reading, its noise counted. Without a compiler the test is skipped after the first two."""
    found = correct(outputs, temperature, beside=beside)
    for name in ("sensor.h", "sensor.py", "sensor.json", "sensor.yaml"):
        bc.export_vector(correct, folder / name)
    again = bc.load_vector_correction(folder / "sensor.json")(outputs, temperature, beside=beside)
    assert np.array_equal(again.vector, found.vector)
    space: dict[str, Any] = {}
    exec((folder / "sensor.py").read_text("utf-8"), space)
    given = {} if beside is None else {"beside": beside}
    vector, covariance = space["correct"](outputs, temperature, **given)
    assert vector == pytest.approx(found.vector[0], abs=1e-12)
    assert covariance == pytest.approx(found.covariance[0], rel=1e-9)
    if COMPILER is None:
        pytest.skip("no C compiler")

    def array(values: np.ndarray) -> str:
        return "{" + ", ".join(map(repr, values.tolist())) + "}"

    extra = "" if beside is None else f", g[3] = {array(beside)}"
    inputs = f"y, {'' if beside is None else 'g, '}{temperature!r}, {correct.noise!r}"
    (folder / "main.c").write_text(
        '#include <stdio.h>\n#include "sensor.h"\nint main(void) {\n'
        f"    double y[3] = {array(outputs)}{extra}, f[3], c[3][3];\n"
        f"    int outside = sensor_correct({inputs}, f, c), i;\n"
        '    printf("%d", outside);\n    for (i = 0; i < 3; i++) printf(" %.17g", f[i]);\n'
        '    for (i = 0; i < 9; i++) printf(" %.17g", c[i / 3][i % 3]);\n    return 0;\n}\n'
    )
    subprocess.run([COMPILER, *FLAGS, "main.c", "-o", "main"], cwd=folder, check=True)
    made = subprocess.run([folder / "main"], capture_output=True, text=True, check=True).stdout
    numbers = np.array(made.split(), dtype=float)
    assert numbers[0] == found.outside[0]
    assert numbers[1:4] == pytest.approx(found.vector[0], abs=1e-12)
    assert numbers[4:].reshape(3, 3) == pytest.approx(found.covariance[0], rel=1e-9)
