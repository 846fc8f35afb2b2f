"""Search of the same candidates by PySINDy's `EvidenceGreedy`, on campaigns of the bank of hidden effects.

It is given each candidate's columns at its best-fitting shapes, over which bayescal averages, the plausible sizes as
prior, and the noise of the true structure. Its evidence has the same form; it has neither families nor prior odds of
structures. Releases up to 2.1 lack it: it is in the repository (dynamicslab/pysindy, c4421fc).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bayescal._data.set_aside import exclude_faults
from bayescal._model.frame import reference_of
from bayescal._search.discover import enumerate_structures
from bayescal._search.scores import Library, Scorer
from bayescal._search.structures import Structure
from benchmarks.bank import Bank
from benchmarks.hidden_effects.bank import Case, instrument_named, plan, simulated
from benchmarks.hidden_effects.measurement import BANKS as OURS
from benchmarks.hidden_effects.measurement import CLEAR
from benchmarks.pages import proportion

INSTRUMENTS = ("mems_gyro", "still_sensor", "inclinometer")
EACH = {"single": 15, "empty": 15}  # campaigns of each instrument


def cases() -> Iterator[tuple[tuple[str, int], tuple[str, Case]]]:
    """Yield the first campaigns of each kind."""
    for name in INSTRUMENTS:
        for kind, count in EACH.items():
            for case in [c for c in plan(instrument_named(name)) if c.kind == kind][:count]:
                yield (name, case.seed), (name, case)


def measure(task: tuple[str, Case]) -> dict[str, Any]:
    """Return the families that `EvidenceGreedy` selects."""
    from pysindy.optimizers import EvidenceGreedy  # pyright: ignore[reportMissingImports]

    name, case = task
    readings = exclude_faults(simulated(instrument_named(name), case))
    model = instrument_named(name).for_readings(readings).baseline()
    structures, _ = enumerate_structures(model, readings, reference_of(readings), widen_noise=False)
    base, library = structures.evaluate(Structure()), Library(structures)
    truth = structures.evaluate(Structure(frozenset(case.hidden)), base)
    noise, view = truth.phi["noise.white"], Scorer(library, base)
    named = [n for n in library.points if not structures.candidates[n].is_placeholder]
    columns, owners = [view.linear.nuisance], [""] * len(view.linear.z)
    for form, points in view.reduced_model().score_candidates(named).items():
        columns.append(view.columns(view.linear, [points[0].point]) * points[0].prior_scale.sd)
        owners += [structures.family(form)] * columns[-1].shape[1]
    output = view.linear.residual + view.linear.nuisance @ view.linear.z
    search = EvidenceGreedy(alpha=1.0, _sigma2=1.0, normalize_columns=False)
    search.fit(np.column_stack(columns) / noise, output[:, None] / noise)
    kept = {owner for owner, keeps in zip(owners, search.ind_[0], strict=True) if keeps and owner}
    return {"hidden": sorted(map(structures.family, case.hidden)), "final": sorted(kept)}


BANKS = (Bank("evidence_greedy", cases, measure, ("instrument", "seed")),)


def lines() -> Iterator[tuple[str, str, str]]:
    """Yield the lines of the page *How we know*: its results beside those of bayescal, on the same campaigns."""
    bank = {(b.name.removeprefix("hidden_effects_"), r["seed"]): r for b in OURS for r in b.rows}
    pairs = [(row, bank[row["instrument"], row["seed"]]) for row in BANKS[0].rows]
    clear = [(t, o) for t, o in pairs if t["hidden"] and o["oracle"] > CLEAR]
    empty = [(t, o) for t, o in pairs if not t["hidden"]]
    clear_words = "the hidden effect (log Bayes factor above 15) and no other"
    for words, rows in ((clear_words, clear), ("nothing hidden: no effect added", empty)):
        right = [[found["final"] == pair[0]["hidden"] for found in pair] for pair in rows]
        theirs, ours = (proportion(sum(flags), len(rows)) for flags in zip(*right, strict=True))
        page = "[hidden effects](hidden_effects.md)"
        yield (
            f"PySINDy's `EvidenceGreedy`, same candidates; {words}",
            f"{theirs}; ours {ours}",
            page,
        )
