"""Effects that are one on these readings: found by linear algebra before anything is fitted.

Columns are whitened by the noise floor and scaled by plausible sizes, about the means of the priors. Deviations of
groups are noise; all else of the model is projected out, whatever its size. What is left of an effect says by how much
readings could narrow its prior. Where that is next to nothing evidence decides nothing, and zero would be wrong by all
that the coefficients in its place take of it.
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
from bayescal._calibration.confounding import is_widened_by, shifts
from bayescal._core.null_space import UNDECIDED_NATS, Spans, beyond, nats, undecided
from bayescal._data.measurements import Measurements
from bayescal._inference.gaussian import column_scale
from bayescal._inference.linear_model import RANK, LinearModel, about_priors
from bayescal._inference.problem import Problem
from bayescal._inference.record import record_of
from bayescal._model.frame import reference_of
from bayescal._model.model import testable
from bayescal._model.parameters import bind
from bayescal._search.library import Library
from bayescal._search.structures import RMS_SIZE, Structure, Structures, has_size

FLAT_NORM = 1e6  # norm of a whitened column of which no prior is stated
MAX_SPANNING = 2  # effects in whose span another one is looked for
MAX_ROWS = 4096  # readings that are looked at, evenly spread
MAX_EXPERIMENT_READINGS = 1500  # the same of an experiment


class Equivalent(NamedTuple):
    """Effects of which readings tell only what they come to together, the first in the span of others and the model.

    Where there are no others, it stands for these coefficients of the model.
    """

    effects: tuple[str, ...]
    coefficients: tuple[str, ...] = ()


def with_spans(structures: Structures, floor: float) -> Structures:
    """Structures that know which candidates these readings cannot tell from the base's effects, or from one another.

    Candidates with shapes, and of groups, are left to evidence, which sums over them.
    """
    structures = replace(structures, floor=min(floor, _left_by_all(structures)))
    line, columns = _columns(structures)
    latent, kept = dict[str, tuple[str, ...]](), dict[str, np.ndarray]()
    for name, own in columns.items():
        if not undecided(own.beside_groups, own.beside_all):
            kept[name] = own.beside_all
        elif widened := _coefficients(line, RMS_SIZE * own.white):
            latent[name] = widened
    if kept:  # the triangle of a QR has the products of all columns, in few rows
        ends = np.cumsum([c.shape[1] for c in kept.values()])[:-1]
        triangle = np.linalg.qr(np.column_stack([*kept.values()]), mode="r")
        kept = dict(zip(kept, np.split(triangle, ends, axis=1), strict=True))
    return replace(structures, spans=Spans(kept, latent))


def _left_by_all(structures: Structures) -> float:
    """Standard deviation of what the base and named candidates without shapes leave of the output, by least squares."""
    layout = replace(structures.layout, model=structures.base)
    line = about_priors(Problem(layout, structures.record))
    library = Library(structures)
    named = {n: p for n, p in library.points.items() if not structures.candidates[n].is_placeholder}
    points = [point for point, *others in named.values() if not others]
    columns = np.column_stack([line.nuisance, library.columns(line, points, {})])
    axes, values, _ = np.linalg.svd(columns * column_scale(columns), full_matrices=False)
    axes = axes[:, values > RANK * values.max(initial=0.0)]
    left = line.residual - axes @ (axes.T @ line.residual)
    free = line.size - axes.shape[1]
    return float(np.sqrt(left @ left / free)) if free > 0 else math.inf


Array = Float[np.ndarray, "n k"]


class _Columns(NamedTuple):
    """Of an effect, whitened, per plausible size: of all readings; of some, beside groups, and beside all effects."""

    white: Array
    beside_groups: Array
    beside_all: Array


def _columns(structures: Structures) -> tuple[LinearModel, dict[str, _Columns]]:
    """The base about its priors' means, and candidates' columns."""
    layout = replace(structures.layout, model=structures.base)
    line = about_priors(Problem(layout, structures.record), structures.floor)
    random = np.zeros(len(line.owners), dtype=bool)
    for t in line.problem.in_x:
        random[t.at] = t.group_sd_name is not None or t.effect.weights is not None
    # Of many readings some, each in the place of several.
    every = -(-line.size // MAX_ROWS)
    white = math.sqrt(every) * line.white_nuisance[::every]
    unstated = FLAT_NORM / np.maximum(np.linalg.norm(white, axis=0), 1 / FLAT_NORM)
    white = white * np.where(line.weight == 0, unstated, 1.0)
    of_groups = _beside(white[:, random])
    of_all = _beside(of_groups(white[:, ~random]))
    library, found = Library(structures), dict[str, _Columns]()
    for name, (point, *others) in library.points.items():
        effect = structures.candidates[name]
        per_member = any(c.group_sd for c in effect.coefficients)
        if not (others or per_member or effect.frees) and has_size(effect):
            columns = library.columns(line, [point], {}) * library.sizes[name][0].sd
            whole = line.whiten(columns)
            beside = of_groups(math.sqrt(every) * whole[::every])
            found[name] = _Columns(whole, beside, of_all(beside))
    return line, found


def _beside(columns: Float[np.ndarray, "n q"]) -> Callable[[Array], Array]:
    """Whitening by noise of covariance 1 + C·Cᵀ, C columns of standard normal coefficients."""
    # Along the axes of C of sizes s what is whitened becomes 1/√(1 + s²) of what it was.
    axes, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    lost = axes * (1 - 1 / np.sqrt(1 + sizes**2))
    return lambda white: white - lost @ (axes.T @ white)


def _coefficients(line: LinearModel, columns: Float[np.ndarray, "n k"]) -> tuple[str, ...]:
    """Names of the coefficients of a model that would be less certain beside an effect of these columns."""
    wider = is_widened_by(line, np.linalg.norm(shifts(line, columns), axis=1))
    blocks = line.problem.layout.x_blocks
    return tuple(b.name for b in blocks if wider[b.start : b.start + b.size].any())


def equivalents(spans: Spans) -> list[Equivalent]:
    """Sets of two or three candidates, and of one and the model's effects, none within another."""
    found = [Equivalent((name,), own) for name, own in spans.latent.items()]
    spanned = [n for n in spans.left if spans.within(n, {*spans.left} - {n})]
    for count, name in itertools.product(range(MAX_SPANNING, 0, -1), spanned):
        for others in itertools.combinations([n for n in spans.left if n != name], count):
            fewer, one = itertools.combinations(others, count - 1), (name, *others)
            least = spans.within(name, others) and not any(spans.within(name, f) for f in fewer)
            if least and not any({*one} <= {*known.effects} for known in found):
                found.append(Equivalent(one))
    return found


def said_of_equivalents(structures: Structures, at: Structure) -> tuple[Claim, ...]:
    """Sets of equivalent effects, those of a structure's model first: whether it is decided what acts, what would tell.

    It stands against a model where the readings do not say which of its terms act in use.
    """
    latent = structures.latent(at)
    found = dict[str, list[Claim]](undecided=[], latent=[], candidates=[])
    for one in equivalents(structures.spans):
        first, *rest = one.effects
        told, state = {"beside": one.coefficients or (*rest,)}, "candidates"
        if latent.intersection(one.effects) and {*one.effects} <= at.effects | latent:
            acting = {_acts_in_use(structures, name) for name in one.effects}
            open_ = acting == {True, False} or (acting == {True} and not rest)
            state = "undecided" if open_ else "latent"
            told |= separating_experiments(structures)[one]
        found[state].append(Claim(f"equivalent.{state}", first, *rest, **told))
    return (*found["undecided"], *found["latent"], *found["candidates"])


def separating_experiments(structures: Structures) -> dict[Equivalent, dict[str, Any]]:
    """Return the experiment that separates each set of equivalent effects best, and by how many nats; cached."""
    if structures.experiments:
        return structures.experiments
    instrument, sets = structures.base.instrument, equivalents(structures.spans)
    found: dict[Equivalent, dict[str, Any]] = {one: {"cure": "none"} for one in sets}
    for name, columns in instrument.experiments:
        readings = Measurements.from_arrays(instrument, **columns())
        every = -(-len(readings) // MAX_EXPERIMENT_READINGS)
        readings = readings.select(np.arange(0, len(readings), every))
        named = {n: structures.candidates[n] for one in sets for n in one.effects}
        own = {n: effect for n, effect in named.items() if testable(effect, readings) is None}
        reference = reference_of(readings)
        layout = bind(structures.base, readings, own.values(), reference)[0]
        record = record_of(instrument, readings, reference)
        there = replace(structures, layout=layout, record=record, candidates=own)
        columns = _columns(there)[1]
        for one in sets:
            if {*one.effects} <= {*own}:
                first, *others = (columns[n].beside_all for n in one.effects)
                span = np.column_stack([np.zeros((len(first), 1)), *others])
                told = nats(beyond(first, span))
                if told > found[one].get("nats", UNDECIDED_NATS):
                    found[one] = {"cure": "test", "experiment": name, "nats": told}
    structures.experiments.update(found)
    return found


def _acts_in_use(structures: Structures, name: str) -> bool:
    use, effect = structures.base.instrument.use, structures.candidates[name]
    slots = {c.slot or effect.slot for c in effect.coefficients}
    return use is None or not use.slots or not slots.isdisjoint(use.slots)
