"""The channels of a unit to a folder: one of results for each, and channels.json with what they share.

Attached to `Channels` as its method `save`, and `bayescal` takes `calibrate_channels` and `Channels` from this module.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bayescal._calibration.description import identity
from bayescal._channels.calibrate_channels import calibrate_channels as calibrate_channels
from bayescal._channels.channels import Channels
from bayescal._report.result_json import clean, write_json
from bayescal._report.save_search import save_search

SCHEMA = "bayescal.channels/1"
RESULT = "channels.json"


def channels_data(found: Channels) -> dict[str, Any]:
    """What a unit's channels are and share, as plain data; what each found is in its own result.json."""
    folders = folders_of(found.trails)
    return clean(
        {
            "schema": SCHEMA,
            "channels": {
                name: {
                    "folder": folders[name],
                    "calibration": identity(trail.final.calibration),
                    "effects": list(trail.final.calibration.model.names),
                    "noise": trail.final.calibration.model.noise.law,
                    **{k: v for k, v in trail.final.errors().items() if k != "title"},
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
    """Write a folder of results for each channel (as `Trail.save` does), then channels.json, to an existing folder.

    Raises:
        InputError: there is no such folder, or it cannot be written.
    """
    for name, inner in folders_of(self.trails).items():
        (Path(folder) / inner).mkdir(exist_ok=True)
        save_search(self.trails[name], Path(folder) / inner)
    write_json(channels_data(self), Path(folder) / RESULT)


Channels.save = save_channels
