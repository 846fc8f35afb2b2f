"""What the options ask for: an instrument, a model, readings, a method; saved calibrations and what is made of them.

A bad file is refused before JAX loads; no sampler loads here, and what is heavy with the first calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli.options import (
    METHODS,
    InUse,
    OwnParts,
    ReadRequest,
    SearchRequest,
    UsedParts,
    named_numbers,
)
from bayescal._core.annex import first_offered
from bayescal._core.errors import InputError
from bayescal._core.progress import print_notes, stage
from bayescal._report.whole_folder import (
    AVERAGED,
    CALIBRATION,
    CHANNELS,
    channel_folders,
    files_of,
    refuse_mixed,
)
from bayescal._search.own_files import instrument_named, user_effects

if TYPE_CHECKING:
    from bayescal._data.measurements import Measurements
    from bayescal._inference.method import Method
    from bayescal._model.effect import Effect
    from bayescal._model.instrument import Instrument
    from bayescal._model.model import Model
    from bayescal._model.noise_law import Noise
    from bayescal._report.result_json import Chapter
    from bayescal._use.compensation_program import CorrectionInUse

LONG_LOG = 20_000  # readings, beyond which means over short times say as much and are sooner done


def open_request(asked: ReadRequest) -> tuple[Instrument, Model, Measurements]:
    """Return instrument, model and readings that are asked for; the instrument tailored to the readings."""
    _, models, readings = open_channels((), asked)
    return models[""].instrument, models[""], readings[""]


def open_channels(
    names: Sequence[str], asked: ReadRequest
) -> tuple[Instrument, dict[str, Model], dict[str, Measurements]]:
    """Return instrument, models and readings of the channels of one unit; a model has it tailored to its readings.

    Args:
        names: of the channels; none: a single output, called "".
        asked: what is.

    Raises:
        InputError, ModelError: something in it cannot be used; says what.
    """
    general = instrument_named(asked.instrument)
    found = _read(asked.files, general, asked, names)
    if not asked.typed and general.tailor is None:  # what is typed may need the readings
        compose(general, asked, user_effects(asked.effects_file))
    for one in found.values():
        # Rests are looked for in the log of a triad: it is averaged over them.
        if (
            len(one) > LONG_LOG
            and asked.average is None
            and one.has("time")
            and not general.outputs
        ):
            mean = f"--average TIME, means of {-(-len(one) // LONG_LOG)} or more"
            said = f"{len(one):,} readings: {mean}, leaves nearly the same information"
            print_notes([f"{one.file}: {said}"])
    readings = {n: averaged(one, asked.average, asked.keep_spikes) for n, one in found.items()}
    models = {}
    for name, one in readings.items():
        tailored = general.for_readings(one)
        models[name] = compose(tailored, asked, own_effects(asked, tailored, one))
    asked.keep()
    return general, models, readings


def own_effects(
    asked: Any, instrument: Instrument, readings: Measurements | None
) -> tuple[Effect, ...]:
    """Return effects of the user's own: of a file, and typed; refuse a file that fails, a formula that is none."""
    made = (bc.effect(t, readings=readings, instrument=instrument) for t in asked.typed or ())
    return (*user_effects(asked.effects_file), *made)


def _read(
    files: Sequence[Path], of: Any, asked: ReadRequest, names: Sequence[str]
) -> dict[str, Measurements]:
    outputs: dict[str, Any] = {"outputs": list(names)} if names else {}
    with stage("reading"):
        found = bc.read(list(files), of, **asked.for_read(), **outputs)
    return found if names else {"": found}  # pyright: ignore[reportReturnType]


def averaged(
    readings: Measurements, average: str | None, keep_spikes: bool = False
) -> Measurements:
    """Return the means that --average asks for; clipped readings and spikes are set aside before: a mean hides them."""
    if average is None:
        return readings
    from bayescal._data.set_aside import set_aside

    return set_aside(readings, keep_spikes).average(average)


def compose(instrument: Instrument, asked: Any, own: Sequence[Effect] = ()) -> Model:
    """Return the model that is asked for: a structure or the baseline, effects added, coefficients fixed."""
    known = {effect.name: effect for effect in own}
    structures = {"": instrument.baseline, **dict(instrument.structures)}
    chosen = asked.structure or ""
    if chosen not in structures:
        raise InputError(
            f"instrument {instrument.name!r} has no structure {chosen!r}; "
            f"it has: {', '.join([*structures][1:])}"
        )
    model = structures[chosen]()
    for name in asked.add or []:
        model = model + known.get(name, name)
    return model.fix(named_numbers(asked.fix, "--fix"))


def law_named(name: str, model: Model, readings: Measurements) -> Noise:
    """Return a noise law by its name: the model's own, or one of those that a search would weigh on these readings."""
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
    """Return a method with its standard settings, by its name on the command line."""
    return getattr(bc, METHODS[name])()


def searched(
    names: Sequence[str], asked: SearchRequest
) -> tuple[dict[str, Model], dict[str, Measurements], dict[str, Measurements]]:
    """Return models, readings and hold-out data by channel ("" where there is one output); say what is to be noted."""
    general, models, readings = open_channels(names, asked)
    kept = {}
    if asked.holdout:
        of = general if names else models[""].instrument
        found = _read(asked.holdout, of, asked, names)
        kept = {n: averaged(one, asked.average, asked.keep_spikes) for n, one in found.items()}
    print_notes(flags_of(readings))
    return models, readings, kept


def flags_of(readings: Mapping[str, Measurements]) -> list[str]:
    """Return notes on the readings of channels: what holds for all once, the others with the channel's name."""
    said = dict[str, list[str]]()
    for name, one in readings.items():
        for flag in one.flags:
            said.setdefault(flag, []).append(name)
    return [
        flag if len(names) == len(readings) else f"{', '.join(names)}: {flag}"
        for flag, names in said.items()
    ]


def each_device(readings: Mapping[str, Measurements]) -> dict[str, Measurements]:
    """Split the readings of channels by device and by axis, where a file holds several."""
    from bayescal._data.header_matching import BEGINNINGS, plain
    from bayescal._data.unit_conversion import is_convertible

    found = dict(readings)
    for group in ("device", "axis"):
        before, found = found, {}
        for name, one in before.items():
            levels, codes = one.groups(group)
            if len(levels) == 1:
                found[name] = one
                continue
            unit = one.unit(one.output) or ""
            for code, label in enumerate(levels):
                found[f"{name}, {group} {label}"] = one.select(codes == code)
                kinds = (k for k, words in BEGINNINGS.items() if plain(label).startswith(words))
                if any(not is_convertible(kind, unit) for kind in kinds):
                    raise InputError(
                        f"{one.file}: the column {group!r} names {label!r}, whose output is not in "
                        f"{unit or 'no unit'}: give the readings of each sensor in a file of their own"
                    )
    return found


# saved calibrations ---------------------------------------------------------------------------------------------------


def reliable(given: Mapping[str, bc.Compensator | CorrectionInUse]) -> dict[str, Any]:
    """Return whether what was written is of results that may be used, as an `Answer` has it."""
    told = [f"{name} {one.why_not}".strip() for name, one in given.items() if one.why_not]
    return {"ok": not told, "why": "; ".join(told)}


def _own(parts: OwnParts) -> dict[str, Any]:
    """Return the user's own effects and instrument, as `bc.load` takes them."""
    named = parts.instrument_file
    instruments = () if named is None else (instrument_named(named),)
    return {"effects": user_effects(parts.effects_file), "instruments": instruments}


def load_saved(path: Path, own: OwnParts) -> bc.Calibration:
    """Load a saved calibration, or the one of a folder of results.

    Args:
        path: of the file or folder.
        own: the user's own effects and instrument; and whether the average over structures stands for it, where the
            folder has one.

    Raises:
        InputError: it cannot be loaded, or is not the one that its folder's manifest lists.
    """
    if (path / CHANNELS).is_file():
        raise InputError(
            f"{path} holds several channels: name the folder of one, such as {of_units([path])[0]}"
        )
    path = inside if (inside := path / CALIBRATION).is_file() else path
    if isinstance(own, UsedParts) and path.name == CALIBRATION:
        if own.one_structure not in ("average", "best"):
            raise InputError(f"--structure {own.one_structure!r} is neither 'average' nor 'best'")
        refuse_mixed(path.parent, CALIBRATION)
        if own.one_structure == "average" and AVERAGED in files_of(path.parent):
            path = path.with_name(AVERAGED)
    refuse_mixed(path.parent, path.name)
    return bc.load(path, **_own(own))


def compensator_from(path: Path, own: InUse) -> bc.Compensator:
    """Return the compensator of a saved calibration of one output, or one exported as JSON."""
    found = correction_from(path, own)
    if not isinstance(found, bc.Compensator):
        raise InputError(
            f"{path} is of three axes: `bayescal export` writes its correction, in Python bc.vector_correction makes it"
        )
    return found


def correction_from(path: Path, own: InUse) -> bc.Compensator | CorrectionInUse:
    """Return what corrects readings, of one output or three axes: of a saved calibration, or exported as JSON."""
    if path.suffix.lower() == ".json":
        from bayescal._use.compensation_program import CompensationProgram
        from bayescal._use.correction_files import load_correction

        if own.member:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        found = load_correction(path)
        one = isinstance(found, CompensationProgram)
        return bc.Compensator(loaded=found) if one else found
    calibration = load_saved(path, own)
    if calibration.model.instrument.vector is None:
        return bc.compensator(calibration, members=own.members)
    return first_offered("corrected", f"{path} is of three axes: to correct them")(calibration)


def of_units(paths: list[Path], file: str = "") -> list[Path]:
    """Return a unit's channels' folders, or a file in each, in place of its folder."""
    found: list[Path] = []
    for path in paths:
        unit = (path / CHANNELS).is_file()
        found += [path / name / file for name in channel_folders(path)] if unit else [path]
    return found


def chapters_from(paths: list[Path], own: OwnParts) -> list[Chapter]:
    """Return what a report is of: saved calibrations, and folders with the search that led to one."""
    from bayescal._report.result_json import chapters, of_folder

    parts = _own(own)
    given = (of_folder(p, **parts) if p.is_dir() else load_saved(p, own) for p in of_units(paths))
    return chapters(given, parts["effects"])
