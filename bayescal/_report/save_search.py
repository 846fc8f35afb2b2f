"""A search to a folder: result.json, the last calibration, the picture of the loop. Offered as `trail.save(folder)`.

Of a unit's channels a folder for each, and channels.json with what they share. Trails and channels stand below what
they are saved as, so the methods are attached here, and `bayescal` takes them from this module.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bayescal._calibration.description import identity
from bayescal._channels.calibrate_channels import calibrate_channels as calibrate_channels
from bayescal._channels.channels import Channels
from bayescal._discovery.calibrate import calibrate as calibrate
from bayescal._discovery.search_path import SearchPath
from bayescal._report.result_json import clean, result, write_json
from bayescal._report.under_way import RESULT, UNDER_WAY
from bayescal._report.whole_folder import CHANNELS, remove_results, whole_folder

CHANNELS_SCHEMA = "bayescal.channels/1"


def save_search(self: SearchPath, folder: Path) -> None:
    """Write result.json, calibration.nc (of the last step), loop.png and manifest.json to an existing folder.

    They take their place in one step; what else stands in the folder stays.

    Raises:
        InputError: there is no such folder, or it cannot be written; what stood there is as it was.
    """
    from bayescal._plots.search import loop  # Matplotlib only where a picture is written
    from bayescal._plots.style import save

    calibration = self.final.calibration
    with whole_folder(Path(folder), identity(calibration), without=UNDER_WAY) as hidden:
        calibration.save(hidden / "calibration.nc")
        save(loop(self), hidden / "loop.png")
        write_json(result(self), hidden / RESULT)


SearchPath.save = save_search


def channels_data(found: Channels) -> dict[str, Any]:
    """What a unit's channels are and share, as plain data; what each found is in its own result.json."""
    folders = folders_of(found.trails)
    return clean(
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
                for name, trail in found.trails.items()
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
                for s in found.shared
            ],
            "ok": found.ok,
        }
    )


def folders_of(names: Iterable[str]) -> dict[str, str]:
    """A folder's name for each channel: its own, without what a file system may not take."""
    found: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip("._") or "channel"
        taken, folder, number = set(found.values()), plain, 2
        while folder in taken:
            folder, number = f"{plain}_{number}", number + 1
        found[name] = folder
    return found


def save_channels(self: Channels, folder: Path) -> None:
    """Write a folder for each channel (as `SearchPath.save` does), then channels.json, to an existing folder.

    Results of another unit's channels, of a run before, are removed, unless they were changed since.

    Raises:
        InputError: there is no such folder, or it cannot be written.
    """
    folder = Path(folder)
    before, now = _channel_folders(folder), folders_of(self.trails)
    for name, inner in now.items():
        (folder / inner).mkdir(exist_ok=True)
        save_search(self.trails[name], folder / inner)
    write_json(channels_data(self), folder / CHANNELS)
    for inner in before - set(now.values()):
        remove_results(folder / inner)


def _channel_folders(folder: Path) -> set[str]:
    """Names of the folders that a channels.json tells of; none where there is none to read."""
    try:
        told = json.loads((folder / CHANNELS).read_text("utf-8"))["channels"].values()
        names = {str(channel["folder"]) for channel in told}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    return {n for n in names if n not in ("", ".", "..") and Path(n).name == n}


Channels.save = save_channels
