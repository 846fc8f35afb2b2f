"""Pages that show commands, code and what they print: to run the one and compare the other."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)")
BOUND = re.compile(r"[<>] (?=\d)")  # of a probability: "< 0.01" is compared as 0.01
RELATIVE = 0.02


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of a page in one language ("python", "sh", "text"), in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def assert_as_shown(printed: str, shown: str, last_digits: float = 2) -> None:
    """Words exactly; numbers within some of the last digit shown, or 2 %.

    Rules under a table's head and the spaces between columns are not compared: their lengths depend
    on the numbers.
    """
    ours, theirs = _lines(printed), _lines(shown)
    where = f"\nprinted now:\n\n{printed}\n\nshown:\n\n{shown}"
    for one, other in zip(ours, theirs, strict=False):
        if NUMBER.sub("#", one) != NUMBER.sub("#", other):
            pytest.fail(f"the words differ:\n  {one}\n  {other}{where}")
        for a, b in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True):
            if abs(float(a) - float(b)) > max(last_digits * _last(b), RELATIVE * abs(float(b))):
                pytest.fail(f"{a} is not {b}, in:\n  {one}\n  {other}{where}")
    if len(ours) != len(theirs):
        pytest.fail(f"{len(ours)} lines, not {len(theirs)}{where}")


def _lines(text: str) -> list[str]:
    plain = (" ".join(BOUND.sub("", line).split()) for line in text.splitlines())
    return [line for line in plain if line and not line.startswith("──")]


def _last(number: str) -> float:
    """One unit of the last digit: 0.01 for 3.14, 1 for 322."""
    digits, _, power = number.partition("e")
    places = len(digits.partition(".")[2])
    return 10.0 ** (int(power or 0) - places)


def load_module(path: Path) -> Any:
    """A Python file that is no part of a package, run."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
