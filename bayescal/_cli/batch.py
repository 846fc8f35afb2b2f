"""The command for many devices at once. Heavy modules load inside it, as in `_cli.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.deliverables import GRAVITY, commands, leave, say
from bayescal._core.errors import InputError


@commands.command(
    epilog="Example: bayescal batch lot.parquet --instrument mems_gyro -o results.parquet"
)
def batch(
    files: options.Files,
    instrument: options.Name,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Parquet file to write.", show_default=False),
    ],
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    fix: options.Fix = None,
    reference: options.Ref = None,
    add: options.Add = None,
    structure: options.Structure = None,
    effects_file: options.OwnEffects = None,
    method: Annotated[str, typer.Option("--method", help="least-squares or marginal.")] = (
        "least-squares"
    ),
    population: Annotated[
        list[str] | None,
        typer.Option(
            "--population",
            help="Coefficient whose mean and spread over the devices are learned; 'all', or repeat.",
        ),
    ] = None,
    seed: options.Seed = 0,
    json_: options.Json = False,
) -> None:
    """Fit every device of files with a column 'device' by itself: one table of coefficients."""
    from bayescal._cli import arguments

    chosen = arguments.instrument_named(instrument)
    asked = arguments.Request(
        instrument, columns, unit, local_gravity, fix, reference, add, structure, effects_file
    )
    model = arguments.composed(
        chosen, asked, {e.name: e for e in arguments.user_effects(effects_file)}
    )
    if out.suffix != ".parquet":
        raise InputError(f"--out: a batch is saved as Parquet: name it ….parquet, not {out.name!r}")
    if out in files:
        raise InputError(f"--out {out}: that is a file of readings; name another")
    devices = bc.split_devices(
        list(files),
        chosen,
        columns=arguments.pairs(columns, "--columns"),
        units=arguments.pairs(unit, "--unit"),
        local_gravity=local_gravity,
        needs=tuple(c for e in model.effects for c in e.columns),
    )
    found = bc.fit_batch(
        model,
        devices,
        method=arguments.method_named(method),
        population=True if population == ["all"] else population or False,
        seed=seed,
        reference={**arguments.numbers(reference, "--reference")},
    )
    found.save(out)
    bad = [name for name, ok in zip(found.devices, found.ok, strict=True) if not ok]
    said = {"file": str(out), "devices": len(found), "not_trusted": bad, **found.about}
    if found.population is not None:
        said["population"] = found.population.table.to_dict("records")
    say(said if json_ else found)
    if not json_:
        print(f"\nwritten: {out}")
    leave(not bad, f"{len(bad)} of {len(found)} devices have no result, or none to rely on")
