"""Golden texts: what is printed for people stands in a file beside its test, to be read when it changes.

`BAYESCAL_GOLDEN=1 python -m pytest ...` writes the files anew.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from tests.support.shown_output import assert_as_shown


def assert_golden(file: Path, parts: Mapping[str, str]) -> None:
    """Compare titled texts with a file: words exactly, numbers within the last digit shown."""
    text = "".join(f"== {title}\n{part.rstrip()}\n\n" for title, part in parts.items())
    text = "".join(f"{line.rstrip()}\n" for line in text.splitlines())
    if os.environ.get("BAYESCAL_GOLDEN"):
        file.write_text(text, "utf-8")
    if text != (shown := file.read_text("utf-8")):
        assert_as_shown(text, shown)
