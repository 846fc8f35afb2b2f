"""Every command helps with an example, and its tables print on any terminal."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.command_line import GYRO, commands, needs_installation, run

pytestmark = needs_installation
ROOT = Path(__file__).resolve().parents[2]
COMMANDS = (
    *("instruments", "effects", "simulate", "pairs", "demo", "calibrate"),
    *("fit", "check", "discover", "compare", "predict", "noise"),
    *("compensate", "export", "budget", "report"),
    *("batch", "triad", "imu", "decide", "workbench"),  # of annexes
)


def test_every_command_is_tested_here() -> None:
    assert tuple(commands()) == COMMANDS


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['bayescal', 'calibrate', '--help']\n"
        "from bayescal._cli.main import command\n"
        "assert command() == 0\n"
        "print([n for n in ('jax', 'numpy', 'pandas', 'pint', 'matplotlib') if n in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_narrow_terminal_breaks_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = []
    for columns in ("40", "300"):
        monkeypatch.setenv("COLUMNS", columns)
        printed.append(run("effects", *GYRO).out)
    assert printed[0] == printed[1]
    widths = [len(line) for line in printed[0].splitlines() if line.startswith("──")]
    assert widths
    assert max(widths) <= 120
