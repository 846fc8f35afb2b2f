"""Saved calibrations: one NetCDF file of draws, mode and readings with a checksum.

The file names its instrument and effects, which are resolved among installed ones; no code in it is evaluated. The
checksum is over the bytes of the file; the identity, a hash of the fit's content, is recomputed on loading.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._calibration.confounding import Confounder
from bayescal._calibration.fitted import Fitted
from bayescal._core import atomic_file
from bayescal._core.errors import InputError, ModelError
from bayescal._core.flag import Flag
from bayescal._core.json_data import parse_json
from bayescal._core.netcdf import Group, Variable, decode_netcdf, encode_netcdf
from bayescal._data.column import NominalScale, Source
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Draws, Verdict
from bayescal._model.effect import Effect
from bayescal._model.formula import Formula, effect
from bayescal._model.installed import list_installed, load_instrument
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, format_model
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import bind
from bayescal._model.prior import PRIORS
from bayescal._tables.raw_table import ROW
from bayescal._tables.unpacked import refuse_hdf5

REPAIR_ADVICE = "Give the file that fit or calibrate saved (--out), or a backup of it"
IDENTITY = "bayescal_identity"
SCHEMA = "bayescal.calibration/2"
GROUPS = ("observed_data", "constant_data", "draws", "mode")
# Fields of a calibration that are stored unchanged.
STORED_FIELDS = ("method", "seed", "reference", "start", "form_factor", "unfound_spreads")
# Errors raised by a file with a valid checksum and inconsistent parts.
PARSE_ERRORS = (
    *(LookupError, ValueError, TypeError, AttributeError, ArithmeticError),
    *(OSError, RuntimeError, ModelError),
)
UNKNOWNS = "unknowns"  # key of a user-defined noise model's priors
NOISE_ADVICE = "Give the file that defines it: --effects my_law.py (in Python: run it before load)"
EFFECT_ADVICE = "--effects my_effects.py (in Python: load(path, effects=[…]))"
_PRIOR_CLASSES = {c.__name__: c for c in PRIORS}


def save(calibration: Fitted, path: Path) -> Path:
    """Write a calibration to NetCDF (*.nc) and return the path; raise InputError for another suffix or a full disk."""
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file *.nc, not {path.name!r}")
    titles = {c.name: c.meaning or c.name for c in calibration.model.instrument.columns}
    readings = {
        atomic_file.encode_name(n): v._replace(attrs={**v.attrs, "long_name": titles.get(n, n)})
        for n, v in calibration.readings.variables().items()
    }
    mode = {n: np.asarray(value, float) for n, value in calibration.mode._asdict().items()}
    draws = vars(calibration.joint)
    groups = {
        "observed_data": {"output": readings.pop("output")},
        "constant_data": readings,
        "draws": {n: Variable(("chain", "draw", f"{n}_entry"), draws[n]) for n in "xv"},
        "mode": {n: Variable(tuple(f"{n}_{i}" for i in range(a.ndim)), a) for n, a in mode.items()},
    }
    metadata = json.dumps({"schema": SCHEMA, **describe(calibration)})
    attributes = {"bayescal": metadata, "bayescal_identity": identity(calibration)}
    title = format_model(calibration.model)
    content = encode_netcdf(groups, Conventions="CF-1.11", title=title, **attributes)
    with atomic_file.replace_user_file(path) as partial_path:
        atomic_file.write_sealed(content, partial_path)
    return path


def load_calibration(
    path: Path, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> dict[str, Any]:
    """Return the fields of a saved calibration, by name; arguments and errors are those of `bayescal.load`."""
    if not path.is_file():
        problem = f"{path} is a folder" if path.is_dir() else f"there is no file {path}"
        raise InputError(f"{problem}: give a calibration saved by bayescal, such as calibration.nc")
    content = io.BytesIO(atomic_file.read_sealed(path, "a saved calibration", REPAIR_ADVICE))
    try:
        return _read_netcdf(path, content, effects, instruments)
    except PARSE_ERRORS as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{path.name} is damaged, or was changed after it was saved: {reason}. {REPAIR_ADVICE}"
        ) from None


def _read_netcdf(
    path: Path, content: io.BytesIO, effects: Sequence[Effect], instruments: Sequence[Instrument]
) -> dict[str, Any]:
    import h5py  # loading takes a tenth of a second

    with h5py.File(content) as hdf5:
        refuse_hdf5(hdf5, path.name, content.getbuffer().nbytes)
        metadata = parse_json(hdf5.attrs.get("bayescal", "{}"))
    if (schema := metadata.get("schema")) != SCHEMA:
        raise InputError(
            f"{path.name} is not a calibration of this version: its schema is {schema!r}, not {SCHEMA!r}. Load it with "
            "the version that saved it, or repeat the calibration"
        )
    groups, attributes = decode_netcdf(content, GROUPS)
    readings = _restore_readings(groups, metadata)
    model = restore_model(path, metadata, readings, effects, instruments)
    model.require(readings)
    full_layout, levels = bind(model, readings, reference=metadata["reference"])
    layout = replace(full_layout, promoted=tuple(metadata["promoted"]))
    draws = Draws(**{n: groups["draws"][n].values for n in "xv"})
    actual, expected = (draws.x.shape[-1], draws.v.shape[-1]), (layout.size, len(layout.hypers))
    if actual != expected:
        text = "{} coefficients and {} hyper-parameters".format
        raise ValueError(f"its draws have {text(*actual)}, but its model has {text(*expected)}")
    mode = Mode(**{n: groups["mode"][n].values for n in Mode._fields})
    verdict, log_evidence = Verdict.read(metadata["verdict"]), metadata["log_evidence"]
    fields = {
        **{name: metadata[name] for name in STORED_FIELDS},
        "log_evidence": log_evidence and tuple(log_evidence),
        **{"model": model, "readings": readings, "layout": layout, "levels": levels},
        **{"joint": draws, "mode": mode._replace(indefinite=mode.indefinite > 0)},
        "verdict": replace(verdict, against=_restore_flags(verdict.against, metadata)),
        "confounded": tuple(Confounder(**values) for values in metadata["confounded"]),
    }
    if attributes.get(IDENTITY) != identity(Fitted(**fields)):
        raise ValueError("its stored SHA-256 is not that of its content (was a noise law changed?)")
    return fields


def _restore_flags(messages: Sequence[str], metadata: Mapping[str, Any]) -> tuple[str, ...]:
    codes = metadata["flag_codes"]
    return tuple(Flag(text, *codes[text]) if text in codes else text for text in messages)


def _restore_readings(groups: Mapping[str, Group], metadata: Mapping[str, Any]) -> Measurements:
    variables = {**groups["constant_data"], **groups["observed_data"]}
    columns = {
        atomic_file.decode_name(n): v for n, v in variables.items() if v.dims == (ROW,) and n != ROW
    }
    sources = tuple(Source(**s) for s in metadata["sources"])
    nominal_scale, flags = metadata["nominal_scale"], _restore_flags(metadata["flags"], metadata)
    scale = nominal_scale and NominalScale(**nominal_scale)
    return Measurements.from_variables(columns, sources=sources, flags=flags, scale=scale)


def identity(calibration: Fitted) -> str:
    """Return the SHA-256 of a fit's model, readings, seed and draws, which saving and loading do not change."""
    digest = hashlib.sha256(json.dumps(describe(calibration), sort_keys=True).encode())
    calibration.readings.add_to(digest)
    for draws in (calibration.joint.x, calibration.joint.v):
        digest.update(f"{draws.shape}\n".encode())
        digest.update(np.ascontiguousarray(draws, dtype="<f8").tobytes())
    return digest.hexdigest()


def list_sources(readings: Measurements) -> tuple[Source, ...]:
    """Return the readings' source files with their hashes; for arrays, the hash of their values."""
    if readings.sources:
        return readings.sources
    digest = hashlib.sha256()
    readings.add_to(digest)
    return (Source("arrays (hash of their values)", digest.hexdigest(), len(readings)),)


def describe(calibration: Fitted) -> dict[str, Any]:
    """Return the fields of a calibration except its arrays, for JSON; instrument and effects by name."""
    model, readings = calibration.model, calibration.readings
    flags = (f for f in (*readings.flags, *calibration.verdict.against) if isinstance(f, Flag))
    known = _collect_instrument_effects(model.instrument)
    return {
        **{name: getattr(calibration, name) for name in STORED_FIELDS},
        "instrument": model.instrument.name,
        "settings": dict(model.instrument.settings),
        "effects": list(model.names),
        "unknowns": {e.name: format_unknowns(e) for e in model.effects},
        "ranges": {
            e.name: {s.name: [s.low, s.high] for s in e.shapes} for e in model.effects if e.shapes
        },
        # Formulas of typed effects, from which these are restored.
        "typed": {e.name: e.basis.text for e in model.effects if isinstance(e.basis, Formula)},
        # Changed prior standard deviations of catalogue effects.
        "sizes": {e.name: e.coefficients[0].size for e in model.effects if _is_resized(e, known)},
        # Averaged effects without coefficients, whose inclusion the draws do not show.
        "averaged": [e.name for e in model.effects if e.constant_indices and e == e.averaged],
        "fixed": dict(model.fixed),
        "noise": _collect_noise_fields(model.noise),
        "promoted": list(calibration.layout.promoted),
        "log_evidence": calibration.log_evidence,
        "confounded": [confounder._asdict() for confounder in calibration.confounders],
        "verdict": asdict(calibration.verdict),
        "sources": [asdict(s) for s in readings.sources],
        "nominal_scale": asdict(scale) if (scale := readings.scale) else None,
        "flags": list(readings.flags),
        # Code and names of flags, by their text.
        "flag_codes": {str(flag): [flag.code, *flag.subjects] for flag in flags},
    }


def _is_resized(effect: Effect, catalogue: Mapping[str, Effect]) -> bool:
    """Return whether an effect differs from that of the catalogue only in its prior standard deviation."""
    default = catalogue.get(effect.name)
    if default is None or effect.coefficients == default.coefficients:
        return bool(effect.frees)
    return replace(effect, coefficients=default.coefficients, shapes=default.shapes) == default


def _collect_instrument_effects(instrument: Instrument) -> dict[str, Effect]:
    """Return every effect of an instrument's structures and catalogue, by name."""
    structural_effects = [e for _, make in instrument.structures for e in make().effects]
    return {**{e.name: e for e in structural_effects}, **instrument.known}


def format_unknowns(effect: Effect) -> str:
    """Format an effect's coefficients and shapes (nonlinear parameters): units, priors, groups."""
    return " ".join(" ".join(map(repr, (*effect.coefficients, *effect.shapes))).split())


def _collect_noise_fields(noise: Noise) -> dict[str, Any]:
    """Return a noise model's class name and fields; for a user-defined one also its priors."""
    fields: dict[str, Any] = {"law": type(noise).__name__}
    for key, value in vars(noise).items():
        is_prior = type(value).__name__ in _PRIOR_CLASSES
        fields[key] = [type(value).__name__, vars(value)] if is_prior else value
    if not type(noise).__module__.startswith("bayescal."):
        fields[UNKNOWNS] = {name: repr(prior) for name, prior in noise.parameters().items()}
    return fields


def _restore_noise(path: Path, metadata: Mapping[str, Any]) -> Noise:
    """Restore a noise model from its fields; raise InputError if its class is not loaded."""
    name, fields = metadata["law"], dict[str, Any]()
    if name not in Noise.registry:
        raise InputError(
            f"{path.name} was fitted with the noise law {name}, which is not loaded (loaded: "
            f"{', '.join(Noise.registry)}). {NOISE_ADVICE}"
        )
    for key, value in metadata.items():
        if isinstance(value, list):
            is_prior = len(value) == 2 and isinstance(value[1], dict)
            value = _PRIOR_CLASSES[value[0]](**value[1]) if is_prior else tuple(value)
        fields[key] = value
    return Noise.registry[name](**{k: v for k, v in fields.items() if k not in ("law", UNKNOWNS)})


def _restore_instrument(path: Path, metadata, readings: Measurements, instruments) -> Instrument:
    """Restore an instrument with its settings; raise InputError if it is not installed."""
    by_name, name = {i.name: i for i in instruments}, metadata["instrument"]
    if name not in (known_names := list(dict.fromkeys([*list_installed(), *by_name]))):
        raise InputError(
            f"{path.name} is a calibration of {name!r}, which is not installed (installed: "
            f"{', '.join(known_names)}). Install the package that provides it"
        )
    instrument = by_name[name] if name in by_name else load_instrument(name)
    if not (settings := metadata["settings"]):
        return instrument
    if instrument.tailor is None:
        raise ValueError(f"the installed {name!r} takes no settings, such as {settings}")
    return instrument.tailor(readings, **settings)


def restore_model(path: Path, metadata, readings: Measurements, effects, instruments) -> Model:
    """Restore a file's model; raise InputError naming an instrument, effect or noise model missing or changed."""
    instrument = _restore_instrument(path, metadata, readings, instruments)
    ranges, saved_unknowns = metadata["ranges"], metadata["unknowns"]
    names, formulas = metadata["effects"], metadata["typed"].items()
    typed = {n: effect(line, readings=readings, instrument=instrument) for n, line in formulas}
    catalogue = {**_collect_instrument_effects(instrument), **{e.name: e for e in effects}, **typed}
    for n in names:
        with suppress(ModelError):
            catalogue[n] = instrument.effect(n, catalogue)
    if missing := [n for n in names if n not in catalogue]:
        raise InputError(
            f"{path.name} uses effects that instrument {instrument.name!r} does not have: {', '.join(missing)}. Give "
            f"the file that defines them: {EFFECT_ADVICE}"
        )
    model_effects = [catalogue[n].with_ranges(ranges.get(n, {})) for n in names]
    model_effects = [e.averaged if e.name in metadata["averaged"] else e for e in model_effects]
    model = Model(instrument, tuple(model_effects), _restore_noise(path, metadata["noise"]), ())
    for n, size in metadata["sizes"].items():
        model = model.resize(n, size)
    for user_effect in model.effects:
        if saved_unknowns[user_effect.name] != (new_unknowns := format_unknowns(user_effect)):
            raise InputError(
                f"{path.name} was fitted with another definition of the effect {user_effect.name!r}: saved "
                f"{saved_unknowns[user_effect.name]}; given {new_unknowns}. Give the saved definition: {EFFECT_ADVICE}"
            )
    return replace(model, fixed=tuple(metadata["fixed"].items()))
