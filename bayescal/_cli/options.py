"""Options that several commands share. Light: `bayescal --help` reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Files = Annotated[
    list[Path],
    typer.Argument(help="CSV, Parquet or NetCDF files of readings.", show_default=False),
]
Saved = Annotated[Path, typer.Argument(help="A saved calibration (.nc).", show_default=False)]
Name = Annotated[
    str,
    typer.Option(
        "--instrument",
        help="Name of an installed instrument, or my.py:INSTRUMENT.",
        show_default=False,
    ),
]
OwnInstrument = Annotated[
    str | None,
    typer.Option(
        "--instrument",
        help="my.py:INSTRUMENT, if the calibration is of an instrument that is not installed.",
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--columns", help="output=gyro_x: our column = the file's; repeat for more."),
]
Units = Annotated[
    list[str] | None,
    typer.Option("--unit", help="gyro_x=rad/s: unit of a column; repeat for more."),
]
Gravity = Annotated[float, typer.Option(min=1.0, help="Local gravity, m/s², for files in m/s².")]
Fix = Annotated[
    list[str] | None,
    typer.Option(
        "--fix", help="bias.temperature=0.041: hold an unknown at a value, in its unit; repeat."
    ),
]
Ref = Annotated[
    list[str] | None,
    typer.Option("--reference", help="T0=0: reference temperature of the bases, °C."),
]
Add = Annotated[
    list[str] | None,
    typer.Option("--add", help="Effect to add to the baseline; repeat for more."),
]
Structure = Annotated[
    str | None,
    typer.Option(help="A model structure of the instrument in place of its baseline."),
]
Structures = Annotated[
    list[str] | None,
    typer.Option(
        "--structure",
        help="Structure to set beside the others, or with effects added, as "
        "line+bias.thermal_lag; repeat. All of the instrument's if none is given.",
    ),
]
OwnEffects = Annotated[
    Path | None,
    typer.Option("--effects", help="Python file with EFFECTS of your own."),
]
Members = Annotated[
    list[str] | None,
    typer.Option("--member", help="device=A17: which device is used; repeat for more."),
]
MethodName = Annotated[str, typer.Option("--method", help="marginal, least-squares or nuts.")]
MostEffects = Annotated[
    int, typer.Option("--max-effects", min=1, help="Most effects that may be missing.")
]
Next = Annotated[
    bool,
    typer.Option(
        "--next-experiment", help="Rank feasible campaigns by how well they tell rivals apart."
    ),
]
Screen = Annotated[
    int | None,
    typer.Option(
        "--calibrate-screen",
        metavar="N",
        min=1,
        help="Search N campaigns simulated from this model, and print how often something is reported.",
    ),
]
Hidden = Annotated[
    list[str] | None,
    typer.Option("--effect", help="name=size: an effect to hide; repeat for more."),
]
NoiseLaw = Annotated[str, typer.Option(help="white, student_t or ornstein_uhlenbeck.")]
Holdout = Annotated[
    list[Path] | None,
    typer.Option(help="Readings kept apart, only read after the last step; repeat for more."),
]
KeepSpikes = Annotated[
    bool, typer.Option("--keep-spikes", help="Keep single readings far from both neighbours.")
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of every random number.")]
Folder = Annotated[Path | None, typer.Option("--out", help="Folder to write to.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
