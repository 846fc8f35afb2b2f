"""What a calibration says of itself, as plain JSON; the model that this names; the identity that it has by it."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._calibration.fitted import Fitted
from bayescal._core.errors import InputError, ModelError
from bayescal._core.flag import Flag
from bayescal._data.column import Source
from bayescal._data.measurements import Measurements
from bayescal._model.effect import READING, Effect
from bayescal._model.formula import Formula, effect, line_of_today
from bayescal._model.installed import installed_instrument, installed_names
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._model.noise_law import Noise
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, LogNormal, LogUniform, Normal

UNKNOWNS = "unknowns"  # of a noise law of the user's own
LAW_FILE = "Give the file that defines the one it was fitted with: --effects my_law.py (in Python: run it before load)"
_PRIORS = {c.__name__: c for c in (Flat, HalfCauchy, HalfNormal, LogNormal, LogUniform, Normal)}


def identity(c: Fitted) -> str:
    """SHA-256 over what was fitted, to which readings, from which seed, and the draws that came of it.

    A calibration has the same one before it is saved and after it is loaded; another fit has another.
    """
    digest = hashlib.sha256(json.dumps(description(c), sort_keys=True).encode())
    c.readings.add_to(digest)
    # Between x and v stood unknowns of single readings once, as a rule none: identities stay what they were.
    for draws in (c.joint.x, np.zeros((*c.joint.x.shape[:2], len(c.readings), 0)), c.joint.v):
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
    # Of flags that code asks for, code and names, by their words; effects that some structures of an average have not,
    # of those that have no size by which their draws say so.
    flags = (f for f in (*c.readings.flags, *c.verdict.against) if isinstance(f, Flag))
    codes = {str(flag): [flag.code, *flag.of] for flag in flags}
    averaged = [e.name for e in c.model.effects if e.held and e == e.averaged]
    return {
        "schema": "bayescal.calibration/1",  # of 0.2: identities stay what they were
        "instrument": c.model.instrument.name,
        "settings": dict(c.model.instrument.settings),
        "effects": list(c.model.names),
        **({"typed": typed} if (typed := typed_effects(c.model)) else {}),
        "unknowns": {e.name: stated(e) for e in c.model.effects},
        "ranges": {
            e.name: {s.name: [s.low, s.high] for s in e.shapes} for e in c.model.effects if e.shapes
        },
        **({"sizes": sizes} if (sizes := _resized(c.model)) else {}),
        **({"averaged": averaged} if averaged else {}),
        "fixed": dict(c.model.fixed),
        "noise": _noise_words(c.model.noise),
        "promoted": list(c.layout.promoted),
        "counts": {**dict(c.layout.counts), READING: len(c.readings)},
        "levels": {k: list(v) for k, v in c.levels.items()},
        "reference": c.reference,
        "method": c.method,
        "seed": c.seed,
        **({"start": dict(c.start)} if c.start else {}),
        **({"confounded": [one._asdict() for one in c.confounders]} if c.confounders else {}),
        "log_evidence": c.log_evidence,
        "verdict": {
            k: v for k, v in asdict(c.verdict).items() if k not in ("against", "checked") or v
        },
        "sources": [
            {k: v for k, v in asdict(s).items() if k not in ("columns", "units") or v}
            for s in c.readings.sources
        ],
        "flags": list(c.readings.flags),
        **({"flag_codes": codes} if codes else {}),
        **({"nominal_scale": asdict(scale)} if (scale := c.readings.scale) else {}),
    }


def typed_effects(model: Model) -> dict[str, str]:
    """The lines of the effects that were typed, by name: data, from which they are made again."""
    return {e.name: e.basis.text for e in model.effects if isinstance(e.basis, Formula)}


def _resized(model: Model) -> dict[str, float]:
    """Plausible sizes, by effect, of the instrument's own effects where they are others than its own."""
    own = _catalogue(model.instrument)

    def resized(e: Effect) -> bool:
        known = own.get(e.name)
        if known is None or e.coefficients in (known.coefficients, _as_before(known).coefficients):
            return bool(e.frees)
        return replace(e, coefficients=known.coefficients, shapes=known.shapes) == known

    return {e.name: e.coefficients[0].size for e in model.effects if resized(e)}


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
    """A description with the names of unknowns, and the words of formulas, that they have now."""
    unknowns = {
        name: str(stated_).replace("spread=", "group_sd=")
        for name, stated_ in described.get("unknowns", {}).items()
    }
    fixed = {name_of_today(name): value for name, value in described.get("fixed", {}).items()}
    typed = {name: line_of_today(line) for name, line in described.get("typed", {}).items()}
    reference = {n: v for n, v in described.get("reference", {}).items() if n != "run_starts"}
    changed = {"unknowns": unknowns, "fixed": fixed, "typed": typed, "reference": reference}
    return described | {key: value for key, value in changed.items() if key in described}


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


def noise_from(path: Path, described: dict[str, Any]) -> Noise:
    """The noise law that the description in a file names.

    Raises:
        InputError: no law of that name is loaded, or it is another one than then; names it.
    """
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
    try:
        law = Noise.known[name](**{k: v for k, v in fields.items() if k not in ("law", UNKNOWNS)})
    except TypeError as error:
        raise InputError(
            f"{path.name} was fitted with another noise law {name} than the one given now, which cannot be made as "
            f"that was ({error}). {LAW_FILE}"
        ) from None
    then, now = described.get(UNKNOWNS), _noise_words(law).get(UNKNOWNS)
    if then != now:
        raise InputError(
            f"{path.name} was fitted with another noise law {name} than the one given now: its unknowns were {then}; "
            f"now {now}. {LAW_FILE}"
        )
    return law


def _tailored(path: Path, instrument: Instrument, settings, readings: Measurements) -> Instrument:
    """The installed instrument as the calibration's was tailored."""
    if not settings:
        return instrument
    try:
        if instrument.tailor is None:
            raise TypeError("it takes none")
        return instrument.tailor(readings, **settings)
    except TypeError as error:
        raise InputError(
            f"{path.name}: the installed {instrument.name!r} cannot be made with {settings} ({error}). Install "
            "the version that the calibration was made with"
        ) from None


def model_from(path: Path, described, readings: Measurements, effects, instruments) -> Model:
    """The model that the description in a file names, of what is installed and what is given.

    Raises:
        InputError: an instrument or effect is not there, or is another one than then; names it.
    """
    own, name = {i.name: i for i in instruments}, described["instrument"]
    if name not in (there := list(dict.fromkeys([*installed_names(), *own]))):
        raise InputError(
            f"{path.name} is a calibration of {name!r}, which is not installed (installed: "
            f"{', '.join(there)}). Install the package that offers it"
        )
    named = own[name] if name in own else installed_instrument(name)
    instrument = _tailored(path, named, described["settings"], readings)
    typed = described.get("typed", {})
    made = {n: effect(text, readings=readings, instrument=instrument) for n, text in typed.items()}
    ranges, known = described["ranges"], _catalogue(instrument)
    # Of two of one name, the instrument's and one that is given, it is the one that was fitted.
    fitted = {e.name: stated(e.ranging(ranges.get(e.name, {}))) for e in effects}
    given = [
        e
        for e in effects
        if e.name not in known or fitted[e.name] == described["unknowns"].get(e.name)
    ]
    catalogue = {**known, **{e.name: e for e in given}, **made}
    for n in described["effects"]:
        with suppress(ModelError):
            catalogue[n] = instrument.effect(n, catalogue)
    if departures := described.get("departures"):
        raise InputError(
            f"{path.name} was fitted by an earlier version, whose {', '.join(departures)} this one does not have: a "
            "curve beside an effect is unknown(…) now. Calibrate the readings again"
        )
    if missing := [n for n in described["effects"] if n not in catalogue]:
        raise InputError(
            f"{path.name} uses the effect {', '.join(missing)}, which {name!r} does not have. Give the file "
            "that defines it: --effects my_effects.py (in Python: load(path, effects=[…]))"
        )
    chosen = tuple(catalogue[n].ranging(ranges.get(n, {})) for n in described["effects"])
    then = described["unknowns"]
    chosen = tuple(b if stated(b := _as_before(e)) == then.get(e.name) else e for e in chosen)
    averaged = described.get("averaged", [])
    chosen = tuple(e.averaged if e.name in averaged else e for e in chosen)
    model = Model(instrument, chosen, noise_from(path, described["noise"]), ())
    for n, size in described.get("sizes", {}).items():
        model = model.resize(n, size)
    for one in model.effects:
        then, now = described["unknowns"][one.name], stated(one)
        if then != now:
            raise InputError(
                f"{path.name} was fitted with another effect {one.name!r} than the one given now: then {then}; "
                f"now {now}. Give the one it was fitted with: --effects my_effects.py (in Python: "
                "load(path, effects=[…]))"
            )
    return replace(model, fixed=tuple(described["fixed"].items()))
