"""What a calibration says of itself, as plain JSON; the model that this names; the identity that it has by it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._calibration.fitted import Fitted
from bayescal._core.errors import InputError
from bayescal._model import noise_laws
from bayescal._model.departure import Departure, departure
from bayescal._model.effect import Effect
from bayescal._model.installed import installed_instruments
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, LogNormal, LogUniform
from bayescal._model.unknown_effect import covariate_in
from bayescal._readings.measurements import Measurements

SCHEMA = "bayescal.calibration/1"
_NOISES = {
    c.__name__: c
    for c in (
        noise_laws.White,
        noise_laws.OrnsteinUhlenbeck,
        noise_laws.StudentT,
        noise_laws.Quantised,
    )
}
_PRIORS = {c.__name__: c for c in (Flat, HalfCauchy, HalfNormal, LogNormal, LogUniform)}


def identity(c: Fitted) -> str:
    """SHA-256 over what was fitted, to which readings, from which seed, and the draws that came of it.

    A calibration has the same one before it is saved and after it is loaded; another fit has another.
    """
    digest = hashlib.sha256(json.dumps(description(c), sort_keys=True).encode())
    for name in sorted(c.readings.columns):
        column = c.readings[name]
        digest.update(f"{name} [{c.readings.unit(name)}] {len(column)}\n".encode())
        digest.update(
            np.ascontiguousarray(column).tobytes()
            if column.dtype.kind == "f"
            else json.dumps(column.tolist()).encode()
        )
    for draws in (c.joint.x, c.joint.rows, c.joint.v):
        digest.update(f"{draws.shape}\n".encode())
        digest.update(np.ascontiguousarray(draws, dtype="<f8").tobytes())
    return digest.hexdigest()


def description(c: Fitted) -> dict[str, Any]:
    """All that a calibration is but its numbers, by the names of what is installed."""
    return {
        "schema": SCHEMA,
        "instrument": c.model.instrument.name,
        "settings": dict(c.model.instrument.settings),
        "effects": list(c.model.names),
        "departures": {
            e.name: {"of": e.of, "size": e.size, "at": dict(e.at), "shares": e.shares}
            for e in c.model.effects
            if isinstance(e, Departure)
        },
        "amplitudes": {
            e.name: (s.low, s.high)
            for e in c.model.effects
            for s in e.shapes
            if covariate_in(e.name) and s.name == e.measure
        },
        "unknowns": {e.name: stated(e) for e in c.model.effects},
        "fixed": dict(c.model.fixed),
        "noise": _noise_words(c.model.noise),
        "promoted": list(c.layout.promoted),
        "counts": dict(c.layout.counts),
        "levels": {k: list(v) for k, v in c.levels.items()},
        "reference": c.reference,
        "method": c.method,
        "seed": c.seed,
        "log_evidence": c.log_evidence,
        "verdict": asdict(c.verdict),
        "sources": [asdict(s) for s in c.readings.sources],
        "flags": list(c.readings.flags),
    }


def stated(effect: Effect) -> str:
    """What an effect says of its unknowns: units, priors, groups, shapes."""
    return " ".join(" ".join(map(repr, (*effect.coefficients, *effect.shapes))).split())


def _noise_words(noise: noise_laws.Noise) -> dict[str, Any]:
    name = type(noise).__name__
    if name not in _NOISES:
        raise InputError(
            f"noise law {name!r} is not one of {', '.join(_NOISES)}: it cannot be saved by name"
        )
    found: dict[str, Any] = {"law": name}
    for key, value in vars(noise).items():
        found[key] = (
            [type(value).__name__, vars(value)] if type(value).__name__ in _PRIORS else value
        )
    return found


def noise_from(described: dict[str, Any]) -> noise_laws.Noise:
    """The noise law that a description names."""
    arguments = {k: v for k, v in described.items() if k != "law"}
    for key, value in arguments.items():
        if isinstance(value, list):
            arguments[key] = _PRIORS[value[0]](**value[1])
    return _NOISES[described["law"]](**arguments)


def _tailored(path: Path, instrument: Instrument, settings, readings: Measurements) -> Instrument:
    """The installed instrument as the calibration's was tailored."""
    if instrument.tailor is None and not settings:
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
    known = {**installed_instruments(), **{i.name: i for i in instruments}}
    name = described["instrument"]
    if name not in known:
        raise InputError(
            f"{path.name} is a calibration of {name!r}, which is not installed (installed: "
            f"{', '.join(known)}). Install the package that offers it"
        )
    instrument = _tailored(path, known[name], described["settings"], readings)
    structural = [e for _, make in instrument.structures for e in make().effects]
    catalogue = {
        e.name: e for e in (*structural, *instrument.effects, *instrument.candidates, *effects)
    }
    for n in described["effects"]:
        if n not in catalogue and (covariate := covariate_in(n)):
            catalogue[n] = instrument.unknown(covariate).sized(*described["amplitudes"][n])
    for n, d in described["departures"].items():
        if (of := catalogue.get(d["of"])) is not None:
            shares, unit = tuple(map(tuple, d["shares"])), instrument.slot(of.slot).unit
            catalogue[n] = departure(of, unit, d["size"], tuple(d["at"].items()), shares)
    missing = [n for n in described["effects"] if n not in catalogue]
    if missing:
        raise InputError(
            f"{path.name} uses the effect {', '.join(missing)}, which {name!r} does not have. Give the file "
            "that defines it: --effects my_effects.py (in Python: load(path, effects=[…]))"
        )
    chosen = tuple(catalogue[n] for n in described["effects"])
    for effect in chosen:
        then, now = described["unknowns"][effect.name], stated(effect)
        if then != now:
            raise InputError(
                f"{path.name} was fitted with another effect {effect.name!r} than the one given now: then {then}; "
                f"now {now}. Give the one it was fitted with: --effects my_effects.py (in Python: "
                "load(path, effects=[…]))"
            )
    fixed = tuple(described["fixed"].items())
    return Model(instrument, chosen, noise_from(described["noise"]), fixed)
