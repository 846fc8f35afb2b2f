"""Stepwise search for the channels of a unit: one after another, then again under priors from all other channels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

from scipy.special import expit

from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.formatting import WIDTH, format_value, number, probability
from bayescal._core.parallel import release_memory
from bayescal._core.progress import track
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, make_table
from bayescal._core.settings import settings, to_seed
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.method import Method
from bayescal._model.effect import Effect, Shape
from bayescal._model.frame import Reference
from bayescal._model.model import Model
from bayescal._search.calibrate import StepwiseSearch, prepare_readings
from bayescal._search.library import Library
from bayescal._search.search_path import SearchPath
from bayescal._search.shared_shape import CavityPrior, ShapeEvidence, SharedShape, evaluate_shape
from bayescal._search.structures import EvaluatedStructure, Structure, Structures
from bayescal._search.walk import BEAM_STRUCTURES

MAX_ROUND_COUNT = 3  # of message passing between the channels, at most
Follow = Callable[[str, SearchPath], None]
# Ratio of the error of a new run to the error as fitted, above which both are printed.
NEW_RUN_RATIO = 1.1


@renamed(trails="search_paths")
@dataclass(frozen=True, repr=False)
class Channels(Printed):
    """Searches of all channels and the evidence on shared shapes; the result of `calibrate_channels`."""

    search_paths: Mapping[str, SearchPath]  # of each channel, by name
    shared: tuple[SharedShape, ...]  # evidence of all channels on each effect with a shared shape
    # Method that writes all results to a folder; attached by `save_search.py`.
    save: ClassVar[Callable[..., None]]

    @property
    def ok(self) -> bool:
        """Return whether every channel's result is reliable."""
        return all(path.ok for path in self.search_paths.values())

    @property
    def reason(self) -> str:
        """Return the reasons why results are not reliable, by channel; empty if all are reliable."""
        return " ".join(f"{n}: {t.gate.reason}" for n, t in self.search_paths.items() if not t.ok)

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the effects of all channels' last models, in the order of the models."""
        calibrations = (t.final.calibration for t in self.search_paths.values())
        return tuple(dict.fromkeys(n for c in calibrations for n in c.model.names))

    def _list_parts(self) -> list[str | ResultTable]:
        parts = [part for table in _split_table(self._list_rows()) for part in (table, "")][:-1]
        parts += [_format_shared(s) for s in self.shared if s.probability > 0.5]
        searches = ((n, t.search) for n, t in self.search_paths.items() if t.search)
        parts += [f"{n}: {s.stopped}" for n, s in searches if not s.complete]
        doubtful_gates = ((n, t.gate) for n, t in self.search_paths.items() if not t.ok)
        return [*parts, *(f"{n}: result not reliable: {gate.reason}" for n, gate in doubtful_gates)]

    def _format_summary(self) -> str:
        return f"{', '.join(self.search_paths)}; effects {', '.join(self.effects) or 'none'}"

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return columns by name, an entry per channel: errors, and effects' mean sizes in the last model."""
        last_steps = [path.final for path in self.search_paths.values()]
        return {
            "channel": list(self.search_paths),
            "unit": [s.calibration.unit for s in last_steps],
            "as fitted, first model": [t.steps[0].rmse_fitted for t in self.search_paths.values()],
            "as fitted, last": [s.rmse_fitted for s in last_steps],
            "new run, last": [s.rmse for s in last_steps],
            "held out, first": [t.steps[0].holdout_rmse for t in self.search_paths.values()],
            "held out, last": [s.holdout_rmse for s in last_steps],
            "noise floor": [s.noise_floor for s in last_steps],
            **{e: [_size(t, e)[0] for t in self.search_paths.values()] for e in self.effects},
            "noise": [s.calibration.model.noise.law for s in last_steps],
        }

    def _list_rows(self) -> list[list[str]]:
        """Return the printed rows, with a column for each channel; the first row is the header."""
        paths, columns = self.search_paths.values(), self._list_columns()
        has_new_run = any(p.final.rmse > NEW_RUN_RATIO * p.final.rmse_fitted for p in paths)
        has_holdout = any(p.holdout is not None for p in paths)
        names = ["as fitted, first model", "as fitted, last", *["new run, last"] * has_new_run]
        names += [*["held out, first", "held out, last"] * has_holdout, "noise floor"]
        rows = [["", *self.search_paths], ["unit", *map(unit_label, columns["unit"])]]
        rows += [[name, *map(number, columns[name])] for name in names]
        for name in self.effects:
            sizes = (_size(path, name) for path in paths)
            rows.append([name, *("–" if m is None else format_value(m, sd) for m, sd in sizes)])
        return [*rows, ["noise", *columns["noise"]]]


def _split_table(rows: Sequence[Sequence[str]]) -> Iterator[ResultTable]:
    """Split a table into tables of as many channels as fit the page, each with the row names and the header row."""
    name_width, *widths = (2 + max(map(len, column)) for column in zip(*rows, strict=True))
    count = max(1, (WIDTH + 2 - name_width) // max(widths))
    for i in range(1, len(rows[0]), count):
        header, *body_rows = ([row[0], *row[i : i + count]] for row in rows)
        yield make_table(header, body_rows)


def _size(path: SearchPath, name: str) -> tuple[float | None, float]:
    """Return the posterior mean and standard deviation of an effect's size; (None, 0) if the model lacks it."""
    model = path.final.calibration.model
    if name not in model.names:
        return None, 0.0
    effect = model.effect(name)
    draws = path.calibration.samples(effect.measure_name or effect.coefficient_name(0))
    return float(draws.mean()), float(draws.std())


def _format_shared(s: SharedShape) -> str:
    """Format the result for an effect whose shape the channels share, in one line."""
    (median, low, high), unit = s.posterior, unit_label(s.shape.unit)
    strong_names = [n for n in s.log_ratios if s.log_bayes_factor(n) > settings().strong_evidence]
    channel_text = ", ".join(strong_names) or "no single channel"
    return (
        f"{s.effect}: probability {probability(s.probability)} that the device has it; {s.shape.name} "
        f"{number(median)} {unit} (95 %: {number(low)} to {number(high)}); strong evidence in {channel_text}"
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
    """Calibrate the output channels of one device (unit) together, by one search for each.

    Each channel has its own effects, coefficients and noise. A shape parameter that the instrument declares shared (the
    time constant of a lag, the time of a step) is common to the unit: given it, channels are independent, and the
    evidence of each is a prior for the others. If the unit has such an effect, an unknown fraction of channels has it.

    Args:
        models: first model of each channel, by name.
        readings: readings of each channel, as `read(…, outputs=[…])` gives them.
        holdout: hold-out data of each channel.
        follow: called with a channel's name and its search path so far, as `calibrate` calls it.
        effects, method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit, accept_conflicts, ignore,
            covariates: as in `calibrate`. If the search ends early, each channel has its most probable evaluated
            structure, which is the first model if there was no time for others.

    Raises:
        InputError: models, readings and holdout have different channels.
        ModelError: the readings lack what a model needs.
    """
    for kind, records in (("readings", readings), ("hold-out data", holdout)):
        if records is not None and set(records) != set(models):
            raise InputError(
                f"models are given for {', '.join(models)}; {kind} for {', '.join(records)}: "
                "give both for each channel"
            )
    channels, count, paths = list[_Channel](), len(models), dict[str, SearchPath]()
    with deadline.limit(time_limit):
        for i, (name, model) in enumerate(models.items(), 1):
            pair = readings[name], None if holdout is None else holdout[name]
            clean_records = prepare_readings(model, *pair, keep_spikes, ignore, covariates)
            options = method, to_seed(seed), reference, max_effects
            search = StepwiseSearch(*clean_records, *options, frozenset(accept_conflicts))
            with track(f"{name}, channel {i} of {count}"):
                search.fit_first_step(model, effects, widen_noise)
            channels.append(_Channel(name, search))
            follow(name, search.build_path())
        unit = _Unit(channels)
        for i, c in enumerate(channels):
            with track(c.name), deadline.shorten(1 / (2 * count - i)):
                c.set_first_prior(unit.cavity_priors(c))
                c.search.run_search(lambda c=c: follow(c.name, c.search.build_path()))
                with suppress(deadline.TimeIsUp):
                    c.evaluate_shapes()
            release_memory()
        shared_shapes = unit.combine_evidence()
        with suppress(deadline.TimeIsUp), deadline.shorten(1 / 2):
            for name in unit.propagate_evidence():
                release_memory()
                follow(name, unit.channels[name].search.build_path())
                shared_shapes = unit.combine_evidence()
        for i, c in enumerate(channels):
            with track(f"{c.name}, channel {i + 1} of {count}"), deadline.shorten(1 / (count - i)):
                path = paths[c.name] = c.search.fit_path(partial(follow, c.name))
            for calibration in {*(step.calibration for step in path.steps), path.calibration}:
                calibration.clear_cache()
            release_memory()
    return Channels(paths, tuple(shared_shapes.values()))


@dataclass(eq=False)
class _Channel:
    """One channel: its search, its evidence on the shared shapes, and its prior from the other channels."""

    name: str
    search: StepwiseSearch
    # shapes that all channels share, with the instrument's priors, by candidate
    shared: Mapping[str, Shape] = field(default_factory=dict)
    # priors of these in the channel's last search; at first the instrument's
    prior_from_others: dict[str, CavityPrior] = field(default_factory=dict)
    # the channel's own evidence on these, from its evaluated structures; empty until computed
    evidence: dict[str, ShapeEvidence] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.search.library is not None and self.search.max_effects > 0:
            structures = self.search.structures
            all_shapes = ((n, e.shared_shape) for n, e in structures.candidates.items())
            self.shared = {n: shape for n, shape in all_shapes if shape is not None}
            for n, s in self.shared.items():
                self.prior_from_others[n] = CavityPrior(structures.log_odds[n], s.low, s.high)

    def set_first_prior(self, priors: Mapping[str, CavityPrior]) -> None:
        """Set the prior of the first search from the channels searched before."""
        if self.search.library is not None:
            self.prior_from_others |= priors
            structures = self._set_priors(self.prior_from_others, priors)
            self.search = replace(self.search, library=Library(structures))

    def update_prior(self, priors: Mapping[str, CavityPrior]) -> bool:
        """Update the prior from the other channels where it changes the posterior; return whether it does.

        If the probability of an effect changes, the channel is searched again; if only a shape changes, the most
        probable structures are evaluated again.

        Raises:
            TimeIsUp: the deadline has passed; the state before the call is kept.
        """
        if self.search.library is None:
            return False
        old, needs_search, changed_names = self.search.library.structures, False, set[str]()
        for n, shape in self.shared.items():
            pair = priors[n], self.prior_from_others[n]
            current, previous = (self.evidence[n].update(prior, shape) for prior in pair)
            is_probability_changed, is_changed = current.differs_from(previous)
            needs_search |= is_probability_changed
            changed_names |= {n} if is_changed else set()
        if not changed_names:
            return False
        # An unchanged shape keeps its prior range; all log odds are the new ones.
        ranges = {n: p[1:] for n, p in self.prior_from_others.items() if n not in changed_names}
        new_prior = {n: CavityPrior(p.log_odds, *ranges.get(n, p[1:])) for n, p in priors.items()}
        earlier = {**old.previous_round, **old.visited}
        structures = replace(self._set_priors(new_prior, changed_names), previous_round=earlier)

        def compute_prior_change(s: Structure) -> float:
            return structures.log_prior(s) - old.log_prior(s)

        def correct_fit(w: EvaluatedStructure, log_change: float = 0.0) -> EvaluatedStructure:
            log_prior = w.log_prior + compute_prior_change(w.structure)
            return replace(w, log_prior=log_prior, log_evidence=w.log_evidence + log_change)

        unchanged_fits = (w for s, w in old.visited.items() if s.effects.isdisjoint(changed_names))
        structures.visited.update({w.structure: correct_fit(w) for w in unchanged_fits})
        fits, changes = sorted(old.visited.values(), key=lambda w: -w.log_posterior), {}
        for fit in reversed(fits[:BEAM_STRUCTURES]):
            deadline.current().raise_if_over()
            current = structures.evaluate(fit.structure)
            changes[fit.structure.effects & changed_names] = current.log_evidence - fit.log_evidence
        structures.evaluate(Structure())
        # Log posteriors of the previous round, corrected by two changes: of the prior odds, and of the log evidence, as
        # in the most probable structure that has exactly these of the effects with a new range.
        for s, fit in earlier.items():
            earlier[s] = correct_fit(fit, changes.get(s.effects & changed_names, 0.0))
            structures.store_score(s, earlier[s].log_posterior)
        for s in old.scores.keys() - earlier.keys():
            log_change = compute_prior_change(s) + changes.get(s.effects & changed_names, 0.0)
            structures.store_score(s, old.scores[s] + log_change)
        search = replace(self.search, library=Library(structures))
        if needs_search:
            search.run_search()
            if search.stopped:
                raise deadline.TimeIsUp(search.stopped)
        self.search, self.prior_from_others = search, new_prior
        self.evaluate_shapes()
        return True

    def _set_priors(self, priors: Mapping[str, CavityPrior], shapes: Collection[str]) -> Structures:
        """Return the channel's structures, none evaluated, with new prior odds and new ranges of the given shapes."""
        base = self.search.structures
        candidates = dict(base.candidates)
        for name in shapes:
            # The cavity range, from the other channels alone, is the next prior: a channel's own evidence counts once.
            shape_range = {self.shared[name].name: (priors[name].low, priors[name].high)}
            candidates[name] = candidates[name].with_ranges(shape_range)
        log_odds = {n: prior.log_odds for n, prior in priors.items()}
        return replace(base, candidates=candidates, stated_log_odds=log_odds, visited={}, scores={})

    def evaluate_shapes(self) -> None:
        """Compute the channel's evidence on each shared shape from its evaluated structures."""
        shared = self.shared.items()
        self.evidence = {n: evaluate_shape(self.search.structures, n, s) for n, s in shared}
        if shared:
            self.search.structures.clear_cache()


class _Unit:
    """The channels of a unit, and the prior probabilities of the effects whose shapes they share."""

    def __init__(self, channels: Sequence[_Channel]) -> None:
        self.channels = {c.name: c for c in channels}
        self.shapes = {n: shape for c in channels for n, shape in c.shared.items()}
        # A uniform share has the mean ½: a unit has an effect twice as probably as one of its channels shows it.
        priors = (pair for c in channels for pair in c.prior_from_others.items())
        effect_priors = sorted((n, 2 * expit(prior.log_odds)) for n, prior in priors)
        self.prior = {n: min(float(p), 0.5) for n, p in effect_priors}

    def combine_evidence(self) -> dict[str, SharedShape]:
        """Return the combined evidence of the channels searched on each shared shape, by effect."""
        shared_shapes = {}
        for n, shape in self.shapes.items():
            if ratios := {c.name: c.evidence[n] for c in self.channels.values() if n in c.evidence}:
                shared_shapes[n] = SharedShape.from_evidence(n, shape, self.prior[n], ratios)
        return shared_shapes

    def cavity_priors(self, channel: _Channel) -> dict[str, CavityPrior]:
        """Return a channel's prior from the other channels, by effect whose shape it shares with them."""
        shared = self.combine_evidence()
        return {n: shared[n].cavity_prior(channel.name) for n in channel.shared if n in shared}

    def propagate_evidence(self) -> Iterator[str]:
        """Update each channel's prior from the others until none changes; yield the name of each changed channel."""
        for c in self.channels.values():
            if not c.evidence:  # there was no time yet
                c.evaluate_shapes()
        # Coordinate ascent on the joint posterior, one channel at a time: simultaneous updates would oscillate.
        for _ in range(MAX_ROUND_COUNT):
            has_changed = False
            for c in self.channels.values():
                with track(c.name):
                    is_changed = c.update_prior(self.cavity_priors(c))
                if is_changed:
                    has_changed = True
                    yield c.name
            if not has_changed:
                break
