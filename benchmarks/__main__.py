"""`python -m benchmarks` runs every benchmark, `python -m benchmarks NAME …` those named; speeds become a page."""

from __future__ import annotations

import importlib
import sys

from benchmarks import speed_page

NAMES = (  # each a module here with `main()`
    "certified",
    "thermal_ramp",
    "false_discoveries",
    "coverage",
    "compensation",
    "ng_accelerometer",
    "quartz_beam_accelerometer",
    "differential_pair",
    "inclinometer",
    "batches",
    "samplers",
    "hidden_effects",
    "start_up",
    "scaling",
)


def main(names: list[str]) -> int:
    """Run benchmarks in order.

    Returns:
        The exit status: 2 for a name that is not known, else 0.
    """
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        print(
            f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(NAMES)}",
            file=sys.stderr,
        )
        return 2
    for name in names or NAMES:
        importlib.import_module(f"benchmarks.{name}").main()
    speed_page.render()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
