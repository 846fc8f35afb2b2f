"""The walk over structures: add, add two, drop, exchange, change the noise law, from the most probable ones.

A table of the structures weighed is its only memory. Nothing is decided by the order in which things were added.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from bayescal._discovery.scores import HINTS, Library, Scored, gain_of, pairs, scores
from bayescal._discovery.structures import Structure, Structures, Weighed
from bayescal._engine.linear_model import linear_model

BEAM = 4  # most probable structures whose neighbours are all looked at before the walk ends
SINGLES = 6  # additions refitted, of each structure looked at,
TWOS = 3  # and pairs,
SWAPS = 2  # and exchanges of each effect
NEAR = 6.0  # log odds behind the best, from which on a structure is looked at


def walk(
    structures: Structures,
    max_effects: int,
    ends_at: float = float("inf"),
    told: Callable[[], None] = lambda: None,
) -> bool:
    """Weigh structures until the most probable ones have no neighbour left to look at.

    Args:
        structures: where they are kept.
        max_effects: most effects to add.
        ends_at: clock (`time.monotonic`) at which the walk ends early.
        told: called after each look.

    Returns:
        Whether it came to its end.
    """
    library = Library(structures)
    root = structures.weigh(Structure())
    if structures.wide is not None:
        structures.weigh(Structure(wanders=True), root)
    looked: set[Structure] = set()
    while True:
        leaders = sorted(structures.visited.values(), key=lambda w: -w.total)[:BEAM]
        fresh = [
            w for w in leaders if w.structure not in looked and w.total > leaders[0].total - NEAR
        ]
        if not fresh:
            return True
        if time.monotonic() > ends_at:
            return False
        looked.add(fresh[0].structure)
        _look_around(library, fresh[0], max_effects, ends_at)
        told()


def _look_around(library: Library, at: Weighed, max_effects: int, ends_at: float) -> None:
    """Weigh the neighbours of a structure that promise most."""
    structures, here = library.structures, at.structure
    room = max_effects - len(here.effects)
    if structures.wide is not None:
        barred = {"unknown(time)"} if not here.wanders else set()
        structures.weigh(Structure(here.effects - barred, not here.wanders), at)
    for name in here.effects:
        without = structures.weigh(here.minus(name), at)
        _add_best(library, without, SWAPS, 0, {name})
    if time.monotonic() < ends_at:
        _add_best(library, at, min(SINGLES, SINGLES * room), TWOS if room > 1 else 0, set())


def _add_best(library: Library, at: Weighed, singles: int, twos: int, passed: set[str]) -> None:
    structures = library.structures
    names = [n for n in structures.open_to(at.structure) if n not in passed]
    if not names or not singles:
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
