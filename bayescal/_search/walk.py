"""The walk over structures: add, add two, drop, exchange, change the noise law, from the most probable ones.

A table of the structures evaluated is its only memory. Nothing is decided by the order in which things were added. It
is a generator: whoever consumes it ends it when it likes, and finds what was evaluated in the table.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

from bayescal._core import deadline
from bayescal._core.parallel import on_one_thread
from bayescal._core.progress import stage, tell
from bayescal._inference import memory
from bayescal._search.library import Library
from bayescal._search.noise_laws import log_prior
from bayescal._search.scores import HINTS, ScoredPoint, View, gain_of
from bayescal._search.structures import NEAR_NATS, OTHER_LAW_NATS, Structure, Structures, Weighed

# Most probable structures whose neighbours are looked at; 4 find what enumeration finds (tests/search).
BEAM_STRUCTURES = 4
# Neighbours that are refitted of each structure looked at, at least and at most.
REFITTED_NEIGHBOURS = (2, 10)
REFITTED_PAIRS = 4  # pairs of effects among them, for those that show together alone

LIKELIEST = 2  # finer noise laws that are weighed beside fewer effects than the best structure has
FOLLOWED_SECONDS = 1.0  # between two reports of how the walk goes on

LIMIT = "The search was ended after {:.0f} s with the best so far: more time may find more."
STOPPED = "The search was interrupted after {:.0f} s: this is the best so far."
NOT_BEGUN = "There was no time to search ({}): no structure but the first was evaluated."


@on_one_thread
def explore(
    library: Library,
    max_effects: int,
    start: Structure | None = None,
    follow: Callable[[], None] = lambda: None,
) -> str:
    """Walk until the end or the deadline, and return why the walk ended early; empty where it did not.

    The first structure is evaluated in any case; `follow` is called at times, and last of all.
    """
    started, followed, structures, ended = time.monotonic(), 0.0, library.structures, ""
    end = deadline.current()
    with deadline.finishing():
        structures.weigh(Structure())
    end.defer_interrupt()
    try:
        with stage("looking for missing effects"):
            end.ask()
            for _ in walk(library, max_effects, start):
                if time.monotonic() > followed + FOLLOWED_SECONDS:
                    follow()
                    followed = time.monotonic()
                end.ask()
    except deadline.TimeIsUp as early:
        ended = (STOPPED if end.interrupted else LIMIT).format(time.monotonic() - started)
        if len(structures.visited) == 1:
            ended = NOT_BEGUN.format(early)
        if end.interrupted:
            tell("interrupted: fitting the best so far; Ctrl-C again ends without a result")
    follow()
    structures.record.clear_cache()
    memory.trim()
    return ended


Evaluated = Generator[Weighed, None, None]


def walk(library: Library, max_effects: int, start: Structure | None = None) -> Evaluated:
    """Evaluate structures until the most probable ones have no neighbour left to look at; yield each.

    Args:
        library: the candidates; its structures keep what was evaluated.
        max_effects: most effects to add.
        start: one that is evaluated last: the walk goes on from there where it is probable, and is else what it would
            be without.
    """
    structures = library.structures
    root = structures.weigh(Structure())
    # Physics first: a curve, or noise that is correlated, found before a second effect takes what this explains, and
    # hides it. So what has a name is looked for by itself, under the noise that is given, and then all together.
    # A fourth power costs nothing to look for, and what is wrong with it the second walk exchanges.
    offered = structures.candidates.items()
    named = frozenset(n for n, e in offered if not (e.is_placeholder and e.unnamed))
    physics, full = Scope(named, ("",)), Scope(frozenset(structures.candidates))
    expanded: dict[Scope, set[Structure]] = {physics: set(), full: set()}
    view = lru_cache(BEAM_STRUCTURES)(partial(View, library))  # of either scope
    for among, later in ((physics, None), (full, None), (full, start)):
        # From the base under a correlated law an effect is seen that slow residuals would otherwise hide.
        for law in () if among is physics else correlated_laws(structures):
            yield structures.weigh(Structure(noise=law), root)
        if later:
            # Effect by effect, as the walk would: from the root at once its shapes may end at a lower maximum.
            yield from map(structures.weigh, path(library, later))
        # A structure that overtakes the others joins the beam when its turn comes: `_next` sorts anew each time. Finer
        # forms and laws come last: on what a missing effect leaves, each would be fitted for nothing.
        while True:
            if fresh := _next(structures, expanded[among], among):
                structure = fresh.structure
                earlier = [*expanded[among]] if structures.thrifty else []
                expanded[among].add(structure)
                if similar := [s for s in earlier if structures.have_same_effects(s, structure)]:
                    yield from _follow(structures, fresh, similar[0])
                else:
                    yield from _look_around(library, fresh, max_effects, among, view)
            elif among is physics:
                # Forms that no score tells of come last, as finer ones do.
                before = len(structures.visited)
                evaluated = (w for w in structures.visited.values() if physics.holds(w.structure))
                yield from _weigh_forms(structures, max(evaluated, key=lambda w: w.total))
                if len(structures.visited) == before:
                    break
            else:
                before = len(structures.visited)
                yield from _weigh_forms(structures, structures.best, last=True)
                if len(structures.visited) == before and not (yield from _refine(structures)):
                    break


@on_one_thread
def path(library: Library, to: Structure, start: Structure | None = None) -> list[Structure]:
    """Return the way from one structure to a larger one: at each step what gains most, by refit where there is any."""
    structures, steps, at = library.structures, [start or Structure()], None
    while True:
        deadline.current().ask()
        current = steps[-1]
        at = structures.weigh(current, at)
        if current == to:
            return steps
        names, totals = sorted(to.effects - current.effects), dict[Structure, float]()
        view = View(library, at).without() if names and math.isfinite(at.total) else None
        for name in names:
            further = current.plus(name)
            if view is None or further in structures.visited or name not in library.points:
                totals[further] = structures.weigh(further, at).total
            else:
                # Without a refit the score does: it decides only the order in which steps are shown.
                gain = gain_of(view.scores([name])[name])
                totals[further] = at.total + structures.log_odds[name] + gain
        if current.noise != to.noise:
            totals[current.under(to.noise)] = structures.weigh(current.under(to.noise), at).total
        steps.append(max(totals, key=totals.__getitem__))


def _next(structures: Structures, expanded: set[Structure], among: Scope) -> Weighed | None:
    """Return the most probable structure of the beam that was not expanded yet, within a scope.

    Of the beam is also the best under each noise law: from the best under another one it would take several changes at
    once to come there.
    """
    evaluated = [w for w in structures.visited.values() if among.holds(w.structure)]
    ordered = sorted(evaluated, key=lambda w: -w.total)
    of_law = {w.structure.noise: w for w in reversed(ordered)}
    for i, w in enumerate(ordered):
        # Farther behind than `near` a structure has no part of the probability that is printed: it is left alone.
        if w.total <= ordered[0].total - NEAR_NATS:
            return None
        in_beam = i < BEAM_STRUCTURES or of_law[w.structure.noise] is w
        if structures.thrifty:
            in_beam = i < BEAM_STRUCTURES and w.structure.noise == ordered[0].structure.noise
        if in_beam and w.structure not in expanded:
            return w
    return None


class Scope(NamedTuple):
    """Where a walk goes."""

    effects: frozenset[str]  # candidates that it adds, drops and exchanges
    laws: tuple[str, ...] | None = None  # names of the noise laws that it changes to; None for all

    def holds(self, structure: Structure) -> bool:
        return structure.effects <= self.effects and self.has(structure.noise)

    def has(self, law: str) -> bool:
        return self.laws is None or law in self.laws


class Move(NamedTuple):
    """A neighbour of a structure, what the linear model expects of it, and where its refit may begin."""

    to: Structure
    total: float
    hints: tuple[dict[str, float], ...] = ()


def _look_around(
    library: Library, at: Weighed, max_effects: int, among: Scope, view: Callable[[Weighed], View]
) -> Evaluated:
    """Weigh the neighbours of a structure that may come near the best; of the others keep what is expected."""
    structures, structure = library.structures, at.structure
    # The same effects under each law: otherwise the walk would have to find them anew under each.
    for law in filter(among.has, ("", *correlated_laws(structures))):
        other = structure.under(law)
        other = other.minus(*structures.barred(other))
        if _is_open(structures, other, at):
            yield structures.weigh(other, at)
    if not math.isfinite(at.total):
        return
    all_laws = among.laws is None
    if all_laws:
        yield from _weigh_forms(structures, at)
    changes = [m for m in _changes_of_noise(structures, at) if among.has(m.to.noise)]
    moves = [*_moves(view(at), max_effects, among)]
    # Substitutes of what corrects a column are seen beside a refit without it, on which all that depends moves.
    for name in sorted(filter(structures.moves_a_column, structure.effects)):
        yield (reduced := structures.weigh(structure.minus(name), at))
        if math.isfinite(reduced.total):
            moves += _moves(View(library, reduced), max_effects, among)
    # What no score tells of is looked at by a refit.
    if len(structure.effects) < max_effects:
        open_ = among.effects.intersection(structures.unscored, structures.open_to(structure))
        moves += [Move(structure.plus(name), at.total) for name in sorted(open_)]
    for move in (*moves, *changes):
        structures.expect(move.to, move.total)
    # Of another law a refit tells little more than was expected, unless it is to be used.
    least = at.total
    if structures.thrifty:
        least = at.total - structures.near if at is structures.best else structures.best.total
    moves += [move for move in changes if move.total > least]
    # The first ones are refitted whatever is expected of them, since a score at φ̂ of a model that lacks an effect
    # (its noise too large, its shapes elsewhere) may be far too low.
    moves.sort(key=lambda m: -m.total)
    for i, move in enumerate(moves[: REFITTED_NEIGHBOURS[1]]):
        near = move.total > structures.best.total - structures.near
        near = near or i < REFITTED_NEIGHBOURS[0]
        if near and _is_open(structures, move.to, at):
            yield (evaluated := structures.weigh(move.to, at, move.hints))
            if all_laws:
                yield from _weigh_forms(structures, evaluated)
    # What a dropped effect explained correlated noise may take up, as no score says that holds the noise.
    if at is structures.best and not structures.noise(structure).independent:
        for name in sorted(structure.effects):
            if _is_open(structures, structure.minus(name), at):
                yield structures.weigh(structure.minus(name), at)


def _is_open(structures: Structures, to: Structure, at: Weighed) -> bool:
    """Return whether a neighbour is to be refitted: unless it is known to be improbable without.

    Under a law that no table tells a refit passes over the readings a hundred times, and what an effect is worth hangs
    little on the finer form: it is known by the law that this refines. Of many devices a change is known by what it
    came to beside another form of the same effects.
    """
    law = structures.noise(to)
    if to in structures.visited:
        return True
    if to in structures.earlier:
        return structures.total(to) > structures.best.total - NEAR_NATS
    if structures.thrifty and (gain := _beside_another(structures, to, at.structure)) is not None:
        structures.expect(to, at.total + gain)
        return at.total + gain > structures.best.total
    if law.refines not in structures.laws or to.noise != at.structure.noise:
        return True
    if structures.record.nodes(law) is not None:
        return True
    by_plainer = [structures.weigh(s.under(law.refines), at) for s in (to, at.structure)]
    total = at.total + by_plainer[0].total - by_plainer[1].total
    structures.expect(to, total)
    return total > structures.best.total - NEAR_NATS


def _beside_another(structures: Structures, to: Structure, structure: Structure) -> float | None:
    """Return what a change gained beside other forms of the same effects; None if never tried."""
    come, gone = to.effects - structure.effects, structure.effects - to.effects
    own_families = structures.families(structure.effects)
    of_form = come and structures.families(to.effects) == own_families
    for s, gain in _known_gains(structures, gone, come, to.noise):
        families = structures.families(s.effects)
        is_similar = families == own_families or (of_form and families < own_families)
        if s.noise == structure.noise and is_similar:
            return gain
    return None


def _known_gains(
    structures: Structures, gone: frozenset[str], come: frozenset[str], noise: str | None = None
) -> Iterator[tuple[Structure, float]]:
    """Yield evaluated structures with what an exchange of effects, and of the noise law if given, gained in each."""
    for s, evaluated in structures.visited.items():
        if gone <= s.effects and not come & s.effects:
            to = Structure(s.effects - gone | come, s.noise if noise is None else noise)
            exchanged = structures.visited.get(to)
            if exchanged is not None and math.isfinite(exchanged.total - evaluated.total):
                yield s, exchanged.total - evaluated.total


def _follow(structures: Structures, at: Weighed, similar: Structure) -> Evaluated:
    """Weigh what came near the best beside other forms of the same effects: no more than that does beside these."""
    gone, come = similar.effects - at.structure.effects, at.structure.effects - similar.effects
    for s, evaluated in [*structures.visited.items()]:
        near = evaluated.total > structures.best.total - structures.near
        if near and gone <= s.effects and len(s.effects ^ similar.effects) == 1:
            yield structures.weigh(Structure(s.effects - gone | come, s.noise), at)


def _weigh_forms(structures: Structures, at: Weighed, last: bool = False) -> Evaluated:
    """Weigh a structure with the forms of its effects that no score tells of, each in place of the one that it has.

    None, where the structure is so improbable that no form could make it anything else. Forms of several shapes, which
    take ten times as long, and one that lost so much wherever it was tried that as much would put it out of sight,
    wait for the `last` look around.
    """
    behind = structures.near if structures.thrifty else OTHER_LAW_NATS
    if not at.total > structures.best.total - behind:
        return
    independent = structures.noise(at.structure).independent
    for name in sorted(at.structure.effects):
        for to in structures.other_forms(at.structure, name):
            (other,) = come = to.effects - at.structure.effects
            shapes = structures.candidates[other].column_shapes
            if not structures.moves_a_column(other) or (len(shapes) > 1 and not last):
                continue
            known = () if last else _known_gains(structures, frozenset({name}), come)
            gains = (gain for s, gain in known if structures.noise(s).independent == independent)
            expected = at.total + max(gains, default=math.inf)
            if to not in structures.visited and expected < structures.best.total - NEAR_NATS:
                structures.expect(to, expected)
            elif _is_open(structures, to, at):
                # Its shapes may be where those of the same name are in the form that the structure has.
                places = at.problem.layout.index_in_phi
                pairs = ((f"{other}.{s.name}", f"{name}.{s.name}") for s in shapes)
                hint = {n: float(at.mode.v[places[o]]) for n, o in pairs if o in places}
                yield structures.weigh(to, at, [hint])


def correlated_laws(structures: Structures) -> list[str]:
    """Return names of further correlated noise laws, which only a refit can judge."""
    return [n for n, law in structures.laws.items() if not law.independent and not law.refines]


def _refine(structures: Structures) -> Generator[Weighed, None, bool]:
    """Weigh finer noise laws beside the effects of the best structure, and beside fewer; whether any was left to weigh.

    What an effect explains under plain noise a finer law may explain without it.
    """
    best, fewest = structures.best, structures.best.total - NEAR_NATS
    moves = sorted(_finer_laws(structures, best), key=lambda m: -m.total)
    chosen = [(move, best) for move in moves if move.total > best.total]
    plain = Structure(noise=best.structure.noise)
    reduced = {best.structure.minus(name) for name in best.structure.effects} - {plain}
    likeliest = [move.to.noise for move in moves[:LIKELIEST]]
    for fewer in (plain, *sorted(reduced, key=lambda s: sorted(s.effects))) if moves else ():
        at = structures.visited.get(fewer)
        if at is not None and at is not best:
            laws = None if fewer == plain else likeliest
            chosen += [(m, at) for m in _finer_laws(structures, at, laws) if m.total > fewest]
    for move in (*moves, *(move for move, _ in chosen)):
        structures.expect(move.to, move.total)
    chosen = [(move, at) for move, at in chosen if move.to not in structures.visited]
    for move, at in sorted(chosen, key=lambda c: -c[0].total)[: REFITTED_NEIGHBOURS[1]]:
        yield structures.weigh(move.to, at, move.hints)
    return bool(chosen)


def _finer_laws(
    structures: Structures, at: Weighed, among: Sequence[str] | None = None
) -> Iterator[Move]:
    """Yield finer forms of a structure's correlated law, by their gain on the residuals under it.

    None where the noise is as probably not correlated at all; of `among` alone, if given.
    """
    current, plain = structures.noise(at.structure), structures.visited.get(at.structure.under(""))
    family = current.refines or current.name
    finer = [n for n, law in structures.laws.items() if law.refines == family and n != current.name]
    finer = [n for n in finer if among is None or n in among]
    correlated = not current.independent and (plain is None or at.total > plain.total)
    if not (correlated and finer and math.isfinite(at.total)):
        return
    # Evidence of either law on the residuals alone: the coefficients' volume is nearly the same.
    evidence = structures.law_on_residuals(at, at.structure.noise)
    for name in finer:
        fit = structures.law_on_residuals(at, name)
        odds = log_prior(structures.laws, name) - log_prior(structures.laws, current.name)
        gain = fit.log_evidence - evidence.log_evidence
        yield Move(at.structure.under(name), at.total + gain + odds, (fit.hint,))


def _changes_of_noise(structures: Structures, at: Weighed) -> Iterator[Move]:
    """Yield other independent noise laws, by their gain on the residuals under the given law."""
    plain = structures.visited.get(at.structure.under(""))
    if not structures.laws or plain is None or not math.isfinite(plain.total):
        return
    evidence = structures.law_on_residuals(plain, "")
    for name, law in structures.laws.items():
        if law.independent and name != at.structure.noise:
            fit = structures.law_on_residuals(plain, name)
            # The law is judged on residuals of the fit under the given law, coefficients held: an outlier has pulled
            # these, so that the gain is rather too low.
            total = plain.total + fit.log_evidence - evidence.log_evidence
            to = at.structure.under(name)
            yield Move(to, total + log_prior(structures.laws, name), (fit.hint,))


def _moves(view: View, max_effects: int, among: Scope) -> Iterator[Move]:
    """Yield additions, pairs, drops and exchanges, with their expected totals."""
    structures, at = view.library.structures, view.at
    structure, odds = at.structure, structures.log_odds
    names = [n for n in view.library.points if n in among.effects]
    open_ = [n for n in structures.open_to(structure) if n in names]
    room = max_effects - len(structure.effects)
    if room > 0 and open_:
        reduced = view.without()
        scores = reduced.scores(open_)
        for name, points in scores.items():
            yield _addition(structure.plus(name), at.total + odds[name], points)
        if room > 1:
            named = {n: p for n, p in scores.items() if not structures.candidates[n].is_placeholder}
            for gain, a, b in reduced.pairs(named)[:REFITTED_PAIRS]:
                total = at.total + gain + odds[a.effect] + odds[b.effect]
                yield Move(structure.plus(a.effect, b.effect), total, ({**a.hint, **b.hint},))
    # Dropping and exchanging start from what is left without the effect; a drop costs no column's volume.
    for name in sorted(n for n in structure.effects if n in view.library.points):
        without = view.without(name)
        yield Move(structure.minus(name), at.total + without.dropped - odds[name])
        others = set(structures.open_to(structure.minus(name))) - {name}
        for other, points in without.scores([n for n in names if n in others]).items():
            total = at.total + odds[other] - odds[name]
            yield _addition(structure.minus(name).plus(other), total, points)


def _addition(to: Structure, total: float, points: list[ScoredPoint]) -> Move:
    return Move(to, total + gain_of(points), tuple(p.hint for p in points[:HINTS]))
