"""Page of pairs and triples of effects that are collinear in the usual test of each instrument.

python -m benchmarks equivalent
"""

from __future__ import annotations

import bayescal as bc
from bayescal._model.frame import reference_of
from bayescal._search.discover import enumerate_structures
from bayescal._search.equivalence import find_equivalents, find_experiments
from benchmarks.hidden_effects.bank import INSTRUMENTS, instrument_named
from benchmarks.pages import table
from benchmarks.record import DOCS

ALL = (*INSTRUMENTS, "accelerometer_dividing_head", "accelerometer_triad", "gyro_triad")
ALL = (*ALL, "magnetometer_triad")
SEED = 1
HEAD = """# Collinear effects

Rendered by `python -m benchmarks equivalent`, from one campaign (seed {seed}) of each instrument's simulator.

An effect's columns, whitened by the noise floor and scaled to plausible sizes, are projected on those of the first
model and of one or two other effects. If the residuals are less than a hundredth of its sum of squares, and less than
half a nat (½·log(1 + K), K the information in units of its prior), the readings cannot distinguish it from these. An
effect collinear with coefficients of the first model, *in* the table, is in every model with its prior, which increases
the uncertainty of these coefficients; one collinear with effects that are found is included with them. `bayescal
calibrate` lists all sets before its findings, and those of its model in the verdict or the notes.

*Separating test*: of the experiments that the instrument lists, the one that leaves most of the first effect, in nats
at its plausible size; at least half a nat.

"""


def main() -> None:
    """Write the page."""
    rows = [row for name in ALL for row in _rows(name)]
    listed = {name for name, *_ in rows}
    head = ["instrument", "effect", "collinear with", "separating test", "nats"]
    none = ", ".join(f"`{name}`" for name in ALL if name not in listed)
    body = HEAD.format(seed=SEED) + table(head, rows)
    (DOCS / "equivalent_effects.md").write_text(f"{body}\nNone: {none}.\n", "utf-8")


def _rows(name: str) -> list[list[str]]:
    instrument = instrument_named(name)
    readings = instrument.simulate(seed=SEED)
    model: bc.Model = instrument.for_readings(readings).baseline()
    structures, _ = enumerate_structures(model, readings, reference_of(readings))
    tests, rows = find_experiments(structures), []
    for equivalent in find_equivalents(structures.spans):
        first, *others = (f"`{n}`" for n in equivalent.effects)
        text = " + ".join(others) or ", ".join(f"`{n}` (in)" for n in equivalent.coefficients)
        test = tests[equivalent]
        nats = f"{test['nats']:.1f}" if "nats" in test else "–"
        rows.append([name, first, text, test.get("experiment", "none listed"), nats])
    return rows


if __name__ == "__main__":
    main()
