"""Whenever a command is killed, its output is the old results, the new, or refused as mixed; the next run ends well.

A kill meets a process just before it does something to a file of its output, so that each state of the files is met.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import bayescal as bc
from tests.support.command_line import needs_installation
from tests.support.inside import read_hashes, refuse_mixed

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
from tests.support.inside import replace_folder

folder, text, names = Path(sys.argv[1]), sys.argv[3], sys.argv[4:]
killed_at(str(folder.parent), int(sys.argv[2]))
with replace_folder(folder) as hidden:
    for name in names:
        (hidden / name).parent.mkdir(exist_ok=True)
        (hidden / name).write_text(text)
    (hidden / "gone").mkdir(exist_ok=True)
"""
ALIVE = 10_000  # things done to files, which nothing does
OLD = ("a.json", "b.json", "x/a.json", "x/b.json")
NEW = ("a.json", "c.json", "x/a.json", "x/c.json")


def killed(*command: str) -> bool:
    """Whether the process was killed before it came to its end."""
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1, -signal.SIGKILL), done.stderr[-2000:]
    return done.returncode == -signal.SIGKILL


def state(place: Path) -> tuple[set[str], set[str]] | str:
    """The names and texts of the results in a folder, or that its files are refused as mixed."""
    try:
        refuse_mixed(place)
    except bc.InputError:
        return "mixed"
    names = {n for n in read_hashes(place) if (place / n).is_file()}
    return names, {(place / n).read_text() for n in names}


def test_a_folder_is_old_or_new_or_refused_at_every_moment(tmp_path: Path) -> None:
    folder, seen = tmp_path / "place" / "out", list[object]()
    mine = [folder / place / "mine.txt" for place in ("", "x", "gone")]
    old, new = ({"a.json", "b.json"}, {"1"}), ({"a.json", "c.json"}, {"2"})
    for count in range(1, 100):
        for file in mine:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("mine")
        assert not killed("-c", WRITES, str(folder), str(ALIVE), "1", *OLD)
        assert state(folder) == state(folder / "x") == old
        if not killed("-c", WRITES, str(folder), str(count), "2", *NEW):
            break
        for place in (folder, folder / "x"):
            seen.append(state(place))
            assert seen[-1] in (old, new, "mixed")
        assert {file.read_text() for file in mine} == {"mine"}
    else:
        pytest.fail("the writing never came to its end")
    assert count > 10
    assert all(one in seen for one in (old, new, "mixed")), "kills met all three"
    assert os.listdir(folder.parent) == ["out"]
    assert not [p for p in folder.rglob("*") if p.name.endswith(".partial")]
