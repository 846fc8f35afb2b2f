"""Commands for what instruments offer: instruments, effects, simulate."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

from bayescal._cli import options
from bayescal._cli.console import print_result
from bayescal._core.errors import InputError

commands = typer.Typer()


@commands.command(epilog="Example: bayescal instruments")
def instruments(json_: options.Json = False) -> None:
    """List the installed instruments."""
    from bayescal._cli import output
    from bayescal._model.installed import installed_instruments

    known = installed_instruments()
    print_result(output.instruments_data(known) if json_ else output.instruments_text(known))


@commands.command(epilog="Example: bayescal effects --instrument mems_gyro")
def effects(
    instrument: options.Name,
    effects_file: options.OwnEffects = None,
    json_: options.Json = False,
) -> None:
    """List an instrument's effects: equation, unit, plausible size, columns needed, source."""
    from bayescal._cli import output
    from bayescal._cli.request import instrument_named, user_effects

    chosen = instrument_named(instrument)
    kinds = {
        "baseline": chosen.effects,
        "candidate": chosen.candidates,
        "your own": user_effects(effects_file),
    }
    print_result(output.effects_data(kinds) if json_ else output.effects_text(kinds))


@commands.command(
    epilog="Example: bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 "
    "--out sim.csv"
)
def simulate(
    instrument: options.Name,
    out: Annotated[
        Path,
        typer.Option("--out", help="File to write: .csv, .parquet or .nc.", show_default=False),
    ],
    effect: options.Hidden = None,
    noise_law: options.NoiseLaw = "white",
    seed: options.Seed = 0,
    json_: options.Json = False,
) -> None:
    """Simulate a test campaign, with effects hidden in it if you like."""
    from bayescal._cli.request import instrument_named

    chosen = instrument_named(instrument)
    if chosen.simulator is None:
        raise InputError(f"instrument {chosen.name!r} has no simulator")
    law = {} if noise_law == "white" else {"noise_law": noise_law}
    if law and "noise_law" not in inspect.signature(chosen.simulator).parameters:
        raise InputError(
            f"the simulator of {chosen.name!r} has white noise only: leave --noise-law out"
        )
    hidden = options.named_numbers(effect, "--effect")
    try:
        readings = chosen.simulate(hidden, seed=seed, **law)
    except ValueError as error:
        raise InputError(str(error)) from None
    readings.write(out)
    hiding = ", ".join(f"{name} = {size:g}" for name, size in hidden.items()) or "nothing"
    said = {"file": str(out), "rows": len(readings), "seed": seed, "noise_law": noise_law}
    text = f"{out}: {len(readings)} readings, hidden: {hiding}; seed {seed}"
    print_result({**said, "effects": hidden} if json_ else text)
