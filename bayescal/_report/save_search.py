"""Saving of a search to a folder: result.json, the last calibration, the picture of the loop: `trail.save(folder)`.

For a unit's channels a folder each, and channels.json with their shared effects. Trails and channels are defined in
rooms below this one, so the methods are attached here, and `bayescal` takes them from this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bayescal._calibration.storage import identity
from bayescal._core import deadline
from bayescal._core.as_json import as_json, write_json
from bayescal._core.errors import InputError
from bayescal._report.report_text import conclusion
from bayescal._report.result_json import PICTURE, RESULT, of_trail, result
from bayescal._report.whole_folder import (
    AVERAGED,
    CHANNELS,
    channel_folders,
    drawing,
    folders_of,
    whole_folder,
)
from bayescal._search.calibrate import calibrate as calibrate
from bayescal._search.calibrate_channels import Channels
from bayescal._search.calibrate_channels import calibrate_channels as calibrate_channels
from bayescal._search.search_path import SearchPath

CHANNELS_SCHEMA = "bayescal.channels/1"


def save_search(self: SearchPath | Channels, folder: Path) -> None:
    """Write result.json, calibration.nc, loop.png, manifest.json to an existing folder; of channels to a folder each.

    calibration.nc is of the last step; averaged.nc, where several structures share the probability, is the one to
    use: predictions, compensation, budgets and exports of the folder are made with it. Beside the folders of channels
    is channels.json; results of another unit's channels, of a run before, are removed, unless they were changed.

    All files are replaced in one step; other files in the folder stay. Pictures are drawn after that, and left out
    after a time limit or Ctrl-C.

    Raises:
        InputError: there is no such folder, or it cannot be written; its files are unchanged.
        NotDrawn: a picture could not be drawn; all other files are written.
    """
    folder, searches = Path(folder), dict[str, SearchPath]()  # by their places in it
    if isinstance(self, Channels):
        paths = self.search_paths
        searches = {inner: paths[name] for name, inner in folders_of(paths).items()}
    else:
        searches[""] = self
    with whole_folder(folder) as hidden:
        for inner, trail in searches.items():
            write_search(trail, hidden / inner)
        if isinstance(self, Channels):
            write_json(channels_data(self), hidden / CHANNELS)
            with suppress(InputError):  # none were there, or none that can be read
                for inner in channel_folders(folder):
                    if (folder / inner).is_dir() and not (folder / inner).is_symlink():
                        (hidden / inner).mkdir(exist_ok=True)
    draw_search(searches, folder)


def draw_search(searches: Mapping[str, SearchPath], folder: Path) -> None:
    """Draw the picture of each search (subfolder → search), unless time is up.

    Raises:
        NotDrawn: one could not be drawn.
    """
    if deadline.current().over:
        return
    with drawing(PICTURE), whole_folder(folder, leaving=True) as hidden:
        from bayescal._report.plots import loop, own_style, save

        for place, trail in searches.items():
            with own_style():
                save(loop(trail), hidden / place / PICTURE)


def write_search(trail: SearchPath, folder: Path) -> None:
    """Write the files of `SearchPath.save`, except the picture, to a hidden folder.

    Raises:
        OSError: it cannot be written.
    """
    calibration = trail.final.calibration
    folder.mkdir(exist_ok=True)
    calibration.save(folder / "calibration.nc")
    if trail.average is not None:
        trail.average.save(folder / AVERAGED)
    write_json(result(trail), folder / RESULT)


SearchPath.save = Channels.save = save_search
SearchPath.in_short = property(  # pyright: ignore[reportAttributeAccessIssue]
    lambda self: conclusion(of_trail(self))
)


def channels_data(channels: Channels) -> dict[str, Any]:
    """Convert the channels of a unit and their shared effects to plain data; results of each are in its result.json."""
    folders = folders_of(channels.search_paths)
    return as_json(
        {
            "schema": CHANNELS_SCHEMA,
            "channels": {
                name: {
                    "folder": folders[name],
                    "calibration": identity(trail.final.calibration),
                    "effects": list(trail.final.calibration.model.names),
                    "noise": trail.final.calibration.model.noise.law,
                    **{k: v for k, v in trail.final.errors().items() if k != "title"},
                    "stopped": trail.search.stopped if trail.search else "",
                    "ok": trail.ok,
                    "reason": trail.gate.reason,
                }
                for name, trail in channels.search_paths.items()
            },
            "shared": [
                {
                    "effect": s.effect,
                    "probability": s.probability,
                    "shape": s.shape.name,
                    "unit": s.shape.unit,
                    **dict(zip(("middle", "low", "high"), s.posterior, strict=True)),
                    "log_bayes_factors": {n: s.evidence(n) for n in s.says},
                }
                for s in channels.shared
            ],
            "ok": channels.ok,
        }
    )
