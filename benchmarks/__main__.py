"""`python -m benchmarks` runs every benchmark, `python -m benchmarks NAME …` those named; speeds become a page.

`python -m benchmarks release` measures anew what a release states, `python -m benchmarks shown PAGE …` prints pages of
docs/ anew: see `release.py` and `shown.py`.
"""

from __future__ import annotations

import importlib
import sys

from benchmarks.speed import page

MODULES = {  # each name's module, with `main()`, in the order in which all are run
    "certified": "accuracy.certified",
    "thermal_ramp": "real_records.thermal_ramp",
    "records_of_others": "real_records.records_of_others",
    "triads_of_others": "real_records.triads_of_others",
    "still_logs": "real_records.still_logs",
    "still_noise": "accuracy.still_noise",
    "false_discoveries": "hidden_effects.false_discoveries",
    "coverage": "accuracy.coverage",
    "compensation": "instruments.compensation",
    "ng_accelerometer": "instruments.ng_accelerometer",
    "quartz_beam_accelerometer": "instruments.quartz_beam_accelerometer",
    "differential_pair": "instruments.differential_pair",
    "inclinometer": "instruments.inclinometer",
    "batches": "speed.batches",
    "samplers": "speed.samplers.rows",
    "hidden_effects": "hidden_effects.measurement",
    "triads": "hidden_effects.triads",
    "dividing_head": "hidden_effects.dividing_head",
    "equivalent": "hidden_effects.equivalent",
    "triad_coverage": "hidden_effects.triad_coverage",
    "under_noise": "hidden_effects.under_noise",
    "units": "hidden_effects.units",
    "holdout": "wrong_model.holdout",
    "one_profile": "wrong_model.one_profile",
    "starts": "wrong_model.starts",
    "wrong_model": "wrong_model.coverage",
    "ordinary_test": "ordinary_test.measurement",
    "no_family": "ordinary_test.no_family",
    "own_unit": "ordinary_test.own_unit",
    "good_records": "ordinary_test.good_records",
    "gauntlet": "spoilt_records.measurement",
    "start_up": "speed.start_up",
    "triad_speed": "speed.triads",
    "scaling": "speed.scaling.rows",
    "fleet": "fleet.measurement",
    "workbench": "speed.workbench",
    "open_benchmark": "open_benchmark",
    "cores": "cores",
    "how_we_know": "how_we_know",
    "stated": "stated",
}
BESIDE = (
    "release",
    "shown",
)  # take arguments, and are not among all: what those above measure; pages printed anew


def main(names: list[str]) -> int:
    """Run benchmarks in order.

    Returns:
        The exit status: 2 for a name that is not known, else 0.
    """
    if names and names[0] in BESIDE:
        importlib.import_module(f"benchmarks.{names[0]}").main(names[1:])
        return 0
    unknown = [name for name in names if name not in MODULES]
    if unknown:
        print(
            f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(MODULES)}",
            file=sys.stderr,
        )
        return 2
    for name in names or MODULES:
        importlib.import_module(f"benchmarks.{MODULES[name]}").main()
    page.render()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
