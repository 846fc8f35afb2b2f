"""Which effect is missing: a ranked list, with what cannot be told apart and what cannot be seen.

The sum of single effects on the efficient score gives credible sets (*findings*) under a prior in which "nothing is
missing" has probability one half; the leading sets are then verified by refitting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp, ndtri
from scipy.stats import chi2, norm

from bayescal import _candidates as candidates
from bayescal import _score as scores
from bayescal import _susie as susie
from bayescal._calibration import Calibration
from bayescal._effect import Effect
from bayescal._fit import bind
from bayescal._frame import build_frame
from bayescal._marginal import laplace_of
from bayescal._model import Model, testable
from bayescal._progress import stage

FINDING = 0.05  # P(nothing is missing) at or below which an effect is reported as found
LEAD = 1.0  # log Bayes factor from which an effect that is not a finding is a lead
RIVAL = (
    0.5  # part of the best log Bayes factor by score from which another candidate is refitted too
)
POWER = 0.80
VISIBLE = 0.01  # share of the information left after the nuisances below which nothing can be seen
VERIFIED = 4  # candidates that are refitted: the leading set's members, then other leads


@dataclass(frozen=True)
class Candidate:
    """What the readings say of one effect that is not in the model.

    Attributes:
        effect: canonical name.
        probability: that it is missing from the model; None if it cannot be tested.
        log_bayes_factor: of the model with it against the model as it is, natural logarithm.
        source: "score", or "refit" where the model was fitted again with it.
        z: size over its uncertainty (a group's chi-square as the z of equal probability).
        size, size_sd: expected coefficient and its uncertainty, in `unit`; for a group effect its spread.
        shape: expected shape parameters, in their units.
        visibility: information left after the nuisances over information before them.
        minimum_detectable: size in `unit` that would be found with 80 % power.
        kind: "finding", "lead", "not visible", "not testable", or None: no evidence for it.
        indistinguishable_from: others that these readings cannot tell from it.
        reason: why it is not testable or not visible.
    """

    effect: str
    probability: float | None = None
    log_bayes_factor: float | None = None
    source: str = "score"
    z: float | None = None
    size: float | None = None
    size_sd: float | None = None
    unit: str = ""
    shape: dict[str, float] = field(default_factory=dict)
    visibility: float | None = None
    minimum_detectable: float | None = None
    kind: str | None = None
    indistinguishable_from: tuple[str, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class Found:
    """One of these effects is missing; the readings cannot tell which."""

    effects: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class Discovery:
    """The answer to "which effect is missing?".

    Attributes:
        nothing_missing: probability that none of the candidates is.
        sets: findings, the most probable first.
        candidates: every candidate, the most probable first.
        best: the effects to add, so that `model + discovery.best` is the next model; empty for none.
        verified: log Bayes factor by refit, of each effect refitted.
    """

    nothing_missing: float
    sets: tuple[Found, ...]
    candidates: tuple[Candidate, ...]
    best: tuple[Effect, ...]
    verified: dict[str, float]

    def __str__(self) -> str:
        from bayescal._text import discovery_text  # tables for people stand above this floor

        return discovery_text(self)


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
    model, readings = calibration.model, calibration.readings
    known = {e.name: e for e in (*model.instrument.candidates, *model.instrument.effects, *effects)}
    open_ = [e for n, e in known.items() if n not in model.names]
    reasons = {e.name: testable(e, readings) for e in open_}
    tested = [e for e in open_ if reasons[e.name] is None]
    shut = [
        Candidate(n, kind="not testable", reason=r) for n, r in reasons.items() if r is not None
    ]
    if not tested:
        return Discovery(1.0, (), tuple(shut), (), {})
    with stage("looking for missing effects"):
        columns = candidates.lay_out(calibration, tested)
        score = scores.score(calibration, columns.matrix)
        unit_prior = np.ones(len(score.u))
        found = susie.single_effects(
            score.u, score.information, unit_prior, columns.items, rows=max_effects
        )
    judged = [_judge(columns, score, i, float(found.inclusion[i])) for i in range(len(tested))]
    sets = tuple(Found(tuple(tested[m].name for m in s.members), s.probability) for s in found.sets)
    judged = _name_aliases(judged, columns, score, found)
    nothing, best, verified = float(found.nothing_probability), (), {}
    leading = _leading(found, judged)
    if leading and verify:
        verified = _verify(calibration, [tested[m] for m in leading])
        nothing = _nothing_after(judged, verified, nothing)
        judged = _after_refit(judged, verified, nothing)
        sets = (_reweighed(1 - nothing, verified), *sets[1:])
    if nothing <= FINDING and sets:
        best = (known[sets[0].effects[0]],)
    else:
        sets = ()
    in_sets = {name for s in sets for name in s.effects}
    judged = [_kind(c, in_sets) for c in judged]
    ranked = sorted(judged, key=lambda c: (-(c.probability or 0.0), -(c.log_bayes_factor or 0.0)))
    return Discovery(nothing, sets, (*ranked, *shut), best, verified)


def _judge(
    columns: candidates.Columns, score: scores.Score, index: int, probability: float
) -> Candidate:
    """One candidate on its own, its shapes and spreads averaged over their priors."""
    effect = columns.effects[index]
    first, unit = candidates.reported(effect)
    log_factors, weights, means, variances, points = [], [], [], [], []
    for i in columns.of(index):
        item, point = columns.items[i], columns.points[i]
        part = score.part(list(item.columns))
        log_factors.append(susie.log_bayes_factor(part.u, part.information, np.ones(len(part.u))))
        weights.append(item.weight)
        if point.spread is not None:
            mean, variance = point.spread, 0.0
        else:
            inverse = np.linalg.inv(np.eye(len(part.u)) + part.information)
            mean, variance = (inverse @ part.u)[0] * first.size, inverse[0, 0] * first.size**2
        means.append(mean)
        variances.append(variance)
        points.append(part)
    log_weight = np.log(weights) + np.array(log_factors)
    total = float(logsumexp(log_weight))
    share = np.exp(log_weight - total)
    size = float(share @ means)
    spread = float(share @ (np.array(variances) + (np.array(means) - size) ** 2))
    top = int(np.argmax(share))
    grid = [columns.points[i] for i in columns.of(index)]
    shape = {s.name: float(share @ [g.shapes[s.name] for g in grid]) for s in effect.shapes}
    main = points[top]
    visibility = _visibility(main)
    detectable = _minimum_detectable(main, first.size, len(columns.effects), grid[top].spread)
    return Candidate(
        effect=effect.name,
        probability=probability,
        log_bayes_factor=total,
        z=_z(main, grid[top].spread is not None),
        size=size,
        size_sd=float(np.sqrt(spread)),
        unit=unit,
        shape=shape,
        visibility=visibility,
        minimum_detectable=detectable,
    )


def _main(part: scores.Score, group: bool) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of what speaks for the effect: all members of a group, or the first coefficient
    with its companions marginalised."""
    if group or len(part.u) == 1:
        return part.u, part.information
    rest = part.information[1:, 1:] + np.eye(len(part.u) - 1)
    pull = np.linalg.solve(rest, np.column_stack([part.information[1:, :1], part.u[1:]]))
    cross = part.information[:1, 1:]
    return part.u[:1] - cross @ pull[:, 1], part.information[:1, :1] - cross @ pull[:, :1]


def _z(part: scores.Score, group: bool) -> float:
    u, information = _main(part, group)
    if len(u) == 1:
        return float(u[0] / np.sqrt(information[0, 0])) if information[0, 0] > 0 else 0.0
    values, vectors = np.linalg.eigh(information)
    keep = values > 1e-10 * max(values.max(), 1e-300)
    square = float(np.sum((vectors.T @ u)[keep] ** 2 / values[keep]))
    return float(norm.isf(max(chi2.sf(square, keep.sum()), 1e-300)))


def _visibility(part: scores.Score) -> float:
    before = float(np.sum(part.before))
    return float(np.trace(part.information)) / before if before > 0 else 0.0


def _minimum_detectable(
    part: scores.Score, size: float, count: int, spread: float | None
) -> float | None:
    """Size found with 80 % power: the log Bayes factor reaches what a finding needs among `count` candidates."""
    needed = np.log(count * (1 - FINDING) / FINDING)
    group = spread is not None
    _, information = _main(part, group)
    if group:
        return _detectable_spread(information, spread or size, needed)
    i = float(information[0, 0])
    if i <= 1e-12:
        return None
    threshold = np.sqrt(2 * (needed + 0.5 * np.log1p(i)) * (1 + i) / i)
    return float((threshold + ndtri(POWER)) / np.sqrt(i) * size)


def _detectable_spread(information: np.ndarray, spread: float, needed: float) -> float | None:
    """For a group: the spread whose members' draws reach the needed log Bayes factor in 80 % of cases."""
    values = np.maximum(np.linalg.eigvalsh(information), 0.0)
    if values.max(initial=0.0) <= 1e-12:
        return None
    normal = np.random.default_rng(0).standard_normal((400, len(values)))
    for factor in np.geomspace(0.01, 1e4, 120):
        # u² along each axis has variance I + I²·factor² in units of the spread
        square = normal**2 * (values + values**2 * factor**2)
        weight = factor**2
        gain = 0.5 * square * weight / (1 + values * weight) - 0.5 * np.log1p(values * weight)
        if np.mean(gain.sum(axis=1) >= needed) >= POWER:
            return float(factor * spread)
    return None


def _name_aliases(judged, columns, score, found) -> list[Candidate]:
    """Which candidates' fitted contributions are one and the same to these readings."""
    best = []
    for index in range(len(judged)):
        items = columns.of(index)
        factors = []
        for i in items:
            part = score.part(list(columns.items[i].columns))
            factors.append(susie.log_bayes_factor(part.u, part.information, np.ones(len(part.u))))
        at = list(columns.items[items[int(np.argmax(factors))]].columns)
        part = score.part(at)
        vector = np.zeros(len(score.u))
        vector[at] = np.linalg.solve(np.eye(len(at)) + part.information, part.u)
        best.append(vector)
    stack = np.array(best)
    gram = stack @ score.information @ stack.T
    norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    cosine = np.abs(gram / np.outer(norms, norms))
    names = [c.effect for c in judged]
    named = []
    for i, c in enumerate(judged):
        same = {names[j] for j in np.flatnonzero(cosine[i] > 0.95) if j != i}
        for s in found.sets:
            if i in s.members:
                same |= {names[m] for m in s.members if m != i}
        named.append(replace(c, indistinguishable_from=tuple(sorted(same))))
    return named


def _kind(candidate: Candidate, in_sets: set[str]) -> Candidate:
    if candidate.effect in in_sets:
        return replace(candidate, kind="finding")
    if (candidate.log_bayes_factor or 0.0) > LEAD:
        return replace(candidate, kind="lead")
    if (candidate.visibility or 0.0) < VISIBLE or candidate.minimum_detectable is None:
        return replace(candidate, kind="not visible", reason="this experiment cannot see it")
    return candidate


def laplace_evidence(model: Model, calibration: Calibration) -> float:
    """Log evidence of a model on a calibration's readings, by Laplace."""
    model.require(calibration.readings)
    layout, _ = bind(model, calibration.readings)
    extra = [n for n in calibration.layout.promoted if n in model.unknowns]
    layout = layout.promote(*extra)
    frame = build_frame(calibration.readings, calibration.reference)
    y = jnp.asarray(calibration.readings["output"])
    return float(laplace_of(layout, frame, y).log_evidence)


def _verify(calibration: Calibration, effects: Sequence[Effect]) -> dict[str, float]:
    """Log Bayes factor of each effect against none, both models fitted anew."""
    with stage("verifying by refit"):
        base = laplace_evidence(calibration.model, calibration)
        return {
            e.name: laplace_evidence(calibration.model + e, calibration) - base for e in effects
        }


def _nothing_after(judged: list[Candidate], verified: dict[str, float], by_score: float) -> float:
    """P(nothing) with refitted evidence in place of the score's, where there is any.

    The score's P(nothing) may rest on several effects at once; the refit judges one. So the odds by score are
    corrected by what the refit changed in the sum over single effects.
    """
    factors = np.array([c.log_bayes_factor or 0.0 for c in judged])
    refit = np.array([verified.get(c.effect, f) for c, f in zip(judged, factors, strict=True)])
    change = float(logsumexp(refit) - logsumexp(factors))
    log_odds = np.log1p(-by_score) - np.log(max(by_score, 1e-300)) + change
    return float(1 / (1 + np.exp(np.clip(log_odds, -700, 700))))


def _leading(found: susie.SingleEffects, judged: list[Candidate]) -> list[int]:
    """Candidates worth a refit: the leading set's members, and leads that come near the best."""
    leading = list(found.sets[0].members[:VERIFIED]) if found.sets else []
    factors = np.array([c.log_bayes_factor or 0.0 for c in judged])
    enough = max(LEAD, RIVAL * factors.max())
    for i in np.argsort(-factors):
        if factors[i] > enough and i not in leading and len(leading) < VERIFIED:
            leading.append(int(i))
    return leading


def _reweighed(probability: float, verified: dict[str, float]) -> Found:
    """The leading set with its members' shares by refitted evidence, the most probable first.

    The score is taken where noise still has to cover what is missing, which makes rivals look more alike than
    they are; a refit does not.
    """
    names = list(verified)
    factor = np.array([verified[n] for n in names])
    share = np.exp(factor - logsumexp(factor))
    order = np.argsort(-share)
    kept = order[: int(np.searchsorted(np.cumsum(share[order]), susie.COVERAGE)) + 1]
    return Found(tuple(names[i] for i in kept), probability)


def _after_refit(
    judged: list[Candidate], verified: dict[str, float], nothing: float
) -> list[Candidate]:
    """Log Bayes factors by refit where there are any, and the probability among those shared out by them."""
    updated = [
        replace(c, log_bayes_factor=verified[c.effect], source="refit")
        if c.effect in verified
        else c
        for c in judged
    ]
    total = logsumexp([c.log_bayes_factor or 0.0 for c in updated])
    among = logsumexp(list(verified.values()))
    by_score = sum(c.probability or 0.0 for c in judged if c.effect in verified)
    mass = min(1.0, max(by_score, (1 - nothing) * float(np.exp(among - total))))
    return [
        replace(c, probability=mass * float(np.exp((c.log_bayes_factor or 0.0) - among)))
        if c.effect in verified
        else c
        for c in updated
    ]
