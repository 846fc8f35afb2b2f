"""What is left without an annex: a sentence in place of what it offers, and all else."""

from __future__ import annotations

import re

import pytest

from tests.house.test_startup import run_python

WITHOUT = """
import contextlib, io, sys

class Removed:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("bayescal._annexes.{annex}"):
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Removed())
import bayescal
from bayescal._cli.main import command

def called(*words):
    sys.argv[1:] = words
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        status = command()
    print(status, " ".join(said.getvalue().split()))

called("{command}", "readings.csv")
called("--help")
try:
    bayescal.{name}
except ImportError as error:
    print(error)
"""
OFFERED = [
    ("fleet", "batch", "fit_batch"),
    ("imu", "triad", "vector_correction"),
    ("metrology", "decide", "decide"),
    ("workbench", "workbench", "workbench"),
]


@pytest.mark.parametrize(("annex", "command", "name"), OFFERED)
def test_without_an_annex_its_command_and_its_names_say_so(
    annex: str, command: str, name: str
) -> None:
    told = run_python(WITHOUT.format(annex=annex, command=command, name=name))
    refused, listed, unnamed = told.splitlines()
    assert re.match(rf"2 bayescal: No such command '{command}'.* '{annex}' cannot be load", refused)
    assert "See: bayescal --help" in refused and "Traceback" not in refused
    assert listed.startswith("0 ") and "calibrate" in listed and f" {command} " not in listed
    assert f"bayescal.{name} is of an annex that is not there" in unnamed
