"""Whenever a command is killed, its output is the old results or the new, and the next run ends well.

A kill meets a process just before it does something to a file of its output, so that each state of the files is met.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import bayescal as bc
from tests.support.command_line import GYRO, needs_installation, run
from tests.support.inside import MANIFEST, files_of, refuse_mixed
from tests.support.made_up.gyro_lot import table

pytestmark = [
    pytest.mark.nightly,
    needs_installation,
    pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX"),
]
ROOT = Path(__file__).resolve().parents[2]
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


def readable(path: Path) -> bool:
    if path.suffix == ".parquet":
        return len(bc.load_batch(path)) == 3
    text = path.read_text("utf-8")
    return text.rstrip().endswith("</html>") if path.suffix == ".html" else bool(json.loads(text))


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
