"""A search to a folder: result.json, the last calibration, the picture of the loop. Offered as `trail.save(folder)`.

The trail stands below what it is saved as, so the method is attached here, and `bayescal` takes `calibrate` and `Trail`
from this module.
"""

from __future__ import annotations

from pathlib import Path

from bayescal._discovery.calibrate import calibrate as calibrate
from bayescal._discovery.search_path import Trail
from bayescal._report.result_json import result, write_json
from bayescal._report.under_way import RESULT


def save_search(self: Trail, folder: Path) -> None:
    """Write result.json, calibration.nc (of the last step) and loop.png to an existing folder."""
    from bayescal._plots.search import loop  # Matplotlib only where a picture is written
    from bayescal._plots.style import save

    self.final.calibration.save(Path(folder) / "calibration.nc")
    save(loop(self), Path(folder) / "loop.png")
    write_json(result(self), Path(folder) / RESULT)  # last: it says whether all is there


Trail.save = save_search
