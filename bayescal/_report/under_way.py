"""A search under way: its result.json, replaced as it goes on, and taken up by the next run if it did not end."""

from __future__ import annotations

import importlib
from contextlib import suppress
from pathlib import Path
from typing import Any

from bayescal._core.as_json import as_json, write_json
from bayescal._core.errors import InputError
from bayescal._core.json_shape import read_json
from bayescal._data.measurements import Measurements
from bayescal._model.model import Model
from bayescal._report.result_json import SCHEMA, hashes, result, search_data
from bayescal._report.whole_folder import files_of
from bayescal._search.posterior import ShownStructure
from bayescal._search.search_path import SearchPath

RESULT = "result.json"
UNDER_WAY = "result_under_way.json"  # where the folder holds the result of a run before
WRITERS = "h5py", "h5netcdf", "dask.distributed"  # loaded by xarray when it writes the first file


class Keeper:
    """Keeps result.json of a folder as a search goes on: `"complete": false` until it is saved at its end.

    The result of a run before stays until then, and result_under_way.json is kept beside it.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / (UNDER_WAY if RESULT in files_of(folder) else RESULT)
        self._steps, self._data = 0, {}
        for module in WRITERS:  # now, as loading them takes half of the 2 s that Ctrl-C leaves
            with suppress(ImportError):
                importlib.import_module(module)

    def __call__(self, trail: SearchPath) -> None:
        if len(trail.steps) != self._steps:  # only the search changes between two steps
            self._steps, self._data = len(trail.steps), result(trail)
        now = {"complete": trail.complete, "search": as_json(search_data(trail))}
        write_json({**self._data, **now}, self.path)


def earlier(folder: Path, model: Model, readings: Measurements) -> tuple[ShownStructure, ...]:
    """Structures of a search in this folder that did not come to its end, if it was this one; else none.

    It was this one if instrument, first model and the bytes of the readings are the same.
    """
    try:
        kept = folder / UNDER_WAY
        kept = kept if kept.is_file() else folder / RESULT
        data = read_json(kept)
        if data["schema"] != SCHEMA or data["complete"] is not False:
            return ()
        first = data["steps"][0]
        then = (data["instrument"], first["effects"], first["noise"]["law"], data["fixed"])
        now = (model.instrument.name, list(model.names), model.noise.name, dict(model.fixed))
        if then != now or data["readings"]["sha256"] != hashes(readings):
            return ()
        return tuple(_shown(s) for s in data["search"]["structures"])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return ()  # no result, or none that can be read: the search begins anew


def _shown(said: dict[str, Any]) -> ShownStructure:
    evidence, probability = said["log_evidence"], said["probability"]
    return ShownStructure(tuple(said["effects"]), str(said["noise"]), evidence, probability)


def refuse_unfinished(path: Path, data: dict[str, Any]) -> None:
    """A result of a search that goes on, or was killed, is nothing to report of.

    Raises:
        InputError: it is one; a search that was ended early has ended, and is none.
    """
    if data.get("complete") is False and not (data.get("search") or {}).get("stopped"):
        raise InputError(
            f"{path} is of a search that goes on, or was killed: wait for its end, or give `bayescal calibrate` "
            "the same files and the same --out again, and it goes on from there"
        )
