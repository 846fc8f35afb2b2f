"""Effects hidden in simulated campaigns: found, told apart, not invented; and what other selections make of them.

    python -m benchmarks hidden_effects            every instrument
    BAYESCAL_ONLY=inclinometer BAYESCAL_KINDS="empty prior" python -m benchmarks hidden_effects

A bank of campaigns for each instrument, by its own simulator: each candidate hidden in turn at sizes drawn at random
(a third to three times the plausible one), two at once, none, and what no catalogue has: an output that follows a
further recorded column, a wave, a step and a shock in time. Every campaign is searched by `calibrate` with least
squares (Laplace) fits, and by three customary selections on the same candidate columns. The oracle is the log Bayes
factor of the true model against the baseline. A bank of its own, drawn from the priors (half of it empty), is
searched by `discover` alone: are the stated probabilities right? One JSON line a campaign in
results/hidden_effects_NAME.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
from scipy.special import logsumexp

import bayescal as bc
from bayescal._calibration.evidence import laplace_evidence
from bayescal._diagnostics import efficient_score
from bayescal._discovery import candidate_columns
from bayescal_models import INSTRUMENTS
from benchmarks.hidden_effects import page
from benchmarks.hidden_effects.bank import (
    OUTSIDE,
    Case,
    by_law,
    instrument_named,
    open_effects,
    plan,
    simulated,
)
from benchmarks.hidden_effects.customary import SELECTIONS, select
from benchmarks.hidden_effects.resume import chosen, go_on
from benchmarks.record import DOCS, RESULTS, ROOT, read, read_lines

METHOD = bc.LeastSquares(draws=200)
ENUMERATED = 8.0  # oracle from which the exact set is computed, by the evidence of every candidate
COVERAGE = 0.95


def main() -> None:
    """Run what is missing of each instrument's bank, then render the page."""
    for name in chosen(INSTRUMENTS):
        run(name)
    render()


def render() -> None:
    """Render the page, and the bank in short in README.md, from the results that stand."""
    files = sorted(RESULTS.glob("hidden_effects_*.jsonl"))
    banks = {path.stem.removeprefix("hidden_effects_"): read_lines(path) for path in files}
    page.write(banks, read("false_discoveries"), DOCS / "hidden_effects.md")
    page.in_readme(banks, ROOT / "README.md")


def run(name: str) -> None:
    """One instrument's bank, resumed."""
    instrument = instrument_named(name)
    path = RESULTS / f"hidden_effects_{name}.jsonl"
    done = {row["seed"] for row in read_lines(path)}
    kinds = os.environ.get("BAYESCAL_KINDS", "").split()

    def measure(case: Case) -> tuple[dict[str, Any], str]:
        row = (stated if case.kind in ("prior", "law") else campaign)(instrument, case)
        what = f"{case.kind} {list(case.hidden) or case.shape} -> {row.get('final')}"
        return row, f"{case.seed} {row['seconds']:.1f} s {what}"

    missing = (
        case
        for case in plan(instrument)
        if case.seed not in done and (not kinds or case.kind in kinds)
    )
    go_on(path, missing, measure)


def stated(instrument: bc.Instrument, case: Case) -> dict[str, Any]:
    """What is said of a campaign drawn from the priors."""
    if case.kind == "law":
        readings, hidden = by_law(instrument, case)
    else:
        readings, hidden = simulated(instrument, case), case.hidden
    begun = time.perf_counter()
    model = instrument.for_readings(readings).baseline()
    found = bc.discover(bc.fit(model, readings, METHOD, strict=False))
    return {
        "seed": case.seed,
        "kind": case.kind,
        "hidden": hidden,
        "nothing": found.nothing_missing,
        "probabilities": _probabilities(found),
        "seconds": time.perf_counter() - begun,
    }


def campaign(instrument: bc.Instrument, case: Case) -> dict[str, Any]:
    """One campaign, searched by every way."""
    readings, later = (simulated(instrument, case, held_out) for held_out in (False, True))
    model = instrument.for_readings(readings).baseline()
    begun = time.perf_counter()
    trail = bc.calibrate(model, readings, holdout=later, method=METHOD)
    taken = time.perf_counter() - begun
    first = trail.steps[0]
    missing = [OUTSIDE[case.shape]] if case.kind == "outside" else list(case.hidden)
    truth = model + missing if missing else model
    true = bc.fit(truth, readings, METHOD, strict=False) if missing else first.calibration
    oracle, each = _oracles(model, first.calibration, missing)
    found = first.discovery
    return {
        "seed": case.seed,
        "kind": case.kind,
        "shape": case.shape,
        "hidden": case.hidden,
        "oracle": oracle,
        "oracle_of_each": each,
        "nothing": None if found is None else found.nothing_missing,
        "first_set": list(found.sets[0].effects) if found and found.sets else [],
        "likeness": _likeness(instrument, case, readings, first.calibration)
        if case.kind == "outside"
        else None,
        "exact_set": _exact_set(first.calibration)
        if case.kind == "single" and oracle >= ENUMERATED
        else None,
        "reported": [
            [list(s.calibration.model.names), [list(f.effects) for f in s.discovery.sets]]
            for s in trail.steps
            if s.discovery is not None and s.discovery.best
        ],
        "probabilities": {} if found is None else _probabilities(found),
        "added": [s.added for s in trail.steps if s.added],
        "final": [n for n in trail.final.calibration.model.names if n not in model.names],
        "noise": trail.final.calibration.model.noise.law,
        "undecided": [] if trail.other_path is None else list(trail.other_path.added),
        "gate": trail.gate.ok,
        "held_out": [first.holdout_rmse, trail.final.holdout_rmse, bc.predict(true, later).rmse],
        "customary": {n: select(n, first.calibration, later) for n in SELECTIONS},
        "seconds": taken,
    }


def _probabilities(found: bc.Discovery) -> dict[str, float]:
    return {c.effect: c.probability for c in found.candidates if c.probability is not None}


def _oracles(
    model: bc.Model, first: bc.Calibration, missing: list[str]
) -> tuple[float, list[float]]:
    """Log Bayes factor of the true model against the baseline, and against itself without each hidden effect."""
    if not missing:
        return 0.0, []
    whole = laplace_evidence(model + missing, first)
    without = [
        laplace_evidence(model + [n for n in missing if n != name], first) for name in missing
    ]
    return whole - laplace_evidence(model, first), [whole - w for w in without]


def _likeness(
    instrument: bc.Instrument, case: Case, readings: bc.Measurements, first: bc.Calibration
) -> float:
    """Largest correlation of what was hidden with a catalogue effect's columns, the nuisances projected out."""
    bare = simulated(instrument, Case("empty", case.seed, {}))
    hidden = readings["output"] - bare["output"]
    laid = candidate_columns.lay_out(first, open_effects(first.model, readings))
    found = efficient_score.score(first, np.column_stack([laid.matrix, hidden])).information
    alike = [0.0]
    for item in laid.items:
        at = list(item.columns)
        shared = np.linalg.lstsq(found[np.ix_(at, at)], found[at, -1], rcond=1e-10)[0]
        alike.append(float(shared @ found[at, -1] / found[-1, -1]))
    return float(np.sqrt(min(1.0, max(alike))))


def _exact_set(first: bc.Calibration) -> list[str]:
    """The fewest effects that hold 95 % of the posterior over one effect, by the evidence of every single one."""
    effects = open_effects(first.model, first.readings)
    evidence = np.array([laplace_evidence(first.model + e, first) for e in effects])
    evidence = np.where(np.isfinite(evidence), evidence, -np.inf)
    share = np.exp(evidence - logsumexp(evidence))
    order = np.argsort(-share)
    count = int(np.searchsorted(np.cumsum(share[order]), COVERAGE)) + 1
    return [effects[i].name for i in order[:count]]
