"""Pages that show commands, code and what they print: to run the one and compare the other."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.shown import LAST_DIGITS, difference


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of a page in one language ("python", "sh", "text"), in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def assert_as_shown(printed: str, shown: str, last_digits: float = LAST_DIGITS) -> None:
    """Words exactly; numbers within some of the last digit shown, or 2 %."""
    if said := difference(printed, shown, last_digits):
        pytest.fail(said)


def load_module(path: Path) -> Any:
    """A Python file that is no part of a package, run."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
