"""Readings drawn from the search's own prior: each candidate in or out, its shapes and sizes, the noise law."""

from __future__ import annotations

import math

import numpy as np

import bayescal as bc
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import reference_of
from bayescal._model.noise_terms import CORRELATION_TIME
from bayescal._model.parameters import Layout, Unknown
from bayescal._model.prior import HalfCauchy, HalfNormal
from bayescal._model.summed_noise import OrnsteinUhlenbeck
from bayescal._search.discover import structures_over
from bayescal._search.structures import SIZE_FACTORS, Structure, Structures

WANDER = OrnsteinUhlenbeck.law


def by_law(
    model: bc.Model, readings: bc.Measurements, seed: int
) -> tuple[bc.Measurements, list[str], bool]:
    """An empty campaign's readings with what the prior says added; what was, and whether the noise wanders.

    Each candidate is in by its prior odds, its shapes, spreads and coefficients by their priors in the catalogue's own
    columns, its size times 1, 3 or 10 by their probabilities. The noise is white or wanders, by the odds of these two
    laws, its diffusion and time by their priors; its white part stays the simulator's.
    """
    rng = np.random.default_rng([seed, 1])
    structures, _ = structures_over(model, readings, reference_of(readings))
    odds = math.exp(structures.log_prior(Structure(noise=WANDER)))
    wanders = WANDER in structures.laws and bool(rng.random() < odds / (1 + odds))
    barred = structures.barred(Structure(noise=WANDER if wanders else ""))
    names = list[str]()
    for forms in structures.forms.values():
        open_ = [n for n in forms if n not in barred and n not in structures.barred(_with(names))]
        each = np.exp([structures.log_odds[n] for n in open_])
        total = each.sum()
        if open_ and rng.random() < total / (1 + total):
            names.append(str(rng.choice(open_, p=each / total)))
    added = np.zeros(len(readings))
    if names:
        added += _effects(structures, names, rng)
    if wanders:
        added += _wander(structures, rng)
    return readings.with_column("output", readings["output"] + added), names, wanders


def _with(names: list[str]) -> Structure:
    return Structure(frozenset(names))


def _effects(structures: Structures, names: list[str], rng: np.random.Generator) -> np.ndarray:
    """What effects add to the expected output at the fitted baseline."""
    base = structures.weigh(Structure())
    model = structures.model(Structure(frozenset(names)))
    sizes, shares = list(SIZE_FACTORS), list(SIZE_FACTORS.values())
    spread = {n: float(rng.choice(sizes, p=shares)) for n in names}
    spread = {n: f for n, f in spread.items() if not structures.candidates[n].is_placeholder}
    problem = Problem(Layout(model, structures.layout.counts), structures.record, spread)
    known = {h.name: v for h, v in zip(base.problem.hypers, base.mode.v, strict=True)}
    v = np.array([known.get(h.name, _coordinate(h, rng)) for h in problem.hypers])
    hyper = problem.hyper(v)
    prior = problem.prior(hyper, np.ones(problem.size))
    own = {t.effect.name: t.at for t in base.problem.in_x}
    x = np.zeros(problem.size)
    placed = dict.fromkeys(own, 0)
    for t in problem.in_x:
        if t.effect.name in own:
            known = [b for b in base.problem.in_x if b.effect.name == t.effect.name]
            at = known[placed[t.effect.name]].at
            placed[t.effect.name] += 1
            x[t.at] = base.mode.x[at]
        else:
            x[t.at] = prior.mean[t.at] + prior.sd[t.at] * rng.standard_normal(t.size)
    # The fitted baseline by itself: a body moves what depends on its temperature too.
    here = base.problem.linearise(base.mode.x, base.problem.hyper(base.mode.v))
    there = problem.linearise(x, hyper)
    moved = np.sqrt(problem.extra(there)) * rng.standard_normal(structures.record.size)
    return there.mean - here.mean + moved


def _coordinate(h: Unknown, rng: np.random.Generator) -> float:
    """Of one entry of φ, by its prior."""
    if isinstance(h.prior, HalfNormal):
        return float(np.log(np.abs(rng.standard_normal())))
    if isinstance(h.prior, HalfCauchy):
        return float(np.log(np.abs(rng.standard_cauchy())))
    return float(rng.standard_normal())


def _wander(structures: Structures, rng: np.random.Generator) -> np.ndarray:
    """Correlated noise with diffusion and time by the wandering law's priors."""
    record: Record = structures.record
    priors = structures.laws[WANDER].parameters()
    values = {
        n: float(p.value(_coordinate(Unknown(n, n, "", "noise", "noise", p), rng)))
        for n, p in priors.items()
        if n != "noise.white"
    }
    tau = values.pop(CORRELATION_TIME)
    (diffusion,) = values.values()
    sd = diffusion * np.sqrt(0.5 * tau)
    order, step = record.in_time
    made, value = np.zeros(record.size), 0.0
    for place, since in zip(order, step, strict=True):
        kept = 0.0 if since < 0 else float(np.exp(-since / tau))
        value = kept * value + sd * np.sqrt(1 - kept**2) * rng.standard_normal()
        made[place] = value
    return made
