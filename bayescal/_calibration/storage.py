"""Saved calibrations: one NetCDF file of draws, mode and readings with a checksum.

The file names its instrument and effects, which are resolved against what is installed; nothing in it is evaluated. The
checksum is over its bytes; the identity, a hash of the fit's content, is recomputed on loading.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
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
from bayescal._core.json_shape import parsed_json
from bayescal._core.netcdf import Group, Variable, netcdf_bytes, netcdf_groups
from bayescal._data.column import NominalScale, Source
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Draws, Verdict
from bayescal._model.effect import READING, Effect
from bayescal._model.formula import Formula, effect
from bayescal._model.installed import installed_instrument, installed_names
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, format_model
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import bind
from bayescal._model.prior import KINDS
from bayescal._tables.raw_table import ROW
from bayescal._tables.unpacked import refuse_hdf5

AGAIN = "Take a copy, or fit the readings again"
IDENTITY = "bayescal_identity"
SCHEMA = "bayescal.calibration/2"
SCHEMA_0_2 = "bayescal.calibration/1"  # with all groups of ArviZ's tree, which are computed now
GROUPS = ("observed_data", "constant_data", "draws", "mode")
# Errors raised by a file with a valid checksum and inconsistent parts.
MISMATCHES = (
    *(LookupError, ValueError, TypeError, AttributeError, ArithmeticError),
    *(OSError, RuntimeError, ModelError),
)
UNKNOWNS = "unknowns"  # of a user-defined noise law
LAW_FILE = "Give the file that defines the one it was fitted with: --effects my_law.py (in Python: run it before load)"
EFFECT_FILE = "--effects my_effects.py (in Python: load(path, effects=[…]))"
_PRIORS = {c.__name__: c for c in KINDS}
_PRIOR = re.compile(rf"\b({'|'.join(_PRIORS)})\(([^()]*)\)")


def save(calibration: Fitted, path: Path) -> Path:
    """Write a calibration to NetCDF; raise InputError if that fails, or the disk is full."""
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file …nc, not {path.name!r}")
    meaning = {c.name: c.meaning or c.name for c in calibration.model.instrument.columns}
    readings = {
        atomic_file.encode_name(n): v._replace(attrs={**v.attrs, "long_name": meaning.get(n, n)})
        for n, v in calibration.readings.variables().items()
    }
    mode = {n: np.asarray(value, float) for n, value in calibration.mode._asdict().items()}
    groups = {
        "observed_data": {"output": readings.pop("output")},
        "constant_data": readings,
        "draws": draws_group(calibration.joint),
        "mode": {n: Variable(tuple(f"{n}_{i}" for i in range(a.ndim)), a) for n, a in mode.items()},
    }
    described = json.dumps({"schema": SCHEMA, **description(calibration)})
    ids = {"bayescal": described, "bayescal_identity": identity(calibration)}
    title = format_model(calibration.model)
    content = netcdf_bytes(groups, Conventions="CF-1.11", title=title, **ids)
    with atomic_file.replacing_for_user(path) as partial:
        atomic_file.write_sealed(content, partial)
    return path


def draws_group(draws: Draws) -> Group:
    """Return joint draws as a NetCDF group."""
    return {n: Variable(("chain", "draw", f"{n}_entry"), vars(draws)[n]) for n in "xv"}


def load_calibration(
    path: Path, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> dict[str, Any]:
    """Read the fields of a calibration; see `bayescal.load`."""
    if path.is_dir():
        saved = sorted([*path.glob("*.nc"), *path.glob("*/*.nc")])
        candidates = " or ".join(map(str, saved[:6])) or "of which there is none"
        raise InputError(f"{path} is a folder: give the calibration in it, {candidates}")
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a calibration saved by bayescal (…nc)")
    content = io.BytesIO(atomic_file.read_sealed(path, "a saved calibration", AGAIN))
    try:
        return _read(path, content, effects, instruments)
    except MISMATCHES as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{path.name} is damaged, or was changed after it was saved: {reason}. {AGAIN}"
        ) from None


def _read(
    path: Path, content: io.BytesIO, effects: Sequence[Effect], instruments: Sequence[Instrument]
) -> dict[str, Any]:
    import h5py  # a tenth of a second that only a saved calibration needs

    with h5py.File(content) as hdf5:
        refuse_hdf5(hdf5, path.name, content.getbuffer().nbytes)
        described = parsed_json(hdf5.attrs.get("bayescal", "{}"))
    if (schema := described.get("schema")) not in (SCHEMA, SCHEMA_0_2):
        raise InputError(
            f"{path.name} is no calibration of this version: its schema is {schema!r}, expected {SCHEMA!r}"
        )
    described = current_description(described) if schema == SCHEMA_0_2 else described
    groups, attributes = netcdf_groups(content, GROUPS)
    readings = _readings_from(groups, described)
    model = model_from(path, described, readings, effects, instruments)
    model.require(readings)
    bound, levels = bind(model, readings, reference=described["reference"])
    layout = replace(bound, promoted=tuple(described["promoted"]))
    joint = Draws(**{n: groups["draws"][n].values for n in "xv"})
    sizes, expected = [joint.x.shape[-1], joint.v.shape[-1]], [layout.size, len(layout.hypers)]
    if sizes != expected:
        raise ValueError(f"its draws are of {sizes} unknowns, its model has {expected}")
    mode = Mode(**{n: groups["mode"][n].values for n in Mode._fields})
    verdict = Verdict.read(described["verdict"])
    evidence = described["log_evidence"]
    fields = {
        **{name: described[name] for name in ("method", "seed", "reference")},
        "start": described.get("start", {}),
        "log_evidence": None if evidence is None else tuple(evidence),
        **{"model": model, "readings": readings, "layout": layout, "levels": levels},
        **{"joint": joint, "mode": mode._replace(indefinite=mode.indefinite > 0)},
        "verdict": replace(verdict, against=_flagged(verdict.against, described)),
        "confounded": tuple(Confounder(**values) for values in described.get("confounded", ())),
        "form_factor": described.get("form_factor", 1.0),
        "unfound_spreads": described.get("unfound_spreads", {}),
    }
    if schema == SCHEMA and attributes.get(IDENTITY) != identity(Fitted(**fields)):
        raise ValueError("its identity is not that of what it holds")
    return fields


def _flagged(messages: Sequence[str], described: Mapping[str, Any]) -> tuple[str, ...]:
    codes = described.get("flag_codes", {})
    return tuple(Flag(words, *codes[words]) if words in codes else words for words in messages)


def _readings_from(groups: Mapping[str, Group], described: Mapping[str, Any]) -> Measurements:
    both = {**groups["constant_data"], **groups["observed_data"]}
    columns = {
        atomic_file.decode_name(n): v for n, v in both.items() if v.dims == (ROW,) and n != ROW
    }
    sources = tuple(Source(**s) for s in described["sources"])
    nominal, flags = (described.get("nominal_scale"), _flagged(described["flags"], described))
    scale = nominal and NominalScale(**nominal)
    return Measurements.of_variables(columns, sources=sources, flags=flags, scale=scale)


def identity(c: Fitted) -> str:
    """Return the SHA-256 of a fit's model, readings, seed and draws.

    It is the same before saving and after loading.
    """
    digest = hashlib.sha256(json.dumps(description(c), sort_keys=True).encode())
    c.readings.add_to(digest)
    for draws in (c.joint.x, c.joint.v):
        digest.update(f"{draws.shape}\n".encode())
        digest.update(np.ascontiguousarray(draws, dtype="<f8").tobytes())
    return digest.hexdigest()


def sources_of(readings: Measurements) -> tuple[Source, ...]:
    """Return the readings' sources: files and their hashes; for arrays, the hash of their values."""
    if readings.sources:
        return readings.sources
    digest = hashlib.sha256()
    readings.add_to(digest)
    return (Source("arrays (hash of their values)", digest.hexdigest(), len(readings)),)


def description(c: Fitted) -> dict[str, Any]:
    """Describe a calibration without its arrays; effects and instruments by name."""
    model, readings = c.model, c.readings
    flags = (f for f in (*readings.flags, *c.verdict.against) if isinstance(f, Flag))
    offered = _catalogue(model.instrument)
    # Omitted where empty, so that identities of earlier versions are unchanged.
    optional = {
        # Formulas of typed effects, from which they are rebuilt.
        "typed": {e.name: e.basis.text for e in model.effects if isinstance(e.basis, Formula)},
        # Plausible sizes of catalogue effects, where changed.
        "sizes": {e.name: e.coefficients[0].size for e in model.effects if _is_resized(e, offered)},
        # Averaged effects whose draws do not show which structures include them: they have no coefficients.
        "averaged": [e.name for e in model.effects if e.held and e == e.averaged],
        "start": dict(c.start),
        "confounded": [confounder._asdict() for confounder in c.confounders],
        "form_factor": c.form_factor if c.form_factor != 1.0 else None,
        "unfound_spreads": c.unfound_spreads,
        # Code and names of flags, by their words.
        "flag_codes": {str(flag): [flag.code, *flag.subjects] for flag in flags},
        "nominal_scale": asdict(scale) if (scale := readings.scale) else None,
    }
    return {
        "instrument": model.instrument.name,
        "settings": dict(model.instrument.settings),
        "effects": list(model.names),
        "unknowns": {e.name: unknowns_of(e) for e in model.effects},
        "ranges": {
            e.name: {s.name: [s.low, s.high] for s in e.shapes} for e in model.effects if e.shapes
        },
        "fixed": dict(model.fixed),
        "noise": _noise_fields(model.noise),
        "promoted": list(c.layout.promoted),
        "counts": {**dict(c.layout.counts), READING: len(readings)},
        "levels": {k: list(v) for k, v in c.levels.items()},
        "reference": c.reference,
        "method": c.method,
        "seed": c.seed,
        "log_evidence": c.log_evidence,
        "verdict": asdict(c.verdict),
        "sources": [asdict(s) for s in readings.sources],
        "flags": list(readings.flags),
        **{key: value for key, value in optional.items() if value},
    }


def _is_resized(e: Effect, catalogue: Mapping[str, Effect]) -> bool:
    """Return whether an effect differs from the instrument's own in plausible size only."""
    plain = catalogue.get(e.name)
    if plain is None or e.coefficients in (plain.coefficients, _unlearned(plain).coefficients):
        return bool(e.frees)
    return replace(e, coefficients=plain.coefficients, shapes=plain.shapes) == plain


def _unlearned(effect: Effect) -> Effect:
    """Return an effect as of files whose initial states had a size and no learned standard deviation."""
    coefficients = (replace(c, group_sd=None) if c.initial else c for c in effect.coefficients)
    return replace(effect, coefficients=tuple(coefficients))


def _catalogue(instrument: Instrument) -> dict[str, Effect]:
    """Return every effect that an instrument offers, by name."""
    structural = [e for _, make in instrument.structures for e in make().effects]
    return {**{e.name: e for e in structural}, **instrument.known}


def unknowns_of(effect: Effect) -> str:
    """Return the text of an effect's unknowns: units, priors, groups, shapes."""
    return " ".join(" ".join(map(repr, (*effect.coefficients, *effect.shapes))).split())


def current_name(name: str) -> str:
    """Return an unknown's current name; in 0.2.0 a group's standard deviation was called spread."""
    return f"{name.removesuffix('.spread')}.group_sd" if name.endswith(".spread") else name


def current_description(described: dict[str, Any]) -> dict[str, Any]:
    """Convert a description of version 0.2 to current names of unknowns."""
    words = {n: s.replace("spread=", "group_sd=") for n, s in described["unknowns"].items()}

    def prior(match: re.Match[str]) -> str:
        """Return a prior's current text, without defaults."""
        named = (field.split("=") for field in match[2].split(", ") if field)
        return repr(_PRIORS[match[1]](**{name: float(value) for name, value in named}))

    return {
        **described,
        "unknowns": {name: _PRIOR.sub(prior, text) for name, text in words.items()},
        "fixed": {current_name(name): value for name, value in described["fixed"].items()},
        "reference": {n: v for n, v in described["reference"].items() if n != "run_starts"},
    }


def _noise_fields(noise: Noise) -> dict[str, Any]:
    """Return a noise law's class name and fields; for a user-defined law, its unknowns too."""
    fields: dict[str, Any] = {"law": type(noise).__name__}
    for key, value in vars(noise).items():
        if value is False:  # absent from earlier files
            continue
        prior = type(value).__name__ in _PRIORS
        fields[key] = [type(value).__name__, vars(value)] if prior else value
    if not type(noise).__module__.startswith("bayescal."):
        fields[UNKNOWNS] = {name: repr(prior) for name, prior in noise.parameters().items()}
    return fields


def _noise_from(path: Path, described: Mapping[str, Any]) -> Noise:
    """Rebuild a described noise law; raise InputError if it is not loaded, or has changed."""
    name, fields = described["law"], dict[str, Any]()
    if name not in Noise.registry:
        raise InputError(
            f"{path.name} was fitted with the noise law {name}, which is not loaded (there are: "
            f"{', '.join(Noise.registry)}). {LAW_FILE}"
        )
    for key, value in described.items():
        if isinstance(value, list):
            prior = len(value) == 2 and isinstance(value[1], dict)
            value = _PRIORS[value[0]](**value[1]) if prior else tuple(value)
        fields[key] = value
    then = described.get(UNKNOWNS)
    try:
        kept = {k: v for k, v in fields.items() if k not in ("law", UNKNOWNS)}
        law = Noise.registry[name](**kept)
        if (now := _noise_fields(law).get(UNKNOWNS)) != then:
            raise TypeError(f"its unknowns were {then}; now {now}")
    except TypeError as error:
        raise InputError(
            f"{path.name} was fitted with another noise law {name} than the one given now: {error}. {LAW_FILE}"
        ) from None
    return law


def _instrument_from(path: Path, described, readings: Measurements, instruments) -> Instrument:
    """Rebuild a described instrument with its settings; raise InputError if it is not installed."""
    supplied, name = {i.name: i for i in instruments}, described["instrument"]
    if name not in (available := list(dict.fromkeys([*installed_names(), *supplied]))):
        raise InputError(
            f"{path.name} is a calibration of {name!r}, which is not installed (installed: "
            f"{', '.join(available)}). Install the package that offers it"
        )
    instrument = supplied[name] if name in supplied else installed_instrument(name)
    if not (settings := described["settings"]):
        return instrument
    try:
        if instrument.tailor is None:
            raise TypeError("it takes none")
        return instrument.tailor(readings, **settings)
    except TypeError as error:
        raise InputError(
            f"{path.name}: the installed {name!r} cannot be made with {settings} ({error}). Install "
            "the version that the calibration was made with"
        ) from None


def model_from(path: Path, described, readings: Measurements, effects, instruments) -> Model:
    """Rebuild a file's model; raise InputError naming an instrument, effect or law that is missing or has changed."""
    instrument = _instrument_from(path, described, readings, instruments)
    ranges, then = described["ranges"], described["unknowns"]
    offered, names = _catalogue(instrument), described["effects"]
    # A given effect replaces the instrument's of the same name only if it is the fitted one.
    given_effects = {
        e.name: e
        for e in effects
        if e.name not in offered
        or unknowns_of(e.ranging(ranges.get(e.name, {}))) == then.get(e.name)
    }
    lines = described.get("typed", {}).items()
    typed = {n: effect(line, readings=readings, instrument=instrument) for n, line in lines}
    catalogue = {**offered, **given_effects, **typed}
    for n in names:
        with suppress(ModelError):
            catalogue[n] = instrument.effect(n, catalogue)
    if missing := [n for n in names if n not in catalogue]:
        raise InputError(
            f"{path.name} uses the effect {', '.join(missing)}, which {instrument.name!r} does not have. Give the file "
            f"that defines it: {EFFECT_FILE}"
        )
    chosen = [catalogue[n].ranging(ranges.get(n, {})) for n in names]
    chosen = [b if unknowns_of(b := _unlearned(e)) == then.get(e.name) else e for e in chosen]
    averaged = described.get("averaged", [])
    chosen = [e.averaged if e.name in averaged else e for e in chosen]
    model = Model(instrument, tuple(chosen), _noise_from(path, described["noise"]), ())
    for n, size in described.get("sizes", {}).items():
        model = model.resize(n, size)
    for used in model.effects:
        now, own_slot = unknowns_of(used), f", slot={used.slot!r}"  # in some earlier files
        if then[used.name].replace(own_slot, "") != now.replace(own_slot, ""):
            raise InputError(
                f"{path.name} was fitted with another effect {used.name!r} than the one given now: then "
                f"{then[used.name]}; now {now}. Give the one it was fitted with: {EFFECT_FILE}"
            )
    return replace(model, fixed=tuple(described["fixed"].items()))
