"""The command for many devices at once. Heavy modules load inside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.column_options import ColumnOptions
from bayescal._cli.console import exit_unless, print_result
from bayescal._cli.options import ModelOptions, named_numbers, with_groups
from bayescal._core.errors import InputError

commands = typer.Typer()


@commands.command(
    epilog="Example: bayescal batch lot.parquet --instrument mems_gyro -o results.parquet"
)
@with_groups
def batch(
    *,
    files: options.Files,
    instrument: options.Name,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Parquet file to write.", show_default=False),
    ],
    columns: ColumnOptions,
    choice: ModelOptions,
    method: options.BatchMethod = "least-squares",
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
    from bayescal._cli.request import compose, instrument_named, method_named, user_effects

    chosen = instrument_named(instrument)
    own = {effect.name: effect for effect in user_effects(choice.effects_file)}
    model = compose(chosen, choice, own)
    if out.suffix != ".parquet":
        raise InputError(f"--out: a batch is saved as Parquet: name it ….parquet, not {out.name!r}")
    if out in files:
        raise InputError(f"--out {out}: that is a file of readings; name another")
    needs = tuple(column for effect in model.effects for column in effect.columns)
    devices = bc.split_devices(list(files), chosen, **columns.for_read(), needs=needs)
    columns.keep()
    fitted = bc.fit_batch(
        model,
        devices,
        method=method_named(method),
        population=True if population == ["all"] else population or False,
        seed=seed,
        reference={**named_numbers(choice.reference, "--reference")},
    )
    fitted.save(out)
    bad = [name for name, ok in zip(fitted.devices, fitted.ok, strict=True) if not ok]
    data = {"file": str(out), "devices": len(fitted), "not_trusted": bad, **fitted.about}
    if fitted.population is not None:
        data["population"] = fitted.population.table.to_dict("records")
    print_result(data if json_ else fitted)
    if not json_:
        print(f"\nwritten: {out}")
    exit_unless(not bad, f"{len(bad)} of {len(fitted)} devices have no result, or none to rely on")
