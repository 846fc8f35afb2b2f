"""Results as JSON, with the versions and the machine that made them."""

from __future__ import annotations

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
REFERENCE_DATA = ROOT.parent / "shared" / "data"  # beside the checkout; not part of it
PACKAGES = ("bayescal", "jax", "jaxlib", "numpy", "scipy", "optimistix", "equinox", "lineax")


def surroundings() -> dict[str, Any]:
    """Python, packages and machine."""
    return {
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
        "machine": {
            "system": platform.system(),
            "kind": platform.machine(),
            "cores": os.cpu_count(),
        },
    }


def write(name: str, results: dict[str, Any]) -> Path:
    """Write `benchmarks/results/NAME.json`, beside and then renamed."""
    path = ROOT / "benchmarks" / "results" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    draft = path.with_suffix(".part")
    text = json.dumps({"surroundings": surroundings(), **results}, indent=1, ensure_ascii=False)
    draft.write_text(text + "\n", encoding="utf-8")
    draft.replace(path)
    return path
