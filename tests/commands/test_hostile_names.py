"""Whatever a column is called, used or not: nothing breaks, on the command line or in a file; no page is marked up."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from tests.support.command_line import GYRO, needs_installation, run
from tests.support.inside import name_in_files

pytestmark = needs_installation
RNG = np.random.default_rng(1)
TIME = np.arange(60) * 10.0
TEMPERATURE = 20 + 0.125 * TIME + 3 * np.sin(TIME / 60)
BESIDE = np.sin(TIME / 35) + 0.3 * RNG.normal(size=60)
OUTPUT = 0.5 + 0.0156 * (TEMPERATURE - 25) + 0.01 * RNG.normal(size=60)
MARKUP = re.compile(r"<b>bold|<b>a/b|<script>alert|<img src=x|</script><script>")


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, quoting=csv.QUOTE_NONNUMERIC)
        writer.writerow(columns)
        writer.writerows(zip(*(v.tolist() for v in columns.values()), strict=True))
    return path


def taken_away(folder: Path, file: Path, *said: str) -> None:
    """Everything that is made of a result, of which nothing may fail."""
    out = folder / "out"
    for arguments in (
        ("report", out, "--out", folder / "report.html"),
        ("predict", out, file, "--out", folder / "predicted.csv", *said),
        ("predict", out, file, "--out", folder / "predicted.nc", *said),
        ("predict", out, file, "--out", folder / "predicted.parquet", *said),
        ("compensate", out, file, "--out", folder / "compensated.csv", *said),
        ("budget", out, "--prior-sensitivity"),
        ("discover", out),
        ("check", out),
        ("export", out, "--out", folder / "a.json"),
        ("decide", out, "--limit", "corrected reading: ±1000 °/s"),
    ):
        done = run(*arguments)
        assert done.status == 0, (arguments[0], done.err)
    program = bc.load_compensator(
        folder / "a.json"
    )  # as commands export it, without tracing it anew
    for suffix in ("h", "py"):
        program.export(folder / f"a.{suffix}")
    assert not MARKUP.search((folder / "report.html").read_text("utf-8"))
    compile((folder / "a.py").read_text("utf-8"), "a.py", "exec")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ['<b>a/b</b> "q", x', "it's $(id) ${a}", "x" * 200, "a\nb", "50% = {x}"]
)
def test_a_name_that_is_found_and_one_that_is_the_output(tmp_path, name) -> None:
    output = OUTPUT + 0.1 * BESIDE + 0.05 * BESIDE**2
    columns = {"time [s]": TIME, "temperature [degC]": TEMPERATURE}
    columns |= {f"{name} out [deg/s]": output, f"{name} [V]": BESIDE}
    if "\n" in name:
        pytest.importorskip("openpyxl")
        import pandas as pd

        file = tmp_path / "lab.xlsx"
        pd.DataFrame(columns).to_excel(file, index=False)
    else:
        file = write(tmp_path / "lab.csv", columns)
    said = ("--columns", f"output={name} out [deg/s]")
    done = run("calibrate", file, *GYRO, *said, "--out", tmp_path / "out", "--max-effects", 1)
    assert done.status == 0, done.err
    found = bc.load(tmp_path / "out" / "calibration.nc")
    name = name_in_files(name)
    unknown = f"unknown({name})"
    assert unknown in found.model.names
    drafted = bc.draft_effect(found, unknown)
    namespace: dict[str, object] = {}
    exec(compile(drafted, "draft.py", "exec"), namespace)  # the draft is Python, its names are data
    effect = namespace["effect"]
    assert isinstance(effect, bc.Effect) and effect.columns == (name,)
    taken_away(tmp_path, file, *said)
