"""Bayesian model averaging: draws of each structure in proportion to its probability, in one model with all effects.

The average is over the structures of the 95 % credible set that have all findings: a few draws of other structures,
far off, would put a mean outside of its own interval.

In the model with the effects of all structures, a draw of one structure has zero coefficients for the other effects:
whatever is computed from draws (predictions, compensation, budgets, exports) is then averaged over the structures.
Source: J. Hoeting et al., Statist. Sci. 14 (1999) 382 (Bayesian model averaging).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import starmap

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._core import deadline
from bayescal._core.importance_weights import resample, smooth
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.progress import track
from bayescal._core.settings import settings
from bayescal._inference.laplace import Mode
from bayescal._inference.method import CHAINS, Draws
from bayescal._inference.problem import ZERO_SD_COORDINATE
from bayescal._inference.sampling import draw_weighted
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.parameters import Layout, Unknowns
from bayescal._search.posterior import Posterior
from bayescal._search.structures import EvaluatedStructure, Structure, Structures

DRAW_COUNT = 4000  # draws in all
MAX_ROUNDS = 6  # of adaptation of the importance sampler
# Factor on the standard uncertainty of the expected output of an incomplete model: on campaigns with formulas that the
# catalogue lacks, 95 % intervals then have a coverage of about 95 % (docs/wrong_model.md).
INCOMPLETE_FACTOR = 2.5
# Log spreads between runs over the plausible spread, from a thousandth of it; a half-normal's density limits them.
LOG_SPREADS = np.linspace(math.log(1e-3), math.log(10.0), 41)
_Values = dict[str, np.ndarray]  # draws of each unknown by name, (s,) or (s, members)


@dataclass(frozen=True)
class StructureShare:
    """A set of effects with its weight in the average, summed over noise laws."""

    effects: tuple[str, ...]
    probability: float


def add_inadequacy(
    calibration: Calibration, complete: float | None, structures: Structures, structure: Structure
) -> Calibration:
    """Return a calibration with the uncertainty of model inadequacy and of undetected deviations of new runs.

    If the model is complete, the expected output has the variance of the draws; if not, `INCOMPLETE_FACTOR`² times as
    much (inadequacy, or misspecification: M. Kennedy and A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425). New runs have
    the deviations that the few fitted runs cannot exclude.

    Args:
        calibration: a calibration of one structure, or averaged over several.
        complete: probability that the model is complete; None if it is unknown, or the model failed a check.
        structures, structure: the structures over the first model, and the most probable of them.
    """
    p_complete = complete or 0.0
    factor = math.sqrt(p_complete + (1 - p_complete) * INCOMPLETE_FACTOR**2)
    p = "P(complete) unknown, taken as 0" if complete is None else f"P(complete) = {complete:.3f}"
    note = (
        f"Model inadequacy (Type B): with {p}, predictions, corrections and budgets multiply the standard "
        f"uncertainty of the expected output by f = √(P + {INCOMPLETE_FACTOR:g}²·(1 − P)) = {factor:.2f}: "
        f"{INCOMPLETE_FACTOR:g} times for a model that lacks an effect, as in simulated tests. Coefficients omit f."
    )
    with_note = calibration.with_verdict(notes=(*calibration.verdict.notes, note))
    run_spreads = _find_run_spreads(calibration, structures, structure)
    return replace(with_note, form_factor=factor, unfound_spreads=run_spreads)


def _find_run_spreads(
    calibration: Calibration, structures: Structures, structure: Structure
) -> dict[str, float]:
    """Return the rms between-run standard deviation of each between-run effect that some draws lack, by name.

    It is estimated with the effect added, other φ at the mode, for a prior density 1/τ below the half-normal's scale.
    """
    spreads, names = dict[str, float](), {*structure.effects, *structures.candidates_for(structure)}
    names &= calibration.model.instrument.known.keys()  # others cannot be looked up by name
    for name, effect in structures.candidates.items():
        p_absent, prior = 1 - calibration.inclusion.get(name, 0.0), effect.coefficients[0].group_sd
        if p_absent and prior is not None and name in names and effect.columns == ("run",):
            fit = structures.evaluate(structure.with_effects(name))
            log_density = fit.log_density_along(effect.group_sd_name(0), LOG_SPREADS)
            log_density = log_density - LOG_SPREADS  # prior density exp(−½(τ/scale)²)/τ
            weight, squares = np.exp(log_density - log_density.max()), prior.value(LOG_SPREADS) ** 2
            spreads[name] = float(np.sqrt(p_absent * (weight @ squares) / weight.sum()))
    return {name: size for name, size in spreads.items() if np.isfinite(size)}


@run_on_one_thread
def average_models(
    last: Calibration, structures: Structures, noise: str, seed: int
) -> tuple[Calibration, tuple[StructureShare, ...]]:
    """Return the Bayesian model average over the structures (`last` if only one is probable), and their weights."""
    shares = list_shares(structures, noise)
    last_effects = frozenset(last.model.names) - frozenset(structures.base.names)
    if len(shares) < 2:
        return last, shares
    rng, parts = np.random.default_rng(seed), list[tuple[Model, _Values]]()
    with track("averaging over structures"):
        for share in shares:
            deadline.current().raise_if_over()
            count = max(1, round(DRAW_COUNT * share.probability))
            if frozenset(share.effects) == last_effects:
                # The last structure was sampled already: take from its draws, without repetition if there are enough.
                x, v = last.draws()
                indices = rng.choice(len(x), count, replace=count > len(x))
                parts.append((last.model, _collect_draws(last.layout, x[indices], v[indices])))
            else:
                fit = structures.evaluate(Structure(frozenset(share.effects), noise))
                draws = _draw_structure(fit, count, share.probability, seed)
                parts.append((fit.sized_model, draws))
    mixture = _combine_draws(last, _merge_models(structures, [model for model, _ in parts]), parts)
    texts = [f"{' + '.join(s.effects) or 'nothing added'} {s.probability:.2f}" for s in shares]
    note = f"Averaged over {len(shares)} structures with their probabilities: {', '.join(texts)}."
    mixture = mixture.with_verdict(notes=(*last.verdict.notes, note))
    return replace(mixture, method=f"{last.method}, averaged"), shares


@run_on_one_thread
def add_latent_effects(
    last: Calibration, in_use: Calibration, structures: Structures, structure: Structure
) -> tuple[Calibration, Calibration]:
    """Return both calibrations with the latent effects, which the readings cannot separate from a structure's.

    Existing draws are conditional on zero latent effects. Latent effects are drawn from their posterior, and all other
    unknowns shifted by their regression on them; effects of one span have wide priors, since their sizes are unknown.
    """
    latent_names = structures.latent_effects(structure)
    spanning = structures.spans.find_spanning(structure.effects)
    if not latent_names:
        return last, in_use
    names = [n for n in structures.candidates if n in latent_names | spanning]
    extended_fit = _extend_model(last, structures.with_wide_priors(last.model, names))
    linear, layout = extended_fit.linear, extended_fit.layout
    is_latent, covariance = np.isin(linear.owners, [*latent_names]), linear.root @ linear.root.T
    latent_covariance = covariance[np.ix_(is_latent, is_latent)]
    # Regression coefficients of each unknown on the latent effects: its shift per unit.
    regression = np.linalg.solve(latent_covariance, covariance[is_latent]) * linear.sd
    shifts = {b.name: regression[:, b.x_slice] for b in layout.x_blocks}
    hypers = ((layout.hypers[i].name, layout.size + k) for k, i in enumerate(layout.nonlinear_phi))
    shifts |= {name: regression[:, column] for name, column in hypers}

    def add_latent(calibration: Calibration) -> Calibration:
        extended = _extend_model(calibration, structures.with_wide_priors(calibration.model, names))
        x, v = (a.copy() for a in extended.draws())
        rng = np.random.default_rng([extended.seed, 4])
        cholesky = np.linalg.cholesky(latent_covariance)
        values = rng.standard_normal((len(x), len(cholesky))) @ cholesky.T + linear.z[is_latent]
        inclusion = calibration.inclusion_masks
        for name in spanning:
            values *= inclusion[name][:, None]
        for name in latent_names & inclusion.keys():
            values *= ~inclusion[name][:, None]
        for b in extended.layout.x_blocks:
            if b.name in shifts:
                mask = 1.0 if b.effect.name in latent_names else inclusion[b.effect.name][:, None]
                x[:, b.x_slice] += mask * (values @ shifts[b.name])
        for name in shifts.keys() & extended.layout.index_in_phi:
            v[:, extended.layout.index_in_phi[name]] += values @ shifts[name]
        mode = _average_mode(calibration, extended.layout, x, v)
        return replace(extended, joint=Draws.of(x, v), mode=mode)

    extended_fit = add_latent(last)
    return extended_fit, extended_fit if in_use is last else add_latent(in_use)


def _extend_model(calibration: Calibration, model: Model) -> Calibration:
    """Return a calibration of a model with further effects, which are zero in all draws."""
    draws = _collect_draws(calibration.layout, *calibration.draws())
    return _combine_draws(calibration, model, [(calibration.model, draws)], shuffle=False)


def list_shares(structures: Structures, noise: str) -> tuple[StructureShare, ...]:
    """Return the sets of effects in the average with their weights, which sum to one, the most probable first."""
    posterior, probabilities = Posterior.from_structures(structures), dict[frozenset[str], float]()
    for s, probability in zip(posterior.structures, posterior.probability, strict=True):
        if s in posterior.evaluated:
            # Sum over noise laws: all coefficients are drawn under the last model's law.
            probabilities[s.effects] = probabilities.get(s.effects, 0.0) + float(probability)
    excluded_names = structures.excluded_candidates(Structure(noise=noise))
    findings = [frozenset(f.effects) for f in posterior.findings]
    shares, covered_mass, mass_sum = dict[frozenset[str], float](), 0.0, sum(probabilities.values())
    for effects, part in sorted(probabilities.items(), key=lambda m: -m[1]):
        families = posterior.space.families(effects)
        is_credible = covered_mass < settings().found_probability
        is_likely = is_credible and part >= settings().averaged_probability
        has_all_findings = not any(f.isdisjoint(families) for f in findings)
        if is_likely and effects.isdisjoint(excluded_names) and has_all_findings:
            shares[effects] = part
        covered_mass += part / mass_sum
    total = sum(shares.values())
    return tuple(StructureShare(tuple(sorted(e)), p / total) for e, p in shares.items())


def _draw_structure(fit: EvaluatedStructure, count: int, probability: float, seed: int) -> _Values:
    """Draw from a structure about its mode, by importance sampling."""
    # All structures together have as many proposals as a single one would: the sampling error is about the same.
    sample = draw_weighted(fit.problem, fit.mode, seed, None, MAX_ROUNDS, probability=probability)
    weights, _ = smooth(sample.log_weight)
    indices = resample(weights, count, seed)
    return _collect_draws(fit.problem.layout, sample.x[indices], sample.v[indices])


def _collect_draws(layout: Layout, x: np.ndarray, v: np.ndarray) -> _Values:
    """Return draws by unknown, in its unit; coefficients stored in units of their group sd are converted."""
    unknowns = Unknowns.of(layout)
    values = unknowns.values(x, v)
    return {key: unknowns.select(values, key) for key in unknowns.by_key}


def _merge_models(structures: Structures, models: Sequence[Model]) -> Model:
    """Return the model with the effects of all models, each as in the most probable structure."""
    by_name: dict[str, Effect] = {}
    for model in models:
        for effect in model.effects:
            is_in_all = all(effect.name in m.names for m in models)
            by_name.setdefault(effect.name, effect if is_in_all else effect.averaged)
    # In the catalogue's order, so that the result does not depend on the order in which effects were found.
    positions = {n: i for i, n in enumerate([*structures.base.names, *structures.candidates])}
    effects = sorted(by_name.values(), key=lambda e: positions.get(e.name, len(positions)))
    return Model(models[0].instrument, tuple(effects), models[0].noise, models[0].fixed)


def _combine_draws(
    last: Calibration, model: Model, parts: Sequence[tuple[Model, _Values]], shuffle: bool = True
) -> Calibration:
    """Combine the draws of several models as draws of one with all their effects, in random order if `shuffle`."""
    # Groups of labels that another structure has and the last model lacks.
    new_groups = {g: last.readings.groups(g)[0] for g in model.groups if g not in last.levels}
    members = tuple((group, len(names)) for group, names in new_groups.items())
    layout = replace(last.layout, model=model, counts=(*last.layout.counts, *members), promoted=())

    def convert_draws(member_model: Model, draws: _Values) -> tuple[np.ndarray, np.ndarray]:
        # An effect that a structure lacks has the coefficient zero in its draws, not its prior's mean.
        count = len(next(iter(draws.values())))
        x, v = np.zeros((count, layout.size)), np.full((count, len(layout.hypers)), np.nan)
        for b in layout.x_blocks:
            if b.name in draws:
                x[:, b.x_slice] = draws[b.name].reshape(count, -1) - b.origin
            elif b.index in b.effect.constant_indices and b.effect.name in member_model.names:
                x[:, b.start] = b.coefficient.mean
        for i, h in enumerate(layout.hypers):
            if h.name in draws:
                v[:, i] = h.prior.coordinate(draws[h.name])
        return x, v

    x, v = map(np.concatenate, zip(*starmap(convert_draws, parts), strict=True))
    # Shapes and spreads of absent effects have no influence: the median leaves summaries unchanged.
    spreads = {b.group_sd_name for b in layout.blocks}
    for values, h in zip(v.T, layout.hypers, strict=True):
        fill_value = ZERO_SD_COORDINATE if h.name in spreads else np.nanmedian(values)
        values[np.isnan(values)] = fill_value
    order = np.random.default_rng(last.seed).permutation(len(x)) if shuffle else np.arange(len(x))
    order = order[: CHAINS * (len(x) // CHAINS)]
    return replace(
        last,
        model=model,
        joint=Draws.of(x[order], v[order]),
        confounded=last.confounders,
        layout=layout,
        levels={**last.levels, **new_groups},
        mode=_average_mode(last, layout, x, v),
    )


def _average_mode(last: Calibration, layout: Layout, x, v) -> Mode:
    """Return the expansion point of the average: means of the draws of x, medians of φ."""
    scales = {b.name: last.mode.flat[b.x_slice] for b in last.layout.x_blocks}
    flat_scales = [scales.get(b.name, np.ones(b.size)) for b in layout.x_blocks]
    medians = np.median(v, axis=0)
    # Absent spreads have the coordinate −30, which must not count in its variance.
    coordinates = np.where(v > 0.5 * ZERO_SD_COORDINATE, v, medians)
    covariance = np.atleast_2d(np.cov(coordinates.T)) if v.shape[1] else np.zeros((0, 0))
    return last.mode._replace(
        x=x.mean(axis=0),
        v=np.where(medians > 0.5 * ZERO_SD_COORDINATE, medians, ZERO_SD_COORDINATE),
        covariance=covariance + 1e-9 * np.eye(v.shape[1]),
        flat=np.concatenate([np.zeros(0), *flat_scales]),
    )
