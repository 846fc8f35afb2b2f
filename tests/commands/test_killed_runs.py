"""Whenever a command is killed, its output is the old results or the new, and the next run ends well.

A kill meets a process just before it does something to a file of its output, so that each state of the files is met.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.command_line import needs_installation
from tests.support.inside import MANIFEST, files_of, refuse_mixed

pytestmark = [
    pytest.mark.nightly,
    needs_installation,
    pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX"),
]
ROOT = Path(__file__).resolve().parents[2]
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
