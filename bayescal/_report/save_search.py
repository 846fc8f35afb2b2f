"""A search to a folder: result.json, the last calibration, the picture of the loop. Offered as `trail.save(folder)`.

The trail stands below what it is saved as, so the method is attached here, and `bayescal` takes `calibrate` and `Trail`
from this module.
"""

from __future__ import annotations

from pathlib import Path

from bayescal._calibration.description import identity
from bayescal._discovery.calibrate import calibrate as calibrate
from bayescal._discovery.search_path import Trail
from bayescal._report.result_json import result, write_json
from bayescal._report.under_way import RESULT, UNDER_WAY
from bayescal._report.whole_folder import whole_folder


def save_search(self: Trail, folder: Path) -> None:
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


Trail.save = save_search
