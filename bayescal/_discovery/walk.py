"""The walk over structures: add, add two, drop, exchange, change the noise law, from the most probable ones.

A table of the structures weighed is its only memory. Nothing is decided by the order in which things were added.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from bayescal._discovery.scores import HINTS, Library, Scored, gain_of, pairs, scores
from bayescal._discovery.structures import Structure, Structures, Weighed
from bayescal._engine.linear_model import linear_model

BEAM = 4  # most probable structures whose neighbours are all looked at before the walk ends
SINGLES = 6  # additions refitted, of each structure looked at,
TWOS = 3  # and pairs,
SWAPS = 2  # and exchanges of each effect
NEAR = 6.0  # log odds behind the best, up to which a structure is looked at
LIMIT = "The search was ended after {:.0f} s with the best so far: more time may find more."
STOPPED = "The search was interrupted after {:.0f} s: this is the best so far."


def walk(
    library: Library,
    max_effects: int,
    time_limit: float | None = None,
    follow: Callable[[Structures], None] = lambda _: None,
    seeds: Sequence[Structure] = (),
) -> str:
    """Weigh structures until the most probable ones have no neighbour left to look at.

    Args:
        library: the candidates; its structures keep what was weighed.
        max_effects: most effects to add.
        time_limit: seconds after which the walk ends early.
        follow: called after each look around.
        seeds: structures that are weighed first, of an earlier walk.

    Returns:
        Why it ended early; empty where it came to its end.
    """
    begun = time.monotonic()
    ends_at = begun + (math.inf if time_limit is None else time_limit)
    structures = library.structures
    try:
        root = structures.weigh(Structure())
        if structures.wide is not None:
            structures.weigh(Structure(wanders=True), root)
        for seed in seeds:
            structures.weigh(seed, root)
        looked: set[Structure] = set()
        while fresh := _next(structures, looked):
            if time.monotonic() > ends_at:
                return LIMIT.format(time.monotonic() - begun)
            looked.add(fresh.structure)
            _look_around(library, fresh, max_effects, ends_at)
            follow(structures)
    except KeyboardInterrupt:
        if not structures.visited:
            raise
        return STOPPED.format(time.monotonic() - begun)
    return ""


def _next(structures: Structures, looked: set[Structure]) -> Weighed | None:
    """The most probable structure of the beam that was not looked at."""
    leaders = sorted(structures.visited.values(), key=lambda w: -w.total)[:BEAM]
    near = (w for w in leaders if w.total > leaders[0].total - NEAR)
    return next((w for w in near if w.structure not in looked), None)


def _look_around(library: Library, at: Weighed, max_effects: int, ends_at: float) -> None:
    """Weigh the neighbours of a structure that promise most."""
    structures, here = library.structures, at.structure
    room = max_effects - len(here.effects)
    if structures.wide is not None:
        other = Structure(here.effects, not here.wanders)
        structures.weigh(other.minus(*structures.barred(other)), at)
    for name in sorted(here.effects):
        if time.monotonic() < ends_at:
            without = structures.weigh(here.minus(name), at)
            _add_best(library, without, SWAPS, 0, {name})
    if room > 0 and time.monotonic() < ends_at:
        _add_best(library, at, SINGLES, TWOS if room > 1 else 0, set())


def _add_best(library: Library, at: Weighed, singles: int, twos: int, passed: set[str]) -> None:
    structures = library.structures
    names = [n for n in structures.open_to(at.structure) if n not in passed]
    if not names or not math.isfinite(at.total):
        return
    found = scores(library, at, names)
    order = sorted(names, key=lambda n: -(gain_of(found[n]) + structures.log_odds[n]))
    for name in order[:singles]:
        hints = [p.hint for p in found[name][:HINTS]]
        structures.weigh(at.structure.plus(name), at, hints)
    if not twos:
        return
    named = {n: found[n] for n in names if not structures.candidates[n].is_placeholder}
    made: dict[Structure, tuple[Scored, Scored]] = {}
    for _, a, b in pairs(named, linear_model(at.assembly, at.mode)):
        made.setdefault(at.structure.plus(a.effect, b.effect), (a, b))
        if len(made) == twos:
            break
    for structure, (a, b) in made.items():
        structures.weigh(structure, at, [{**a.hint, **b.hint}])
