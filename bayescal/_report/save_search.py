"""A search to a folder: result.json, the last calibration, the picture of the loop. Offered as `trail.save(folder)`.

Of a unit's channels a folder for each, and channels.json with what they share. Trails and channels stand below what
they are saved as, so the methods are attached here, and `bayescal` takes them from this module.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from bayescal._calibration.description import identity
from bayescal._core import deadline
from bayescal._core.as_json import as_json, write_json
from bayescal._core.errors import InputError
from bayescal._report.report_text import conclusion
from bayescal._report.result_json import RESULT, UNDER_WAY, result
from bayescal._report.section import of_trail
from bayescal._report.whole_folder import (
    AVERAGED,
    CHANNELS,
    channel_folders,
    folders_of,
    remove_results,
    whole_folder,
)
from bayescal._search.calibrate import calibrate as calibrate
from bayescal._search.calibrate_channels import calibrate_channels as calibrate_channels
from bayescal._search.channels import Channels
from bayescal._search.search_path import SearchPath

CHANNELS_SCHEMA = "bayescal.channels/1"


def save_search(self: SearchPath, folder: Path) -> None:
    """Write result.json, calibration.nc, loop.png and manifest.json to an existing folder.

    calibration.nc is of the last step; averaged.nc, where several structures share the probability, is what is to be
    used: predictions, compensation, budgets and exports of the folder are made with it.

    They take their place in one step; what else stands in the folder stays. Where a time limit has come, or Ctrl-C, the
    picture is left out.

    Raises:
        InputError: there is no such folder, or it cannot be written; what stood there is as it was.
    """
    calibration = self.final.calibration
    with whole_folder(Path(folder), identity(calibration), without=UNDER_WAY) as hidden:
        calibration.save(hidden / "calibration.nc")
        if self.average is not None:
            self.average.save(hidden / AVERAGED)
        if not deadline.current().over:
            from bayescal._report.plots import loop, save

            save(loop(self), hidden / "loop.png")
        write_json(result(self), hidden / RESULT)


SearchPath.save = save_search
SearchPath.in_short = property(  # pyright: ignore[reportAttributeAccessIssue]
    lambda self: conclusion(of_trail(self))
)


def channels_data(found: Channels) -> dict[str, Any]:
    """What a unit's channels are and share, as plain data; what each found is in its own result.json."""
    folders = folders_of(found.trails)
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


def save_channels(self: Channels, folder: Path) -> None:
    """Write a folder for each channel (as `SearchPath.save` does), then channels.json, to an existing folder.

    Results of another unit's channels, of a run before, are removed, unless they were changed since.

    Raises:
        InputError: there is no such folder, or it cannot be written.
    """
    folder = Path(folder)
    before, now = set[str](), folders_of(self.trails)
    with suppress(InputError):  # none were there, or none that can be read
        before.update(channel_folders(folder))
    for name, inner in now.items():
        (folder / inner).mkdir(exist_ok=True)
        save_search(self.trails[name], folder / inner)
    write_json(channels_data(self), folder / CHANNELS)
    for inner in before - set(now.values()):
        remove_results(folder / inner)


Channels.save = save_channels
