"""Results as JSON, with the versions and the machine that made them; rows of long benchmarks as lines of JSON."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
RESULTS = ROOT / "benchmarks" / "results"
REFERENCE_DATA = ROOT.parent / "shared" / "data"  # beside the checkout; not part of it
RELEASE = "release"  # its file: the code of the last one, and what came of each part
PACKAGES = ("bayescal", "jax", "jaxlib", "numpy", "scipy", "optimistix", "equinox", "lineax")


DECIDING = ("bayescal/_model", "bayescal/_inference", "bayescal/_calibration", "bayescal/_search")
DECIDING = (*DECIDING, "bayescal/effects", "models")  # sources on which a result hangs


# What a row says of its case: where these are the same, the case came out as it had before.
OUTCOME = ("crash", "status", "verdict", "final", "added", "covered", "channels")


@cache
def core() -> str:
    """Digest of the sources that decide a result, which a row carries; comments and docstrings decide nothing."""
    found = hashlib.sha256()
    for path in sorted(p for folder in DECIDING for p in (ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        for node in ast.walk(tree):
            if isinstance(body := getattr(node, "body", None), list):
                node.body = [n for n in body if not _is_text(n)]  # pyright: ignore[reportAttributeAccessIssue]
        found.update(path.relative_to(ROOT).as_posix().encode() + ast.dump(tree).encode())
    return found.hexdigest()[:12]


def _is_text(node: ast.AST) -> bool:
    value = node.value if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def cores_of(rows: Iterable[Mapping[str, Any]]) -> str:
    """By which code rows were measured: a sentence, the commonest digest first."""
    rows = list(rows)
    count = Counter(row.get("core", "") for row in rows)
    named = ((f"core `{c}`" if c else "an older core", n) for c, n in count.most_common())
    said = ", ".join(f"{n:,} by {which}" for which, n in named)
    again = [before["same"] for row in rows if (before := row.get("before"))]
    anew = f" Of {len(again):,} measured anew {sum(again):,} came out as before."
    return (
        f"*Rows measured: {said}.{anew if again else ''} `python -m benchmarks cores` compares with the code as it "
        "is.*\n"
    )


def surroundings() -> dict[str, Any]:
    """Python, packages and machine."""
    return {
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
        "core": core(),
        "machine": {
            "system": platform.system(),
            "kind": platform.machine(),
            "cores": os.cpu_count(),
        },
    }


def write_json(path: Path, content: dict[str, Any]) -> Path:
    """Write a file of JSON, beside and then renamed."""
    path.parent.mkdir(exist_ok=True)
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    draft.replace(path)
    return path


def write(name: str, results: dict[str, Any]) -> Path:
    """Write `benchmarks/results/NAME.json`, with what surrounds it."""
    return write_json(RESULTS / f"{name}.json", {"surroundings": surroundings(), **results})


def read(name: str) -> dict[str, Any]:
    """What `write` wrote, without what surrounds it; empty if nothing stands there."""
    path = RESULTS / f"{name}.json"
    found = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    found.pop("surroundings", None)
    return found


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Rows of a file, a line each; none if there is no file."""
    text = path.read_text("utf-8") if path.is_file() else ""
    return [json.loads(line) for line in text.splitlines()]


def lines_of(kind: str) -> dict[str, list[dict[str, Any]]]:
    """Rows of every `benchmarks/results/KIND_NAME.jsonl`, by that name."""
    files = sorted(RESULTS.glob(f"{kind}_*.jsonl"))
    return {path.stem.removeprefix(f"{kind}_"): read_lines(path) for path in files}


def measured(path: Path, fields: Sequence[str]) -> set[tuple[Any, ...]]:
    """Cases of a file that need no measuring.

    Those that have a row; where BAYESCAL_ANEW is set, as for a release, a row of the code as it is.
    """
    return cases_of(path, fields, anew=bool(os.environ.get("BAYESCAL_ANEW")))


def cases_of(path: Path, fields: Sequence[str], anew: bool = False) -> set[tuple[Any, ...]]:
    """Cases of a file, by the fields that tell them apart; `anew`: of the code as it is."""
    rows = (r for r in read_lines(path) if not anew or r.get("core") == core())
    return {tuple(row[field] for field in fields) for row in rows}


def add_line(path: Path, row: dict[str, Any], fields: Sequence[str] = ()) -> None:
    """Add a row to a file, with the digest of the code, so that a benchmark that is stopped goes on where it was.

    Args:
        path: of the file.
        row: of one case.
        fields: that tell cases apart: a row of the same case, of an older code, gives place, and the new one says
            whether it came out the same. None keeps all rows.
    """
    path.parent.mkdir(exist_ok=True)
    row = {**row, "core": row.get("core", core())}
    case = [row[field] for field in fields]
    former = read_lines(path) if fields else []
    kept = [one for one in former if [one[field] for field in fields] != case]
    if own := [one for one in former if [one[field] for field in fields] == case]:
        same = all(own[0].get(said) == row.get(said) for said in OUTCOME)
        row["before"] = {"core": own[0].get("core", ""), "same": same}
        draft = path.with_suffix(".part")
        draft.write_text("".join(map(_line, (*kept, row))), encoding="utf-8")
        draft.replace(path)
        return
    with path.open("a", encoding="utf-8") as out:
        out.write(_line(row))


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(row, ensure_ascii=False) + "\n"
