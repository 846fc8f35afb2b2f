"""Results as JSON, with versions, date and machine; rows of banks as lines of JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
RESULTS = ROOT / "benchmarks" / "results"
CERTIFIED_DATA = ROOT / "tests" / "data"
# Public records that are no part of the repository: beside the checkout, unless BAYESCAL_SHARED names their folder.
REFERENCE_DATA = Path(os.environ.get("BAYESCAL_SHARED", ROOT.parent / "shared")) / "data"
PACKAGES = ("bayescal", "jax", "numpy", "scipy", "optimistix")


def today() -> str:
    """Return the date, ISO 8601."""
    return datetime.now(UTC).date().isoformat()


def surroundings() -> dict[str, Any]:
    """Return date, Python version, package versions and machine."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    packages = {name: version(name) for name in PACKAGES}
    return {
        "day": today(),
        "python": platform.python_version(),
        "packages": packages,
        "machine": machine,
    }


def write(name: str, results: Mapping[str, Any]) -> Path:
    """Write `benchmarks/results/NAME.json` with date, versions and machine; return its path."""
    path = RESULTS / f"{name}.json"
    content = {"surroundings": surroundings(), **results}
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")
    return path


def read(name: str) -> dict[str, Any]:
    """Return results written by `write`; empty if there are none."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text("utf-8")) if path.is_file() else {}


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file, one per line; none if there is no file."""
    text = path.read_text("utf-8") if path.is_file() else ""
    return [json.loads(line) for line in text.splitlines()]


def write_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the rows of a file atomically."""
    draft = path.with_suffix(".part")
    draft.write_text("".join(json.dumps(r, ensure_ascii=False) + "\n" for r in rows), "utf-8")
    draft.replace(path)
