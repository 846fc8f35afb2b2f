"""Readings drawn from the search's prior: inclusion of each candidate, its shapes and sizes, and the noise law."""

from __future__ import annotations

import math

import numpy as np

import bayescal as bc
from bayescal._inference.linear_model import LinearModel
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._inference.sampling import draw_prior
from bayescal._model.frame import reference_of
from bayescal._model.noise_terms import CORRELATION_TIME
from bayescal._model.parameters import Layout
from bayescal._model.summed_noise import OrnsteinUhlenbeck
from bayescal._search.discover import enumerate_structures
from bayescal._search.structures import SIZE_FACTORS, Structure, Structures

WANDER = OrnsteinUhlenbeck.law
Added = tuple[np.ndarray, dict[str, float]]  # a sum of effects, and what each of them adds


def by_law(
    model: bc.Model, readings: bc.Measurements, seed: int
) -> tuple[bc.Measurements, dict[str, float], bool]:
    """Add a draw of the prior to an empty campaign's readings; return readings, truth, and whether noise is correlated.

    The truth is, by effect, the part of its contribution outside the span of the baseline: rms, relative to the noise.

    Each candidate is included by its prior odds, with shapes, standard deviations and coefficients from their priors in
    the catalogue, times 1, 3 or 10 by their probabilities. The noise is white or white plus correlated, by the odds of
    these laws, with diffusion and correlation time from their priors; the white part is the simulator's.
    """
    rng = np.random.default_rng([seed, 1])
    structures, _ = enumerate_structures(model, readings, reference_of(readings))
    odds = math.exp(structures.log_prior(Structure(noise=WANDER)))
    wanders = WANDER in structures.noise_laws and bool(rng.random() < odds / (1 + odds))
    barred = structures.excluded_candidates(Structure(noise=WANDER if wanders else ""))
    names = list[str]()
    for forms in structures.forms.values():
        excluded = barred | structures.excluded_candidates(_with(names))
        open_ = [n for n in forms if n not in excluded]
        odds = np.exp([structures.log_odds[n] for n in open_])
        if open_ and rng.random() < odds.sum() / (1 + odds.sum()):
            names.append(str(rng.choice(open_, p=odds / odds.sum())))
    added, adds = _effects(structures, names, rng) if names else (np.zeros(len(readings)), {})
    if wanders:
        added += _wander(structures, rng)
    return readings.with_column("output", readings["output"] + added), adds, wanders


def _with(names: list[str]) -> Structure:
    return Structure(frozenset(names))


def _effects(structures: Structures, names: list[str], rng: np.random.Generator) -> Added:
    """Return the effects' contribution to the expected output at the fitted baseline, and the size of each."""
    base = structures.evaluate(Structure())
    model = structures.build_model(Structure(frozenset(names)))
    sizes, shares = list(SIZE_FACTORS), list(SIZE_FACTORS.values())
    spread = {n: float(rng.choice(sizes, p=shares)) for n in names}
    spread = {n: f for n, f in spread.items() if not structures.candidates[n].is_placeholder}
    problem = Problem(Layout(model, structures.layout.counts), structures.record, spread)
    same_effect = {h.name: v for h, v in zip(base.problem.hypers, base.mode.v, strict=True)}
    v = np.array([same_effect.get(h.name, draw_prior(h.prior, rng, 1)[0]) for h in problem.hypers])
    hyper = problem.hyper(v)
    prior = problem.prior(hyper, np.ones(problem.size))
    positions = {t.effect.name: t.x_slice for t in base.problem.in_x}
    x = np.zeros(problem.size)
    placed = dict.fromkeys(positions, 0)
    for t in problem.in_x:
        if t.effect.name in positions:
            same_effect = [b for b in base.problem.in_x if b.effect.name == t.effect.name]
            at = same_effect[placed[t.effect.name]].x_slice
            placed[t.effect.name] += 1
            x[t.x_slice] = base.mode.x[at]
        else:
            x[t.x_slice] = prior.mean[t.x_slice] + prior.sd[t.x_slice] * rng.standard_normal(t.size)
    # The fitted baseline by itself: a body moves what depends on its temperature too.
    baseline = base.problem.linearise(base.mode.x, base.problem.hyper(base.mode.v))
    changed = problem.linearise(x, hyper)
    moved = np.sqrt(problem.extra(changed)) * rng.standard_normal(structures.record.size)
    line, adds = structures.linearise(base), dict[str, float]()
    for name in names:
        own = [t.effect.name == name for t in problem.in_x for _ in range(t.size)]
        without = problem.linearise(np.where(own, 0.0, x), hyper).mean
        left = not_held(line, changed.mean - without + moved * (not any(own)))
        adds[name] = float(np.sqrt(np.mean(left**2)))
    return changed.mean - baseline.mean + moved, adds


def not_held(linear: LinearModel, part: np.ndarray) -> np.ndarray:
    """Return the part of an output outside the span of the model's columns, whitened, (n,)."""
    white = linear.whiten(part[:, None])[:, 0]
    return linear.deflate(white, np.ones(len(linear.owners), dtype=bool))


def _wander(structures: Structures, rng: np.random.Generator) -> np.ndarray:
    """Simulate correlated noise with diffusion and correlation time from their priors."""
    record: Record = structures.record
    priors = structures.noise_laws[WANDER].parameters()
    values = {
        n: float(p.value(draw_prior(p, rng, 1)[0])) for n, p in priors.items() if n != "noise.white"
    }
    tau = values.pop(CORRELATION_TIME)
    (diffusion,) = values.values()
    sd = diffusion * np.sqrt(0.5 * tau)
    order, step = record.time_order
    noise, value = np.zeros(record.size), 0.0
    for place, since in zip(order, step, strict=True):
        decay = 0.0 if since < 0 else float(np.exp(-since / tau))
        value = decay * value + sd * np.sqrt(1 - decay**2) * rng.standard_normal()
        noise[place] = value
    return noise
