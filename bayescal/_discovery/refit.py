"""The leading candidates are refitted: evidence in place of the score's, and what it changes.

The score is taken where noise still has to cover what is missing, which makes rivals look more alike than they are;
a refit does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit, logsumexp

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.evidence import laplace_evidence
from bayescal._core.progress import stage
from bayescal._discovery import susie
from bayescal._discovery.candidate import Candidate
from bayescal._model.effect import Effect

LEAD = 1.0  # log Bayes factor from which an effect that is not a finding is a lead
RIVAL = (
    0.5  # part of the best log Bayes factor by score from which another candidate is refitted too
)
# Of what an unknown function explains, from which an effect with a name is added first:
HALF = 0.5  # of its log Bayes factor,
MOST = 0.9  # or of its variance
VERIFIED = 4  # candidates that are refitted: the leading set's members, then other leads


def leading(
    found: susie.SingleEffects, judged: Sequence[Candidate], learned_spreads: bool
) -> list[int]:
    """Candidates worth a refit: the leading set's members, and leads that come near the best.

    Args:
        found: single effects, by score.
        judged: the candidates.
        learned_spreads: deviations of cells or runs stand in for what is missing, with spreads as wide as that takes,
            and next to them the score sees little of it, however large: the least evidence is worth a refit.
    """
    chosen = list(found.sets[0].members[:VERIFIED]) if found.sets else []
    factors = np.array([_weighed(c, c.log_bayes_factor) for c in judged])
    share = float(np.log(max(c.prior for c in judged)))
    least = 0.0 if learned_spreads else LEAD
    enough = share + max(least, RIVAL * (float(factors.max()) - share))
    for i in np.argsort(-factors):
        if factors[i] > enough and i not in chosen and len(chosen) < VERIFIED:
            chosen.append(int(i))
    named = [i for i in np.argsort(-factors) if not judged[i].unknown]
    if chosen and named and all(judged[i].unknown for i in chosen) and factors[named[0]] > LEAD:
        chosen.append(int(named[0]))  # to be set beside the unknown function
    return chosen


def nearly(
    verified: dict[str, float], judged: Sequence[Candidate], leader: str, readings: int
) -> tuple[str, ...]:
    """Effects with a name that explain nearly all that a free curve does, by refit: their own credible set.

    Far above the noise a law that takes away nine tenths of the variance, and leaves a departure that the readings
    show, has less than half of the log evidence. The variance is read off the evidence: 1 − exp(−2·log B/n), the
    coefficient of determination of Cox and Snell; under wandering noise it is of what the noise does not foretell.
    """
    named = {c.effect: verified[c.effect] for c in judged if not c.unknown and c.effect in verified}
    best, whole = max(named.values(), default=-np.inf), verified[leader]
    if best <= 0:
        return ()
    most = np.expm1(-2 * best / readings) <= MOST * np.expm1(-2 * whole / readings)
    return members(judged, named) if best >= HALF * whole or most else ()


def verify(calibration: Calibration, effects: Sequence[Effect]) -> dict[str, float]:
    """Log Bayes factor of each effect against none, both models fitted anew; without those that found no mode."""
    with stage("verifying by refit"):
        base = laplace_evidence(calibration.model, calibration)
        found = {
            e.name: laplace_evidence(calibration.model + e, calibration) - base for e in effects
        }
    return {name: factor for name, factor in found.items() if np.isfinite(factor)}


def _weighed(c: Candidate, factor: float | None) -> float:
    """Log of Bayes factor times prior share."""
    return (factor or 0.0) + float(np.log(c.prior))


def share_of(
    calibration: Calibration,
    effects: Sequence[Effect],
    judged: Sequence[Candidate],
    verified: dict[str, float],
) -> float:
    """Probability of several effects together, against the best single one by refit. Each has its prior."""
    if len(effects) < 2:
        return 0.0
    prior = {c.effect: float(np.log(c.prior)) for c in judged}
    base = laplace_evidence(calibration.model, calibration)
    with stage("verifying by refit"):
        gain = laplace_evidence(calibration.model + effects, calibration) - base
    together = gain + sum(prior[e.name] for e in effects)
    alone = max(factor + prior[n] for n, factor in verified.items())
    return float(expit(together - alone)) if np.isfinite(together) else 0.0


def shared_out(
    judged: Sequence[Candidate], names: set[str], share: float, mass: float
) -> list[Candidate]:
    """Probabilities where several effects together are more probable than the one that led."""
    return [
        replace(c, probability=max(c.probability or 0.0, share * mass))
        if c.effect in names
        else replace(c, probability=(1 - share) * (c.probability or 0.0))
        for c in judged
    ]


def nothing_after(
    judged: Sequence[Candidate], verified: dict[str, float], by_score: float
) -> float:
    """P(nothing) with refitted evidence in place of the score's, where there is any.

    The score's P(nothing) may rest on several effects at once; the refit judges one. So the odds by score are
    corrected by what the refit changed in the sum over single effects.
    """
    factors = [_weighed(c, c.log_bayes_factor) for c in judged]
    refit = [_weighed(c, verified.get(c.effect, c.log_bayes_factor or 0.0)) for c in judged]
    change = float(logsumexp(refit) - logsumexp(factors))
    log_odds = np.log1p(-by_score) - np.log(max(by_score, 1e-300)) + change
    return float(1 / (1 + np.exp(np.clip(log_odds, -700, 700))))


def members(judged: Sequence[Candidate], verified: dict[str, float]) -> tuple[str, ...]:
    """The verified candidates that together hold 95 % of their posterior, the most probable first.

    What no reading can tell apart stands in the catalogue's order, whatever the last digits say.
    """
    names = [c.effect for c in judged if c.effect in verified]
    factor = np.array([_weighed(c, verified[c.effect]) for c in judged if c.effect in verified])
    share = np.exp(factor - logsumexp(factor))
    order = np.argsort(-share.round(4), kind="stable")
    kept = order[: int(np.searchsorted(np.cumsum(share[order]), susie.COVERAGE)) + 1]
    return tuple(names[i] for i in kept)


def after_refit(
    judged: Sequence[Candidate], verified: dict[str, float], nothing: float
) -> list[Candidate]:
    """Log Bayes factors by refit where there are any, and the probability among those shared out by them."""
    updated = [
        replace(c, log_bayes_factor=verified[c.effect], source="refit")
        if c.effect in verified
        else c
        for c in judged
    ]
    total = logsumexp([_weighed(c, c.log_bayes_factor) for c in updated])
    among = logsumexp([_weighed(c, c.log_bayes_factor) for c in updated if c.effect in verified])
    by_score = sum(c.probability or 0.0 for c in judged if c.effect in verified)
    mass = min(1.0, max(by_score, (1 - nothing) * float(np.exp(among - total))))
    return [
        replace(c, probability=mass * float(np.exp(_weighed(c, c.log_bayes_factor) - among)))
        if c.effect in verified
        else c
        for c in updated
    ]
