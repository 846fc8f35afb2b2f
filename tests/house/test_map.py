"""ARCHITECTURE.md and the index of terms are maps of what is there: the files and names in their tables exist.

A row of a table names places in its last cell: a file, then names in it.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [(ROOT / name).read_text("utf-8") for name in ("ARCHITECTURE.md", "bayescal/__init__.py")]
ROWS = [line for page in PAGES for line in page.splitlines() if re.match(r"(# )?\|.*`.*\|$", line)]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip().replace("*", ""))
def test_a_row_names_what_is_there(row: str) -> None:
    text = ""
    for quoted in re.findall(r"`([^`]+)`", row.rstrip("|").rpartition("|")[2]):
        if "/" in quoted:  # below the package, or below the repository
            below = ROOT / "bayescal" / quoted
            text = (below if below.exists() else ROOT / quoted).read_text("utf-8")
        else:
            defined = rf"^(?:class |def )?{quoted}\b"
            assert re.search(defined, text, re.MULTILINE), f"{row}: no {quoted} there"
    assert text, "name a place"
