"""Saved calibrations: one sealed NetCDF file of draws, mode and readings, from which all else is computed.

The file names its instrument and effects; they are resolved against what is installed. Nothing in it is evaluated. Its
seal is over its bytes; its identity, over what was fitted, is computed again from what was read.
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
from bayescal._model.model import Model
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
# What a file may raise whose seal is right and whose parts are not as they should be.
MISMATCHES = (
    *(LookupError, ValueError, TypeError, AttributeError, ArithmeticError),
    *(OSError, RuntimeError, ModelError),
)
UNKNOWNS = "unknowns"  # of a noise law of the user's own
LAW_FILE = "Give the file that defines the one it was fitted with: --effects my_law.py (in Python: run it before load)"
EFFECT_FILE = "--effects my_effects.py (in Python: load(path, effects=[…]))"
_PRIORS = {c.__name__: c for c in KINDS}
_PRIOR = re.compile(rf"\b({'|'.join(_PRIORS)})\(([^()]*)\)")


def save(calibration: Fitted, path: Path) -> Path:
    """Write a calibration to NetCDF.

    Raises:
        InputError: the place cannot be written to, or has no room.
    """
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file …nc, not {path.name!r}")
    readings = {atomic_file.storable(n): v for n, v in calibration.readings.variables().items()}
    mode = {n: np.asarray(value, float) for n, value in calibration.mode._asdict().items()}
    groups = {
        "observed_data": {"output": readings.pop("output")},
        "constant_data": readings,
        "draws": draws_group(calibration.joint),
        "mode": {n: Variable(tuple(f"{n}_{i}" for i in range(a.ndim)), a) for n, a in mode.items()},
    }
    described = json.dumps({"schema": SCHEMA, **description(calibration)})
    content = netcdf_bytes(groups, bayescal=described, bayescal_identity=identity(calibration))
    with atomic_file.replacing_for_user(path) as partial:
        atomic_file.write_sealed(content, partial)
    return path


def draws_group(draws: Draws) -> Group:
    """Return joint draws as plain vectors, from which everything else is computed."""
    return {n: Variable(("chain", "draw", f"{n}_entry"), vars(draws)[n]) for n in "xv"}


def load_calibration(
    path: Path, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> dict[str, Any]:
    """Read the fields of a calibration; see `bayescal.load`."""
    if path.is_dir():
        saved = sorted([*path.glob("*.nc"), *path.glob("*/*.nc")])
        there = " or ".join(map(str, saved[:6])) or "of which there is none"
        raise InputError(f"{path} is a folder: give the calibration in it, {there}")
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a calibration saved by bayescal (…nc)")
    content = io.BytesIO(atomic_file.verified(path, "a saved calibration", AGAIN))
    try:
        return _read(path, content, effects, instruments)
    except MISMATCHES as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{path.name} is damaged, or was changed after it was saved: {said}. {AGAIN}"
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
    described = of_today(described) if schema == SCHEMA_0_2 else described
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
    found = {
        **{name: described[name] for name in ("method", "seed", "reference")},
        "start": described.get("start", {}),
        "log_evidence": None if evidence is None else tuple(evidence),
        **{"model": model, "readings": readings, "layout": layout, "levels": levels},
        **{"joint": joint, "mode": mode._replace(indefinite=mode.indefinite > 0)},
        "verdict": replace(verdict, against=_with_codes(verdict.against, described)),
        "confounded": tuple(Confounder(**one) for one in described.get("confounded", ())),
        "form_factor": described.get("form_factor", 1.0),
        "unfound_spreads": described.get("unfound_spreads", {}),
    }
    if schema == SCHEMA and attributes.get(IDENTITY) != identity(Fitted(**found)):
        raise ValueError("its identity is not that of what it holds")
    return found


def _with_codes(said: Sequence[str], described: Mapping[str, Any]) -> tuple[str, ...]:
    codes = described.get("flag_codes", {})
    return tuple(Flag(words, *codes[words]) if words in codes else words for words in said)


def _readings_from(groups: Mapping[str, Group], described: Mapping[str, Any]) -> Measurements:
    both = {**groups["constant_data"], **groups["observed_data"]}
    held = {atomic_file.named_back(n): v for n, v in both.items() if v.dims == (ROW,) and n != ROW}
    sources = tuple(Source(**s) for s in described["sources"])
    given, flags = described.get("nominal_scale"), _with_codes(described["flags"], described)
    scale = given and NominalScale(**given)
    return Measurements.of_variables(held, sources=sources, flags=flags, scale=scale)


# what a calibration says of itself, and the model that this names --------------------------------------------------


def identity(c: Fitted) -> str:
    """SHA-256 over what was fitted, to which readings, from which seed, and the draws that came of it.

    A calibration has the same one before it is saved and after it is loaded; another fit has another.
    """
    digest = hashlib.sha256(json.dumps(description(c), sort_keys=True).encode())
    c.readings.add_to(digest)
    for draws in (c.joint.x, c.joint.v):
        digest.update(f"{draws.shape}\n".encode())
        digest.update(np.ascontiguousarray(draws, dtype="<f8").tobytes())
    return digest.hexdigest()


def sources_of(readings: Measurements) -> tuple[Source, ...]:
    """Where readings came from, as every artefact states it: files and their hashes; of arrays, that of the values."""
    if readings.sources:
        return readings.sources
    digest = hashlib.sha256()
    readings.add_to(digest)
    return (Source("arrays (hash of their values)", digest.hexdigest(), len(readings)),)


def description(c: Fitted) -> dict[str, Any]:
    """All that a calibration is but its numbers, by the names of what is installed."""
    model, readings = c.model, c.readings
    flags = (f for f in (*readings.flags, *c.verdict.against) if isinstance(f, Flag))
    own = _catalogue(model.instrument)
    # Left out where they are empty, so that identities stay what they were.
    further = {
        # Lines of the effects that were typed, from which they are made again.
        "typed": {e.name: e.basis.text for e in model.effects if isinstance(e.basis, Formula)},
        # Plausible sizes of the instrument's own effects, where these are others than its own.
        "sizes": {e.name: e.coefficients[0].size for e in model.effects if _is_resized(e, own)},
        # Effects that some structures of an average have not, if they have no size by which their draws say so.
        "averaged": [e.name for e in model.effects if e.held and e == e.averaged],
        "start": dict(c.start),
        "confounded": [one._asdict() for one in c.confounders],
        "form_factor": c.form_factor if c.form_factor != 1.0 else None,
        "unfound_spreads": c.unfound_spreads,
        # Of flags that code asks for, code and names, by their words.
        "flag_codes": {str(flag): [flag.code, *flag.of] for flag in flags},
        "nominal_scale": asdict(scale) if (scale := readings.scale) else None,
    }
    return {
        "instrument": model.instrument.name,
        "settings": dict(model.instrument.settings),
        "effects": list(model.names),
        "unknowns": {e.name: stated(e) for e in model.effects},
        "ranges": {
            e.name: {s.name: [s.low, s.high] for s in e.shapes} for e in model.effects if e.shapes
        },
        "fixed": dict(model.fixed),
        "noise": _noise_words(model.noise),
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
        **{key: value for key, value in further.items() if value},
    }


def _is_resized(e: Effect, catalogue: Mapping[str, Effect]) -> bool:
    """Whether an effect differs from the instrument's own by its plausible size alone."""
    known = catalogue.get(e.name)
    if known is None or e.coefficients in (known.coefficients, _as_before(known).coefficients):
        return bool(e.frees)
    return replace(e, coefficients=known.coefficients, shapes=known.shapes) == known


def _as_before(effect: Effect) -> Effect:
    """An effect as it was when states in which runs begin had a size and no learned spread: saved ones may have it."""
    own = (replace(c, group_sd=None) if c.initial else c for c in effect.coefficients)
    return replace(effect, coefficients=tuple(own))


def _catalogue(instrument: Instrument) -> dict[str, Effect]:
    """Every effect that an instrument offers, by name."""
    structural = [e for _, make in instrument.structures for e in make().effects]
    return {**{e.name: e for e in structural}, **instrument.known}


def stated(effect: Effect) -> str:
    """What an effect says of its unknowns: units, priors, groups, shapes."""
    return " ".join(" ".join(map(repr, (*effect.coefficients, *effect.shapes))).split())


def name_of_today(name: str) -> str:
    """The name of an unknown that may be one of 0.2.0, where a group's standard deviation was its spread."""
    return f"{name.removesuffix('.spread')}.group_sd" if name.endswith(".spread") else name


def of_today(described: dict[str, Any]) -> dict[str, Any]:
    """Return a description of 0.2 with the names of unknowns that they have now."""
    words = {n: s.replace("spread=", "group_sd=") for n, s in described["unknowns"].items()}

    def prior(match: re.Match[str]) -> str:
        """Return a prior as it says itself now, its defaults left out."""
        named = (field.split("=") for field in match[2].split(", ") if field)
        return repr(_PRIORS[match[1]](**{name: float(value) for name, value in named}))

    return {
        **described,
        "unknowns": {name: _PRIOR.sub(prior, told) for name, told in words.items()},
        "fixed": {name_of_today(name): value for name, value in described["fixed"].items()},
        "reference": {n: v for n, v in described["reference"].items() if n != "run_starts"},
    }


def _noise_words(noise: Noise) -> dict[str, Any]:
    """A noise law by the name of its class and its fields; of one that is not bayescal's own, its unknowns too."""
    found: dict[str, Any] = {"law": type(noise).__name__}
    for key, value in vars(noise).items():
        if value is False:  # files of before there was the choice hold none
            continue
        prior = type(value).__name__ in _PRIORS
        found[key] = [type(value).__name__, vars(value)] if prior else value
    if not type(noise).__module__.startswith("bayescal."):
        found[UNKNOWNS] = {name: repr(prior) for name, prior in noise.parameters().items()}
    return found


def _noise_from(path: Path, described: Mapping[str, Any]) -> Noise:
    """Return the noise law that a description names; raise InputError if it is not loaded, or another one than then."""
    name, fields = described["law"], dict[str, Any]()
    if name not in Noise.known:
        raise InputError(
            f"{path.name} was fitted with the noise law {name}, which is not loaded (there are: "
            f"{', '.join(Noise.known)}). {LAW_FILE}"
        )
    for key, value in described.items():
        if isinstance(value, list):
            prior = len(value) == 2 and isinstance(value[1], dict)
            value = _PRIORS[value[0]](**value[1]) if prior else tuple(value)
        fields[key] = value
    then = described.get(UNKNOWNS)
    try:
        law = Noise.known[name](**{k: v for k, v in fields.items() if k not in ("law", UNKNOWNS)})
        if (now := _noise_words(law).get(UNKNOWNS)) != then:
            raise TypeError(f"its unknowns were {then}; now {now}")
    except TypeError as error:
        raise InputError(
            f"{path.name} was fitted with another noise law {name} than the one given now: {error}. {LAW_FILE}"
        ) from None
    return law


def _instrument_from(path: Path, described, readings: Measurements, instruments) -> Instrument:
    """Return the instrument that a description names, tailored as it was; raise InputError if it is not there."""
    own, name = {i.name: i for i in instruments}, described["instrument"]
    if name not in (there := list(dict.fromkeys([*installed_names(), *own]))):
        raise InputError(
            f"{path.name} is a calibration of {name!r}, which is not installed (installed: "
            f"{', '.join(there)}). Install the package that offers it"
        )
    instrument = own[name] if name in own else installed_instrument(name)
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
    """The model that the description in a file names, of what is installed and what is given.

    Raises:
        InputError: an instrument, effect or noise law is not there, or is another one than then; names it.
    """
    instrument = _instrument_from(path, described, readings, instruments)
    ranges, then = described["ranges"], described["unknowns"]
    known, names = _catalogue(instrument), described["effects"]
    # Of two of one name, the instrument's and one that is given, it is the one that was fitted.
    given = {
        e.name: e
        for e in effects
        if e.name not in known or stated(e.ranging(ranges.get(e.name, {}))) == then.get(e.name)
    }
    lines = described.get("typed", {}).items()
    typed = {n: effect(line, readings=readings, instrument=instrument) for n, line in lines}
    catalogue = {**known, **given, **typed}
    for n in names:
        with suppress(ModelError):
            catalogue[n] = instrument.effect(n, catalogue)
    if missing := [n for n in names if n not in catalogue]:
        raise InputError(
            f"{path.name} uses the effect {', '.join(missing)}, which {instrument.name!r} does not have. Give the file "
            f"that defines it: {EFFECT_FILE}"
        )
    chosen = [catalogue[n].ranging(ranges.get(n, {})) for n in names]
    chosen = [b if stated(b := _as_before(e)) == then.get(e.name) else e for e in chosen]
    averaged = described.get("averaged", [])
    chosen = [e.averaged if e.name in averaged else e for e in chosen]
    model = Model(instrument, tuple(chosen), _noise_from(path, described["noise"]), ())
    for n, size in described.get("sizes", {}).items():
        model = model.resize(n, size)
    for one in model.effects:
        now, own_slot = stated(one), f", slot={one.slot!r}"  # which once stood with some
        if then[one.name].replace(own_slot, "") != now.replace(own_slot, ""):
            raise InputError(
                f"{path.name} was fitted with another effect {one.name!r} than the one given now: then "
                f"{then[one.name]}; now {now}. Give the one it was fitted with: {EFFECT_FILE}"
            )
    return replace(model, fixed=tuple(described["fixed"].items()))
