"""A saved calibration and a saved loop, made once for the tests of commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.command_line import (
    GYRO,
    OWN_INSTRUMENT,
    QUICK,
    TABLE,
    Ran,
    run,
    write_bent_table,
)

OWN_EFFECTS = """
import bayescal as bc

EFFECTS = (
    bc.Effect(
        "bias.elbow", "bias",
        basis=lambda r: (r["temperature"] - 60.0).clip(0.0),
        coefficients=(bc.Coefficient("deg/s/degC", bc.Normal(0.0, 0.05)),),
        columns=("temperature",),
        equation="c·max(T − 60 °C, 0)",
    ),
)
"""


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved calibration of the table, and files of a user's own."""
    here = tmp_path_factory.mktemp("command_line")
    (here / "level.py").write_text(OWN_INSTRUMENT, encoding="utf-8")
    (here / "my_effects.py").write_text(OWN_EFFECTS, encoding="utf-8")
    fitted = run("fit", TABLE, *GYRO, *QUICK, "--out", here / "line")
    assert fitted.status == 0, fitted.err
    return here


@pytest.fixture(scope="session")
def saved(folder: Path) -> Path:
    return folder / "line" / "calibration.nc"


@pytest.fixture(scope="session")
def loop(folder: Path) -> Ran:
    """The whole loop on a table that a line does not fit, with hold-out data."""
    bent, kept = (write_bent_table(folder / name) for name in ("bent.csv", "kept.csv"))
    return run(
        *("calibrate", bent, *GYRO, *QUICK, "--holdout", kept),
        *("--out", folder / "loop", "--json"),
    )
