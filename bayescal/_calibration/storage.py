"""Saved calibrations: one sealed NetCDF file of draws, mode and readings, from which all else is computed.

The file names its instrument and effects; they are resolved against what is installed. Nothing in it is evaluated. Its
seal is over its bytes; its identity, over what was fitted, is computed again from what was read.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._calibration.confounding import Confounder
from bayescal._calibration.description import description, identity, model_from, of_today
from bayescal._calibration.fitted import Fitted
from bayescal._core.atomic_file import (
    named_back,
    replacing_for_user,
    storable,
    verified,
    write_sealed,
)
from bayescal._core.errors import InputError, ModelError
from bayescal._core.flag import Flag
from bayescal._core.json_shape import parsed_json
from bayescal._core.netcdf import Group, Variable, netcdf_bytes, netcdf_groups
from bayescal._data.column import NominalScale, Source
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Draws, Verdict
from bayescal._model.effect import Effect
from bayescal._model.instrument import Instrument
from bayescal._model.parameters import bind
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


def save(calibration: Fitted, path: Path) -> Path:
    """Write a calibration to NetCDF.

    Raises:
        InputError: the place cannot be written to, or has no room.
    """
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file …nc, not {path.name!r}")
    readings = {storable(n): v for n, v in calibration.readings.variables().items()}
    mode = {n: np.asarray(value, float) for n, value in calibration.mode._asdict().items()}
    groups = {
        "observed_data": {"output": readings.pop("output")},
        "constant_data": readings,
        "draws": draws_group(calibration.joint),
        "mode": {n: Variable(tuple(f"{n}_{i}" for i in range(a.ndim)), a) for n, a in mode.items()},
    }
    described = json.dumps({**description(calibration), "schema": SCHEMA})
    content = netcdf_bytes(groups, bayescal=described, bayescal_identity=identity(calibration))
    with replacing_for_user(path) as partial:
        write_sealed(content, partial)
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
        there = f", {' or '.join(map(str, saved[:6]))}" if saved else ""
        raise InputError(f"{path} is a folder: give the calibration in it{there}")
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a calibration saved by bayescal (…nc)")
    content = io.BytesIO(verified(path, "a saved calibration", AGAIN))
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
    }
    if schema == SCHEMA and attributes.get(IDENTITY) != identity(Fitted(**found)):
        raise ValueError("its identity is not that of what it holds")
    return found


def _with_codes(said: Sequence[str], described: Mapping[str, Any]) -> tuple[str, ...]:
    codes = described.get("flag_codes", {})
    return tuple(Flag(words, *codes[words]) if words in codes else words for words in said)


def _readings_from(groups: Mapping[str, Group], described: Mapping[str, Any]) -> Measurements:
    both = {**groups["constant_data"], **groups["observed_data"]}
    held = {named_back(n): v for n, v in both.items() if v.dims == (ROW,) and n != ROW}
    sources = tuple(Source(**s) for s in described["sources"])
    given, flags = described.get("nominal_scale"), _with_codes(described["flags"], described)
    scale = given and NominalScale(**given)
    return Measurements.of_variables(held, sources=sources, flags=flags, scale=scale)
