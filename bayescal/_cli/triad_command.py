"""Three axes as one command: from a raw log or a table of poses to a correction as C, Python, JSON and YAML."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal._cli.console import exit_unless, print_notes, print_result, result_folder
from bayescal._cli.options import ColumnOptions, Commands, ModelOptions, ReadRequest

commands = Commands()
MOST = 5  # effects that are added
FILES = ("correction.h", "correction.py", "correction.json", "correction.yaml")


@commands.example(
    "bayescal triad log.csv --columns output_x=ax,output_y=ay,output_z=az --out result"
)
def triad(
    files: list[Path],
    columns: ColumnOptions,
    instrument: str = "accelerometer_triad",
    poses: bool = False,
    shortest: float = 2.0,
    dry_run: bool = False,
    baseline: bool = False,
    seed: int = 0,
    out: Path | None = None,
    json_: bool = False,
) -> None:
    """Calibrate three axes by poses at rest or known rates; corrections as C99, Python, JSON and YAML."""
    from bayescal._cli.request import open_request
    from bayescal._core.errors import InputError
    from bayescal._use.vector_export import data

    chosen, model, readings = open_request(ReadRequest(instrument, files, columns, ModelOptions()))
    if chosen.vector is None:
        raise InputError(
            f"--instrument {instrument}: it has one output; `bayescal calibrate` is for it"
        )
    print_notes(readings.flags)
    with result_folder(out) as folder:
        if not poses:
            readings = bc.poses(readings, chosen, shortest=shortest)
            print_notes(readings.flags)
        untold = bc.undetermined(model, readings)
        if dry_run:
            print(untold)
            return
        if untold.add:
            print_notes([str(untold)])
        trail = bc.calibrate(model, readings, seed=seed, max_effects=0 if baseline else MOST)
        calibration = trail.final.calibration
        correction = bc.vector_correction(calibration)
        print_notes(correction.notes)
        if json_:
            print_result(data(correction))
        else:
            print(f"{trail}\n\n{calibration}")
        if folder is not None:
            trail.save(folder)
            bc.report(trail, folder / "report.html")
            for name in FILES:
                bc.export_vector(correction, folder / name)
            readings.write(folder / "poses.csv")
            if not json_:
                names = ("result.json", "calibration.nc", "report.html", "poses.csv")
                print(f"written: {folder}/{', '.join((*FILES, *names))}")
    exit_unless(trail.ok, trail.gate.reason)
