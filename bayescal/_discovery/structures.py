"""Structures: which effects and which noise law may make up a model, how probable each is, before and after.

Each candidate is in or out, independently, with odds such that P(nothing missing) is one half; placeholders share a
tenth of the prior. A plausible size is known to an order of magnitude: evidence is averaged over it times 1, 3 and 10.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from bayescal._engine.assembly import Assembly
from bayescal._engine.closed_form import NOWHERE, Density, condition
from bayescal._engine.mode import Mode, find_mode
from bayescal._engine.record import Record
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.noise_laws import Noise
from bayescal._model.parameters import Layout

NOTHING = 0.5  # prior probability that no candidate is missing
UNKNOWN_SHARE = 0.1  # of the prior that something is, for what no named effect describes
SIZES = {1.0: 0.6, 3.0: 0.3, 10.0: 0.1}  # factors on a plausible size, and their probabilities


@dataclass(frozen=True)
class Structure:
    """A set of added effects, and whether the noise wanders."""

    effects: frozenset[str] = frozenset()
    wanders: bool = False

    def plus(self, *names: str) -> Structure:
        return Structure(self.effects | set(names), self.wanders)

    def minus(self, *names: str) -> Structure:
        return Structure(self.effects - set(names), self.wanders)


@dataclass(frozen=True, eq=False)
class Weighed:
    """A structure with its evidence, its prior, and its mode.

    Attributes:
        structure: which.
        log_evidence: by Laplace, averaged over the sizes.
        log_prior: of the structure.
        assembly, mode: at the likeliest sizes.
    """

    structure: Structure
    log_evidence: float
    log_prior: float
    assembly: Assembly
    mode: Mode

    @property
    def total(self) -> float:
        return self.log_evidence + self.log_prior

    @cached_property
    def values(self) -> dict[str, float]:
        """Coordinates of φ by name."""
        names = [h.name for h in self.assembly.hypers]
        return dict(zip(names, self.mode.v.tolist(), strict=True))


@dataclass(eq=False)
class Structures:
    """All structures over one model on one record.

    Attributes:
        base: the model that effects are added to.
        layout: its own, for the groups' sizes.
        record: the readings.
        candidates: effects that may be added, by name.
        wide: the wandering law; None where the readings cannot tell, or the base's own law wanders.
    """

    base: Model
    layout: Layout
    record: Record
    candidates: Mapping[str, Effect]
    wide: Noise | None
    visited: dict[Structure, Weighed] = field(default_factory=dict)
    expected: dict[Structure, float] = field(default_factory=dict)  # totals of others, by score

    @cached_property
    def log_odds(self) -> dict[str, float]:
        """Prior log odds of each candidate to be missing."""
        unknown = [n for n, e in self.candidates.items() if e.is_placeholder]
        named = [n for n in self.candidates if n not in unknown]
        share = UNKNOWN_SHARE if named else 1.0
        each = {}
        for names, part in ((unknown, share), (named, 1 - share if unknown else 1.0)):
            for name in names:
                each[name] = math.log(math.expm1(-math.log(NOTHING) * part / len(names)))
        return each

    def log_prior(self, structure: Structure) -> float:
        """Of a structure, against that of the base under the same law."""
        return sum(self.log_odds[name] for name in structure.effects)

    def barred(self, structure: Structure) -> set[str]:
        """Candidates that a structure may not have: a free curve in time beside a wander is the wander again."""
        wanders = structure.wanders or not self.base.noise.independent
        return {"unknown(time)"} if wanders else set()

    def open_to(self, structure: Structure) -> list[str]:
        """Candidates that may be added to it."""
        barred = structure.effects | self.barred(structure)
        return [n for n in self.candidates if n not in barred]

    def path(self, to: Structure) -> list[Structure]:
        """From the base to a structure, at each step what gains most."""
        steps = [Structure()]
        while steps[-1] != to:
            here = steps[-1]
            ways = [here.plus(name) for name in sorted(to.effects - here.effects)]
            if here.wanders != to.wanders:
                ways.append(Structure(here.effects, to.wanders))
            near = self.weigh(here)
            steps.append(max(ways, key=lambda s: self.weigh(s, near).total))
        return steps

    def model(self, structure: Structure) -> Model:
        """A structure as a model, effects in the catalogue's order."""
        added = (e for name, e in self.candidates.items() if name in structure.effects)
        noise = self.wide if structure.wanders and self.wide else self.base.noise
        return Model(self.base.instrument, (*self.base.effects, *added), noise, self.base.fixed)

    def weigh(
        self,
        structure: Structure,
        near: Weighed | None = None,
        hints: Sequence[Mapping[str, float]] = (),
    ) -> Weighed:
        """The evidence of a structure: a full refit.

        Args:
            structure: which.
            near: another one, whose φ̂ is a start.
            hints: coordinates by name that are starts too, beside those of `near`.
        """
        found = self.visited.get(structure)
        if found is None:
            found = self.visited[structure] = self._weighed(structure, near, hints)
        return found

    def _weighed(self, structure, near, hints) -> Weighed:
        model = self.model(structure)
        layout = Layout(model, self.layout.counts)
        assembly = Assembly(layout, self.record)
        if near is None:
            mode = find_mode(assembly)
        else:
            mode = find_mode(assembly, _starts(assembly, near, hints), _width(assembly, near))
        sized = [e for e in model.effects if e.name in structure.effects and _has_size(e)]
        assembly, mode, log_evidence = _averaged(assembly, mode, sized)
        return Weighed(structure, log_evidence, self.log_prior(structure), assembly, mode)

    def expect(self, structure: Structure, total: float) -> None:
        """Keep what the score expects of a structure: it counts where that was not refitted."""
        if math.isfinite(total):
            self.expected[structure] = max(total, self.expected.get(structure, -math.inf))

    @property
    def best(self) -> Weighed:
        return max(self.visited.values(), key=lambda w: w.total)


def _has_size(effect: Effect) -> bool:
    """Whether its size is a prior's standard deviation, and not learned."""
    return not effect.is_placeholder and any(
        c.spread is None and not c.flat for c in effect.coefficients
    )


def _averaged(
    assembly: Assembly, mode: Mode, sized: Sequence[Effect]
) -> tuple[Assembly, Mode, float]:
    """The structure at its likeliest sizes, and its log evidence averaged over all.

    One effect's size at a time, the others' at their likeliest.
    """
    if not sized or not math.isfinite(mode.log_evidence):
        return assembly, mode, mode.log_evidence
    chosen = {e.name: 1.0 for e in sized}
    at_sizes = _AtSizes(assembly, mode, chosen)
    for _ in range(2):
        before = dict(chosen)
        for name in chosen:
            gains = at_sizes.of(name, chosen)
            chosen[name] = max(gains, key=gains.__getitem__)
        if chosen == before:
            break
    if any(factor != 1.0 for factor in chosen.values()):
        assembly = Assembly(assembly.layout, assembly.record, dict(chosen))
        mode = find_mode(assembly, [mode.v], mode.covariance)
    at_sizes = _AtSizes(assembly, mode, chosen)
    log_evidence = mode.log_evidence
    for name in chosen:
        gains = at_sizes.of(name, chosen)
        here = gains[chosen[name]] - math.log(SIZES[chosen[name]])
        log_evidence += float(logsumexp(list(gains.values()))) - here
    return assembly, mode, log_evidence


class _AtSizes:
    """Log density at a mode's φ for other sizes of its effects, times their probabilities."""

    def __init__(self, assembly: Assembly, mode: Mode, made_at: Mapping[str, float]):
        density, hyper = Density(assembly, mode.point, mode.flat), assembly.hyper(mode.v)
        self.gram, self.at, self.size = (
            density.gram(mode.v, hyper),
            mode.point.x,
            assembly.record.size,
        )
        self.prior, self.made_at = assembly.prior(hyper, mode.flat), dict(made_at)
        self.places = {
            name: [t.at for t in assembly.in_x if t.known.of == name and t.spread_name is None]
            for name in made_at
        }

    def of(self, name: str, chosen: Mapping[str, float]) -> dict[float, float]:
        """For each size of one effect, the others as chosen."""
        found = {}
        for factor, probability in SIZES.items():
            sd = self.prior.sd.copy()
            for other, places in self.places.items():
                share = (factor if other == name else chosen[other]) / self.made_at[other]
                for place in places:
                    sd[place] *= share
            got = condition(self.gram, self.size, self.prior._replace(sd=sd), self.at)
            found[factor] = (got.log_marginal if got else NOWHERE) + math.log(probability)
        return found


def _width(assembly: Assembly, near: Weighed) -> np.ndarray:
    """A first guess of φ's covariance: another structure's, and that of a badly known coordinate for the others."""
    names, known = [h.name for h in assembly.hypers], list(near.values)
    found = 0.1 * np.eye(len(names))
    at = [i for i, n in enumerate(names) if n in near.values]
    there = [known.index(names[i]) for i in at]
    found[np.ix_(at, at)] = near.mode.covariance[np.ix_(there, there)]
    return found


def _starts(
    assembly: Assembly, near: Weighed, hints: Sequence[Mapping[str, float]]
) -> list[np.ndarray]:
    """Where the climb may begin: at another structure's φ̂, at the hints, and one step aside along each known shape."""
    names = [h.name for h in assembly.hypers]
    here = {**dict.fromkeys(names, 0.0), **{n: v for n, v in near.values.items() if n in names}}
    starts = [here, *({**here, **{n: v for n, v in hint.items() if n in names}} for hint in hints)]
    for h in assembly.hypers:
        if h.kind == "shape" and h.name in near.values:
            starts += [{**here, h.name: here[h.name] + aside} for aside in (-1.0, 1.0)]
        elif h.name not in near.values and h.kind in ("spread", "noise"):
            starts += [{**here, h.name: v} for v in (-1.5, 1.0)]
    return [np.array([start[n] for n in names]) for start in starts]
