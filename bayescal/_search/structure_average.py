"""The average over structures: draws of each in proportion to its probability, in one model that holds all of them.

The average is over the structures of the 95 % credible set that have what is found to be missing: the few draws of
others, far off, would put a mean outside of its own interval.

In the model that has the effects of all structures, a draw of one of them is a draw whose other coefficients are zero:
so everything that is computed from draws (predictions, compensation, budgets, exports) is averaged without knowing it.
Source: J. Hoeting et al., Statist. Sci. 14 (1999) 382 (Bayesian model averaging).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._core import deadline
from bayescal._core.importance_weights import resample, smoothed
from bayescal._core.parallel import on_one_thread
from bayescal._core.progress import stage
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.laplace import Mode
from bayescal._inference.method import CHAINS, Draws
from bayescal._inference.problem import ABSENT
from bayescal._inference.sampling import weighted_draws
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.parameters import Layout
from bayescal._model.unknowns import Unknowns
from bayescal._search.posterior import Posterior
from bayescal._search.structures import Structure, Structures, Weighed

COUNT = 4000  # draws in all
MAX_ROUNDS = 6  # of adaptation at most
# How much more uncertain the expected output is where something is missing from the model that has no formula here: on
# campaigns whose formulas are none of the catalogue's, 95 % intervals then hold about 95 % (docs/wrong_model.md).
INCOMPLETE_FACTOR = 2.5
# Log of spreads between runs over the plausible one, from a thousandth of it: equally probable, where none was found.
LOG_SPREADS = np.linspace(math.log(1e-3), math.log(10.0), 41)


@dataclass(frozen=True)
class StructureShare:
    """A set of effects with its part of the average, all noise laws together."""

    effects: tuple[str, ...]
    probability: float


def with_form(
    calibration: Calibration, complete: float | None, structures: Structures, at: Structure
) -> Calibration:
    """Return a calibration that counts what the formulas of its structures do not hold.

    With the probability that it is complete its expected output has the variance that draws say, else
    `INCOMPLETE_FACTOR`² times that (model inadequacy: M. Kennedy and A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425).
    New runs have the deviations that so few as were fitted leave open, found or not.

    Args:
        calibration: of one structure, or averaged over several.
        complete: that probability; None where it is not known, or something speaks against it.
        structures: that it is of, `at` the most probable.
    """
    p_complete = complete or 0.0
    factor = math.sqrt(p_complete + (1 - p_complete) * INCOMPLETE_FACTOR**2)
    why = "unknown" if complete is None else f"{complete:.2f}"
    note = (
        f"Form of the model: the probability that it is complete is {why}; for this the standard uncertainty of the "
        f"expected output is multiplied by {factor:.2f}."
    )
    noted = calibration.with_verdict(notes=(*calibration.verdict.notes, note))
    spreads = _of_new_runs(calibration, structures, at)
    return replace(noted, form_factor=factor, unfound_spreads=spreads)


def _of_new_runs(
    calibration: Calibration, structures: Structures, at: Structure
) -> dict[str, float]:
    """Return by how much runs may differ where draws lack that: of each such effect added to `at`, its rms spread.

    Below its plausible size a spread that was not found is of any order of magnitude: its logarithm is uniform.
    """
    spreads, open_to = dict[str, float](), {*at.effects, *structures.open_to(at)}
    open_to &= calibration.model.instrument.known.keys()  # in which a name is looked up
    for name, effect in structures.candidates.items():
        lacking = 1 - calibration.inclusion.get(name, 0.0)
        learned = effect.coefficients[0].group_sd is not None
        if lacking and learned and name in open_to and effect.columns == ("run",):
            weighed = structures.weigh(at.plus(name))
            problem, mode = weighed.problem, weighed.mode
            place = problem.layout.index_in_phi[effect.group_sd_name(0)]
            along = np.tile(mode.v, (len(LOG_SPREADS), 1))
            along[:, place] = LOG_SPREADS
            density = Density(problem, mode.x, mode.flat, mode.v).values(along) - LOG_SPREADS  # 1/τ
            weight = np.exp(density - density.max())
            squares = problem.hypers[place].prior.value(LOG_SPREADS) ** 2
            spreads[name] = float(np.sqrt(lacking * (weight @ squares) / weight.sum()))
    return {name: size for name, size in spreads.items() if np.isfinite(size)}


_Values = dict[str, np.ndarray]  # draws of each unknown by name, (s,) or (s, members)


@on_one_thread
def averaged(
    last: Calibration, structures: Structures, noise: str, seed: int
) -> tuple[Calibration, tuple[StructureShare, ...]]:
    """Average the last model's calibration over the structures; return it with their shares."""
    shares = shares_of(structures, noise)
    last_effects = frozenset(last.model.names) - frozenset(structures.base.names)
    if len(shares) < 2:
        return last, shares
    random, parts, models = np.random.default_rng(seed), [], []
    with stage("averaging over structures"):
        for share in shares:
            deadline.current().ask()
            count = max(1, round(COUNT * share.probability))
            if frozenset(share.effects) == last_effects:
                # The last structure was sampled already: its draws again, without repetition where there are enough.
                x, v = last.draws()
                pick = random.choice(len(x), count, replace=count > len(x))
                parts.append(_by_name(last.layout, x[pick], v[pick]))
                models.append(last.model)
                continue
            weighed = structures.weigh(Structure(frozenset(share.effects), noise))
            parts.append(_drawn(weighed, count, share.probability, seed))
            models.append(weighed.sized_model)
    mixture = _together(last, _union(structures, models), models, parts)
    words = [f"{' + '.join(s.effects) or 'nothing added'} {s.probability:.2f}" for s in shares]
    note = f"Averaged over {len(shares)} structures with their probabilities: {', '.join(words)}."
    mixture = mixture.with_verdict(notes=(*last.verdict.notes, note))
    return replace(mixture, method=f"{last.method}, averaged"), shares


@on_one_thread
def with_latent(
    last: Calibration, used: Calibration, structures: Structures, at: Structure
) -> tuple[Calibration, Calibration]:
    """Return calibrations with the latent effects that readings cannot tell from a structure's.

    Draws that lack them are those of the others given that they are zero. Linear in them, the others then stand where
    they are to be given what they are; all of one span have the prior of a size that nobody knows.
    """
    latent, spanning = structures.latent(at), structures.spans.spanning(at.effects)
    if not latent:
        return last, used
    names = [n for n in structures.candidates if n in latent | spanning]
    whole = _extended(last, structures.unsized(last.model, names))
    line, layout = whole.linear, whole.layout
    inside, covariance = np.isin(line.owners, [*latent]), line.root @ line.root.T
    latent_covariance = covariance[np.ix_(inside, inside)]
    # By how much each unknown stands elsewhere for each unit of what is latent.
    moves = np.linalg.solve(latent_covariance, covariance[inside]) * line.sd
    by_name = {b.name: moves[:, b.start : b.start + b.size] for b in layout.x_blocks}
    hypers = ((layout.hypers[i].name, layout.size + k) for k, i in enumerate(layout.nonlinear_phi))
    by_name |= {name: moves[:, column] for name, column in hypers}

    def moved(calibration: Calibration) -> Calibration:
        extended = _extended(calibration, structures.unsized(calibration.model, names))
        x, v = (a.copy() for a in extended.draws())
        random = np.random.default_rng([extended.seed, 4])
        root = np.linalg.cholesky(latent_covariance)
        values = random.standard_normal((len(x), len(root))) @ root.T + line.z[inside]
        inclusion = calibration.having
        for name in spanning:
            values *= inclusion[name][:, None]
        for name in latent & inclusion.keys():
            values *= ~inclusion[name][:, None]
        for b in extended.layout.x_blocks:
            if b.name in by_name:
                has = 1.0 if b.effect.name in latent else inclusion[b.effect.name][:, None]
                x[:, b.start : b.start + b.size] += has * (values @ by_name[b.name])
        for name in by_name.keys() & extended.layout.index_in_phi:
            v[:, extended.layout.index_in_phi[name]] += values @ by_name[name]
        mode = _mode(calibration, extended.layout, x, v)
        return replace(extended, joint=Draws.of(x, v), mode=mode)

    whole = moved(last)
    return whole, whole if used is last else moved(used)


def _extended(calibration: Calibration, model: Model) -> Calibration:
    """Return a calibration of a model with more effects, which are zero in all draws."""
    draws = _by_name(calibration.layout, *calibration.draws())
    return _together(calibration, model, [calibration.model], [draws], shuffled=False)


def shares_of(structures: Structures, noise: str) -> tuple[StructureShare, ...]:
    """Return the sets of effects that take part, the most probable first, and their parts, which sum to one."""
    posterior, mass = Posterior.of(structures), dict[frozenset[str], float]()
    for s, probability in zip(posterior.structures, posterior.probability, strict=True):
        if s in posterior.refitted:
            # Noise laws are summed over: all coefficients are drawn under the law of the last model.
            mass[s.effects] = mass.get(s.effects, 0.0) + float(probability)
    barred = structures.barred(Structure(noise=noise))
    findings = [frozenset(f.effects) for f in posterior.findings]
    shares, total, whole = dict[frozenset[str], float](), 0.0, sum(mass.values())
    for effects, part in sorted(mass.items(), key=lambda m: -m[1]):
        families = posterior.space.families(effects)
        likely = total < settings().found_probability and part >= settings().averaged_probability
        holds_all = not any(f.isdisjoint(families) for f in findings)
        if likely and effects.isdisjoint(barred) and holds_all:
            shares[effects] = part
        total += part / whole
    averaged = sum(shares.values())
    return tuple(StructureShare(tuple(sorted(e)), p / averaged) for e, p in shares.items())


def _drawn(weighed: Weighed, count: int, probability: float, seed: int) -> _Values:
    """Draw from a structure about its mode, by importance sampling."""
    # All structures together have as many proposals as one alone: the average is as well known as that would be.
    sample = weighted_draws(weighed.problem, weighed.mode, seed, None, MAX_ROUNDS, part=probability)
    weights, _ = smoothed(sample.log_weight)
    pick = resample(weights, count, seed)
    return _by_name(weighed.problem.layout, sample.x[pick], sample.v[pick])


def _by_name(layout: Layout, x: np.ndarray, v: np.ndarray) -> _Values:
    """Return draws by unknown; coefficients as values, also where held in units of their spread."""
    unknowns = Unknowns.of(layout)
    values = unknowns.values(x, v)
    return {key: unknowns.select(values, key) for key in unknowns.by_key}


def _union(structures: Structures, models: Sequence[Model]) -> Model:
    """Return the model with the effects of all, each as in the most probable structure."""
    by_name: dict[str, Effect] = {}
    for model in models:
        for effect in model.effects:
            always = all(effect.name in m.names for m in models)
            by_name.setdefault(effect.name, effect if always else effect.averaged)
    # In the catalogue's order, so that equal structures are equal models whatever the order they were found in.
    places = {n: i for i, n in enumerate([*structures.base.names, *structures.candidates])}
    effects = sorted(by_name.values(), key=lambda e: places.get(e.name, len(places)))
    return Model(models[0].instrument, tuple(effects), models[0].noise, models[0].fixed)


def _together(
    last: Calibration,
    model: Model,
    models: Sequence[Model],
    parts: Sequence[_Values],
    shuffled: bool = True,
) -> Calibration:
    """Return the draws of all structures as those of one model, in a random order."""
    # Groups of labels that the last model knows nothing of, but another structure.
    further = {g: last.readings.groups(g)[0] for g in model.groups if g not in last.levels}
    members = tuple((group, len(names)) for group, names in further.items())
    layout = replace(last.layout, model=model, counts=(*last.layout.counts, *members), promoted=())
    counts = [len(next(iter(part.values()))) for part in parts]
    total = sum(counts)
    # An effect that a structure lacks has the coefficient zero in its draws, not its prior's mean.
    x, v = np.zeros((total, layout.size)), np.full((total, len(layout.hypers)), np.nan)
    for member, part, end, count in zip(models, parts, np.cumsum(counts), counts, strict=True):
        at = slice(end - count, end)
        for b in layout.x_blocks:
            if b.name in part:
                x[at, b.start : b.start + b.size] = part[b.name].reshape(count, -1) - b.origin
            elif b.index in b.effect.held and b.effect.name in member.names:
                x[at, b.start] = b.coefficient.mean
        for i, h in enumerate(layout.hypers):
            if h.name in part:
                v[at, i] = h.prior.coordinate(part[h.name])
    # What an effect has that is not there moves nothing: any value serves, and the median keeps summaries undisturbed.
    spreads = {b.group_sd_name for b in layout.blocks}
    for values, h in zip(v.T, layout.hypers, strict=True):
        absent = ABSENT if h.name in spreads else np.nanmedian(values)
        values[np.isnan(values)] = absent
    order = np.random.default_rng(last.seed).permutation(total) if shuffled else np.arange(total)
    order = order[: CHAINS * (total // CHAINS)]
    return replace(
        last,
        model=model,
        joint=Draws.of(x[order], v[order]),
        confounded=last.confounders,
        layout=layout,
        levels={**last.levels, **further},
        mode=_mode(last, layout, x, v),
    )


def _mode(last: Calibration, layout: Layout, x, v) -> Mode:
    """Return the expansion point of the average: the means of the draws."""
    blocks = last.layout.x_blocks
    scales = {b.name: last.mode.flat[b.start : b.start + b.size] for b in blocks}
    flat = [scales.get(b.name, np.ones(b.size)) for b in layout.x_blocks]
    middle = np.median(v, axis=0)
    # Absent spreads stand at −30: they must not count as scatter of the coordinate.
    around = np.where(v > 0.5 * ABSENT, v, middle)
    covariance = np.atleast_2d(np.cov(around.T)) if v.shape[1] else np.zeros((0, 0))
    return last.mode._replace(
        x=x.mean(axis=0),
        v=np.where(middle > 0.5 * ABSENT, middle, ABSENT),
        covariance=covariance + 1e-9 * np.eye(v.shape[1]),
        flat=np.concatenate([np.zeros(0), *flat]),
    )
