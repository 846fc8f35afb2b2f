"""Reads a data sheet: which effects and coefficients the docstring of an instrument's `model.py` names.

A name stands between backticks. So that a family needs one line only,

- `_quadratic` or `…_quadratic` continues the last full name of its line;
- in a docstring that says "as `bias.…` and `scale.…`", a name without a dot in the first cell of a table's row
  stands for one name under each.
"""

from __future__ import annotations

import re

QUOTED = re.compile(r"`([^`\n]+)`")
NAME = re.compile(r"[a-z][a-z_0-9]*(\.[a-z][a-z_0-9]*)?(\[[^\]]+\])?")
FILES = (".py", ".json", ".csv", ".md")


def listed(sheet: str) -> tuple[set[str], set[str]]:
    """Names that a data sheet lists: those written with a dot, and all others that may be names."""
    families = [t[:-2] for t in QUOTED.findall(sheet) if t.endswith(".…")]
    dotted: set[str] = set()
    plain: set[str] = set()
    for line in sheet.splitlines():
        first_cell = line.split("|")[1] if line.startswith("|") else ""
        last, in_family = "", False
        for token in QUOTED.findall(line):
            token = token.removeprefix("…")
            if token.startswith("_") and last:
                found = [last + token]
            else:
                found, last = [token], token
                in_family = f"`{token}`" in first_cell and "." not in token
            for name in found:
                if not NAME.fullmatch(name) or name.endswith(FILES):
                    continue
                (dotted if "." in name else plain).add(name)
                plain.add(name.partition("[")[0])  # a coefficient names its effect too
                if in_family:
                    plain |= {f"{family}.{name}" for family in families}
    return dotted, plain
