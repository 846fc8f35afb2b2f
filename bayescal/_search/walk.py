"""Beam search over structures: add one or two effects, drop, swap, change the noise law, from the most probable ones.

The search has no memory but the table of evaluated structures, so no result depends on the order of additions. It is a
generator: the caller may end it at any structure, and reads the table.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

from bayescal._core import deadline
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.progress import notify, track
from bayescal._search.library import Library
from bayescal._search.noise_laws import log_prior
from bayescal._search.scores import MAX_STARTS, ScoredPoint, Scorer, log_mean_bayes_factor
from bayescal._search.structures import LAW_WINDOW_NATS, EvaluatedStructure, Structure, Structures

# Most probable structures whose neighbours are evaluated; 4 find what enumeration finds (tests/search).
BEAM_STRUCTURES = 4
# Neighbours of each structure of the beam that are fitted, at least and at most.
NEIGHBOUR_COUNTS = (2, 10)
MAX_FITTED_PAIRS = 4  # pairs of effects among them, for effects that show only together

FORM_NATS = 3.0  # change of log posterior on block means that decides whether a form is fitted
LAWS_OF_REDUCED = 2  # finer noise laws evaluated without one of the best structure's effects
FOLLOW_SECONDS = 1.0  # between two progress reports
Evaluations = Generator[EvaluatedStructure, None, None]

OUT_OF_TIME = "The search was ended early, after {:.0f} s, with the best structure so far."
STOPPED = "The search was interrupted after {:.0f} s with the best structure so far."
NOT_BEGUN_TEXT = "There was no time to search ({}): only the first structure was evaluated."


@run_on_one_thread
def explore(
    library: Library,
    max_effects: int,
    start: Structure | None = None,
    follow: Callable[[], None] = lambda: None,
) -> str:
    """Search until it is complete or the deadline has passed; return the reason if it ended early, else "".

    The structure without added effects is evaluated in any case; `follow` is called once a second, and at the end.
    """
    begin, last_time, structures, reason = time.monotonic(), 0.0, library.structures, ""
    limit = deadline.current()
    with deadline.suspend():
        structures.evaluate(Structure())
    limit.defer_interrupt()
    try:
        with track("looking for missing effects"):
            limit.raise_if_over()
            for _ in beam_search(library, max_effects, start):
                if time.monotonic() > last_time + FOLLOW_SECONDS:
                    follow()
                    last_time = time.monotonic()
                limit.raise_if_over()
    except deadline.TimeIsUp as stop:
        reason = (STOPPED if limit.is_interrupted else OUT_OF_TIME).format(time.monotonic() - begin)
        if len(structures.visited) == 1:
            reason = NOT_BEGUN_TEXT.format(stop)
        if limit.is_interrupted:
            notify("interrupted: fitting the best model so far; Ctrl-C again ends without a result")
    follow()
    library.cached_columns.clear()
    structures.clear_cache()
    return reason


def beam_search(library: Library, max_effects: int, start: Structure | None = None) -> Evaluations:
    """Evaluate structures until no neighbour of the most probable ones is left; yield each.

    Args:
        library: the candidates; evaluated structures are cached in `library.structures`.
        max_effects: largest number of effects to add.
        start: structure to evaluate once the search without it has ended; the search continues from it if probable.
    """
    structures = library.structures
    start_fit = structures.evaluate(Structure())
    # Named effects first: a curve or correlated noise would hide a second. Then all: swaps replace early polynomials.
    candidates = structures.candidates.items()
    named_effects = frozenset(n for n, e in candidates if not (e.is_placeholder and e.unnamed))
    named_scope = Scope(max_effects, named_effects, ("",))
    full_scope = Scope(max_effects, frozenset(structures.candidates))
    expanded_by_scope: dict[Scope, set[Structure]] = {named_scope: set(), full_scope: set()}
    make_scorer = lru_cache(BEAM_STRUCTURES)(partial(Scorer, library))  # shared by both scopes
    for scope, final_start in ((named_scope, None), (full_scope, None), (full_scope, start)):
        # Under a correlated law the base shows an effect that slow residuals would otherwise hide.
        for noise in () if scope is named_scope else list_correlated(structures):
            yield structures.evaluate(Structure(noise=noise), start_fit)
        if final_start:
            # Add the effects one by one: fitted all at once, their shapes may end at a lower maximum.
            yield from map(structures.evaluate, find_path(library, final_start))
        # `_select_next` sorts anew each time. Finer forms and laws come last: they would fit what is still missing.
        while True:
            count = len(structures.visited)
            if current := _select_next(structures, expanded_by_scope[scope], scope):
                previous = [*expanded_by_scope[scope]] if structures.near_best_only else []
                expanded_by_scope[scope].add(structure := current.structure)
                families = structures.families(structure.effects)
                same_law = (s.effects for s in previous if s.noise == structure.noise)
                # A fleet's search expands the effects in one form: `_try_forms` scores the others by their change.
                if families not in map(structures.families, same_law):
                    yield from _evaluate_neighbours(library, current, scope, make_scorer)
                continue
            if scope is named_scope:
                # Forms without a score come last, as finer ones do.
                fits = (w for w in structures.visited.values() if named_scope.contains(w.structure))
                yield from _try_forms(structures, max(fits, key=lambda w: w.log_posterior))
            else:
                yield from _try_forms(structures, structures.best, last=True)
                if len(structures.visited) == count and (yield from _evaluate_finer(structures)):
                    continue
            if len(structures.visited) == count:
                break


@run_on_one_thread
def find_path(library: Library, goal: Structure, start: Structure | None = None) -> list[Structure]:
    """Return the path from one structure to a larger one; each step has the highest log posterior, fitted or scored."""
    structures, steps, fit = library.structures, [start or Structure()], None
    while True:
        deadline.current().raise_if_over()
        current = steps[-1]
        fit = structures.evaluate(current, fit)
        if current == goal:
            return steps
        names, log_posteriors = sorted(goal.effects - current.effects), dict[Structure, float]()
        is_scored = names and math.isfinite(fit.log_posterior)
        reduced = Scorer(library, fit).reduced_model() if is_scored else None
        for name in names:
            neighbour = current.with_effects(name)
            if reduced is None or neighbour in structures.visited or name not in library.points:
                log_posteriors[neighbour] = structures.evaluate(neighbour, fit).log_posterior
            else:
                # The score stands for the fit: it decides only the order in which steps are shown.
                factor = log_mean_bayes_factor(reduced.score_candidates([name])[name])
                log_posteriors[neighbour] = fit.log_posterior + structures.log_odds[name] + factor
        if current.noise != goal.noise:
            neighbour = current.with_noise(goal.noise)
            log_posteriors[neighbour] = structures.evaluate(neighbour, fit).log_posterior
        steps.append(max(log_posteriors, key=log_posteriors.__getitem__))


def _select_next(
    structures: Structures, expanded: set[Structure], scope: Scope
) -> EvaluatedStructure | None:
    """Return the most probable structure of the beam that is in the scope and not yet expanded; None if there is none.

    Unless `near_best_only`, the beam includes the best structure under each law, several changes from that of others.
    """
    fits = [w for w in structures.visited.values() if scope.contains(w.structure)]
    ranked_fits = sorted(fits, key=lambda w: -w.log_posterior)
    best_by_law = {w.structure.noise: w for w in reversed(ranked_fits)}
    for i, w in enumerate(ranked_fits):
        # Outside of Occam's window a structure has no part of the probabilities that are printed.
        if not w.is_in_window_of(ranked_fits[0]):
            return None
        is_in_beam = i < BEAM_STRUCTURES or best_by_law[w.structure.noise] is w
        if structures.near_best_only:
            is_in_beam = i < BEAM_STRUCTURES and w.structure.noise == ranked_fits[0].structure.noise
        if is_in_beam and w.structure not in expanded:
            return w
    return None


class Scope(NamedTuple):
    """The candidates and noise laws that a search may use."""

    max_effects: int  # most effects to add
    effects: frozenset[str]  # candidates to add, drop and swap
    laws: tuple[str, ...] | None = None  # names of noise laws; None for all

    def contains(self, structure: Structure) -> bool:
        return structure.effects <= self.effects and self.has_law(structure.noise)

    def has_law(self, law: str) -> bool:
        return self.laws is None or law in self.laws


class Move(NamedTuple):
    """A neighbour of a structure, its log posterior by the linear model, and starting coordinates of φ by name."""

    structure: Structure
    log_posterior: float
    starts: tuple[dict[str, float], ...] = ()


def _evaluate_neighbours(
    library: Library, fit: EvaluatedStructure, scope: Scope, make_scorer: Callable[..., Scorer]
) -> Evaluations:
    """Evaluate the neighbours of a structure that may be nearly as probable as the best; store the others' scores."""
    structures, structure = library.structures, fit.structure
    # Evaluate the same effects under each law: else the search would have to find them anew under each.
    for law in filter(scope.has_law, ("", *list_correlated(structures))):
        neighbour = structure.with_noise(law)
        neighbour = neighbour.without_effects(*structures.excluded_candidates(neighbour))
        if _needs_fit(structures, neighbour, fit):
            yield structures.evaluate(neighbour, fit)
    if not math.isfinite(fit.log_posterior):
        return
    has_all_laws = scope.laws is None
    if has_all_laws:
        yield from _try_forms(structures, fit)
    law_moves = _propose_noise_laws(structures, fit)
    noise_moves = [move for move in law_moves if scope.has_law(move.structure.noise)]
    moves = [*_propose_moves(make_scorer(fit), scope)]
    # Without a column's correction all that depends on the column shifts: substitutes are scored beside such a fit.
    for name in sorted(filter(structures.corrects_column, structure.effects)):
        yield (reduced_fit := structures.evaluate(structure.without_effects(name), fit))
        if math.isfinite(reduced_fit.log_posterior):
            moves += _propose_moves(Scorer(library, reduced_fit), scope)
    # Candidates without a score are evaluated by a fit.
    if len(structure.effects) < scope.max_effects:
        candidates = scope.effects.intersection(structures.candidates_for(structure))
        names = sorted(candidates.intersection(structures.unscored_candidates))
        moves += [Move(structure.with_effects(name), fit.log_posterior) for name in names]
    for move in (*moves, *noise_moves):
        structures.store_score(move.structure, move.log_posterior)
    # A fit under another law tells little more than its score, unless it is to be used.
    min_log_posterior, best = fit.log_posterior, structures.best
    if structures.near_best_only:
        min_log_posterior = best.log_posterior - structures.window_nats * (fit is best)
    moves += [move for move in noise_moves if move.log_posterior > min_log_posterior]
    # The first ones are fitted whatever their scores, which are too low where noise and shapes lack an effect.
    moves.sort(key=lambda move: -move.log_posterior)
    for i, move in enumerate(moves[: NEIGHBOUR_COUNTS[1]]):
        is_near = structures.is_in_window(move.log_posterior, structures.window_nats)
        is_near = is_near or i < NEIGHBOUR_COUNTS[0]
        if is_near and _needs_fit(structures, move.structure, fit):
            yield (neighbour_fit := structures.evaluate(move.structure, fit, move.starts))
            if has_all_laws:
                yield from _try_forms(structures, neighbour_fit)
    # Correlated noise may take up what a dropped effect explained; a score, which holds the noise, cannot tell.
    if fit is structures.best and not structures.noise_law(structure).independent:
        for neighbour in map(structure.without_effects, sorted(structure.effects)):
            if _needs_fit(structures, neighbour, fit):
                yield structures.evaluate(neighbour, fit)


def _needs_fit(structures: Structures, neighbour: Structure, fit: EvaluatedStructure) -> bool:
    """Return whether to fit a neighbour of a structure; False if it can be rated improbable without a fit.

    The change of log evidence by an effect depends little on a noise law's finer form. Under a law without interpolated
    inner products (`Record.nodes`), whose fits are slow, it is therefore taken from the law that this one refines. If
    forms are evaluated near the best structure only, it is taken from the same move with other forms of the effects.
    """
    law, current = structures.noise_law(neighbour), fit.structure
    if neighbour in structures.visited:
        return True
    if neighbour in structures.previous_round:
        return structures.is_in_window(structures.log_posterior(neighbour))
    change = _find_change(structures, neighbour, current) if structures.near_best_only else None
    if change is not None:
        structures.store_score(neighbour, fit.log_posterior + change)
        return fit.log_posterior + change > structures.best.log_posterior
    if law.refines not in structures.noise_laws or neighbour.noise != current.noise:
        return True
    if structures.record.nodes(law) is not None:
        return True
    changed_fit = structures.evaluate(neighbour.with_noise(law.refines), fit)
    plain_fit = structures.evaluate(current.with_noise(law.refines), fit)
    log_posterior = fit.log_posterior + changed_fit.log_posterior - plain_fit.log_posterior
    structures.store_score(neighbour, log_posterior)
    return structures.is_in_window(log_posterior)


def _find_change(structures: Structures, neighbour: Structure, current: Structure) -> float | None:
    """Return the change of log posterior by the same move with other forms of the effects; None if not evaluated."""
    added_names, removed = neighbour.effects - current.effects, current.effects - neighbour.effects
    own_families = structures.families(current.effects)
    is_form_change = added_names and structures.families(neighbour.effects) == own_families
    for s, change in _list_changes(structures, removed, added_names, neighbour.noise):
        families = structures.families(s.effects)
        is_similar = families == own_families or (is_form_change and families < own_families)
        if s.noise == current.noise and is_similar:
            return change
    return None


def _list_changes(
    structures: Structures, removed: frozenset[str], added: frozenset[str], noise: str | None = None
) -> Iterator[tuple[Structure, float]]:
    """Yield evaluated structures and the change of log posterior if effects (and the law, if given) are replaced."""
    for s, fit in structures.visited.items():
        if removed <= s.effects and not added & s.effects:
            neighbour = Structure(s.effects - removed | added, s.noise if noise is None else noise)
            if (swapped_fit := structures.visited.get(neighbour)) is not None:
                change = swapped_fit.log_posterior - fit.log_posterior
                if math.isfinite(change):
                    yield s, change


def _try_forms(structures: Structures, fit: EvaluatedStructure, last: bool = False) -> Evaluations:
    """Evaluate a structure with other forms of its effects that have no score, one form replaced at a time.

    Nothing is evaluated if the structure is too improbable for any form to matter. The `last` pass also evaluates forms
    with several shapes, which take ten times as long, and forms that earlier passes omitted because the same change
    of form had made other structures much less probable.
    """
    structure = fit.structure
    window = structures.window_nats if structures.near_best_only else LAW_WINDOW_NATS
    if not structures.is_in_window(fit.log_posterior, window):
        return
    is_independent, means = structures.noise_law(structure).independent, structures.on_means
    # By means a form that gains is fitted at once, one that is near the best in the `last` pass.
    window = () if means is None else (FORM_NATS if last else -FORM_NATS,)
    for name in sorted(structure.effects):
        for neighbour in structures.other_forms(structure, name):
            (form,) = added = neighbour.effects - structure.effects
            shapes = structures.candidates[form].column_shapes
            if not structures.corrects_column(form) or (len(shapes) > 1 and not last):
                continue
            pairs = () if last else _list_changes(means or structures, frozenset({name}), added)
            changes = [c for s, c in pairs if structures.noise_law(s).independent == is_independent]
            change = max(changes) if changes else structures.change_on_means(neighbour, fit)
            # A fleet's search takes the change from another law, unless the form would be the best.
            limit = (0.0,) if changes and structures.near_best_only else window
            is_near = structures.is_in_window(fit.log_posterior + change, *limit)
            if not (is_near or neighbour in structures.visited):
                structures.store_score(neighbour, fit.log_posterior + change)
            elif means is not None or _needs_fit(structures, neighbour, fit):
                # Begin its shapes where those of the same name are in the form to be replaced.
                index = fit.problem.layout.index_in_phi
                names = ((f"{form}.{s.name}", f"{name}.{s.name}") for s in shapes)
                start = {n: float(fit.mode.v[index[o]]) for n, o in names if o in index}
                yield structures.evaluate(neighbour, fit, [start])


def list_correlated(structures: Structures) -> list[str]:
    """Return the names of further correlated noise laws, which have no score."""
    return [n for n, law in structures.noise_laws.items() if not (law.independent or law.refines)]


def _evaluate_finer(structures: Structures) -> Generator[EvaluatedStructure, None, bool]:
    """Evaluate noise laws with more terms for the best effects and for fewer; return whether any was evaluated.

    A law with more terms may explain what an effect explains under the law with fewer terms.
    """
    best = structures.best
    moves = sorted(_propose_finer(structures, best), key=lambda move: -move.log_posterior)
    pairs = [(move, best) for move in moves if move.log_posterior > best.log_posterior]
    base = Structure(noise=best.structure.noise)
    reduced = {*map(best.structure.without_effects, best.structure.effects)} - {base}
    likely_laws = [move.structure.noise for move in moves[:LAWS_OF_REDUCED]]
    for subset in (base, *sorted(reduced, key=lambda s: sorted(s.effects))) if moves else ():
        fit = structures.visited.get(subset)
        if fit is not None and fit is not best:
            finer_moves = _propose_finer(structures, fit, None if subset == base else likely_laws)
            pairs += [(m, fit) for m in finer_moves if structures.is_in_window(m.log_posterior)]
    for move in (*moves, *(move for move, _ in pairs)):
        structures.store_score(move.structure, move.log_posterior)
    pairs = [(move, fit) for move, fit in pairs if move.structure not in structures.visited]
    for move, fit in sorted(pairs, key=lambda c: -c[0].log_posterior)[: NEIGHBOUR_COUNTS[1]]:
        yield structures.evaluate(move.structure, fit, move.starts)
    return bool(pairs)


def _propose_finer(
    structures: Structures, fit: EvaluatedStructure, allowed_laws: Sequence[str] | None = None
) -> Iterator[Move]:
    """Yield finer forms of a structure's correlated law, scored by the change of log evidence on its residuals.

    No law is yielded if uncorrelated noise is at least as probable; if `allowed_laws` is given, only these laws are.
    """
    structure, laws = fit.structure, structures.noise_laws
    current_law = structures.noise_law(structure)
    plain_fit = structures.visited.get(structure.with_noise(""))
    family = current_law.refines or current_law.name
    finer_names = [n for n, law in laws.items() if law.refines == family and n != current_law.name]
    finer_names = [n for n in finer_names if allowed_laws is None or n in allowed_laws]
    is_correlated = plain_fit is None or fit.log_posterior > plain_fit.log_posterior
    is_correlated = is_correlated and not current_law.independent
    if not (is_correlated and finer_names and math.isfinite(fit.log_posterior)):
        return
    # Evidence of both laws on the residuals alone: the coefficients' posterior volumes are nearly equal.
    current_law_fit = structures.fit_law(fit, structure.noise)
    for name in finer_names:
        law_fit = structures.fit_law(fit, name)
        change = law_fit.log_evidence - current_law_fit.log_evidence
        change += log_prior(laws, name) - log_prior(laws, current_law.name)
        yield Move(structure.with_noise(name), fit.log_posterior + change, (law_fit.start,))


def _propose_noise_laws(structures: Structures, fit: EvaluatedStructure) -> Iterator[Move]:
    """Yield other independent noise laws, scored by the change of log evidence on residuals under the given law."""
    structure, laws = fit.structure, structures.noise_laws
    plain_fit = structures.visited.get(structure.with_noise(""))
    if not laws or plain_fit is None or not math.isfinite(plain_fit.log_posterior):
        return
    plain_law_fit = structures.fit_law(plain_fit, "")
    for name, law in laws.items():
        if law.independent and name != structure.noise:
            law_fit = structures.fit_law(plain_fit, name)
            # Coefficients are held at a fit that outliers have pulled: the change is rather too low.
            change = law_fit.log_evidence - plain_law_fit.log_evidence + log_prior(laws, name)
            log_posterior = plain_fit.log_posterior + change
            yield Move(structure.with_noise(name), log_posterior, (law_fit.start,))


def _propose_moves(scorer: Scorer, scope: Scope) -> Iterator[Move]:
    """Yield additions of one effect and of pairs, drops and swaps, with their log posteriors from scores."""
    structures, fit = scorer.library.structures, scorer.fit
    structure, log_odds, total = fit.structure, structures.log_odds, fit.log_posterior
    names = [n for n in scorer.library.points if n in scope.effects]
    candidates = [n for n in structures.candidates_for(structure) if n in names]
    free_count = scope.max_effects - len(structure.effects)
    if free_count > 0 and candidates:
        reduced = scorer.reduced_model()
        scores = reduced.score_candidates(candidates)
        for name, points in scores.items():
            yield _make_addition(structure.with_effects(name), total + log_odds[name], points)
        if free_count > 1:
            named = {n: p for n, p in scores.items() if not structures.candidates[n].is_placeholder}
            for factor, a, b in reduced.score_pairs(named)[:MAX_FITTED_PAIRS]:
                pair_total = total + factor + log_odds[a.name] + log_odds[b.name]
                pair, start = structure.with_effects(a.name, b.name), {**a.start, **b.start}
                yield Move(pair, pair_total, (start,))
    # Drops and swaps begin at the model without the effect; a drop has no log determinant of new columns.
    for name in sorted(n for n in structure.effects if n in scorer.library.points):
        subset, reduced = structure.without_effects(name), scorer.reduced_model(name)
        yield Move(subset, total + reduced.drop_log_bayes_factor - log_odds[name])
        others = set(structures.candidates_for(subset)) - {name}
        for other, points in reduced.score_candidates([n for n in names if n in others]).items():
            swap = subset.with_effects(other)
            yield _make_addition(swap, total + log_odds[other] - log_odds[name], points)


def _make_addition(structure: Structure, log_posterior: float, points: list[ScoredPoint]) -> Move:
    starts = tuple(point.start for point in points[:MAX_STARTS])
    return Move(structure, log_posterior + log_mean_bayes_factor(points), starts)
