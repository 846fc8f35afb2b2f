"""Loading of the instrument, model, readings, method, calibrations and corrections that options request.

Invalid files are refused before JAX loads; samplers and other heavy modules load with the first calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli.options import (
    DefinitionOptions,
    MemberOptions,
    MethodName,
    ReadRequest,
    SearchRequest,
    parse_numbers,
)
from bayescal._core.annex import load_entry
from bayescal._core.errors import InputError
from bayescal._core.progress import print_notes, track
from bayescal._report.whole_folder import (
    AVERAGED,
    CALIBRATION,
    CHANNELS,
    channel_folders,
    read_hashes,
    refuse_mixed,
)
from bayescal._search.own_files import instrument_named, load_user_effects

if TYPE_CHECKING:
    from bayescal._data.measurements import Measurements
    from bayescal._inference.method import Method
    from bayescal._model.effect import Effect
    from bayescal._model.instrument import Instrument
    from bayescal._model.model import Model
    from bayescal._model.noise_law import Noise
    from bayescal._report.result_json import Chapter
    from bayescal._use.compensation_program import CorrectionInUse

LONG_LOG_READINGS = 20_000  # number of readings above which averaging loses little information


def open_request(request: ReadRequest) -> tuple[Instrument, Model, Measurements]:
    """Return the requested instrument and model, both adapted to the readings, and the readings."""
    _, models, readings = open_channels((), request)
    return models[""].instrument, models[""], readings[""]


def open_channels(
    names: Sequence[str], request: ReadRequest
) -> tuple[Instrument, dict[str, Model], dict[str, Measurements]]:
    """Return the instrument, and by channel ("" if single) a model adapted to the readings, and the readings."""
    instrument = instrument_named(request.instrument)
    readings = _read(request.files, instrument, request, names)
    for record in readings.values():
        # A triad's log is averaged over its stationary intervals.
        averages = request.average is not None or instrument.outputs
        if len(record) > LONG_LOG_READINGS and record.has("time") and not averages:
            mean = f"--average TIME, means of {-(-len(record) // LONG_LOG_READINGS)} or more"
            note = f"{len(record):,} readings: {mean}, loses little information"
            print_notes([f"{record.file}: {note}"])
    models = {}
    for name, record in readings.items():
        tailored = instrument.for_readings(record)
        models[name] = compose(tailored, request, load_effects(request, tailored, record))
        flags = (f"{e.slot}: {e.source}" for e in models[name].effects if e.is_reference_error)
        readings[name] = replace(record, flags=(*record.flags, *flags))
    request.save_options()
    return instrument, models, readings


def load_effects(
    request: Any, instrument: Instrument, readings: Measurements | None
) -> tuple[Effect, ...]:
    """Return the user's effects of --effects and --effect; raise InputError for an invalid file or formula."""
    effects = (bc.effect(t, readings=readings, instrument=instrument) for t in request.typed or ())
    return (*load_user_effects(request.effects_file), *effects)


def _read(
    files: Sequence[Path], kind: Any, request: ReadRequest, names: Sequence[str], **options: Any
) -> dict[str, Measurements]:
    """Read files as readings of one output (key "") or of the channels `names`; average them if requested."""
    options |= {"outputs": list(names)} if names else {}
    with track("reading"):
        readings: Any = bc.read(list(files), kind, **request.read_options(), **options)
    records = (readings if names else {"": readings}).items()
    return {n: average_readings(r, request.average, request.keep_spikes) for n, r in records}


def average_readings(
    readings: Measurements, average: str | None, keep_spikes: bool = False
) -> Measurements:
    """Return means over the time `average`, without clipped readings and, unless kept, spikes; None: no averaging."""
    if average is None:
        return readings
    from bayescal._data.set_aside import exclude_faults

    return exclude_faults(readings, keep_spikes).average(average)


def compose(instrument: Instrument, request: Any, added: Sequence[Effect] = ()) -> Model:
    """Return the requested model: a structure or the baseline, with added effects and fixed coefficients."""
    effects = {effect.name: effect for effect in added}
    structures = {"": instrument.baseline, **dict(instrument.structures)}
    structure = request.structure or ""
    if structure not in structures:
        raise InputError(
            f"instrument {instrument.name!r} has no structure {structure!r}; "
            f"it has: {', '.join(map(repr, [*structures][1:]))}"
        )
    model = structures[structure]()
    for name in request.add or []:
        model = model + effects.get(name, name)
    for text in request.reference_dcc or []:
        column, _, path = text.rpartition("=")
        read_certificate = load_entry("reference_dcc", "--reference-dcc")
        model = model + read_certificate(path, instrument, column or "temperature")
    return model.fix(parse_numbers(request.fix, "--fix"))


def find_noise_law(name: str, model: Model, readings: Measurements) -> Noise:
    """Return a noise law by name: that of the model, or one that a search would compare for these readings."""
    from bayescal._model.frame import build_frame, reference_of
    from bayescal._search.noise_laws import list_laws

    frame = build_frame(readings, reference_of(readings))
    models = {model.noise.name: model.noise, **list_laws(model, frame)}
    if name not in models:
        raise InputError(
            f"--noise {name!r} is not one of {', '.join(models)}. For your own law, also give its file: "
            "--effects my_law.py"
        )
    return models[name]


def create_method(name: MethodName) -> Method:
    """Return the method of inference of a name on the command line, with default settings."""
    return {"marginal": bc.Marginal, "least-squares": bc.LeastSquares, "nuts": bc.NUTS}[name]()


def open_search(
    names: Sequence[str], request: SearchRequest
) -> tuple[dict[str, Model], dict[str, Measurements], dict[str, Measurements]]:
    """Return models, readings and hold-out data by channel ("" if single); print the flags of the readings."""
    instrument, models, readings = open_channels(names, request)
    holdout = {}
    if request.holdout:
        kind = instrument if names else models[""].instrument
        holdout = _read(request.holdout, kind, request, names, allow_one_temperature=True)
    print_notes(flags_of(readings))
    return models, readings, holdout


def flags_of(readings: Mapping[str, Measurements]) -> list[str]:
    """List the flags of readings, each once; a flag that not all channels have is preceded by their names."""
    names_by_flag = dict[str, list[str]]()
    for name, record in readings.items():
        for flag in record.flags:
            names_by_flag.setdefault(flag, []).append(name)
    return [
        flag if len(names) == len(readings) else f"{', '.join(names)}: {flag}"
        for flag, names in names_by_flag.items()
    ]


def split_records(readings: Mapping[str, Measurements]) -> dict[str, Measurements]:
    """Split the readings of channels by device and axis: "name, device A17" → readings."""
    from bayescal._data.header_matching import PREFIXES, normalise
    from bayescal._data.unit_conversion import is_convertible

    records = dict(readings)
    for group in ("device", "axis"):
        previous_records, records = records, {}
        for name, record in previous_records.items():
            levels, codes = record.groups(group)
            if len(levels) == 1:
                records[name] = record
                continue
            unit = record.unit(record.output) or ""
            for code, label in enumerate(levels):
                records[f"{name}, {group} {label}"] = record.select(codes == code)
                units = (k for k, words in PREFIXES.items() if normalise(label).startswith(words))
                if any(not is_convertible(kind, unit) for kind in units):
                    raise InputError(
                        f"{record.file}: the column {group!r} contains {label!r}, a sensor whose output is not in "
                        f"{unit or 'no unit'}: give the readings of each sensor in a separate file"
                    )
    return records


def describe_reliability(corrections: Mapping[str, bc.Compensator | CorrectionInUse]) -> str:
    """Return why corrections, given by name, are not fit for use; "" if all are."""
    return "; ".join(f"{name} {c.why_not}".strip() for name, c in corrections.items() if c.why_not)


def _load_user_parts(parts: DefinitionOptions) -> dict[str, Any]:
    """Load the user-defined effects and instrument, and return them as keyword arguments of `bc.load`."""
    instruments = (instrument_named(file),) if (file := parts.instrument_file) else ()
    return {"effects": load_user_effects(parts.effects_file), "instruments": instruments}


def load_saved(path: Path, user: DefinitionOptions) -> bc.Calibration:
    """Load a saved calibration.

    Args:
        path: the file, or a result folder.
        user: user-defined effects and instrument, and whether to load the average over structures, if there is one.

    Raises:
        InputError: the calibration cannot be loaded, or differs from the hash in its folder's manifest.
    """
    if (path / CHANNELS).is_file():
        raise InputError(
            f"{path} contains several channels: give the folder of one, such as {expand_channels([path])[0]}"
        )
    path = inner_path if (inner_path := path / CALIBRATION).is_file() else path
    files, structure = [path.name], getattr(user, "one_structure", "best")
    if (path.name, structure) == (CALIBRATION, "average") and AVERAGED in read_hashes(path.parent):
        files.append(AVERAGED)
    refuse_mixed(path.parent, *files)
    return bc.load(path.with_name(files[-1]), **_load_user_parts(user))


def load_compensator(path: Path, user: MemberOptions) -> bc.Compensator:
    """Load the compensator of a saved calibration; raise InputError if it has three axes."""
    correction = load_correction(path, user)
    if not isinstance(correction, bc.Compensator):
        raise InputError(
            f"{path} has three axes: use `bayescal export`, in Python bc.vector_correction, for its correction"
        )
    return correction


def load_correction(path: Path, user: MemberOptions) -> bc.Compensator | CorrectionInUse:
    """Load the correction of a saved calibration: a compensator, or a correction of three axes."""
    calibration = load_saved(path, user)
    if calibration.model.instrument.vector is None:
        return bc.compensator(calibration, members=user.members)
    return load_entry("corrected", f"{path} has three axes: their correction")(calibration)


def expand_channels(paths: list[Path], file: str = "") -> list[Path]:
    """Return paths, with each folder of several channels replaced by its subfolders, or by `file` in each."""
    folders: list[Path] = []
    for path in paths:
        is_unit = (path / CHANNELS).is_file()
        folders += [path / name / file for name in channel_folders(path)] if is_unit else [path]
    return folders


def load_chapters(paths: list[Path], user: DefinitionOptions) -> list[Chapter]:
    """Build the chapters of a report from saved calibrations and result folders."""
    from bayescal._report.result_json import chapters, read_chapter

    parts, files = _load_user_parts(user), expand_channels(paths)
    loaded = (read_chapter(p, **parts) if p.is_dir() else load_saved(p, user) for p in files)
    return chapters(loaded, parts["effects"])
