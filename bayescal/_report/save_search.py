"""Saving of a search to a folder (`SearchPath.save`): result.json, calibrations and a figure.

Each channel of a device has a subfolder; channels.json has their shared effects. The classes are defined in packages on
which this one depends: their method `save` is attached here, and `bayescal` imports them from this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bayescal._calibration.storage import identity
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.json_data import as_json, write_json
from bayescal._report.report_text import summarise_chapter
from bayescal._report.result_json import PICTURE, RESULT, build_chapter, result
from bayescal._report.whole_folder import (
    AVERAGED,
    CHANNELS,
    channel_folders,
    guard_drawing,
    name_folders,
    replace_folder,
)
from bayescal._search.calibrate import calibrate as calibrate
from bayescal._search.calibrate_channels import Channels
from bayescal._search.calibrate_channels import calibrate_channels as calibrate_channels
from bayescal._search.search_path import SearchPath

CHANNELS_SCHEMA = "bayescal.channels/1"


def save_search(self: SearchPath | Channels, folder: Path) -> None:
    """Write result.json, calibration.nc, loop.png, manifest.json to `folder`, or a subfolder per channel.

    calibration.nc is the calibration of the last step. If several structures are probable, averaged.nc is the average
    over them; predictions, compensation, budgets and exports from the folder then use it. channels.json is written
    beside the subfolders of channels; unmodified results of other channels from an earlier run are removed.

    All files are replaced atomically; other files in the folder are kept. Figures are drawn afterwards, unless a time
    limit has passed or Ctrl-C was pressed.

    Raises:
        InputError: the folder does not exist, or cannot be written; its files are unchanged.
        NotDrawn: a figure could not be drawn; all other files are written.
    """
    folder, searches = Path(folder), dict[str, SearchPath]()  # by subfolder
    if isinstance(self, Channels):
        paths = self.search_paths
        searches = {subfolder: paths[name] for name, subfolder in name_folders(paths).items()}
    else:
        searches[""] = self
    with replace_folder(folder) as hidden:
        for subfolder, path in searches.items():
            write_search(path, hidden / subfolder)
        if isinstance(self, Channels):
            write_json(channels_data(self), hidden / CHANNELS)
            with suppress(InputError):  # no readable channels.json from an earlier run
                for subfolder in channel_folders(folder):
                    if (folder / subfolder).is_dir() and not (folder / subfolder).is_symlink():
                        (hidden / subfolder).mkdir(exist_ok=True)
    draw_search(searches, folder)


def draw_search(searches: Mapping[str, SearchPath], folder: Path) -> None:
    """Draw the figure of each search (subfolder → search) unless the deadline has passed.

    Raises:
        NotDrawn: a figure could not be drawn.
    """
    if deadline.current().is_over:
        return
    with guard_drawing(PICTURE), replace_folder(folder, keep_results=True) as hidden:
        from bayescal._report.plots import loop, save, use_own_style

        for subfolder, path in searches.items():
            with use_own_style():
                save(loop(path), hidden / subfolder / PICTURE)


def write_search(path: SearchPath, folder: Path) -> None:
    """Write the files of `SearchPath.save`, except the figure, to a hidden folder.

    Raises:
        OSError: a file cannot be written.
    """
    calibration = path.final.calibration
    folder.mkdir(exist_ok=True)
    calibration.save(folder / "calibration.nc")
    if path.average is not None:
        path.average.save(folder / AVERAGED)
    write_json(result(path), folder / RESULT)


SearchPath.save = Channels.save = save_search
SearchPath.in_short = property(  # pyright: ignore[reportAttributeAccessIssue]
    lambda self: summarise_chapter(build_chapter(self))
)


def channels_data(channels: Channels) -> dict[str, Any]:
    """Convert channels and their shared effects to plain data: the content of channels.json."""
    folders = name_folders(channels.search_paths)
    return as_json(
        {
            "schema": CHANNELS_SCHEMA,
            "channels": {
                name: {
                    "folder": folders[name],
                    "calibration": identity(path.final.calibration),
                    "effects": list(path.final.calibration.model.names),
                    "noise": path.final.calibration.model.noise.law,
                    **{k: v for k, v in path.final.errors().items() if k != "title"},
                    "stopped": path.search.stopped if path.search else "",
                    "ok": path.ok,
                    "reason": path.gate.reason,
                }
                for name, path in channels.search_paths.items()
            },
            "shared": [
                {
                    "effect": s.effect,
                    "probability": s.probability,
                    "shape": s.shape.name,
                    "unit": s.shape.unit,
                    **dict(zip(("middle", "low", "high"), s.posterior, strict=True)),
                    "log_bayes_factors": {n: s.log_bayes_factor(n) for n in s.log_ratios},
                }
                for s in channels.shared
            ],
            "ok": channels.ok,
        }
    )
