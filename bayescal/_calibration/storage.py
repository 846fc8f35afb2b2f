"""Saved calibrations: one sealed NetCDF file of draws, mode and readings, checked in bytes and in parts when read.

All else is computed from these when it is asked for. The file names its instrument and effects; they are resolved
against what is installed. Nothing in it is evaluated.
"""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
from bayescal._model.effect import READING, Effect
from bayescal._model.frame import constants_of, held_name, origins, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._model.parameters import Layout, bind
from bayescal._tables.raw_table import ROW
from bayescal._tables.unpacked import refuse_hdf5

AGAIN = "Take a copy, or fit the readings again"
IDENTITY = "bayescal_identity"
SCHEMA = "bayescal.calibration/2"
SCHEMA_0_2 = "bayescal.calibration/1"  # with all groups of ArviZ's tree, which are computed now
Groups = Mapping[str, Group]
GROUPS = ("observed_data", "constant_data", "draws", "mode")


def save(calibration: Fitted, path: Path) -> Path:
    """Write a calibration to NetCDF.

    Raises:
        InputError: the place cannot be written to, or has no room.
    """
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file …nc, not {path.name!r}")
    readings = {storable(n): v for n, v in calibration.readings.variables().items()}
    groups = {
        "observed_data": {"output": readings.pop("output")},
        "constant_data": readings,
        "draws": draws_group(calibration.joint),
        "mode": _mode_group(calibration.mode),
    }
    described = json.dumps({**description(calibration), "schema": SCHEMA})
    content = netcdf_bytes(groups, bayescal=described, bayescal_identity=identity(calibration))
    with replacing_for_user(path) as partial:
        write_sealed(content, partial)
    return path


def draws_group(draws: Draws) -> Group:
    """Return joint draws as plain vectors, from which everything else is computed."""
    return {n: Variable(("chain", "draw", f"{n}_entry"), vars(draws)[n]) for n in "xv"}


def _mode_group(mode: Mode) -> Group:
    parts = {name: np.asarray(value, float) for name, value in mode._asdict().items()}
    return {n: Variable(tuple(f"{n}_{i}" for i in range(a.ndim)), a) for n, a in parts.items()}


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
    with _damage_in_words(path):
        import h5py  # a tenth of a second that only a saved calibration needs

        with h5py.File(content) as hdf5:
            refuse_hdf5(hdf5, path.name, content.getbuffer().nbytes)
            written = _parsed(hdf5.attrs.get("bayescal"))
        if (schema := written.get("schema")) not in (SCHEMA, SCHEMA_0_2):
            raise InputError(
                f"{path.name} is no calibration of this version: its schema is {schema!r}, "
                f"expected {SCHEMA!r}"
            )
        groups, attributes = netcdf_groups(content, GROUPS)
        described = of_today(written) if schema == SCHEMA_0_2 else written
        readings = _readings_from(groups, described)
        model = model_from(path, described, readings, effects, instruments)
        found = _fields(groups, described, model, readings)
        if schema == SCHEMA and attributes.get(IDENTITY) != identity(Fitted(**found)):
            raise ValueError("its identity is not that of what it holds")
    return found


@contextmanager
def _damage_in_words(path: Path) -> Iterator[None]:
    """A part that is not there or not as it should be: the file was changed after it was written."""
    try:
        yield
    except (
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
        ArithmeticError,
        OSError,
        RuntimeError,
    ) as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{path.name} is damaged, or was changed after it was saved: {said}. {AGAIN}"
        ) from None
    except ModelError as error:
        raise InputError(
            f"{path.name}: its model does not go with its readings: {error}. {AGAIN}"
        ) from None


def _fields(
    groups: Groups, described: dict[str, Any], model: Model, readings: Measurements
) -> dict[str, Any]:
    """The fields of a calibration, each of the size that its model and readings ask for."""
    model.require(readings)
    bound, levels = bind(model, readings, reference=described["reference"])
    _same("group sizes", described["counts"], {**dict(bound.counts), READING: len(readings)})
    _same("group members", described["levels"], {k: list(v) for k, v in levels.items()})
    constants = described["reference"].keys() - origins(described["reference"])
    _same(
        "constants", sorted(constants - constants_of(readings)), sorted({"run_starts"} & constants)
    )
    added = {held_name(name) for name in readings.columns}  # since 0.2.1
    _same("constants", sorted(reference_of(readings).keys() - constants - added), [])
    layout = replace(bound, promoted=tuple(described["promoted"]))
    if unknown := set(layout.promoted) - {b.name for b in layout.blocks}:
        raise ValueError(f"{', '.join(sorted(unknown))} is no coefficient of its model")
    verdict = Verdict.read(described["verdict"])
    verdict = replace(verdict, against=_with_codes(verdict.against, described))
    joint = _draws_from(groups, layout, finite=verdict.ok)
    mode = _mode_from(groups, layout, finite=verdict.ok)
    confounded = tuple(Confounder(**one) for one in described.get("confounded", ()))
    evidence = described["log_evidence"]
    return {
        **{name: described[name] for name in ("method", "seed", "reference")},
        "start": described.get("start", {}),
        "log_evidence": None if evidence is None else (evidence[0], evidence[1]),
        **{"model": model, "readings": readings, "layout": layout, "levels": levels},
        **{"joint": joint, "verdict": verdict, "mode": mode, "confounded": confounded},
    }


def _same(what: str, written: object, expected: object) -> None:
    if written != expected:
        raise ValueError(f"its {what} are {written}, its readings have {expected}")


def _arrays(
    groups: Groups, group: str, shapes: Mapping[str, tuple[int | None, ...]], finite: bool = True
) -> dict[str, np.ndarray]:
    """Variables of a group, if they are numbers of these shapes (None: any length)."""
    data, found = groups[group], {}
    for name, shape in shapes.items():
        if name not in data:
            raise ValueError(f"its group {group} has no variable {name}")
        values = found[name] = data[name].values
        what = f"its {group}/{name}"
        if values.dtype != np.float64:
            raise ValueError(f"{what} is of type {values.dtype}, expected float64")
        asked = itertools.zip_longest(shape, values.shape, fillvalue=-1)
        if any(length not in (None, came) for length, came in asked):
            expected = tuple("any" if length is None else length for length in shape)
            raise ValueError(f"{what} has the shape {values.shape}, its model asks for {expected}")
        if finite and not np.isfinite(values).all():
            raise ValueError(f"{what} holds numbers that are not finite")
    return found


def _draws_from(groups: Groups, layout: Layout, finite: bool) -> Draws:
    (x,) = _arrays(groups, "draws", {"x": (None, None, layout.size)}, finite).values()
    both = x.shape[:2]
    if 0 in both:
        raise ValueError("it holds no draws")
    (v,) = _arrays(groups, "draws", {"v": (*both, len(layout.hypers))}, finite).values()
    return Draws(x, v)


def _parsed(text: object) -> dict[str, Any]:
    """The description in a file, empty if it has none that can be read."""
    try:
        found = parsed_json(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _mode_from(groups: Groups, layout: Layout, finite: bool) -> Mode:
    p, d = layout.size, len(layout.hypers)
    shapes = {"x": (p,), "v": (d,), "covariance": (d, d), "flat": (p,)}
    found = _arrays(groups, "mode", shapes, finite)
    scalars = {name: () for name in Mode._fields if name not in shapes}
    mode = Mode(**found, **_arrays(groups, "mode", scalars, finite=False))
    return mode._replace(indefinite=mode.indefinite > 0)


def _with_codes(said: Sequence[str], described: dict[str, Any]) -> tuple[str, ...]:
    codes = described.get("flag_codes", {})
    return tuple(Flag(words, *codes[words]) if words in codes else words for words in said)


def _readings_from(groups: Groups, described: dict[str, Any]) -> Measurements:
    _arrays(groups, "observed_data", {"output": (None,)})
    both = {**groups["constant_data"], **groups["observed_data"]}
    held = {named_back(n): v for n, v in both.items() if v.dims == (ROW,) and n != ROW}
    if len({len(v.values) for v in held.values()}) > 1:
        raise ValueError("its columns differ in length")
    sources = tuple(Source(**s) for s in described["sources"])
    given, flags = described.get("nominal_scale"), _with_codes(described["flags"], described)
    scale = given and NominalScale(**given)
    return Measurements.of_variables(held, sources=sources, flags=flags, scale=scale)
