"""The loop for the channels of one unit: each searched with what those before it say of their body, then all again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scipy.special import expit

from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.formatting import number, probability, with_error
from bayescal._core.progress import stage
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, plain_table
from bayescal._core.settings import seed_of, settings
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._inference import memory
from bayescal._inference.method import Method
from bayescal._model.effect import Effect, Shape
from bayescal._model.frame import Reference
from bayescal._model.model import Model
from bayescal._search.calibrate import Loop, prepared
from bayescal._search.library import Library
from bayescal._search.search_path import SearchPath
from bayescal._search.shared_shape import FromOthers, ShapeEvidence, SharedShape, evidence_of
from bayescal._search.structures import Structure, Structures, Weighed
from bayescal._search.walk import BEAM_STRUCTURES

MAX_ROUNDS = 3  # of hearing the others, at most
Follow = Callable[[str, SearchPath], None]
# Error of a new run over that of the readings as fitted, from which both are shown.
APART_RATIO = 1.1


@renamed(trails="search_paths")
@dataclass(frozen=True, repr=False)
class Channels(Printed):
    """What `calibrate_channels` gives."""

    # of each channel, by name: its models, errors, findings and last calibration
    search_paths: Mapping[str, SearchPath]
    shared: tuple[SharedShape, ...]  # what the channels say of each effect whose shape they share

    @property
    def ok(self) -> bool:
        """Return whether every channel's result is reliable."""
        return all(trail.ok for trail in self.search_paths.values())

    if TYPE_CHECKING:

        def save(self, folder: Path) -> None:
            """Write all results to a folder; `save_search.py` attaches it."""

    @property
    def reason(self) -> str:
        """Return why some are not, channel by channel; empty if all are."""
        return " ".join(f"{n}: {t.gate.reason}" for n, t in self.search_paths.items() if not t.ok)

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the effects of all channels' last models, in the order of the models."""
        models = (t.final.calibration.model for t in self.search_paths.values())
        return tuple(dict.fromkeys(n for model in models for n in model.names))

    def _parts(self) -> list[str | ResultTable]:
        laws = (t.final.calibration.model.noise.law for t in self.search_paths.values())
        rows = self._errors()
        for name in self.effects:
            sizes = (_size(trail, name) for trail in self.search_paths.values())
            cells = ("–" if mean is None else with_error(mean, sd) for mean, sd in sizes)
            rows.append([name, *cells])
        rows.append(["noise", *laws])
        parts: list[str | ResultTable] = [plain_table(["", *self.search_paths], rows)]
        parts += [_shared_text(s) for s in self.shared if s.probability > 0.5]
        # Of a search that ended early; one that could not begin is not reliable, which is said.
        searches = {n: t.search for n, t in self.search_paths.items() if t.search is not None}
        parts += [f"{n}: {s.stopped}" for n, s in searches.items() if not s.complete]
        against = {n: t.gate.reason for n, t in self.search_paths.items() if not t.ok}
        return [*parts, *(f"{n}: result not reliable: {why}" for n, why in against.items())]

    def _brief(self) -> str:
        return f"{', '.join(self.search_paths)}; effects {', '.join(self.effects) or 'none'}"

    def _columns(self) -> dict[str, list[Any]]:
        """Return a row for each channel's last model: errors in its unit, mean sizes of effects in theirs."""
        finals = [trail.final for trail in self.search_paths.values()]
        return {
            "channel": list(self.search_paths),
            "unit": [s.calibration.unit for s in finals],
            "as fitted, first model": [t.steps[0].rmse_fitted for t in self.search_paths.values()],
            "as fitted, last": [s.rmse_fitted for s in finals],
            "new run, last": [s.rmse for s in finals],
            "held out": [s.holdout_rmse for s in finals],
            "noise floor": [s.noise_floor for s in finals],
            **{e: [_size(t, e)[0] for t in self.search_paths.values()] for e in self.effects},
            "noise": [s.calibration.model.noise.law for s in finals],
        }

    def _errors(self) -> list[list[str]]:
        trails, columns = self.search_paths.values(), self._columns()
        row_names = ["as fitted, first model", "as fitted, last"]
        if any(t.final.rmse > APART_RATIO * t.final.rmse_fitted for t in trails):
            row_names.append("new run, last")
        if any(t.holdout is not None for t in trails):
            row_names += ["held out, first", "held out, last"]
            columns["held out, first"] = [t.steps[0].holdout_rmse for t in trails]
            columns["held out, last"] = columns["held out"]
        rows = [[name, *map(number, columns[name])] for name in (*row_names, "noise floor")]
        return [["unit", *map(unit_label, columns["unit"])], *rows]


def _size(trail: SearchPath, name: str) -> tuple[float | None, float]:
    """Return an effect's posterior mean and standard deviation; None and 0 where the model lacks it."""
    model = trail.final.calibration.model
    if name not in model.names:
        return None, 0.0
    effect = model.effect(name)
    size = effect.measure_name or effect.coefficient_name(0)
    draws = trail.calibration.samples(size)
    return float(draws.mean()), float(draws.std())


def _shared_text(s: SharedShape) -> str:
    """Return one line on an effect that the channels share."""
    (middle, low, high), unit = s.posterior, unit_label(s.shape.unit)
    strong = [n for n in s.says if s.evidence(n) > settings().strong_evidence]
    showing = ", ".join(strong) or "none alone"
    return (
        f"{s.effect}: the unit has it with probability {probability(s.probability)}, {s.shape.name} "
        f"{number(middle)} {unit} (95 %: {number(low)} to {number(high)}), shown by {showing}"
    )


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
    seed: Any = 0,
    reference: Reference | None = None,
    time_limit: float | None = None,
    accept_conflicts: Collection[str] = (),
    ignore: Collection[str] = (),
    covariates: Collection[str] | None = None,
    follow: Follow = lambda _, __: None,
) -> Channels:
    """Calibrate the channels of one unit together: `calibrate` for each, one body for all.

    Each channel has its own effects, coefficients and noise. A shape that an instrument declares shared (the time of
    a body's lag, the moment of a step) is one for the unit: given it, the channels are independent, and what each says
    of it is to the others a prior. The unit has such an effect or not; if it has, some share of its channels shows it.

    Args:
        models: of each channel, to begin with.
        readings: of each channel, as `read(…, outputs=[…])` gives them.
        holdout: hold-out data, of each channel.
        follow: called with a channel's name and its trail so far, as `calibrate` calls it.
        effects, method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit, accept_conflicts, ignore,
            covariates: as `calibrate` has them. Whenever the search ends, every channel is there, with the most
            probable structure that was evaluated of it: the first model, where there was no time for others.

    Raises:
        InputError: fewer than two channels, or models, readings and holdout of different ones.
        ModelError: the readings lack what a model needs.
    """
    for records in (readings, holdout):
        if records is not None and set(records) != set(models):
            raise InputError(
                f"models are given for {', '.join(models)}; readings for {', '.join(records)}: "
                "give both for each channel"
            )
    if len(models) < 2:
        raise InputError("a unit has two channels or more: use `calibrate` for one")
    channels, count, trails = list[_Channel](), len(models), dict[str, SearchPath]()
    with deadline.until(time_limit):
        for i, (name, model) in enumerate(models.items(), 1):
            pair = readings[name], None if holdout is None else holdout[name]
            used = prepared(model, *pair, keep_spikes, ignore, covariates)
            how = method, seed_of(seed), reference, max_effects
            loop = Loop(*used, *how, frozenset(accept_conflicts))
            with stage(f"{name}, channel {i} of {count}"):
                loop.begin(model, effects, widen_noise)
            channels.append(_Channel(name, loop))
            follow(name, loop.trail())
        unit = _Unit(channels)
        for i, c in enumerate(channels):
            with stage(c.name), deadline.sooner(1 / (2 * count - i)):
                c.begin(unit.from_others(c))
                c.loop.look(lambda c=c: follow(c.name, c.loop.trail()))
                with suppress(deadline.TimeIsUp):
                    c.evaluate_shapes()
        shared = unit.shared()
        with suppress(deadline.TimeIsUp), deadline.sooner(1 / 2):
            for name in unit.exchange_evidence():
                follow(name, unit.channels[name].loop.trail())
                shared = unit.shared()
        for i, c in enumerate(channels):
            with stage(f"{c.name}, channel {i + 1} of {count}"), deadline.sooner(1 / (count - i)):
                trails[c.name] = c.loop.to_best(partial(follow, c.name))
            memory.trim()
    return Channels(trails, tuple(shared.values()))


@dataclass(eq=False)
class _Channel:
    """One channel: its search, and what it and the others say of what they share."""

    name: str
    loop: Loop
    # shapes that all channels share, as the instrument states them, by the candidate that has it
    shared: Mapping[str, Shape] = field(default_factory=dict)
    # what the others said of these when it was last asked; at first what the instrument says
    heard: dict[str, FromOthers] = field(default_factory=dict)
    # what it says of them itself, by the structures evaluated; empty until it is asked
    says: dict[str, ShapeEvidence] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.loop.library is not None and self.loop.max_effects > 0:
            structures = self.loop.structures
            of_all = ((n, e.shared_shape) for n, e in structures.candidates.items())
            self.shared = {n: shape for n, shape in of_all if shape is not None}
            for n, s in self.shared.items():
                self.heard[n] = FromOthers(structures.log_odds[n], s.low, s.high)

    def begin(self, others: Mapping[str, FromOthers]) -> None:
        """Take what the channels searched before say for a prior of the first search."""
        if self.loop.library is not None:
            self.heard |= others
            self.loop = replace(
                self.loop, library=Library(self._conditioned_on(self.heard, others))
            )

    def hear(self, others: Mapping[str, FromOthers]) -> bool:
        """Take what the others say for a prior, where that leads elsewhere; return whether it does.

        Where an effect is more or less probable by it the channel is searched again; where only a shape moves, the most
        probable structures are weighed again. Without time TimeIsUp is raised, and what stood before stands.
        """
        if self.loop.library is None:
            return False
        before, searched, news = self.loop.library.structures, False, set[str]()
        for n, shape in self.shared.items():
            now, then = (self.says[n].conclude(o, shape) for o in (others[n], self.heard[n]))
            likelier, changed = now.changed(then)
            searched, news = searched or likelier, news | {n} if changed else news
        if not news:
            return False
        # Where the shape says nothing new its range stays; all odds are what the others say now.
        ranges = {n: {"low": h.low, "high": h.high} for n, h in self.heard.items() if n not in news}
        heard = {n: others[n]._replace(**ranges.get(n, {})) for n in self.shared}
        earlier = {**before.earlier, **before.visited}
        after = replace(self._conditioned_on(heard, news), earlier=earlier)

        def odds_changed(s: Structure) -> float:
            return after.log_prior(s) - before.log_prior(s)

        def corrected(w: Weighed, gain: float = 0.0) -> Weighed:
            log_prior = w.log_prior + odds_changed(w.structure)
            return replace(w, log_prior=log_prior, log_evidence=w.log_evidence + gain)

        same = (w for s, w in before.visited.items() if s.effects.isdisjoint(news))
        after.visited.update({w.structure: corrected(w) for w in same})
        leaders, gained = sorted(before.visited.values(), key=lambda w: -w.total), {}
        for weighed in reversed(leaders[:BEAM_STRUCTURES]):
            deadline.current().ask()
            now = after.weigh(weighed.structure)
            gained[now.structure.effects & news] = now.log_evidence - weighed.log_evidence
        after.weigh(Structure())
        # Totals of the former round are what to expect: with what the prior odds changed, and with what the shape's
        # range changed in the most probable structure that has the same of the effects.
        for s, weighed in earlier.items():
            earlier[s] = corrected(weighed, gained.get(s.effects & news, 0.0))
            after.expect(s, earlier[s].total)
        for s in before.expected.keys() - earlier.keys():
            gain = odds_changed(s) + gained.get(s.effects & news, 0.0)
            after.expect(s, before.expected[s] + gain)
        loop = replace(self.loop, library=Library(after))
        if searched:
            loop.look()
            if loop.stopped:
                raise deadline.TimeIsUp(loop.stopped)
        self.loop, self.heard = loop, heard
        self.evaluate_shapes()
        return True

    def _conditioned_on(self, heard: Mapping[str, FromOthers], news: Collection[str]) -> Structures:
        """Return the channel's structures, none evaluated, by what the others say; only shapes of `news` range anew."""
        before = self.loop.structures
        candidates = dict(before.candidates)
        for name in news:
            # A posterior range becomes the next prior: from the others alone, so that no channel hears itself.
            range_ = {self.shared[name].name: (heard[name].low, heard[name].high)}
            candidates[name] = candidates[name].ranging(range_)
        odds = {n: now.log_odds for n, now in heard.items()}
        return replace(before, candidates=candidates, odds=odds, visited={}, expected={})

    def evaluate_shapes(self) -> None:
        """Evaluate what the channel says of each shared shape, by its evaluated structures."""
        evidence = ((n, evidence_of(self.loop.structures, n, s)) for n, s in self.shared.items())
        self.says = dict(evidence)


class _Unit:
    """The channels that share shapes, and what all say of each."""

    def __init__(self, channels: Sequence[_Channel]) -> None:
        self.channels = {c.name: c for c in channels}
        self.shapes = {n: shape for c in channels for n, shape in c.shared.items()}
        # A uniform share has the mean ½: a unit has an effect twice as probably as one of its channels shows it.
        alone = ((n, 2 * expit(now.log_odds)) for c in channels for n, now in c.heard.items())
        self.prior = {n: min(float(p), 0.5) for n, p in sorted(alone)}

    def shared(self) -> dict[str, SharedShape]:
        """Return the combined evidence of the channels searched on each shared shape, by effect."""
        shared = {}
        for n, shape in self.shapes.items():
            if says := {c.name: c.says[n] for c in self.channels.values() if n in c.says}:
                shared[n] = SharedShape.of(n, shape, self.prior[n], says)
        return shared

    def from_others(self, channel: _Channel) -> dict[str, FromOthers]:
        """Return what the other channels say of each effect whose shape a channel shares with them."""
        shared = self.shared()
        return {n: shared[n].from_others(channel.name) for n in channel.shared if n in shared}

    def exchange_evidence(self) -> Iterator[str]:
        """Have the channels hear each other until nothing new is said; yield the name of each that changed."""
        for c in self.channels.values():
            if not c.says:  # there was no time yet
                c.evaluate_shapes()
        # Coordinate ascent on a joint posterior, one by one: told all at once, they would swap opinions.
        for _ in range(MAX_ROUNDS):
            changed = False
            for c in self.channels.values():
                with stage(c.name):
                    moved = c.hear(self.from_others(c))
                if moved:
                    changed = True
                    yield c.name
            if not changed:
                break
