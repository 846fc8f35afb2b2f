"""Saved calibrations: one NetCDF file, written beside and renamed.

The file names its instrument and effects; they are resolved against what is installed. Nothing in it is evaluated.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr

from bayescal._calibration.fitted import Fitted
from bayescal._core.atomic_file import replacing
from bayescal._core.errors import InputError
from bayescal._inference.gaussian import Point
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Draws, Verdict
from bayescal._model import noise_laws
from bayescal._model.departure import Departure, departure
from bayescal._model.effect import Effect
from bayescal._model.installed import installed_instruments
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._model.parameters import Layout
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, LogNormal, LogUniform
from bayescal._model.unknown_effect import covariate_in
from bayescal._readings.column import Source
from bayescal._readings.measurements import Measurements

SCHEMA = "bayescal.calibration/1"
IN_UNITS = (
    "in units"  # an unknown function's coefficients; before, they were in parts of its amplitude
)
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


def save(calibration: Fitted, tree: xr.DataTree, path: Path) -> Path:
    """Write a calibration and its tree to NetCDF.

    Raises:
        InputError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file …nc, not {path.name!r}")
    if not path.parent.is_dir():
        raise InputError(
            f"There is no folder {path.parent} to write {path.name!r} to: make it first"
        )
    tree = tree.copy()
    tree["mode"] = xr.DataTree(_mode_dataset(calibration.mode))
    tree.attrs["bayescal"] = json.dumps(_description(calibration))
    with replacing(path) as partial:
        tree.to_netcdf(partial, engine="h5netcdf")
    return path


def _description(c: Fitted) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "instrument": c.model.instrument.name,
        "settings": dict(c.model.instrument.settings),
        "effects": list(c.model.names),
        "coefficients": IN_UNITS,
        "departures": {
            e.name: {"of": e.of, "size": e.size, "at": dict(e.at), "shares": e.shares}
            for e in c.model.effects
            if isinstance(e, Departure)
        },
        "unknowns": {e.name: _stated(e) for e in c.model.effects},
        "fixed": dict(c.model.fixed),
        "noise": _noise_description(c.model.noise),
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


def _stated(effect: Effect) -> str:
    """What an effect says of its unknowns: units, priors, groups, shapes."""
    return " ".join(" ".join(map(repr, (*effect.coefficients, *effect.shapes))).split())


def _noise_description(noise: noise_laws.Noise) -> dict[str, Any]:
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


def _noise_from(described: dict[str, Any]) -> noise_laws.Noise:
    arguments = {k: v for k, v in described.items() if k != "law"}
    for key, value in arguments.items():
        if isinstance(value, list):
            arguments[key] = _PRIORS[value[0]](**value[1])
    return _NOISES[described["law"]](**arguments)


def _mode_dataset(mode: Mode) -> xr.Dataset:
    parts = {
        "x": mode.point.x,
        "rows": mode.point.rows,
        **{k: getattr(mode, k) for k in _MODE_FIELDS},
    }
    return xr.Dataset(
        {
            name: (tuple(f"{name}_{i}" for i in range(np.ndim(value))), np.asarray(value, float))
            for name, value in parts.items()
        }
    )


_MODE_FIELDS = ("v", "covariance", "log_density", "log_evidence", "change", "flat", "indefinite")


def load_calibration(
    path: Path, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> tuple[dict[str, Any], xr.DataTree]:
    """Read the fields of a calibration and its tree back; see `bayescal.load`."""
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a calibration saved by bayescal (…nc)")
    try:
        with xr.open_datatree(path, engine="h5netcdf") as opened:
            tree = opened.load()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path.name} cannot be read as NetCDF ({error}): is it a saved calibration?"
        ) from None
    described = _parsed(tree.attrs.pop("bayescal", None))
    if described.get("schema") != SCHEMA:
        raise InputError(
            f"{path.name} is no calibration of this version: its schema is {described.get('schema')!r}, "
            f"expected {SCHEMA!r}"
        )
    if "noise.correlated" in tree["posterior"]:  # its draws would be read as of the diffusion
        raise InputError(
            f"{path.name} was saved when correlated noise was described by its size, now by its diffusion: "
            "fit the readings again"
        )
    readings = _readings_from(tree, described)
    model = _model_from(path, described, readings, effects, instruments)
    layout = Layout(model, tuple(described["counts"].items()), tuple(described["promoted"]))
    mode = _mode_from(tree["mode"].to_dataset())
    del tree["mode"]
    verdict = described["verdict"]
    evidence = described["log_evidence"]
    found = {
        "model": model,
        "readings": readings,
        "joint": _draws_from(tree),
        "verdict": Verdict(
            **{**verdict, "reasons": tuple(verdict["reasons"]), "notes": tuple(verdict["notes"])}
        ),
        "method": described["method"],
        "seed": described["seed"],
        "reference": described["reference"],
        "levels": {k: tuple(v) for k, v in described["levels"].items()},
        "layout": layout,
        "mode": mode,
        "log_evidence": None if evidence is None else (evidence[0], evidence[1]),
    }
    return found, tree


def _draws_from(tree: xr.DataTree) -> Draws:
    vectors, stats = tree["draws"].to_dataset(), tree["sample_stats"].to_dataset()
    x, rows, v = (vectors[name].values for name in ("x", "rows", "v"))
    return Draws(x, rows, v, {str(name): stats[name].values for name in stats})


def _parsed(text: object) -> dict[str, Any]:
    """The description in a file, empty if it has none that can be read."""
    try:
        found = json.loads(text) if isinstance(text, str) else {}
    except json.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}


def _mode_from(data: xr.Dataset) -> Mode:
    values = {str(k): jnp.asarray(v.values) for k, v in data.items()}
    rest = {k: values[k] for k in _MODE_FIELDS}
    return Mode(
        Point(values["x"], values["rows"]), **{**rest, "indefinite": rest["indefinite"] > 0}
    )


def _readings_from(tree: xr.DataTree, described: dict[str, Any]) -> Measurements:
    data = tree["constant_data"].to_dataset().merge(tree["observed_data"].to_dataset())
    sources = tuple(Source(**s) for s in described["sources"])
    return Measurements(data=data, sources=sources, flags=tuple(described["flags"]))


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


def _model_from(path: Path, described, readings: Measurements, effects, instruments) -> Model:
    known = {**installed_instruments(), **{i.name: i for i in instruments}}
    name = described["instrument"]
    if name not in known:
        raise InputError(
            f"{path.name} is a calibration of {name!r}, which is not installed (installed: "
            f"{', '.join(known)}). Install the package that offers it"
        )
    instrument = _tailored(path, known[name], described.get("settings", {}), readings)
    structural = [e for _, make in instrument.structures for e in make().effects]
    catalogue = {
        e.name: e for e in (*structural, *instrument.effects, *instrument.candidates, *effects)
    }
    for n in described["effects"]:
        if n not in catalogue and (covariate := covariate_in(n)):
            catalogue[n] = instrument.unknown(covariate)
    for n, d in described.get("departures", {}).items():
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
        then, now = described["unknowns"][effect.name], _stated(effect)
        if then != now:
            raise InputError(
                f"{path.name} was fitted with another effect {effect.name!r} than the one given now: then {then}; "
                f"now {now}. Give the one it was fitted with: --effects my_effects.py (in Python: "
                "load(path, effects=[…]))"
            )
    fixed = tuple(described["fixed"].items())
    _refuse_parts(path, described, chosen)
    return Model(instrument, chosen, _noise_from(described["noise"]), fixed)


def _refuse_parts(path: Path, described: dict[str, Any], effects: Sequence[Effect]) -> None:
    """Draws of an unknown function's coefficients in parts of its amplitude would be read as in units.

    Raises:
        InputError: the file holds some.
    """
    old = [e.name for e in effects if e.weights is not None]
    if old and described.get("coefficients") != IN_UNITS:
        raise InputError(
            f"{path.name} was saved when the coefficients of {', '.join(old)} were parts of its amplitude, now they "
            "are in units: fit the readings again"
        )
