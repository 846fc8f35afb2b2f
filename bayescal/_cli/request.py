"""What the options ask for: an instrument, a model, readings, a method.

A bad file is refused first, before the instrument loads, and JAX with it; no sampler loads here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import bayescal as bc
from bayescal._cli.console import print_notes
from bayescal._cli.options import METHODS, ModelOptions, ReadRequest, SearchRequest, named_numbers
from bayescal._core.errors import InputError
from bayescal._data.read import read
from bayescal._model.installed import FileColumns, file_columns
from bayescal._search.own_files import (
    in_a_file,
    instrument_named,
    known_instrument,
    user_effects,
)

if TYPE_CHECKING:
    from bayescal._data.measurements import Measurements
    from bayescal._inference.method import Method
    from bayescal._model.effect import Effect
    from bayescal._model.frame import Reference
    from bayescal._model.instrument import Instrument
    from bayescal._model.model import Model
    from bayescal._model.noise_law import Noise

Early = tuple[Any, FileColumns | None]  # readings, or None; and by which columns they were read
LONG_LOG = 20_000  # readings, beyond which means over short times say as much and are sooner done
LONG = 50_000_000  # bytes of files that take longer to read than an instrument takes to load


def open_request(
    asked: ReadRequest, early: Early | None = None
) -> tuple[Instrument, Model, Measurements]:
    """Instrument, model and readings that are asked for; the instrument tailored to the readings.

    Args:
        asked: what is.
        early: what `read_early` gave, where it was called already.

    Raises:
        InputError, ModelError: something in it cannot be used; says what.
    """
    general, readings = _opened(asked, early)
    own = {effect.name: effect for effect in user_effects(asked.choice.effects_file)}
    model = general.baseline() if asked.choice.typed else compose(general, asked.choice, own)
    asked.columns.keep()
    if asked.average is None:
        print_notes(long_log(readings))
    readings = averaged(readings, asked.average, asked.keep_spikes)
    tailored = general.for_readings(readings)
    if tailored is not general or asked.choice.typed:
        own |= {e.name: e for e in typed_effects(asked.choice.typed, tailored, readings)}
        model = compose(tailored, asked.choice, own)
    return tailored, model, readings


def own_effects(
    choice: ModelOptions, instrument: Instrument, readings: Measurements
) -> tuple[Effect, ...]:
    """Effects of the user's own: of a file, and typed.

    Raises:
        InputError: the file fails, or a formula is none; the place is marked.
    """
    return (*user_effects(choice.effects_file), *typed_effects(choice.typed, instrument, readings))


def typed_effects(
    typed: Sequence[str] | None, instrument: Instrument, readings: Measurements | None
) -> tuple[Effect, ...]:
    """The effects that --effect gives.

    Raises:
        InputError: a formula is none, its units do not go together, or a size is missing; the place is marked.
    """
    return tuple(bc.effect(line, readings=readings, instrument=instrument) for line in typed or ())


def open_channels(
    names: Sequence[str], asked: ReadRequest, early: Early | None = None
) -> tuple[Instrument, dict[str, Model], dict[str, Measurements]]:
    """Instrument, models and readings of the channels of one unit; a model has it tailored to its readings.

    Raises:
        InputError, ModelError: something in it cannot be used; says what.
    """
    general, read_ = _opened(asked, early, outputs=list(names))
    own = {effect.name: effect for effect in user_effects(asked.choice.effects_file)}
    asked.columns.keep()
    if asked.average is None:
        print_notes(dict.fromkeys(note for one in read_.values() for note in long_log(one)))
    readings = {n: averaged(one, asked.average, asked.keep_spikes) for n, one in read_.items()}
    models: dict[str, Model] = {}
    for n, one in readings.items():
        tailored = general.for_readings(one)
        typed = {e.name: e for e in typed_effects(asked.choice.typed, tailored, one)}
        models[n] = compose(tailored, asked.choice, own | typed)
    return general, models, readings


def _opened(asked: ReadRequest, early: Early | None = None, **more: Any) -> tuple[Instrument, Any]:
    """The instrument, and what `read` gives; a file that cannot be used is refused before the instrument loads."""
    found, holds = read_early(asked, **more) if early is None else early
    general = instrument_named(asked.instrument)
    if found is not None and holds == FileColumns.of(general):
        return general, found
    return general, read(list(asked.files), general, **asked.columns.for_read(), **more)


def read_early(asked: ReadRequest, **more: Any) -> Early:
    """What `read` gives before the instrument loads, and by which columns; None where that cannot be, or takes long.

    Raises:
        InputError: a file cannot be used, or no instrument is of that name.
    """
    files, how = list(asked.files), {**asked.columns.for_read(), **more}
    holds = (
        None if in_a_file(asked.instrument) else file_columns(known_instrument(asked.instrument))
    )
    short = sum(path.stat().st_size for path in files if path.is_file()) <= LONG
    return (read(files, holds, **how) if holds and short else None), holds


def open_kept(instrument: Instrument, asked: SearchRequest) -> Measurements | None:
    """Hold-out data, averaged as the others are; None where there are none."""
    if not asked.holdout:
        return None
    readings = read(list(asked.holdout), instrument, **asked.columns.for_read())
    return averaged(readings, asked.average, asked.keep_spikes)


def open_kept_channels(
    names: Sequence[str], general: Instrument, asked: SearchRequest
) -> dict[str, Measurements] | None:
    """The same of the channels of one unit."""
    if not asked.holdout:
        return None
    readings = read(list(asked.holdout), general, **asked.columns.for_read(), outputs=list(names))
    return {n: averaged(one, asked.average, asked.keep_spikes) for n, one in readings.items()}


def averaged(
    readings: Measurements, average: str | None, keep_spikes: bool = False
) -> Measurements:
    """The means that --average asks for; clipped readings and spikes are set aside before, for a mean hides them."""
    if average is None:
        return readings
    from bayescal._data.set_aside import set_aside

    return set_aside(readings, keep_spikes).average(average)


def long_log(readings: Measurements) -> list[str]:
    """A sentence that proposes --average, where there are more readings than a calibration has use for."""
    if len(readings) <= LONG_LOG or not readings.has("time"):
        return []
    steps = np.diff(readings["time"])
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    least = usual * max(10.0, len(readings) / LONG_LOG)  # ten readings to a mean, and a short log
    power = math.floor(math.log10(least)) if usual else 0
    step = next((r for m in (1, 2, 5, 10) if (r := m * 10.0**power) >= least * (1 - 1e-9)), least)
    means = f"{float(f'{len(readings) * usual / step:.2g}'):,.0f}"
    return [
        f"{readings.file}: {len(readings):,} readings: --average {step:g}s would leave about {means} "
        "with nearly the same information"
    ] * (usual > 0)


def compose(instrument: Instrument, choice: ModelOptions, own: Mapping[str, Effect]) -> Model:
    """The model that is asked for: a structure or the baseline, effects added, coefficients fixed."""
    model = (
        structure_named(instrument, choice.structure) if choice.structure else instrument.baseline()
    )
    for name in choice.add or []:
        model = model + own.get(name, name)
    return model.fix(named_numbers(choice.fix, "--fix"))


def structure_named(instrument: Instrument, name: str) -> Model:
    """A model structure of an instrument.

    Raises:
        InputError: it has none of that name.
    """
    structures = dict(instrument.structures)
    if name not in structures:
        raise InputError(
            f"instrument {instrument.name!r} has no structure {name!r}; "
            f"it has: {', '.join(structures)}"
        )
    return structures[name]()


def structure_with(instrument: Instrument, text: str, own: Sequence[Effect]) -> Model:
    """A structure with effects added to it: "line+bias.thermal_lag"."""
    first, *added = (part.strip() for part in text.split("+"))
    model, known = structure_named(instrument, first), {effect.name: effect for effect in own}
    for name in added:
        model = model + known.get(name, name)
    return model


def law_named(name: str, model: Model, readings: Measurements) -> Noise:
    """A noise law by its name: the model's own, or one of those that a search would weigh on these readings.

    Raises:
        InputError: there is none of that name; says which there are.
    """
    from bayescal._model.frame import build_frame
    from bayescal._model.frame import reference_of as constants_of
    from bayescal._search.noise_laws import laws_over

    frame = build_frame(readings, constants_of(readings))
    laws = {model.noise.name: model.noise, **laws_over(model, frame)}
    if name not in laws:
        raise InputError(
            f"--noise {name!r}: for this model and these readings there are {', '.join(laws)}. A law of your own is "
            "offered by its file: --effects my_law.py"
        )
    return laws[name]


def method_named(name: str) -> Method:
    """A method with its standard settings, by its name on the command line."""
    return getattr(bc, METHODS[name])()


def reference_of(given: list[str] | None, readings: Measurements) -> Reference:
    """The constants of the bases that the user sets with --reference.

    Raises:
        InputError: these readings have no such constant.
    """
    from bayescal._model.frame import reference_of as constants_of

    reference = named_numbers(given, "--reference")
    known = [n for n, value in constants_of(readings).items() if not isinstance(value, dict)]
    for name in reference:
        if name not in known:
            raise InputError(
                f"--reference {name}: the bases of these readings have no constant {name!r}; "
                f"they have: {', '.join(known)}"
            )
    return dict(reference)
