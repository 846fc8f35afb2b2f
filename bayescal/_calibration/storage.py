"""Saved calibrations: one sealed NetCDF file, written beside and renamed; checked in bytes and in parts when read.

The file names its instrument and effects; they are resolved against what is installed. Nothing in it is evaluated.
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
import xarray as xr

from bayescal._calibration.confounding import Confounder, widened
from bayescal._calibration.description import (
    SCHEMA,
    description,
    identity,
    model_from,
    name_of_today,
    of_today,
)
from bayescal._calibration.fitted import Fitted, named
from bayescal._core.atomic_file import (
    named_back,
    renamed,
    replacing_for_user,
    verified,
    write_sealed,
)
from bayescal._core.errors import InputError, ModelError
from bayescal._core.flag import Flag
from bayescal._core.json_shape import parsed_json
from bayescal._core.netcdf_bytes import netcdf_bytes, netcdf_tree
from bayescal._data.column import NominalScale, Source
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import Mode
from bayescal._inference.method import Draws, Verdict
from bayescal._model.effect import READING, Effect
from bayescal._model.frame import constants_of, held_name, origins, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._model.parameters import Layout, bind
from bayescal._model.unknowns import Unknowns
from bayescal._tables.unpacked import refuse_hdf5

AGAIN = "Take a copy, or fit the readings again"
IDENTITY = "bayescal_identity"
GROUPS = (
    *("posterior", "posterior_predictive", "log_prior", "sample_stats"),
    *("observed_data", "constant_data", "draws", "mode"),
)


def save(calibration: Fitted, tree: xr.DataTree, path: Path) -> Path:
    """Write a calibration and its tree to NetCDF.

    Raises:
        InputError: the place cannot be written to, or has no room.
    """
    path = Path(path)
    if path.suffix != ".nc":
        raise InputError(f"A calibration is saved as NetCDF: name the file …nc, not {path.name!r}")
    tree = tree.copy()
    tree["mode"] = xr.DataTree(_mode_dataset(calibration.mode))
    tree.attrs["bayescal"] = json.dumps(description(calibration))
    tree.attrs[IDENTITY] = identity(calibration)
    content = netcdf_bytes(tree)
    with replacing_for_user(path) as partial:
        write_sealed(content, partial)
    return path


def _mode_dataset(mode: Mode) -> xr.Dataset:
    parts = {name: getattr(mode, name) for name in _MODE_FIELDS}
    sizes = {n: [f"{n}_{i}" for i in range(np.ndim(value))] for n, value in parts.items()}
    return xr.Dataset({n: (sizes[n], np.asarray(value, float)) for n, value in parts.items()})


_MODE_FIELDS = (
    "x",
    "v",
    "covariance",
    "log_density",
    "log_evidence",
    "change",
    "flat",
    "indefinite",
)


def _saved_in(folder: Path) -> str:
    """The calibrations in a folder, or in those of a unit's channels, by name."""
    found = sorted([*folder.glob("*.nc"), *folder.glob("*/*.nc")])
    return f", {' or '.join(map(str, found[:6]))}" if found else ""


def load_calibration(
    path: Path, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> tuple[dict[str, Any], xr.DataTree]:
    """Read the fields of a calibration and its tree back; see `bayescal.load`."""
    if path.is_dir():
        raise InputError(f"{path} is a folder: give the calibration in it{_saved_in(path)}")
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a calibration saved by bayescal (…nc)")
    content = io.BytesIO(verified(path, "a saved calibration", AGAIN))
    with _damage_in_words(path):
        import h5py  # a tenth of a second that only a saved calibration needs

        with h5py.File(content) as hdf5:
            refuse_hdf5(hdf5, path.name, content.getbuffer().nbytes)
            tree = netcdf_tree(hdf5)
        former: list[Any] = []
        if "posterior" in tree.children:
            posterior = renamed(tree["posterior"].to_dataset(), name_of_today)
            # Noise on an input was once an unknown of each reading: such draws stood among the others.
            former = [name for name, own in posterior.data_vars.items() if "reading" in own.dims]
            tree["posterior"] = xr.DataTree(posterior.drop_vars(former))
        described = of_today(written := _parsed(tree.attrs.pop("bayescal", None)))
        if described.get("schema") != SCHEMA:
            raise InputError(
                f"{path.name} is no calibration of this version: its schema is {described.get('schema')!r}, "
                f"expected {SCHEMA!r}"
            )
        if missing := [name for name in GROUPS if name not in tree.children]:
            raise ValueError(f"it has no group {', '.join(missing)}")
        readings = _readings_from(tree, described)
        model = model_from(path, described, readings, effects, instruments)
        found = _fields(tree, described, model, readings)
        same = tree.attrs.pop(IDENTITY, None) == identity(Fitted(**found))
        if not same and described == written and not former:
            raise ValueError("its identity is not that of what it holds")
    del tree["mode"]
    return found, tree


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
    tree: xr.DataTree, described: dict[str, Any], model: Model, readings: Measurements
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
    joint = _draws_from(tree, layout, finite=verdict.ok)
    mode = _mode_from(tree, layout, finite=verdict.ok)
    confounded = tuple(Confounder(**one) for one in described.get("confounded", ()))
    x, unknowns = (
        widened(joint.x, confounded, layout, described["seed"]),
        Unknowns.of(layout, levels),
    )
    _refuse_other_posterior(tree, named(unknowns, unknowns.values(x, joint.v)))
    _arrays(tree, "posterior_predictive", {"output": (joint.x.shape[0], None, len(readings))})
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
    tree: xr.DataTree, group: str, shapes: Mapping[str, tuple[int | None, ...]], finite: bool = True
) -> dict[str, np.ndarray]:
    """Variables of a group, if they are numbers of these shapes (None: any length)."""
    data, found = tree[group].to_dataset(), {}
    for name, shape in shapes.items():
        if name not in data.data_vars:
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


def _draws_from(tree: xr.DataTree, layout: Layout, finite: bool) -> Draws:
    (x,) = _arrays(tree, "draws", {"x": (None, None, layout.size)}, finite).values()
    both = x.shape[:2]
    if 0 in both:
        raise ValueError("it holds no draws")
    (v,) = _arrays(tree, "draws", {"v": (*both, len(layout.hypers))}, finite).values()
    return Draws(x, v)


def _refuse_other_posterior(tree: xr.DataTree, expected: xr.Dataset) -> None:
    """The posterior that a person reads is that of the draws from which everything is computed."""
    posterior = renamed(tree["posterior"].to_dataset(), named_back)
    if set(posterior.data_vars) != set(expected.data_vars):
        raise ValueError(
            f"its posterior is of {', '.join(map(str, posterior.data_vars))}, its model has "
            f"{', '.join(map(str, expected.data_vars))}"
        )
    for name, variable in expected.data_vars.items():
        if not np.array_equal(posterior[name].values, variable.values, equal_nan=True):
            raise ValueError(f"its posterior of {name} is not that of its draws")


def _parsed(text: object) -> dict[str, Any]:
    """The description in a file, empty if it has none that can be read."""
    try:
        found = parsed_json(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _mode_from(tree: xr.DataTree, layout: Layout, finite: bool) -> Mode:
    p, d = layout.size, len(layout.hypers)
    shapes = {"x": (p,), "v": (d,), "covariance": (d, d), "flat": (p,)}
    found = _arrays(tree, "mode", shapes, finite)
    scalars = {name: () for name in _MODE_FIELDS if name not in shapes}
    found |= _arrays(tree, "mode", scalars, finite=False)
    rest = {name: np.asarray(found[name]) for name in _MODE_FIELDS}
    rest["indefinite"] = rest["indefinite"] > 0
    return Mode(**rest)


def _readings_from(tree: xr.DataTree, described: dict[str, Any]) -> Measurements:
    _arrays(tree, "observed_data", {"output": (None,)})
    data = tree["constant_data"].to_dataset().merge(tree["observed_data"].to_dataset())
    data = renamed(data, named_back)
    sources = tuple(Source(**s) for s in described["sources"])
    given, codes = described.get("nominal_scale"), described.get("flag_codes", {})
    flags = tuple(Flag(f, *codes[f]) if f in codes else f for f in described["flags"])
    scale = given and NominalScale(**given)
    return Measurements.from_xarray(data, sources=sources, flags=flags, scale=scale)
