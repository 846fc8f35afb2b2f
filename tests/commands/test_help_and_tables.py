"""Every command helps with an example, and its tables print on any terminal."""

from __future__ import annotations

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


def test_every_command_helps_with_an_example() -> None:
    assert tuple(commands()) == COMMANDS
    _, listed = run("--help").out.split("Commands:")
    assert all(f"  {name} " in listed for name in COMMANDS) and "..." not in listed
    for name in COMMANDS:
        done = run(name, "--help")
        assert done.status == 0 and f"Example: bayescal {name}" in " ".join(done.out.split())
        assert "--json" in done.out or name in ("export", "workbench")


def test_a_narrow_terminal_breaks_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = []
    for columns in ("40", "300"):
        monkeypatch.setenv("COLUMNS", columns)
        printed.append(run("effects", *GYRO).out)
    assert printed[0] == printed[1]
    widths = [len(line) for line in printed[0].splitlines() if line.startswith("──")]
    assert widths
    assert max(widths) <= 120
