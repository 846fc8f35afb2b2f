"""Equivalent effects, which the readings cannot distinguish, found by linear algebra before any fit.

Columns at the prior means are whitened by the noise floor and scaled by plausible sizes. Deviations of groups count as
noise; all other columns of the model are projected out. An effect with hardly any remainder cannot be decided by
evidence, and leaving it out would bias the coefficients that take its place.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._calibration.claim import Claim
from bayescal._calibration.confounding import find_shifts, mask_widened
from bayescal._core.null_space import UNDECIDED_NATS, Spans, compute_nats, is_undecided, project_out
from bayescal._data.measurements import Measurements
from bayescal._inference.gaussian import compute_column_scales
from bayescal._inference.linear_model import RANK_TOLERANCE, LinearModel, linearise_at_priors
from bayescal._inference.problem import Problem
from bayescal._inference.record import record_of
from bayescal._model.frame import reference_of
from bayescal._model.model import why_untestable
from bayescal._model.parameters import bind
from bayescal._search.library import Library
from bayescal._search.structures import RMS_SCALE_FACTOR, Structure, Structures, has_prior_scale

FLAT_NORM = 1e6  # norm of the whitened column of a coefficient with a flat prior
MAX_SPANNING = 2  # effects whose span is tested for another effect
MAX_READINGS = 4096  # readings compared, evenly spread
MAX_EXPERIMENT_READINGS = 1500  # readings of an experiment compared, evenly spread
Array = Float[np.ndarray, "n k"]


class Equivalent(NamedTuple):
    """Collinear effects: the columns of the first are in the span of those of the others and of the model.

    The readings determine only a combination. A single effect is in the span of the model's `coefficients` alone.
    """

    effects: tuple[str, ...]
    coefficients: tuple[str, ...] = ()


def add_spans(structures: Structures, floor: float) -> Structures:
    """Return structures with the spans (`spans`) by which inseparable candidates are found.

    Candidates with shape parameters or group members are compared by evidence instead, which integrates over these.
    """
    structures = replace(structures, noise_floor=min(floor, _estimate_residual_sd(structures)))
    linear, candidates = _whiten_candidates(structures)
    latent_names, separable = dict[str, tuple[str, ...]](), dict[str, np.ndarray]()
    for name, candidate in candidates.items():
        if not is_undecided(candidate.without_groups, candidate.without_model):
            separable[name] = candidate.without_model
        elif widened_names := _list_widened(linear, RMS_SCALE_FACTOR * candidate.columns):
            latent_names[name] = widened_names
    if separable:  # the triangle of a QR has the products of all columns, in few rows
        ends = np.cumsum([c.shape[1] for c in separable.values()])[:-1]
        r_factor = np.linalg.qr(np.column_stack([*separable.values()]), mode="r")
        separable = dict(zip(separable, np.split(r_factor, ends, axis=1), strict=True))
    return replace(structures, spans=Spans(separable, latent_names))


def _estimate_residual_sd(structures: Structures) -> float:
    """Return the residual sd of a least-squares fit of the base and named candidates without shapes."""
    layout = replace(structures.layout, model=structures.base)
    linear, library = linearise_at_priors(Problem(layout, structures.record)), Library(structures)
    grids = {n: p for n, p in library.points.items() if not structures.candidates[n].is_placeholder}
    points = [point for point, *others in grids.values() if not others]
    columns = np.column_stack([linear.nuisance, library.columns(linear, points, {})])
    axes, values, _ = np.linalg.svd(columns * compute_column_scales(columns), full_matrices=False)
    axes = axes[:, values > RANK_TOLERANCE * values.max(initial=0.0)]
    residual, dof = linear.residual - axes @ (axes.T @ linear.residual), linear.size - axes.shape[1]
    return float(np.sqrt(residual @ residual / dof)) if dof > 0 else math.inf


class _CandidateColumns(NamedTuple):
    """Whitened columns of an effect at its plausible size: of all readings, and two projections of a subset's."""

    columns: Array
    without_groups: Array  # group deviations counted as noise
    without_model: Array  # candidate columns with all columns of the model projected out


def _whiten_candidates(structures: Structures) -> tuple[LinearModel, dict[str, _CandidateColumns]]:
    """Return the base linearised at its priors' means, and the candidates' whitened columns."""
    layout = replace(structures.layout, model=structures.base)
    linear = linearise_at_priors(Problem(layout, structures.record), structures.noise_floor)
    is_random = np.zeros(len(linear.owners), dtype=bool)
    for t in linear.problem.in_x:
        is_random[t.x_slice] = t.group_sd_name is not None or t.effect.weights is not None
    # A subset of many readings, each with the weight of `stride` readings.
    stride = -(-linear.size // MAX_READINGS)
    white_nuisances = math.sqrt(stride) * linear.white_nuisance[::stride]
    flat_scale = FLAT_NORM / np.maximum(np.linalg.norm(white_nuisances, axis=0), 1 / FLAT_NORM)
    white_nuisances = white_nuisances * np.where(linear.weight == 0, flat_scale, 1.0)
    whiten_groups = _make_whitener(white_nuisances[:, is_random])
    whiten_model = _make_whitener(whiten_groups(white_nuisances[:, ~is_random]))
    library, candidates = Library(structures), dict[str, _CandidateColumns]()
    for name, (point, *others) in library.points.items():
        effect = structures.candidates[name]
        is_per_member = any(c.group_sd for c in effect.coefficients)
        if not (others or is_per_member or effect.frees) and has_prior_scale(effect):
            columns = library.columns(linear, [point], {}) * library.prior_scales[name][0].sd
            whitened_columns = linear.whiten(columns)
            without_groups = whiten_groups(math.sqrt(stride) * whitened_columns[::stride])
            whitened_parts = whitened_columns, without_groups, whiten_model(without_groups)
            candidates[name] = _CandidateColumns(*whitened_parts)
    return linear, candidates


def _make_whitener(columns: Float[np.ndarray, "n q"]) -> Callable[[Array], Array]:
    """Return the whitening function for noise of covariance I + C·Cᵀ, with C the columns of group deviations."""
    # Along the left singular vectors of C, singular values s, whitened columns are multiplied by 1/√(1 + s²).
    axes, singular_values, _ = np.linalg.svd(columns, full_matrices=False)
    removed_axes = axes * (1 - 1 / np.sqrt(1 + singular_values**2))
    return lambda white: white - removed_axes @ (axes.T @ white)


def _list_widened(linear: LinearModel, columns: Float[np.ndarray, "n k"]) -> tuple[str, ...]:
    """Return the names of coefficients whose uncertainty an effect with these columns would increase."""
    is_widened = mask_widened(linear, np.linalg.norm(find_shifts(linear, columns), axis=1))
    blocks = linear.problem.layout.x_blocks
    return tuple(b.name for b in blocks if is_widened[b.start : b.start + b.size].any())


def find_equivalents(spans: Spans) -> list[Equivalent]:
    """Return minimal sets of two or three collinear candidates, and candidates in the span of the model's columns."""
    sets = [Equivalent((name,), coefficients) for name, coefficients in spans.model_sums.items()]
    spanned_names = [n for n in spans.columns if spans.is_spanned(n, {*spans.columns} - {n})]
    for count, name in itertools.product(range(MAX_SPANNING, 0, -1), spanned_names):
        for others in itertools.combinations([n for n in spans.columns if n != name], count):
            subsets, members = itertools.combinations(others, count - 1), (name, *others)
            is_spanned = spans.is_spanned(name, others)
            if not is_spanned or any(spans.is_spanned(name, subset) for subset in subsets):
                continue
            if not any({*members} <= {*equivalent.effects} for equivalent in sets):
                sets.append(Equivalent(members))
    return sets


def list_equivalence_claims(structures: Structures, structure: Structure) -> tuple[Claim, ...]:
    """Return claims on sets of equivalent effects; sets with effects of the structure's model come first.

    A claim is against the model if the readings cannot determine which of its terms act in use.
    """
    latent_names = structures.latent_effects(structure)
    claims = dict[str, list[Claim]](undecided=[], latent=[], candidates=[])
    for equivalent in find_equivalents(structures.spans):
        first, *others = equivalent.effects
        details, state = {"beside": equivalent.coefficients or (*others,)}, "candidates"
        members = {*equivalent.effects}
        if members & latent_names and members <= structure.effects | latent_names:
            uses = {_is_in_use(structures, name) for name in equivalent.effects}
            is_undecided = uses == {True, False} or (uses == {True} and not others)
            state = "undecided" if is_undecided else "latent"
            details |= find_experiments(structures)[equivalent]
        claims[state].append(Claim(f"equivalent.{state}", first, *others, **details))
    return (*claims["undecided"], *claims["latent"], *claims["candidates"])


def find_experiments(structures: Structures) -> dict[Equivalent, dict[str, Any]]:
    """Return for each set of equivalent effects the experiment with most information on it, if any; cached."""
    if structures.experiments:
        return structures.experiments
    instrument, sets = structures.base.instrument, find_equivalents(structures.spans)
    result: dict[Equivalent, dict[str, Any]] = {equivalent: {"cure": "none"} for equivalent in sets}
    for name, columns in instrument.experiments:
        readings = Measurements.from_arrays(instrument, **columns())
        stride = -(-len(readings) // MAX_EXPERIMENT_READINGS)
        readings = readings.select(np.arange(0, len(readings), stride))
        effects = {n: structures.candidates[n] for equivalent in sets for n in equivalent.effects}
        candidates = {n: e for n, e in effects.items() if why_untestable(e, readings) is None}
        reference = reference_of(readings)
        layout = bind(structures.base, readings, candidates.values(), reference)[0]
        record = record_of(instrument, readings, reference)
        design = replace(structures, layout=layout, record=record, candidates=candidates)
        columns = _whiten_candidates(design)[1]
        for equivalent in sets:
            if {*equivalent.effects} <= {*candidates}:
                first, *others = (columns[n].without_model for n in equivalent.effects)
                span = np.column_stack([np.zeros((len(first), 1)), *others])
                information = compute_nats(project_out(first, span))
                if information > result[equivalent].get("nats", UNDECIDED_NATS):
                    test = {"cure": "test", "experiment": name, "nats": information}
                    result[equivalent] = test | {"share": math.exp(-information / first.shape[1])}
    structures.experiments.update(result)
    return result


def _is_in_use(structures: Structures, name: str) -> bool:
    use, effect = structures.base.instrument.use, structures.candidates[name]
    slots = {c.slot or effect.slot for c in effect.coefficients}
    return use is None or not use.slots or not slots.isdisjoint(use.slots)
