"""Effects hidden in simulated campaigns: rates of detection, of confusion, and of false discovery.

There is a bank of campaigns for each instrument, from its own simulator: each candidate hidden in turn at random sizes
(a third to three times the plausible one), two at once, several in a longer record, none, and effects outside the
catalogue: an output that depends on a further recorded column, a sinusoid, a step and a shock in time. Every campaign
is searched as by `calibrate`, without its fits and checks. The oracle is the log evidence of the true structure minus
the baseline's. A further bank is drawn from the search's prior, to test the stated probabilities.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._model.summed_noise import OrnsteinUhlenbeck
from bayescal._search.structures import MAX_UNNAMED_RMS, Structure
from benchmarks import pages
from benchmarks.bank import Bank
from benchmarks.hidden_effects import bank, false_discoveries, triads
from benchmarks.hidden_effects.searched import Later, Searched
from benchmarks.pages import Claim, Rows, share, stated_and_true
from benchmarks.record import ROOT

SAMPLE = 70  # campaigns of each instrument that a release measures anew
STRONG, CLEAR = 8.0, 15.0  # oracle
WANDER = OrnsteinUhlenbeck.law


def cases(name: str) -> Iterator[tuple[tuple[Any, ...], tuple[str, bank.Case]]]:
    """Yield the campaigns of an instrument's bank."""
    return (((case.seed,), (name, case)) for case in bank.plan(bank.instrument_named(name)))


def measure(task: tuple[str, bank.Case]) -> dict[str, Any]:
    """Return the row of a campaign."""
    name, case = task
    search = stated if case.kind in ("prior", "law") else campaign
    return search(bank.instrument_named(name), case)


BANKS = tuple(Bank(f"hidden_effects_{n}", partial(cases, n), measure) for n in bank.INSTRUMENTS)


def stated(instrument: bc.Instrument, case: bank.Case) -> dict[str, Any]:
    """Search a campaign drawn from the priors; return its stated probabilities."""
    if case.kind == "law":
        readings, adds, wanders = bank.by_law(instrument, case)
    else:
        readings, adds, wanders = bank.simulated(instrument, case), {}, False
    hidden = list(adds or case.hidden)
    start = time.perf_counter()
    searched = Searched.of(instrument.for_readings(readings).baseline(), readings)
    seconds = time.perf_counter() - start
    return {
        "seed": case.seed,
        "kind": case.kind,
        "hidden": sorted(map(searched.structures.family, hidden)),
        "adds": {searched.structures.family(n): rms for n, rms in adds.items()},
        "wanders": wanders,
        "nothing": searched.posterior.completeness(),
        "stated_wanders": searched.posterior.law_probability(WANDER),
        "probabilities": searched.probabilities,
        "sets": [[list(s.effects), s.probability] for s in searched.sets],
        "final": searched.reported_names(searched.chosen),
        "forms": sorted(searched.chosen.effects),
        "seconds": seconds,
        "truth": _against(searched, hidden, wanders),
    }


def campaign(instrument: bc.Instrument, case: bank.Case) -> dict[str, Any]:
    """Search one campaign by every method."""
    readings, second = (bank.simulated(instrument, case, held_out) for held_out in (False, True))
    model = instrument.for_readings(readings).baseline()
    start = time.perf_counter()
    trial = Searched.of(model, readings)
    final, sets, probabilities = trial.chosen, trial.sets, trial.probabilities
    seconds = time.perf_counter() - start
    p_complete, structures = trial.posterior.completeness(), trial.structures
    missing = [bank.OUTSIDE[case.shape]] if case.kind == "outside" else list(case.hidden)
    truth = Structure(frozenset(missing))
    against = _against(trial, missing, False)
    base, later = trial.base, Later.of(trial, second)
    oracle = structures.evaluate(truth).log_evidence - base.log_evidence
    return {
        "seed": case.seed,
        "kind": case.kind,
        "shape": case.shape,
        "hidden": {structures.family(n): size for n, size in case.hidden.items()},
        "oracle": oracle,
        "oracle_of_each": _oracles(trial, truth) if len(missing) > 1 else [oracle] * len(missing),
        "nothing": p_complete,
        "sets": [[list(s.effects), s.probability] for s in sets],
        "probabilities": probabilities,
        "final": trial.reported_names(final),
        "forms": sorted(final.effects),
        "noise": "wandering" if final.noise == WANDER else final.noise or "white",
        "held_out": [trial.error(s, later) for s in (Structure(), final, truth)],
        "seconds": seconds,
        "truth": against,
    }


def _against(trial: Searched, missing: list[str], wanders: bool) -> dict[str, Any] | None:
    """Compare the true structure with the most probable one: whether it was evaluated, and log posteriors, nats."""
    structures = trial.structures
    best = structures.visited[trial.posterior.best]
    truth = Structure(frozenset(missing), WANDER if wanders else "")
    if truth == best.structure or not set(missing) <= set(structures.candidates):
        return None
    weighed, true = truth in structures.visited, structures.evaluate(truth, trial.base)
    fresh = structures._fit_structure(truth, None, ())
    return {
        "weighed": weighed,
        "best": [sorted(best.structure.effects), best.structure.noise],
        "total": true.log_posterior - best.log_posterior,
        "evidence": true.log_evidence - best.log_evidence,
        "prior": true.log_prior - best.log_prior,
        "fresh": fresh.log_posterior - best.log_posterior,
    }


def _oracles(trial: Searched, truth: Structure) -> list[float]:
    """Return the true structure's log Bayes factors over itself without each hidden effect."""
    evaluate, base = trial.structures.evaluate, trial.base
    reduced = map(truth.without_effects, sorted(truth.effects))
    return [evaluate(truth).log_evidence - evaluate(s, base).log_evidence for s in reduced]


def hidden_in(row: dict[str, Any]) -> str:
    """Return the hidden effect of a campaign with one."""
    return next(iter(row["hidden"]))


def found_effects(row: dict[str, Any]) -> set[str]:
    """Return the effects in the final model, and those equivalent to one of them."""
    return set(row["final"]) | {name for effects, _ in row["sets"] for name in effects}


def of_kind(rows: Rows, kind: str) -> Rows:
    return [row for row in rows if row.get("kind") == kind]


def clear(rows: Rows) -> Rows:
    """Return the campaigns with one hidden effect, detectable in the readings."""
    return [r for r in of_kind(rows, "single") if r["oracle"] > CLEAR]


def _pairs(rows: Rows) -> Rows:
    """Return the campaigns with two hidden effects, both detectable in the readings."""
    return [r for r in of_kind(rows, "pair") if min(r["oracle_of_each"]) >= STRONG]


def _outside(rows: Rows, shape: str = "") -> Rows:
    """Return the campaigns with a detectable effect outside the catalogue, of one shape if given."""
    outside_rows = [r for r in of_kind(rows, "outside") if shape in ("", r["shape"])]
    return [r for r in outside_rows if r["oracle"] >= STRONG]


def _names_outside(row: dict[str, Any]) -> bool:
    """Return whether the final model depends on the column of the effect outside the catalogue."""
    column = bank.OUTSIDE[row["shape"]].removesuffix(")").split(",")[0]
    return any(n.removesuffix(")").split(",")[0] == column for n in row["final"])


def _held_out(rows: Rows) -> str:
    """Return the median ratio of the final model's hold-out error to the true model's."""
    ratios = [r["held_out"][1] / r["held_out"][2] for r in rows if "held_out" in r]
    return f"{np.median(ratios):.2f}" if ratios else "–"


def _complete(rows: Rows, low: float, high: float) -> str:
    """Return how often the model was complete: no named effect missing, and no curve above the stated minimum."""
    law = of_kind(rows, "law")
    counted = (
        [a for n, a in r["adds"].items() if n[:7] != "unknown" or a > MAX_UNNAMED_RMS] for r in law
    )
    pairs = ((r["nothing"], not missing) for r, missing in zip(law, counted, strict=True))
    return stated_and_true(pairs, low, high)


def _missing(rows: Rows, low: float, high: float) -> str:
    probabilities = [
        (p, n in r["hidden"]) for r in of_kind(rows, "law") for n, p in r["probabilities"].items()
    ]
    return stated_and_true(probabilities, low, high)


SHORT: tuple[Claim, ...] = (
    (
        "one effect hidden (log Bayes factor above 15): in the final model, or equivalent to its effects",
        lambda rows: share(hidden_in(r) in found_effects(r) for r in clear(rows)),
    ),
    (
        "the same: in the final model",
        lambda rows: share(hidden_in(r) in r["final"] for r in clear(rows)),
    ),
    (
        "two hidden: both in the final model",
        lambda rows: share(set(r["hidden"]) <= set(r["final"]) for r in _pairs(rows)),
    ),
    (
        "outside the catalogue (a column; a wave, step or shock in time): its column in the final model",
        lambda rows: share(map(_names_outside, _outside(rows))),
    ),
    (
        "nothing hidden: an effect added",
        lambda rows: share(bool(r["final"]) for r in of_kind(rows, "empty")),
    ),
)
CLAIMS: tuple[Claim, ...] = (
    *SHORT,
    (
        "one effect hidden, clear: another effect in the final model",
        lambda rows: share(bool(set(r["final"]) - {hidden_in(r)}) for r in clear(rows)),
    ),
    (
        "one effect hidden, log Bayes factor below 5: found",
        lambda rows: share(
            hidden_in(r) in r["final"] for r in of_kind(rows, "single") if r["oracle"] < 5.0
        ),
    ),
    (
        "four hidden on a long record: each in the final model or equivalent",
        lambda rows: share(set(r["hidden"]) <= found_effects(r) for r in of_kind(rows, "several")),
    ),
    *(
        (
            f"outside the catalogue, {shape}: its column in the final model",
            lambda rows, shape=shape: share(map(_names_outside, _outside(rows, shape))),
        )
        for shape in bank.OUTSIDE
    ),
    ("hold-out error over the true model's, median", _held_out),
    *(
        (
            f"drawn from the search's prior: {what}, stated {low:g} to {high:g}, true",
            partial(say, low=low, high=high),
        )
        for what, say, bands in (
            ("complete", _complete, ((0.5, 0.8), (0.8, 0.95), (0.95, 1.0))),
            ("an effect is missing", _missing, ((0.05, 0.5), (0.5, 0.95), (0.95, 1.0))),
        )
        for low, high in bands
    ),
)
ABOUT = """
Campaigns simulated by each instrument's own physics, hidden effects of a third to three times the plausible size,
searched as by `calibrate`. *Log Bayes factor*: of the true structure over the baseline, under white noise.
*Final*: the chosen structure. *Drawn from the search's prior*: each candidate included by its odds, so that stated
probabilities should be calibrated; *complete*: no named effect is missing, nor a curve above a fifth of the noise;
*expected*: the central 95 % for calibrated statements. Brackets: exact 95 % binomial intervals.
"""


@cache
def results() -> dict[str, Rows]:
    """Return the rows of each instrument."""
    return dict(zip(bank.INSTRUMENTS, (b.rows for b in BANKS), strict=True)) | triads.results()


def render() -> pages.Texts:
    """Render the page and its summary in README.md from the stored results."""
    groups, spoilt = results(), false_discoveries.results()
    days = [r["day"] for group_rows in (*groups.values(), *spoilt.values()) for r in group_rows]
    tables = (
        pages.claims_table(groups, CLAIMS),
        "Nothing hidden, and noise, rows or priors that violate the model: an effect added "
        "(`python -m benchmarks false_discoveries`).",
        pages.claims_table(spoilt, false_discoveries.CLAIMS),
    )
    page = pages.page("hidden_effects", "Hidden effects", "hidden_effects", days, ABOUT, *tables)
    readme, marks = ROOT / "README.md", ("<!-- the bank in short -->", "<!-- end of it -->")
    before, _, tail = readme.read_text("utf-8").partition(marks[0])
    six = [row for name in bank.INSTRUMENTS for row in groups[name]]
    short = pages.claims_table({"count": six}, SHORT, "campaigns of all kinds")
    text = f"{before}{marks[0]}\n\n{short}\n{marks[1]}{tail.partition(marks[1])[2]}"
    return {**page, readme: text}
