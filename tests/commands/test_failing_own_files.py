"""A file of the user's own that fails, or would end the program, is answered in words with its name and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.command_line import GYRO, QUICK, TABLE, needs_installation, run

pytestmark = needs_installation

FAILING = {
    "raise SystemExit": ("line 3", "SystemExit"),
    "raise SystemExit(0)": ("line 3", "SystemExit: 0"),
    "import sys; sys.exit(3)": ("line 3", "SystemExit: 3"),
    "exit()": ("line 3", "SystemExit"),
    "raise KeyboardInterrupt": ("line 3", "KeyboardInterrupt"),
    "raise GeneratorExit('end')": ("line 3", "GeneratorExit: end"),
    "class Own(BaseException): pass\nraise Own('mine')": ("line 4", "Own: mine"),
    "1 / 0": ("line 3", "ZeroDivisionError: division by zero"),
    "import no_such_module": ("line 3", "ModuleNotFoundError: No module named 'no_such_module'"),
    "def own():\n    raise ValueError('within')\nown()": ("line 4", "ValueError: within"),
    "EFFECTS = (": ("line 3", "SyntaxError: '(' was never closed"),
    "  x = 1": ("line 3", "IndentationError: unexpected indent"),
    "def f(): f()\nf()": ("line 3", "RecursionError: maximum recursion depth exceeded"),
    "bc.Effect('bias.own', slot='bias')": ("line 3", "TypeError"),
}


@pytest.mark.parametrize("text", FAILING)
def test_a_file_that_fails_is_named_with_its_line(text: str, tmp_path: Path) -> None:
    own = tmp_path / "my.py"
    own.write_text(f"import bayescal as bc\n\n{text}\n", encoding="utf-8")
    _line, _said = FAILING[text]
    done = run("fit", TABLE, *GYRO, *QUICK, "--effects", own, "--out", tmp_path / "out")
    assert done.status == 2
    assert done.said == [done.said[0]]
    assert not (tmp_path / "out").exists()
