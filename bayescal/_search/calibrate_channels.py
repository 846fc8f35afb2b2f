"""The loop for the channels of one unit: each searched alone, then again with what the others say of their body."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from bayescal._core import deadline
from bayescal._core.errors import InputError, TimeIsUp
from bayescal._core.progress import stage
from bayescal._data.measurements import Measurements
from bayescal._data.set_aside import set_aside
from bayescal._inference.method import Method
from bayescal._model.effect import Effect, Shape
from bayescal._model.frame import Reference
from bayescal._model.model import Model
from bayescal._search.calibrate import Loop
from bayescal._search.candidate import Candidate
from bayescal._search.channels import Channels
from bayescal._search.discover import WORK, with_causes
from bayescal._search.library import Library
from bayescal._search.posterior import Search
from bayescal._search.search_path import SearchPath, Step
from bayescal._search.shared_shape import FromOthers, ShapeEvidence, SharedShape, said
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import BEAM_STRUCTURES

ROUNDS = 3  # of hearing the others, at most


def calibrate_channels(
    models: Mapping[str, Model],
    readings: Mapping[str, Measurements],
    *,
    holdout: Mapping[str, Measurements] | None = None,
    effects: Sequence[Effect] = (),
    method: Method | None = None,
    max_effects: int = 5,
    widen_noise: bool = True,
    keep_spikes: bool = False,
    seed: int = 0,
    reference: Reference | None = None,
    time_limit: float | None = None,
    accept_conflicts: Collection[str] = (),
    ignore: Collection[str] = (),
    covariates: Collection[str] | None = None,
    follow: Callable[[str, SearchPath], None] = lambda _, __: None,
) -> Channels:
    """Calibrate the channels of one unit together: `calibrate` for each, one body for all.

    Each channel has its own effects, coefficients and noise. A shape that an instrument declares shared (the time of
    a body's lag, the moment of a step) is one for the unit: given it, the channels are independent, and what each says
    of it is to the others a prior. The unit has such an effect or not; if it has, some share of its channels shows it.

    Args:
        models: of each channel, to begin with.
        readings: of each channel, as `read(…, outputs=[…])` gives them.
        holdout: hold-out data, of each channel.
        follow: called with a channel's name and its trail so far, whenever that grows.
        effects, method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit, accept_conflicts, ignore,
            covariates: as `calibrate` has them; channels that the time limit leaves no time to begin are left out.

    Raises:
        InputError: fewer than two channels, or models, readings and holdout of different ones.
        ModelError: the readings lack what a model needs.
    """
    for given in (readings, holdout):
        if given is not None and set(given) != set(models):
            raise InputError(
                f"models are given for {', '.join(models)}; readings for {', '.join(given)}: give both for each channel"
            )
    if len(models) < 2:
        raise InputError("a unit has two channels or more: use `calibrate` for one")
    channels, trails = list[_Channel](), dict[str, SearchPath]()

    def run() -> Channels:
        for i, (name, model) in enumerate(models.items()):
            kept = None if holdout is None else set_aside(holdout[name], keep_spikes, model.columns)
            if kept is not None:
                model.require(kept)
            used = with_causes(readings[name], model.instrument, ignore, covariates)
            used, accepted = (
                set_aside(used, keep_spikes, model.columns),
                frozenset(accept_conflicts),
            )
            loop = Loop(used, kept, method, seed, reference, max_effects, accepted)
            try:
                with stage(name), deadline.share(1 / (2 * len(models) - i)):
                    channels.append(_Channel.begun(name, model, loop, effects, widen_noise))
            except TimeIsUp:
                if not channels:
                    raise
                continue
            deadline.offer(so_far)
            deadline.allow(sum(c.loop.grace for c in channels))
        with deadline.share(1 / 2):
            shared = _shared(channels)
        for i, channel in enumerate(channels):
            with stage(channel.name), deadline.share(1 / (len(channels) - i)):
                trails[channel.name] = deadline.within(partial(channel.trail, follow))
        return Channels(trails, tuple(shared))

    def so_far(why: str) -> Channels:
        cut = {c.name: c.loop.cut([c.first], c.search, why) for c in channels}
        return Channels({**cut, **trails}, ())

    with deadline.until(time_limit), deadline.share(WORK):
        return deadline.within(run)


@dataclass(eq=False)
class _Channel:
    """One channel: its loop, its first step, the structures weighed, and what the others say.

    Attributes:
        structures: None where nothing can be looked for.
        shut: candidates that its readings cannot test.
        shared: shapes that all channels share, as the instrument states them, by the candidate that has it.
        heard: what the others said of these when the channel was last asked; at first what the instrument says.
        says: what it says of them itself, by the structures weighed last.
        stopped: why its search ended early, if it did.
        search: how it stands.
    """

    name: str
    loop: Loop
    first: Step
    structures: Structures | None = None
    shut: Sequence[Candidate] = ()
    shared: Mapping[str, Shape] = field(default_factory=dict)
    heard: dict[str, FromOthers] = field(default_factory=dict)
    says: dict[str, ShapeEvidence] = field(default_factory=dict)
    stopped: str = ""
    search: Search | None = None

    @classmethod
    def begun(
        cls, name: str, model: Model, loop: Loop, effects: Sequence[Effect], widen_noise: bool
    ) -> _Channel:
        """After a first search alone."""
        loop, first = loop.begin(model)
        deadline.allow(loop.grace)
        more = loop.freed(first)
        if first.against and not more:
            return cls(name, loop, first)
        loop, structures, shut = loop.open(first, (*effects, *more), widen_noise)
        found = cls(name, loop, first, shut=shut)
        if loop.max_effects > 0:
            of_all = {n: e.shared_shape for n, e in structures.candidates.items()}
            found.shared = {n: shape for n, shape in of_all.items() if shape is not None}
        # What the instrument says of a shape is what a channel has heard before any other spoke.
        odds = structures.log_odds
        found.heard = {n: FromOthers(odds[n], s.low, s.high) for n, s in found.shared.items()}
        try:
            found._look(structures)
        except TimeIsUp as early:
            return cls(name, loop, first, shut=shut, stopped=early.why)
        return found

    def hear(self, others: Mapping[str, FromOthers]) -> bool:
        """Take what the others say for a prior, where that leads elsewhere; whether it does.

        Where an effect is more or less probable by it the channel is searched again; where only a shape moves, the most
        probable structures are weighed again.
        """
        before, shapes = self.structures, self.shared
        if before is None:
            return False
        then = {n: self.says[n].concluded(self.heard[n], shapes[n]) for n in others}
        now = {n: self.says[n].concluded(others[n], shapes[n]) for n in others}
        searched = any(now[n].likelier(then[n]) for n in others)
        news = {n for n in others if now[n].likelier(then[n]) or now[n].informs(then[n])}
        if not news:
            return False
        candidates, heard_before = dict(before.candidates), dict(self.heard)
        for name in news:
            self.heard[name] = heard = others[name]
            # A posterior range becomes the prior of the next round: from the others alone, so that no channel hears
            # itself.
            range_ = {shapes[name].name: (heard.low, heard.high)}
            candidates[name] = candidates[name].ranging(range_)
        after = replace(
            before,
            candidates=candidates,
            odds={n: now.log_odds for n, now in self.heard.items()},
            earlier={**before.earlier, **before.visited},
            visited={},
            expected={},
        )
        known = before.expected | {s: w.total for s, w in before.visited.items()}
        # Only a shape moved: totals of the former round, corrected by what the prior odds changed, are what to
        # expect.
        for structure, total in () if searched else known.items():
            changed = total + after.log_prior(structure) - before.log_prior(structure)
            after.expect(structure, changed)
        for structure, weighed in before.visited.items():
            if structure.effects.isdisjoint(news):
                changed = after.log_prior(structure) - before.log_prior(structure)
                after.visited[structure] = replace(weighed, log_prior=weighed.log_prior + changed)
        leaders = sorted(before.visited.values(), key=lambda w: -w.total)[:BEAM_STRUCTURES]
        try:
            self._look(after, [w.structure for w in leaders], searched)
        except TimeIsUp:
            self.heard = heard_before
            return False
        return True

    def _look(
        self, structures: Structures, again: Sequence[Structure] = (), searched: bool = True
    ) -> None:
        """Walk over structures, or weigh some again, and find what the channel says of the shared shapes by them.

        Raises:
            TimeIsUp: there was none for that; what stood before stands.
        """
        if searched:
            library, self.stopped = self.loop.look(Library(structures), again)
            structures = library.structures
        else:
            for structure in (Structure(), *again):
                deadline.current().ask()
                structures.weigh(structure)
        self.structures = structures
        self.search = self.loop.trail([self.first], structures, complete=False).search
        self.says = {n: said(structures, n, shape) for n, shape in self.shared.items()}

    def trail(self, follow: Callable[[str, SearchPath], None]) -> SearchPath:
        """The models on the way to the most probable structure."""
        if self.structures is None and self.stopped:
            return self.loop.not_searched(self.first, self.stopped)
        if self.structures is None:
            return self.loop.not_looked(self.first)
        library, to = Library(self.structures), partial(follow, self.name)
        return self.loop.to_best(self.first, library, self.shut, self.stopped, to)


def _shared(channels: Sequence[_Channel]) -> list[SharedShape]:
    """Have the channels hear each other until nothing new is said; what they say in the end."""
    shapes = {n: shape for c in channels for n, shape in c.shared.items()}
    alone: dict[str, float] = {}  # prior probability of each effect in one channel
    for c in channels:
        for n, now in c.heard.items():
            alone[n] = max(alone.get(n, 0.0), 1 / (1 + math.exp(-now.log_odds)))
    # Coordinate ascent on a joint posterior: each channel given what all others say now.
    for _ in range(ROUNDS):
        moved = []
        for c in channels:  # one by one: told all at once, they would swap opinions
            found = _said(channels, shapes, alone)
            with stage(c.name):
                moved.append(c.hear({n: found[n].from_others(c.name) for n in c.shared}))
        if not any(moved):
            break
    return list(_said(channels, shapes, alone).values())


def _said(
    channels: Sequence[_Channel], shapes: Mapping[str, Shape], alone: Mapping[str, float]
) -> dict[str, SharedShape]:
    """What the channels that can say something of each effect say of it."""
    found = {}
    for n, shape in shapes.items():
        # A share that is uniform has the mean ½: a unit has the effect twice as probably as one of its channels shows
        # it.
        says = {c.name: c.says[n] for c in channels if n in c.says}
        found[n] = SharedShape.of(n, shape, min(2 * alone[n], 0.5), says)
    return found
