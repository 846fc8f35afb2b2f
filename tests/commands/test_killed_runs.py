"""Whenever a command is killed, its output is the old results or the new, and the next run ends well.

A kill meets a process just before it does something to a file of its output, so that each state of the files is met.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from bayescal_models import gyro_triad
from tests.support.command_line import GYRO, QUICK, TABLE, needs_installation, run
from tests.support.inside import MANIFEST, files_of, identity_of, refuse_mixed
from tests.support.made_up.gyro_lot import table

pytestmark = [
    pytest.mark.nightly,
    needs_installation,
    pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX"),
]
RESULT = "result.json"
ROOT = Path(__file__).resolve().parents[2]
CALIBRATE = ("calibrate", TABLE, *GYRO, *QUICK, "--out", "{out}/loop")
FILES = {
    "batch": (("batch", "{lot}", *GYRO, "-o", "{out}/lot.parquet"), "lot.parquet"),
    "report": (("report", "{saved}", "-o", "{out}/report.html"), "report.html"),
    "decide": (
        ("decide", "{saved}", "--limit", "bias: ±500 °/s", "-o", "{out}/decisions.json"),
        "decisions.json",
    ),
    "export": (("export", "{saved}", "-o", "{out}/gyro.json"), "gyro.json"),
}
WRITES = """
import sys
from pathlib import Path
from tests.support.spoilt_runs import killed_at
from tests.support.inside import list_files, whole_folder

folder, text, names = Path(sys.argv[1]), sys.argv[3], sys.argv[4:]
killed_at(str(folder.parent), int(sys.argv[2]))
with whole_folder(folder, text) as hidden:
    for name in names:
        (hidden / name).parent.mkdir(exist_ok=True)
        (hidden / name).write_text(text)
    list_files(hidden / "x", text)
    (hidden / "gone").mkdir(exist_ok=True)
"""
ALIVE = 10_000  # things done to files, which nothing does
OLD, NEW = (
    ("a.json", "b.json", "x/a.json", "x/b.json"),
    ("a.json", "c.json", "x/a.json", "x/c.json"),
)


def killed(*command: str) -> bool:
    """Whether the process was killed before it came to its end."""
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1, -signal.SIGKILL), done.stderr[-2000:]
    return done.returncode == -signal.SIGKILL


def test_a_folder_is_old_or_new_at_every_moment(tmp_path: Path) -> None:
    folder, seen = tmp_path / "place" / "out", set()
    mine = [folder / place / "mine.txt" for place in ("", "x", "gone")]
    for count in range(1, 100):
        for file in mine:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("mine")
        assert not killed("-c", WRITES, str(folder), str(ALIVE), "1", *OLD)
        if not killed("-c", WRITES, str(folder), str(count), "2", *NEW):
            break
        there = {p for p in folder.rglob("*") if p.is_file() and p.name != MANIFEST} - {*mine}
        names = {str(p.relative_to(folder)) for p in there}
        texts = {p.read_text() for p in there}
        assert (names, texts) in (({*OLD}, {"1"}), ({*NEW}, {"2"}))
        assert {file.read_text() for file in mine} == {"mine"}
        listed = {f"{place}{n}" for place in ("", "x/") for n in files_of(folder / place)}
        assert listed == names
        refuse_mixed(folder)
        refuse_mixed(folder / "x")
        seen |= texts
    else:
        pytest.fail("the writing never came to its end")
    assert count > 10
    assert seen == {"1", "2"}, "kills met both the old folder and the new"
    assert os.listdir(folder.parent) == ["out"]


def spoilt(out: Path, count: int, command: list[str]) -> bool:
    return killed("-m", "tests.support.spoilt_runs", "killed", str(out), str(count), *command)


def whole(folder: Path) -> bool:
    """Whether a folder holds results, which are then of one run."""
    refuse_mixed(folder)
    if not files_of(folder):
        assert not (folder / "calibration.nc").exists() and not (folder / RESULT).exists()
        return False
    own = identity_of(bc.load(folder / "calibration.nc"))
    assert json.loads((folder / RESULT).read_text("utf-8"))["calibration"] == own
    assert json.loads((folder / MANIFEST).read_text("utf-8"))["calibration"] == own
    return True


def readable(path: Path) -> bool:
    if path.suffix == ".parquet":
        return len(bc.load_batch(path)) == 3
    text = path.read_text("utf-8")
    return text.rstrip().endswith("</html>") if path.suffix == ".html" else bool(json.loads(text))


# A calibration does some 92 things to files, the later half for its picture; kills at later moments meet none.
EACH = np.random.default_rng(1).permutation(np.arange(1, 91))[:38].tolist()


@pytest.mark.parametrize(
    ("counts", "least"), [([12], 1), pytest.param(EACH, 30, marks=pytest.mark.slow)]
)
def test_a_calibration_killed_at_any_moment_is_whole(
    counts: list[int], least: int, tmp_path: Path
) -> None:
    out, met = tmp_path / "out", 0
    folder = out / "loop"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("mine")
    for seed, count in enumerate(counts):
        command = [str(w).format(out=out) for w in CALIBRATE]
        before = files_of(folder)
        met += spoilt(out, count, [*command, "--seed", str(seed)])
        whole(folder)
        assert (folder / "notes.txt").read_text() == "mine"
        assert not before or files_of(folder), "results that were there are gone"
        if seed % 5 == 0:
            again = run(*command, "--seed", seed)
            assert again.status in (0, 1), again.err
            assert {p.name for p in folder.iterdir()} == {*files_of(folder), MANIFEST, "notes.txt"}
            assert whole(folder)
            assert calibration_of(folder) == unbroken(command, seed, tmp_path / f"unbroken_{seed}")
    assert met >= least, "so many kills met it"


def calibration_of(folder: Path) -> str:
    """Identity of the calibration: over its model, its readings, its seed and its draws."""
    return json.loads((folder / MANIFEST).read_text("utf-8"))["calibration"]


def unbroken(command: list[str], seed: int, folder: Path) -> str:
    """The same of a run into a folder of its own, which nothing stopped."""
    assert run(*command[:-1], folder, "--seed", seed).status in (0, 1)
    return calibration_of(folder)


def test_two_commands_into_one_folder_leave_the_results_of_one(tmp_path: Path) -> None:
    out = tmp_path / "loop"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    words = [str(word).format(out=tmp_path) for word in CALIBRATE]
    for seed, later in enumerate(np.random.default_rng(5).uniform(0.0, 0.4, 4)):
        given = [[sys.executable, "-m", "bayescal", *words, "--seed", f"{seed}{n}"] for n in (1, 2)]
        first = subprocess.Popen(given[0], cwd=ROOT, stdout=subprocess.DEVNULL)
        time.sleep(later)
        assert subprocess.run(given[1], cwd=ROOT, capture_output=True, check=False).returncode < 2
        assert first.wait() < 2
        assert whole(out)
        assert {p.name for p in out.iterdir()} == {*files_of(out), MANIFEST, "notes.txt"}
        assert os.listdir(tmp_path) == ["loop"]


@pytest.mark.parametrize("name", FILES)
def test_files_of_commands_killed_at_each_moment_are_whole(
    name: str, saved: Path, tmp_path: Path
) -> None:
    lot, out, met = tmp_path / "lot.csv", tmp_path / "out", 0
    table(count=3).to_csv(lot, index=False)
    out.mkdir()
    words, file = FILES[name]
    command = [str(word).format(out=out, lot=lot, saved=saved) for word in words]
    old = b""
    for count in (1, 2, 3, 1, 2, 3, 4):
        met += spoilt(out, count, command)
        now = (out / file).read_bytes() if (out / file).exists() else b""
        assert now == old or readable(out / file)
        old = now
    assert run(*command).status == 0
    assert readable(out / file)
    assert os.listdir(out) == [file], "what killed runs left is cleared away"
    assert met >= 3, "so many kills met it"


UNITS = {  # command, and folders of its parts
    "imu --accelerometers accel_x,accel_y,accel_z --gyroscopes gyro_x,gyro_y,gyro_z": (
        "accelerometer",
        "gyroscope",
    ),
    "triad --columns output_x=accel_x --columns output_y=accel_y --columns output_z=accel_z": ("",),
}


@pytest.mark.parametrize(("given", "of_unit"), UNITS.items(), ids=["imu", "triad"])
def test_a_unit_killed_at_random_moments_is_of_one_run(
    given: str, of_unit: tuple[str, ...], tmp_path: Path
) -> None:
    """Accelerometers, gyroscopes and what is of both: the old unit or the new, whichever moment a kill meets."""
    told, *words = given.split()
    log, out, met = tmp_path / "log.csv", tmp_path / "out", 0
    made = gyro_triad.simulate_log(seed=1, campaign=gyro_triad.MovesByHand(poses=14))
    units = {"time": "s", "gyro": "deg/s", "accel": "g", "mag": "uT"}
    named = {f"{n} [{units[n.partition('_')[0]]}]": values for n, values in made.items()}
    pd.DataFrame(named).to_csv(log, index=False)
    unit = out / "unit"
    unit.mkdir(parents=True)
    (unit / "notes.txt").write_text("mine")
    command = [told, str(log), *words, "--baseline", "--out", str(unit)]
    assert run(*command).status == 0
    files = {p.relative_to(unit) for p in unit.rglob("*")}
    for seed, count in enumerate(np.random.default_rng(2).integers(1, 130, 8).tolist(), 1):
        met += spoilt(out, count, [*command, "--seed", str(seed)])
        # Pictures are drawn of a result that stands: killed between, a unit is without, never with those of another.
        there = {p.relative_to(unit) for p in unit.rglob("*")}
        assert {p.name for p in files ^ there} <= {"loop.png", "report.html"} and there <= files
        parts = [unit / part for part in of_unit]
        seeds = {json.loads((p / RESULT).read_text("utf-8"))["seed"] for p in parts}
        assert len(seeds) == 1, "parts of two runs stand side by side"
        assert all(whole(part) for part in parts)
        refuse_mixed(unit)
    assert met >= 2 * len(of_unit), "so many kills met it"
    assert run(*command).status == 0
    assert os.listdir(out) == ["unit"], "what killed runs left is cleared away"
