"""Which effect is missing: a ranked list, with what cannot be told apart and what cannot be seen.

The sum of single effects on the efficient score gives credible sets (*findings*) under a prior in which "nothing is
missing" has probability one half; the leading sets are then verified by refitting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._core.progress import stage
from bayescal._diagnostics import efficient_score
from bayescal._discovery import candidate as judgement
from bayescal._discovery import candidate_columns as candidates
from bayescal._discovery import refit, susie
from bayescal._discovery.candidate import FINDING, Candidate
from bayescal._discovery.discovery import Discovery, Found
from bayescal._discovery.refit import LEAD
from bayescal._model.effect import Effect
from bayescal._model.frame import derived
from bayescal._model.model import testable
from bayescal._model.unknown_effect import FORMS, free_curve

RIVALS = 4  # effects that an experiment is asked to tell apart, at most
VISIBLE = 0.01  # share of the information left after the nuisances, below which a plausible size must still be seen
HOPELESS = 10.0  # plausible sizes that an effect would need to be found, above which this experiment cannot see it


def discover(
    calibration: Calibration,
    *,
    effects: Sequence[Effect] = (),
    max_effects: int = 5,
    verify: bool = True,
) -> Discovery:
    """Which effect is missing from a fitted model.

    Args:
        calibration: a converged fit.
        effects: further candidates of the user's own, beside the instrument's.
        max_effects: most effects that may be missing at once.
        verify: refit the leading set's members and demand that their evidence agrees.
    """
    known, tested, shut = _candidates_of(calibration, effects)
    if not tested:
        return Discovery(nothing_missing=1.0, sets=(), candidates=tuple(shut), best=(), verified={})
    with stage("looking for missing effects"):
        columns = candidates.lay_out(calibration, tested)
        score = efficient_score.score(calibration, columns.matrix)
        found = susie.single_effects(
            score.u,
            score.information,
            np.ones(len(score.u)),
            columns.items,
            rows=max_effects,
            candidate_prior=columns.prior,
        )
        shares = [float(share) for share in found.inclusion]
        judged = [judgement.judge(columns, score, i, share) for i, share in enumerate(shares)]
        judged = judgement.name_aliases(judged, columns, score, found)
    sets = tuple(Found(tuple(tested[m].name for m in s.members), s.probability) for s in found.sets)
    learned = any(h.kind == "spread" for h in calibration.layout.hypers)
    leading = refit.leading(found, judged, learned)
    nothing, best, verified = float(found.nothing_probability), (), {}
    if leading and verify:
        verified = refit.verify(calibration, [tested[m] for m in leading])
    if verified:
        nothing = refit.nothing_after(judged, verified, nothing)
        judged = refit.after_refit(judged, verified, nothing)
        sets = (Found(refit.members(judged, verified), 1 - nothing), *sets[1:])
        if nothing <= FINDING and known[sets[0].effects[0]].is_placeholder:
            together = _together(columns, score, max_effects)
            leaders = [known[s.effects[0]] for s in together]
            share = refit.share_of(calibration, leaders, judged, verified)
            sets, judged = _named(
                sets, together, share, judged, verified, len(calibration.readings)
            )
    if nothing <= FINDING and sets:
        best = (_first(sets[0], known),)
        judged = judgement.given(judged, columns, score, tested.index(best[0]))
    else:
        sets = ()
    return _ranked(known, tested, shut, nothing, sets, judged, best, verified)


def _ranked(
    known: dict[str, Effect],
    tested: list[Effect],
    shut: list[Candidate],
    nothing: float,
    sets: tuple[Found, ...],
    judged: list[Candidate],
    best: tuple[Effect, ...],
    verified: dict[str, float],
) -> Discovery:
    """The answer, its candidates in order, each with its kind."""
    in_sets = {name for s in sets for name in s.effects}
    plausible = {e.name: _plausible(e) for e in tested}
    judged = [_kind(c, in_sets, plausible[c.effect]) for c in judged]
    ranked = sorted(judged, key=lambda c: (-(c.probability or 0.0), -(c.log_bayes_factor or 0.0)))
    rivals = tuple(known[name] for name in _rivals(sets, ranked))
    return Discovery(
        nothing_missing=nothing,
        sets=sets,
        candidates=(*ranked, *shut),
        best=best,
        verified=verified,
        rivals=rivals,
    )


def _candidates_of(
    calibration: Calibration, effects: Sequence[Effect]
) -> tuple[dict[str, Effect], list[Effect], list[Candidate]]:
    """All effects by name; those to test; and those that these readings cannot test, each with the reason."""
    model, readings = calibration.model, calibration.readings
    known = {e.name: e for e in (*model.instrument.candidates, *model.instrument.effects, *effects)}
    for effect in unknowns(calibration):
        known.setdefault(effect.name, effect)
    reasons = {n: testable(e, readings) for n, e in known.items() if n not in model.names}
    tested = [known[n] for n, reason in reasons.items() if reason is None]
    shut = [
        Candidate(n, kind="not testable", reason=reason)
        for n, reason in reasons.items()
        if reason is not None and not known[n].is_placeholder
    ]
    return known, tested, shut


def _named(
    sets: tuple[Found, ...],
    together: tuple[Found, ...],
    share: float,
    judged: list[Candidate],
    verified: dict[str, float],
    readings: int,
) -> tuple[tuple[Found, ...], list[Candidate]]:
    """Sets and candidates where an unknown function leads, after effects with a name have been set beside it.

    Args:
        sets: the unknown's first.
        together: of named effects.
        share: their probability together, against the unknown's.
        judged, verified: candidates, and log Bayes factors by refit.
        readings: how many there are.
    """
    if share > 0.5:
        names = {name for found in together for name in found.effects}
        return together, refit.shared_out(judged, names, share, sets[0].probability)
    leader, near = sets[0].effects[0], ()
    if free_curve(leader):
        near = refit.nearly(verified, judged, leader, readings)
    beside = dict.fromkeys((*sets[0].effects, *near))
    return (Found(tuple(beside), sets[0].probability), *sets[1:]), judged


def _together(
    columns: candidates.Columns, score: efficient_score.Score, max_effects: int
) -> tuple[Found, ...]:
    """What named effects together would explain: an unknown function can imitate a sum of several of them."""
    named = [i for i, e in enumerate(columns.effects) if not e.is_placeholder]
    place = {candidate: i for i, candidate in enumerate(named)}
    if not named:
        return ()
    found = susie.single_effects(
        score.u,
        score.information,
        np.ones(len(score.u)),
        [replace(i, candidate=place[i.candidate]) for i in columns.items if i.candidate in place],
        rows=max_effects,
        candidate_prior=columns.prior[named] / columns.prior[named].sum(),
    )
    return tuple(
        Found(tuple(columns.effects[named[m]].name for m in s.members), s.probability)
        for s in found.sets
    )


def _first(found: Found, known: dict[str, Effect]) -> Effect:
    """What to add of a set: its likeliest effect that has a name, if any has one; a placeholder comes last."""
    effects = [known[name] for name in found.effects]
    return next((e for e in effects if not e.is_placeholder), effects[0])


def _rivals(sets: tuple[Found, ...], ranked: Sequence[Candidate]) -> list[str]:
    """Names of what another experiment should tell apart, the most probable first."""
    first = sets[0].effects if sets else ()
    if len(first) > 1:
        return list(first)
    near = [
        c.effect
        for c in ranked
        if c.effect not in first
        and (c.kind == "lead" or set(first) & set(c.indistinguishable_from))
        and not (first and c.unknown)
    ]
    return [*first, *near][:RIVALS]


def unknowns(calibration: Calibration) -> list[Effect]:
    """An unknown smooth dependence on each covariate, a jump and a cycle in time, beside the catalogue's effects."""
    instrument, readings = calibration.model.instrument, calibration.readings
    if all(s.unit != instrument.unit for s in instrument.slots):
        return []
    names = [name for name, values in derived(readings).items() if np.ptp(values) > 0]
    forms = [form for form in FORMS if form.split(",")[0] in names]
    return [instrument.unknown(name) for name in (*names, *forms)]


def _plausible(effect: Effect) -> float:
    """The size that an effect plausibly has, in the unit in which it is reported."""
    amplitude = next((s for s in effect.shapes if s.name == effect.measure), None)
    return effect.coefficients[0].size if amplitude is None else amplitude.high


def _kind(candidate: Candidate, in_sets: set[str], plausible: float) -> Candidate:
    if candidate.effect in in_sets:
        return replace(candidate, kind="finding")
    by_itself = candidate.log_bayes_factor or 0.0
    # Beside a finding, what its neighbours merely share with it does not count.
    factor = by_itself if candidate.conditional is None else min(by_itself, candidate.conditional)
    if factor > LEAD:
        return replace(candidate, kind="lead")
    least = candidate.minimum_detectable
    hidden = (candidate.visibility or 0.0) < VISIBLE
    if least is None or least > HOPELESS * plausible or (hidden and least > plausible):
        return replace(candidate, kind="not visible", reason="this experiment cannot see it")
    return candidate
