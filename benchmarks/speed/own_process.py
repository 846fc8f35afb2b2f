"""Rows of a table, each measured in a process of its own, so that none finds what another has warmed up or left."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.record import ROOT

CODE = "import sys; from benchmarks.speed.own_process import answer; answer(*sys.argv[1:])"


def measured(module: str, row: str, limit: float | None = None) -> dict[str, Any] | None:
    """What `measure(row)` of a module returns, called in a process that is ended after `limit` seconds.

    Returns:
        None if what it measures is not installed; `{"ended_after": limit}` if it was ended.

    Raises:
        RuntimeError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "row.json"
        command = [sys.executable, "-c", CODE, module, row, str(out)]
        try:
            ran = subprocess.run(command, cwd=ROOT, timeout=limit, check=False)
        except subprocess.TimeoutExpired:
            return {"ended_after": limit}
        if ran.returncode:
            raise RuntimeError(f"{row}: ended with {ran.returncode}; its reason stands above")
        return json.loads(out.read_text("utf-8"))


def answer(module: str, row: str, out: str) -> None:
    """Measure a row in this process, and write it to a file, for what is printed is for people."""
    found = None
    try:
        found = import_module(module).measure(row)
    except ImportError as missing:
        print(f"{row}: skipped, {missing.name} is not installed", file=sys.stderr)
    Path(out).write_text(json.dumps(found), encoding="utf-8")
