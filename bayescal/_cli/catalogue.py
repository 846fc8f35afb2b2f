"""Commands for what instruments offer: instruments, effects, simulate; of some, pairs of devices, a demonstration."""

from __future__ import annotations

import contextlib
import inspect
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import exit_unless, print_notes, print_result, result_folder
from bayescal._cli.options import ColumnOptions, Commands, ModelOptions, ReadRequest
from bayescal._core.errors import InputError
from bayescal._report.whole_folder import MANIFEST, files_of, whole_folder

commands = Commands()
DEMONSTRATIONS = "bayescal.demos"
"""`run(folder, seed)` writes a demonstration to an existing folder."""

PAIR_SELECTIONS = "bayescal.pair_selections"
"""`select(calibration, criterion=…)` gives a table of pairs that prints itself and has `data()`, plain JSON."""


@commands.example("bayescal instruments --check level.py:INSTRUMENT")
def instruments(
    check: str | None = None,
    readings: list[Path] | None = None,
    seed: int = 0,
    json_: bool = False,
) -> None:
    """List the installed instruments, or check one of your own."""
    from bayescal._cli import output
    from bayescal._model.installed import installed_instruments

    if check is not None:
        from bayescal._cli.request import instrument_named

        chosen = instrument_named(check)
        given = bc.read(list(readings), chosen) if readings else None
        found = bc.check_instrument(chosen, given, seed=seed)
        print_result(found.data() if json_ else found)
        exit_unless(found.ok, " ".join(found.errors))
        return
    if readings:
        raise InputError("--readings are for --check: say which instrument, my.py:INSTRUMENT")
    known = installed_instruments()
    print_result(output.instruments_data(known) if json_ else output.instruments_text(known))


@commands.example("bayescal effects --instrument mems_gyro")
def effects(
    instrument: str,
    effects_file: Path | None = None,
    json_: bool = False,
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


@commands.example(
    "bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --out sim.csv"
)
def simulate(
    instrument: str,
    out: Path,
    effect: list[str] | None = None,
    noise_law: str = "white",
    seed: int = 0,
    json_: bool = False,
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


@commands.example("bayescal pairs readings.csv")
def pairs(
    *,
    files: list[Path],
    instrument: str = "differential_pair",
    criterion: str = "residual",
    columns: ColumnOptions,
    add: list[str] | None = None,
    average: str | None = None,
    seed: int = 0,
    json_: bool = False,
) -> None:
    """Which two devices make the best pair, each pair with its probability."""
    from bayescal._cli.request import open_request

    choice = ModelOptions(add=add)
    chosen, model, readings = open_request(ReadRequest(instrument, files, columns, choice, average))
    select = offered(PAIR_SELECTIONS, chosen.name)
    if select is None:
        raise InputError(f"instrument {chosen.name!r} does not choose its devices in pairs")
    print_notes(readings.flags)
    fitted = bc.fit(model, readings, seed=seed, strict=False)
    found = select(fitted, criterion=criterion)
    print_result(found.data() if json_ else found)
    exit_unless(fitted.verdict.ok, " ".join(fitted.verdict.reasons))


@commands.example("bayescal demo --out demo_output")
def demo(
    out: Path = Path("demo_output"),
    instrument: str = "mems_gyro",
    seed: int = 0,
    json_: bool = False,
) -> None:
    """A gyroscope's table against its published line, then a hidden effect found and added."""
    from bayescal._cli.request import instrument_named

    chosen = instrument_named(instrument)
    demonstrate = offered(DEMONSTRATIONS, chosen.name)
    if demonstrate is None:
        raise InputError(f"instrument {chosen.name!r} has no demonstration")
    with (
        result_folder(out),
        contextlib.redirect_stdout(sys.stderr if json_ else sys.stdout),
    ):
        with whole_folder(out) as hidden:
            demonstrate(hidden, seed)
        print(f"\nwritten to {out}: {', '.join([*files_of(out), MANIFEST])}")
    if json_:
        print((out / "result.json").read_text(encoding="utf-8"), end="")


def offered(group: str, instrument: str) -> Callable[..., Any] | None:
    """What an installed package offers in a group for the instrument of this name; None where none does."""
    for found in entry_points(group=group, name=instrument):
        return found.load()
    return None
