"""The loop for the channels of one unit: each searched alone, then again with what the others say of their body."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from bayescal._channels.channels import Channels
from bayescal._channels.shared_shape import MOVED, FromOthers, SharedShape, channel_says, grid
from bayescal._core.errors import InputError
from bayescal._core.progress import stage
from bayescal._discovery.calibrate import Loop
from bayescal._discovery.candidate import Candidate
from bayescal._discovery.search_path import Step, Trail
from bayescal._inference.method import Method
from bayescal._model.effect import Effect, Shape
from bayescal._model.frame import Reference
from bayescal._model.model import Model
from bayescal._readings.measurements import Measurements
from bayescal._recording.set_aside import set_aside
from bayescal._search.library import Library
from bayescal._search.structures import Structures
from bayescal._search.walk import NEAR

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
    follow: Callable[[str, Trail], None] = lambda _, __: None,
) -> Channels:
    """Calibrate the channels of one unit together: `calibrate` for each, one body for all.

    Each channel has its own effects, coefficients and noise. A shape that an instrument declares shared (the time of
    a body's lag, the moment of a jump) is one for the unit: given it, the channels are independent, and what each says
    of it is to the others a prior. The unit has such an effect or not; if it has, some share of its channels shows it.

    Args:
        models: of each channel, to begin with.
        readings: of each channel, as `read(…, outputs=[…])` gives them.
        holdout: readings kept apart, of each channel.
        follow: called with a channel's name and its trail so far, whenever that grows.
        effects, method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit, accept_conflicts: as
            `calibrate` has them; the time limit is for one search of one channel.

    Raises:
        InputError: fewer than two channels, or models, readings and holdout of different ones.
        ModelError: the readings lack what a model needs.
    """
    _refuse_different(models, readings, holdout)
    channels = []
    for name, model in models.items():
        kept = None if holdout is None else set_aside(holdout[name], keep_spikes)
        if kept is not None:
            model.require(kept)
        loop = Loop(
            set_aside(readings[name], keep_spikes),
            kept,
            method,
            seed,
            reference,
            max_effects,
            frozenset(accept_conflicts),
            time_limit,
        )
        with stage(name):
            channels.append(_Channel.begun(name, model, loop, effects, widen_noise))
    shared = _heard(channels)
    trails = {}
    for channel in channels:
        with stage(channel.name):
            trails[channel.name] = channel.trail(follow)
    return Channels(trails, tuple(shared))


def _refuse_different(models, readings, holdout) -> None:
    for given in (readings, holdout):
        if given is not None and set(given) != set(models):
            raise InputError(
                f"models are given for {', '.join(models)}; readings for {', '.join(given)}: give both for each channel"
            )
    if len(models) < 2:
        raise InputError("a unit has two channels or more: use `calibrate` for one")


@dataclass(eq=False)
class _Channel:
    """One channel: its loop, its first step, the structures weighed, and what the others say.

    Attributes:
        structures: None where nothing can be looked for.
    """

    name: str
    loop: Loop
    first: Step
    structures: Structures | None
    shut: list[Candidate]
    heard: dict[str, FromOthers]
    prior_odds: dict[str, float]
    stopped: str = ""

    @classmethod
    def begun(
        cls, name: str, model: Model, loop: Loop, effects: Sequence[Effect], widen_noise: bool
    ) -> _Channel:
        """After a first search alone."""
        loop, first = loop.begin(model)
        if first.against:
            return cls(name, loop, first, None, [], {}, {})
        loop, structures, shut = loop.open(first, effects, widen_noise)
        own = cls(name, loop, first, structures, shut, {}, dict(structures.log_odds))
        own.stopped = loop.look(Library(structures))
        return own

    def shared(self) -> dict[str, Shape]:
        """Shapes that all channels share, by the candidate that has it."""
        if self.structures is None or self.loop.max_effects == 0:
            return {}
        candidates = self.structures.candidates.items()
        return {n: e.shared_shape for n, e in candidates if e.shared_shape is not None}

    def moved_by(self, told: Mapping[str, FromOthers], shared: Mapping[str, SharedShape]) -> bool:
        """Whether the others say something else than before; then it is the prior of what is weighed from now on."""
        aside = {n for n, t in told.items() if t.aside(self._heard(shared[n]), shared[n].shape)}
        likelier = {
            n for n, t in told.items() if abs(t.log_odds - self._heard(shared[n]).log_odds) > MOVED
        }
        if self.structures is None or not aside | likelier:
            return False
        before, candidates = self.structures, dict(self.structures.candidates)
        for name in aside | likelier:
            then, now, shape = self._heard(shared[name]), told[name], shared[name].shape
            self.heard[name] = now if name in aside else then._replace(log_odds=now.log_odds)
            if name in aside:
                candidates[name] = candidates[name].ranging({shape.name: (now.low, now.high)})
        odds = {n: t.log_odds for n, t in self.heard.items()}
        after = replace(before, candidates=candidates, odds=odds, visited={}, expected={}, forms={})
        for structure, weighed in before.visited.items():
            if structure.effects.isdisjoint(aside):
                log_prior = after.log_prior(structure)
                after.visited[structure] = replace(weighed, log_prior=log_prior)
        self.structures = after
        near = sorted(before.visited.values(), key=lambda w: -w.total)
        again = [w.structure for w in near if w.total > near[0].total - NEAR]
        self.stopped = self.loop.look(Library(after), again)
        return True

    def _heard(self, shared: SharedShape) -> FromOthers:
        """What the others said of an effect when the channel was last asked; at first what the instrument says."""
        alone = FromOthers(self.prior_odds[shared.effect], shared.shape.low, shared.shape.high)
        return self.heard.get(shared.effect, alone)

    def trail(self, follow: Callable[[str, Trail], None]) -> Trail:
        """The models on the way to the most probable structure."""
        if self.structures is None:
            return self.loop.not_looked(self.first)
        return self.loop.steps_to_best(
            self.first,
            Library(self.structures),
            self.shut,
            self.stopped,
            lambda trail: follow(self.name, trail),
        )


def _heard(channels: Sequence[_Channel]) -> list[SharedShape]:
    """Have the channels hear each other until nothing new is said; what they say in the end."""
    shapes = {n: shape for channel in channels for n, shape in channel.shared().items()}
    shared: dict[str, SharedShape] = {}
    for asked in range(ROUNDS + 1):
        shared = {n: _shared(n, shape, channels) for n, shape in shapes.items()}
        moved = []
        for channel in channels if asked < ROUNDS else ():
            told = {n: shared[n].from_others(channel.name) for n in channel.shared()}
            with stage(channel.name):
                moved.append(channel.moved_by(told, shared))
        if not any(moved):
            break
    return list(shared.values())


def _shared(effect: str, shape: Shape, channels: Sequence[_Channel]) -> SharedShape:
    """What all channels that can say something of an effect say of it."""
    able = [c for c in channels if effect in c.shared()]
    found = {c.name: c.structures for c in able if c.structures is not None}
    v = grid(effect, shape, found.values())
    alone = max(1 / (1 + math.exp(-c.prior_odds[effect])) for c in able)
    says = {n: channel_says(s, effect, shape, v) for n, s in found.items()}
    return SharedShape(effect, shape, v, min(2 * alone, 0.5), says)
