"""By which code the committed rows were measured: every file of results, and how much of it the code as it is.

python -m benchmarks cores
"""

from __future__ import annotations

import json

from benchmarks.record import RESULTS, core, read_lines


def main() -> None:
    """Print a line for each file: how many of its rows are of this core."""
    print(f"this core: {core()}")
    for path in sorted(RESULTS.glob("*.json*")):
        lines = path.suffix == ".jsonl"
        rows = (
            read_lines(path)
            if lines
            else [json.loads(path.read_text("utf-8")).get("surroundings", {})]
        )
        own = sum(row.get("core") == core() for row in rows)
        print(f"{path.name:45s} {own:6,d} of {len(rows):6,d}")


if __name__ == "__main__":
    main()
