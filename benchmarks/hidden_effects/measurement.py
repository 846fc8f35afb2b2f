"""Effects hidden in simulated campaigns: found, told apart, not invented; and what other selections make of them.

    python -m benchmarks hidden_effects            every instrument
    BAYESCAL_ONLY=inclinometer BAYESCAL_KINDS="empty prior" python -m benchmarks hidden_effects

A bank of campaigns for each instrument, by its own simulator: each candidate hidden in turn at sizes drawn at random
(a third to three times the plausible one), two at once, several on a longer record, none, and what no catalogue has: an
output that follows a further recorded column, a wave, a step and a shock in time. Every campaign is searched as
`calibrate` does, without its fits and checks, and by three customary selections on the same candidate columns. The
oracle is the log evidence of the true structure less the base's. A bank of its own is drawn from the search's prior:
are the stated probabilities right? One JSON line a campaign in results/hidden_effects_NAME.jsonl: stopped, it goes on
where it was.
"""

from __future__ import annotations

import math
import os
import time
from typing import Any

import numpy as np
from scipy.special import logsumexp

import bayescal as bc
from bayescal._inference.linear_model import linear_model
from bayescal._model.summed_noise import OrnsteinUhlenbeck
from bayescal._search.calibrate import _other_path
from bayescal._search.scores import View
from bayescal._search.structures import Structure
from benchmarks.hidden_effects import page
from benchmarks.hidden_effects.bank import (
    INSTRUMENTS,
    OUTSIDE,
    Case,
    by_law,
    instrument_named,
    plan,
    simulated,
)
from benchmarks.hidden_effects.customary import SELECTIONS, select
from benchmarks.hidden_effects.resume import chosen, go_on
from benchmarks.hidden_effects.searched import Later, Searched
from benchmarks.record import DOCS, RESULTS, ROOT, lines_of, read

ENUMERATED = 8.0  # oracle from which the exact set is computed, by the evidence of every candidate,
EVERY = 4  # in one of so many campaigns, for it takes as long as the search
COVERAGE = 0.95
WANDER = OrnsteinUhlenbeck.law


def main() -> None:
    """Run what is missing of each instrument's bank, then render the page."""
    for name in chosen(INSTRUMENTS):
        run(name)
    render()


def render() -> None:
    """Render the page, and the bank in short in README.md, from the results that stand."""
    banks = lines_of("hidden_effects")
    page.write(banks, read("false_discoveries"), DOCS / "hidden_effects.md")
    page.in_readme(banks, ROOT / "README.md")


def run(name: str) -> None:
    """One instrument's bank, resumed."""
    instrument = instrument_named(name)
    path = RESULTS / f"hidden_effects_{name}.jsonl"
    kinds = os.environ.get("BAYESCAL_KINDS", "").split()

    def measure(case: Case) -> tuple[dict[str, Any], str]:
        row = (stated if case.kind in ("prior", "law") else campaign)(instrument, case)
        what = f"{case.kind} {list(case.hidden) or case.shape or row['hidden']} -> {row['final']}"
        return row, f"{case.seed} {row['seconds']:.1f} s {what}"

    asked = (((c.seed,), c) for c in plan(instrument) if not kinds or c.kind in kinds)
    go_on(path, ("seed",), asked, measure)


def stated(instrument: bc.Instrument, case: Case) -> dict[str, Any]:
    """What is said of a campaign drawn from the priors."""
    if case.kind == "law":
        readings, hidden, wanders = by_law(instrument, case)
    else:
        readings, hidden, wanders = simulated(instrument, case), list(case.hidden), False
    begun = time.perf_counter()
    found = Searched.of(instrument.for_readings(readings).baseline(), readings)
    taken = time.perf_counter() - begun
    return {
        "seed": case.seed,
        "kind": case.kind,
        "hidden": sorted(map(found.structures.family, hidden)),
        "wanders": wanders,
        "nothing": found.posterior.complete(found.structures),
        "stated_wanders": found.posterior.noise(WANDER),
        "probabilities": found.probabilities,
        "sets": [[list(s.effects), s.probability] for s in found.sets],
        "final": found.reported_names(found.chosen),
        "forms": sorted(found.chosen.effects),
        "seconds": taken,
        "truth": _against(found, hidden, wanders),
    }


def campaign(instrument: bc.Instrument, case: Case) -> dict[str, Any]:
    """One campaign, searched by every way."""
    readings, second = (simulated(instrument, case, held_out) for held_out in (False, True))
    model = instrument.for_readings(readings).baseline()
    begun = time.perf_counter()
    found = Searched.of(model, readings)
    final, sets, probabilities = found.chosen, found.sets, found.probabilities
    taken = time.perf_counter() - begun
    nothing, structures = found.posterior.complete(found.structures), found.structures
    other = _other_path(structures)
    missing = [OUTSIDE[case.shape]] if case.kind == "outside" else list(case.hidden)
    truth = Structure(frozenset(missing))
    against = _against(found, missing, False)
    base, later = found.base, Later.of(found, second)
    oracle = structures.weigh(truth).log_evidence - base.log_evidence
    return {
        "seed": case.seed,
        "kind": case.kind,
        "shape": case.shape,
        "hidden": {structures.family(n): size for n, size in case.hidden.items()},
        "as": sorted(case.hidden),
        "oracle": oracle,
        "oracle_of_each": _oracles(found, truth) if len(missing) > 1 else [oracle] * len(missing),
        "nothing": nothing,
        "first_set": list(sets[0].effects) if sets else [],
        "sets": [[list(s.effects), s.probability] for s in sets],
        "likeness": _likeness(instrument, case, found) if case.kind == "outside" else None,
        "exact_set": _exact_set(found)
        if case.kind == "single" and oracle >= ENUMERATED and case.seed % EVERY == 0
        else None,
        "reported": found.reported(),
        "probabilities": probabilities,
        "final": found.reported_names(final),
        "forms": sorted(final.effects),
        "noise": "wandering" if final.noise == WANDER else final.noise or "white",
        "undecided": [] if other is None else list(other.added),
        "held_out": [found.error(s, later) for s in (Structure(), final, truth)],
        "customary": {n: select(n, found, later) for n in SELECTIONS},
        "seconds": taken,
        "truth": against,
    }


def _against(found: Searched, missing: list[str], wanders: bool) -> dict[str, Any] | None:
    """The true structure against the most probable one: whether it was weighed, and their totals, in nats."""
    structures = found.structures
    best = structures.visited[found.posterior.best]
    truth = Structure(frozenset(missing), WANDER if wanders else "")
    if truth == best.structure or not set(missing) <= set(structures.candidates):
        return None
    weighed = truth in structures.visited
    own, fresh = structures.weigh(truth, found.base), structures._refitted(truth, None, ())
    return {
        "weighed": weighed,
        "best": [sorted(best.structure.effects), best.structure.noise],
        "total": own.total - best.total,
        "evidence": own.log_evidence - best.log_evidence,
        "prior": own.log_prior - best.log_prior,
        "fresh": fresh.total - best.total,
    }


def _oracles(found: Searched, truth: Structure) -> list[float]:
    """Log Bayes factor of the true structure against itself without each hidden effect."""
    weigh = found.structures.weigh
    whole = weigh(truth).log_evidence
    return [whole - weigh(truth.minus(n), found.base).log_evidence for n in sorted(truth.effects)]


def _likeness(instrument: bc.Instrument, case: Case, found: Searched) -> float:
    """Largest correlation of what was hidden with a catalogue effect's columns, the nuisances projected out."""
    bare = simulated(instrument, Case("empty", case.seed, {}))["output"]
    if len(bare) != len(found.readings):  # spikes were set aside
        return math.nan
    line = linear_model(found.base.problem, found.base.mode)
    hidden = line.whiten((found.readings["output"] - bare)[:, None])
    inside = line.projected(hidden)
    left = float((hidden.T @ hidden - inside.T @ inside).item())
    own = found.structures.candidates
    names = [n for n in found.library.points if not own[n].is_placeholder]
    alike = [0.0]
    for points in View(found.library, found.base).without().scores(names).values():
        for s in points:
            shared = s.columns.T @ hidden - s.inside.T @ inside
            part = np.linalg.lstsq(s.information, shared, rcond=1e-10)[0]
            alike.append(float((part.T @ shared).item()) / left)
    return float(np.sqrt(min(1.0, max(alike))))


def _exact_set(found: Searched) -> list[str]:
    """The fewest effects that hold 95 % of the posterior over one effect, by the evidence of every single one."""
    structures = found.structures
    names = [
        n
        for n, own in structures.forms.items()
        if n in own and not structures.candidates[n].is_placeholder
    ]
    single = [structures.weigh(Structure(frozenset({n})), found.base) for n in names]
    evidence = np.array([w.log_evidence for w in single])
    share = np.exp(evidence - logsumexp(evidence))
    order = np.argsort(-share)
    count = int(np.searchsorted(np.cumsum(share[order]), COVERAGE)) + 1
    return [names[i] for i in order[:count]]
