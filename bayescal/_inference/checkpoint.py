"""Checkpoints: chains that were stopped go on where they were, and end with the same draws, bit for bit.

While a fit runs under `keeping`, NUTS hands each block of iterations with the sampler's state to `current()`, and the
whole state is written beside the file, forced to the disk, and renamed over it: whatever moment the process is
killed at, the file is whole. What comes before chains takes seconds, and is computed again.

A checkpoint belongs to one model, one set of readings, one method, one seed and one set of versions. For anything
else it is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import platform
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import CodeType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from bayescal._core.atomic_file import (
    left_behind,
    replacing_for_user,
    to_disk,
    verified,
    write_sealed,
)
from bayescal._core.errors import InputError
from bayescal._core.netcdf_bytes import netcdf_bytes
from bayescal._data.measurements import Measurements
from bayescal._model.effect import Effect
from bayescal._model.model import Model

SCHEMA = "bayescal.checkpoint/2"
PAUSE = 1.0  # s between writes of unfinished chains; finished ones are written at once
PACKAGES = ("bayescal", "jax", "jaxlib", "numpyro", "optimistix", "equinox", "numpy")
T = TypeVar("T")


@dataclass
class Checkpoint:
    """Finished pieces of a run, in memory and in a file.

    Attributes:
        path: the file, …nc.
        fingerprint: what the run is of, one entry for each thing that may differ.
        arrays: name of a piece → its arrays.
        notes: name of a piece → anything that JSON can hold.
    """

    path: Path
    fingerprint: dict[str, str]
    arrays: dict[str, list[np.ndarray]] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)
    written: float = 0.0

    def write(self) -> None:
        """Replace the file by the present state.

        Raises:
            InputError: it cannot be written.
        """
        variables = {
            f"{name}.{i}": (tuple(f"{name}.{i}.{axis}" for axis in range(leaf.ndim)), leaf)
            for name, leaves in self.arrays.items()
            for i, leaf in enumerate(leaves)
        }
        counts = {name: len(leaves) for name, leaves in self.arrays.items()}
        head = {"schema": SCHEMA, "fingerprint": self.fingerprint, "notes": self.notes}
        data = xr.Dataset(variables, attrs={"bayescal": json.dumps({**head, "arrays": counts})})
        # First the file's bytes on the disk, then its name, then the folder that holds the name: a power cut between
        # any two leaves the old file or the new one.
        with replacing_for_user(self.path) as partial:
            write_sealed(netcdf_bytes(data), partial)
            to_disk(partial)
        to_disk(self.path.parent)
        self.written = time.monotonic()

    def write_now_and_then(self) -> None:
        """Write, unless that has been done within the last `PAUSE` seconds."""
        if time.monotonic() - self.written > PAUSE:
            self.write()


_CURRENT: ContextVar[Checkpoint | None] = ContextVar("checkpoint", default=None)


def current() -> Checkpoint | None:
    """The checkpoint of the fit that is running, if it has one."""
    return _CURRENT.get()


@contextmanager
def keeping(path: str | Path | None, fingerprint: Callable[[], dict[str, str]]) -> Iterator[None]:
    """Keep the pieces of the fit inside in a file; without a path, do nothing.

    Raises:
        InputError: the file is no checkpoint, or one of another run; says what differs.
    """
    store = None if path is None else open_checkpoint(Path(path), fingerprint())
    token = _CURRENT.set(store)
    try:
        yield
    finally:
        _CURRENT.reset(token)


def leaves_of(tree: Any) -> list[np.ndarray]:
    """The arrays of a structure, random keys as numbers."""
    return [np.array(jax.random.key_data(a) if _is_key(a) else a) for a in jax.tree.leaves(tree)]


def filled(like: T, leaves: list[np.ndarray]) -> T:
    """A structure like another one, with these arrays."""
    olds, structure = jax.tree.flatten(like)
    news = [
        jax.random.wrap_key_data(jnp.asarray(new)) if _is_key(old) else jnp.asarray(new)
        for old, new in zip(olds, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, news)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def open_checkpoint(path: Path, fingerprint: dict[str, str]) -> Checkpoint:
    """The checkpoint in a file, or a new one where there is no file.

    Raises:
        InputError: the name does not end in .nc, there is no folder, the file is no checkpoint, or one of
            another run.
    """
    if path.suffix != ".nc":
        raise InputError(f"a checkpoint is a NetCDF file: name it …nc, not {path.name!r}")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {str(path.parent)!r} for a checkpoint: make it first")
    for left in left_behind(path):
        left.unlink(missing_ok=True)
    if not path.exists():
        return Checkpoint(path, fingerprint)
    anew = "Name another file, or delete it to start anew"
    content = io.BytesIO(verified(path, "a checkpoint of a fit", anew))
    try:
        with xr.open_dataset(
            content, engine="h5netcdf", decode_times=False, mask_and_scale=False
        ) as opened:
            data = opened.load()
        head = json.loads(data.attrs["bayescal"])
        then, notes, counts = head["fingerprint"], head["notes"], head["arrays"]
        arrays = {
            name: [data[f"{name}.{i}"].values for i in range(count)]
            for name, count in counts.items()
        }
        if head["schema"] != SCHEMA or not isinstance(notes, dict):
            raise ValueError(head["schema"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path.name!r} is no checkpoint of a fit, or a damaged one ({type(error).__name__}). {anew}"
        ) from None
    if differing := _differing(then, fingerprint):
        raise InputError(f"{path.name!r} is the checkpoint of another run: {differing}. {anew}")
    return Checkpoint(path, fingerprint, arrays, notes)


def _differing(then: dict[str, str], now: dict[str, str]) -> str:
    """What differs between two fingerprints, in words."""
    found = []
    for name in sorted({*then, *now}):
        one, other = then.get(name), now.get(name)
        if one != other:
            short = (
                one and other and max(len(one), len(other)) < 60 and not name.endswith(" (hash)")
            )
            how = f" ({one}, now {other})" if short else ""
            found.append(f"{name.removesuffix(' (hash)')} differs{how}")
    return ", ".join(found)


def fingerprint(
    model: Model, readings: Measurements, method: Any, seed: int, reference: dict
) -> dict[str, str]:
    """What a run is of: anything that its draws depend on."""
    values = hashlib.sha256()
    readings.add_to(values)
    made_by = [f"{name} {version(name)}" for name in PACKAGES]
    return {
        "effects": ", ".join(model.names),
        "model (hash)": _digest(model_texts(model)),
        "readings (hash)": values.hexdigest(),
        "reference (hash)": _digest([json.dumps(reference, sort_keys=True)]),
        "method": shown(method),
        "seed": str(seed),
        "versions": f"{', '.join(made_by)}, Python {platform.python_version()}, {platform.machine()}",
    }


def model_texts(model: Model, candidates: Sequence[Effect] = ()) -> list[str]:
    """What a model computes, as texts that are the same in every process: its numbers, and the code of its functions.

    Args:
        model: the model.
        candidates: effects that may be added to it.
    """
    instrument = model.instrument
    return [
        shown((instrument.name, instrument.settings, instrument.columns, instrument.slots)),
        _code_of(instrument.response),
        shown((type(model.noise).__name__, model.noise, model.fixed)),
        *(
            shown((e.name, e.slot, e.coefficients, e.shapes))
            + "".join(_code_of(function) for function in (e.basis, e.weights) if function)
            for e in (*model.effects, *candidates)
        ),
    ]


def _digest(parts: list[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _code_of(function: Any, depth: int = 0) -> str:
    """What a function does, as text: its code, constants, defaults and what it closes over."""
    bound: tuple[Any, ...] = ()
    if isinstance(function, partial):
        function, bound = function.func, (*function.args, *function.keywords.values())
    # Byte code, not source: a comment or a blank line changes nothing, a constant does.
    code = getattr(function, "__code__", None)
    if code is None or depth > 8:
        return f"{type(function).__name__} {getattr(function, '__qualname__', shown(function))}"
    closed = [cell.cell_contents for cell in getattr(function, "__closure__", None) or ()]
    given = [*bound, *closed, *(getattr(function, "__defaults__", None) or ())]
    inner = [_code_of(v, depth + 1) if callable(v) else shown(v) for v in given]
    return f"{_bytes_of(code)} {inner}"


def _bytes_of(code: CodeType) -> str:
    constants = [_bytes_of(c) if isinstance(c, CodeType) else shown(c) for c in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {constants}"


def shown(value: Any) -> str:
    """A value as text that is the same in every process: no addresses, sets in order."""
    if isinstance(value, frozenset | set):
        return repr(sorted(map(repr, value)))
    return re.sub(r" at 0x[0-9a-fA-F]+", "", " ".join(repr(value).split()))
