"""The posterior over structures: inclusion probabilities, findings with their substitutes, the structure to use."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bayescal._discovery.structures import Structure, Structures, Weighed

FOUND = 0.95  # probability from which something is reported as found
RIVAL = math.log(20)  # log odds within which exchanging one effect for another keeps a structure


@dataclass(frozen=True)
class Found:
    """One of these effects is missing; the readings cannot tell which."""

    effects: tuple[str, ...]
    probability: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Weighed structures that hold some effects, with their probabilities.

    Attributes:
        given: effects that all of them hold.
        weighed: the structures, the most probable first.
        probability: of each.
    """

    given: frozenset[str]
    weighed: tuple[Weighed, ...]
    probability: np.ndarray

    @classmethod
    def of(cls, structures: Structures, given: Iterable[str] = ()) -> Posterior:
        held = frozenset(given)
        inside = [w for w in structures.visited.values() if held <= w.structure.effects]
        inside = sorted((w for w in inside if math.isfinite(w.total)), key=lambda w: -w.total)
        total = np.array([w.total for w in inside])
        weight = np.exp(total - total[0])
        return cls(held, tuple(inside), weight / weight.sum())

    @property
    def nothing(self) -> float:
        """Probability that nothing beyond the given is missing, under either noise law."""
        return self.of_any(lambda s: s.effects == self.given)

    @property
    def wanders(self) -> float:
        """Probability that the noise wanders."""
        return self.of_any(lambda s: s.wanders)

    def inclusion(self, *names: str) -> float:
        """Probability that at least one of these effects is missing."""
        wanted = set(names)
        return self.of_any(lambda s: not wanted.isdisjoint(s.effects))

    def of_any(self, holds) -> float:
        inside = [bool(holds(w.structure)) for w in self.weighed]
        return float(min(1.0, self.probability[inside].sum()))

    @property
    def findings(self) -> tuple[Found, ...]:
        """Smallest sets of effects of which at least one is missing, with probability `FOUND`, the most probable first.

        Each begins with an effect of the most probable structure and goes on with what can take its place.
        """
        best = self.weighed[0]
        found = []
        for name in best.structure.effects - self.given:
            members = [name]
            for other in self._substitutes(best, name):
                if self.inclusion(*members) >= FOUND:
                    break
                members.append(other)
            if self.inclusion(*members) >= FOUND:
                order = sorted(members, key=lambda n: -self.inclusion(n))
                found.append(Found(tuple(order), self.inclusion(*members)))
        return tuple(sorted(found, key=lambda f: (-self.inclusion(f.effects[0]), len(f.effects))))

    def _substitutes(self, best: Weighed, name: str) -> list[str]:
        """Effects that may stand in an effect's place, the most probable first."""
        rest = best.structure.effects - {name}
        totals: dict[str, float] = {}
        for w in self.weighed:
            other = w.structure.effects - rest
            if rest <= w.structure.effects and len(other) == 1 and w.total > best.total - RIVAL:
                (own,) = other
                totals[own] = max(w.total, totals.get(own, -math.inf))
        totals.pop(name, None)
        return sorted(totals, key=lambda n: -totals[n])

    @property
    def chosen(self) -> Structure:
        """The structure to use: the most probable, without what is not found."""
        best = self.weighed[0].structure
        kept = {n for n in best.effects if any(n in f.effects for f in self.findings)}
        return Structure(frozenset(kept) | self.given, best.wanders)
