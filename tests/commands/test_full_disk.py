"""Where storage is full, every command that writes ends with 2 and a sentence, and what stood there is as it was."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.command_line import GYRO, QUICK, TABLE, needs_installation
from tests.support.made_up.gyro_lot import table

pytestmark = [
    pytest.mark.nightly,
    needs_installation,
    pytest.mark.skipif(os.name != "posix", reason="limits of file size are of POSIX"),
]
ROOT = Path(__file__).resolve().parents[2]
COMMANDS = {
    "fit": ("fit", TABLE, *GYRO, *QUICK, "--out", "{out}/line"),
    "calibrate": ("calibrate", TABLE, *GYRO, *QUICK, "--out", "{out}/loop"),
    "batch": ("batch", "{lot}", *GYRO, "-o", "{out}/lot.parquet"),
    "report": ("report", "{saved}", "-o", "{out}/report.html"),
    "export to C": ("export", "{saved}", "-o", "{out}/gyro.h"),
    "export to JSON": ("export", "{saved}", "-o", "{out}/gyro.json"),
    "predict to CSV": ("predict", "{saved}", TABLE, "--out", "{out}/new.csv"),
    "predict to NetCDF": ("predict", "{saved}", TABLE, "--out", "{out}/new.nc"),
    "compensate": ("compensate", "{saved}", TABLE, "--out", "{out}/done.csv"),
    "decide": ("decide", "{saved}", "--limit", "bias: ±500 °/s", "-o", "{out}/decisions.json"),
    "simulate": ("simulate", *GYRO, "--out", "{out}/made.csv"),
}
FEW = (0.0, 0.02, 0.97)  # of the largest file that a command writes
MANY = tuple(np.linspace(0, 0.999, 20).round(4))
SIZES = [(name, FEW) for name in ("calibrate", "batch")]
SIZES += [(name, MANY) for name in COMMANDS]


@pytest.mark.parametrize(("name", "parts"), SIZES)
def test_a_disk_that_fills_at_any_size_is_said_in_words(
    name: str, parts: tuple[float, ...], saved: Path, tmp_path: Path
) -> None:
    lot, out = tmp_path / "lot.csv", tmp_path / "out"
    table(count=4).to_csv(lot, index=False)
    out.mkdir()
    command = [str(word).format(out=out, lot=lot, saved=saved) for word in COMMANDS[name]]
    given = ",".join(map(str, parts))
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.spoilt_runs", "full", str(out), given, *command],
        env={**os.environ, "BAYESCAL_CACHE": ""},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]  # not 139, by which HDF5 would end it
    first, *rest = (json.loads(line) for line in done.stdout.splitlines())
    assert first["status"] == 0, first
    assert len(rest) == len(parts)
    for told in rest:
        assert told["status"] == 2, told
        assert len(told["said"]) == 1, told
        assert told["as_it_was"], told
