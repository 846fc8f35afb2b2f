"""The command line.

Exit status: 0 done; 1 not converged, or the noise gate failed (results are written all the same);
2 bad input: one sentence on stderr, nothing written.

Heavy modules load inside the commands, so that `bayescal --help` answers at once.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import bayescal as bc
from bayescal._cli import (
    options,
)
from bayescal._cli.deliverables import commands
from bayescal._cli.deliverables import leave as _leave
from bayescal._cli.deliverables import say as _say
from bayescal._core.errors import BayescalError, InputError, NotConverged

if TYPE_CHECKING:
    from bayescal._readings.measurements import Measurements

GRAVITY = 9.80665  # m/s², standard gravity

app = typer.Typer(
    name="bayescal",
    help="Bayesian calibration of inertial and tilt sensors: compare, see where the model fails, "
    "find the missing effect, add it, watch the error fall.",
    epilog="Start with: bayescal demo",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line; every refusal is a sentence on stderr, never a traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where ° or µ cannot be shown, ? is
    try:
        status = app(standalone_mode=False, prog_name="bayescal")
        sys.stdout.flush()
        sys.exit(status if isinstance(status, int) else 0)
    except NotConverged as error:
        _fail(str(error), 1)
    except BayescalError as error:
        _fail(str(error), 2)
    except typer.Abort:
        _fail("stopped", 1)
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        _fail(f"{error.filename or 'a file'}: {error.strerror or error}", 2)
    except Exception as error:
        usage = getattr(error, "format_message", None)  # an option that the parser refused
        if usage is None:
            raise
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "bayescal"
        said = (usage() or "Give a command, such as: bayescal demo").rstrip(".")
        _fail(f"{said}. See: {command} --help", 2)


def _fail(message: str, status: int) -> None:
    print(f"bayescal: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


@app.command(epilog="Example: bayescal instruments")
def instruments(json_: options.Json = False) -> None:
    """List the installed instruments."""
    from bayescal._calibration.storage import installed_instruments
    from bayescal._cli import output

    known = installed_instruments()
    _say(output.instruments_data(known) if json_ else output.instruments_text(known))


@app.command(epilog="Example: bayescal effects --instrument mems_gyro")
def effects(
    instrument: options.Name,
    effects_file: options.OwnEffects = None,
    json_: options.Json = False,
) -> None:
    """List an instrument's effects: equation, unit, plausible size, columns needed, source."""
    from bayescal._cli import arguments, output

    chosen = arguments.instrument_named(instrument)
    kinds = {
        "baseline": chosen.effects,
        "candidate": chosen.candidates,
        "your own": arguments.user_effects(effects_file),
    }
    _say(output.effects_data(kinds) if json_ else output.effects_text(kinds))


@app.command(
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
    from bayescal._cli.arguments import instrument_named, numbers

    chosen = instrument_named(instrument)
    if chosen.simulator is None:
        raise InputError(f"instrument {chosen.name!r} has no simulator")
    law = {} if noise_law == "white" else {"noise_law": noise_law}
    if law and "noise_law" not in inspect.signature(chosen.simulator).parameters:
        raise InputError(
            f"the simulator of {chosen.name!r} has white noise only: leave --noise-law out"
        )
    hidden = numbers(effect, "--effect")
    try:
        readings = chosen.simulate(hidden, seed=seed, **law)
    except ValueError as error:
        raise InputError(str(error)) from None
    readings.write(out)
    hiding = ", ".join(f"{name} = {size:g}" for name, size in hidden.items()) or "nothing"
    said = {"file": str(out), "rows": len(readings), "seed": seed, "noise_law": noise_law}
    text = f"{out}: {len(readings)} readings, hidden: {hiding}; seed {seed}"
    _say({**said, "effects": hidden} if json_ else text)


@app.command(epilog="Example: bayescal fit readings.csv --instrument mems_gyro --out result")
def fit(
    files: options.Files,
    instrument: options.Name,
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    fix: options.Fix = None,
    reference: options.Ref = None,
    add: options.Add = None,
    structure: options.Structure = None,
    effects_file: options.OwnEffects = None,
    method: options.MethodName = "marginal",
    seed: options.Seed = 0,
    out: options.Folder = None,
    json_: options.Json = False,
) -> None:
    """Fit one model: coefficients with uncertainty."""
    from bayescal._cli import arguments, output

    asked = arguments.Request(
        instrument, columns, unit, local_gravity, fix, reference, add, structure, effects_file
    )
    how = arguments.method_named(method)
    _, model, readings = arguments.open_up(asked, files)
    _say_flags(readings)
    with arguments.folder(out) as folder:
        found = bc.fit(
            model,
            readings,
            how,
            seed=seed,
            strict=False,
            reference=arguments.reference_of(asked, readings),
        )
        if folder is not None:
            found.save(folder / "calibration.nc")
    _say(output.fit_data(found) if json_ else found)
    if folder is not None and not json_:
        print(f"\nwritten: {folder / 'calibration.nc'}")
    _leave(found.verdict.ok, " ".join(found.verdict.reasons))


@app.command(epilog="Example: bayescal check result/calibration.nc")
def check(
    calibration: options.Saved,
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
    json_: options.Json = False,
) -> None:
    """Where a fitted model fails."""
    from bayescal._cli import arguments
    from bayescal._report.result_json import check_data, clean

    found = bc.check(arguments.saved(calibration, effects_file, instrument))
    _say(clean(check_data(found, 0)) if json_ else found)


@app.command(epilog="Example: bayescal discover result/calibration.nc")
def discover(
    calibration: options.Saved,
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
    max_effects: options.MostEffects = 5,
    next_experiment: options.Next = False,
    calibrate_screen: options.Screen = None,
    json_: options.Json = False,
) -> None:
    """Which effect is missing from a fitted model; and which experiment would tell rivals apart."""
    from bayescal._cli import arguments
    from bayescal._cli.output import unexplained_text
    from bayescal._report.result_json import clean, experiment_data, missing_data

    loaded = arguments.saved(calibration, effects_file, instrument)
    own = arguments.user_effects(effects_file)
    found, checked = bc.discover(loaded, effects=own, max_effects=max_effects), bc.check(loaded)
    text = f"{found}\n{unexplained_text(loaded, checked, own)}".rstrip()
    data = missing_data(found, 0, checked)
    if next_experiment:
        ranked = bc.next_experiment(loaded, found.rivals) if len(found.rivals) > 1 else None
        text += f"\n\n{ranked or 'next experiment: nothing here has a rival to be told from'}"
        data["next_experiment"] = None if ranked is None else experiment_data(ranked)
    if calibrate_screen is not None:
        rate = bc.false_reports(loaded, calibrate_screen, effects=own, max_effects=max_effects)
        text += f"\n\n{rate}"
        data["false_reports"] = asdict(rate)
    _say(clean(data) if json_ else text)


@app.command(
    epilog="Example: bayescal compare readings.csv --instrument mems_gyro --structure line "
    "--structure line+bias.thermal_lag"
)
def compare(
    files: options.Files,
    instrument: options.Name,
    structure: options.Structures = None,
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    reference: options.Ref = None,
    effects_file: options.OwnEffects = None,
    method: options.MethodName = "marginal",
    seed: options.Seed = 0,
    json_: options.Json = False,
) -> None:
    """Set model structures side by side: left-out groups, leave-one-out, evidence, weights."""
    from bayescal._cli import arguments, output

    asked = arguments.Request(
        instrument, columns, unit, local_gravity, None, reference, None, None, effects_file
    )
    how = arguments.method_named(method)
    chosen, _, readings = arguments.open_up(asked, files)
    names = structure or [name for name, _ in chosen.structures]
    if len(set(names)) < 2:
        raise InputError("compare needs two structures or more: give --structure twice, or never")
    own = arguments.user_effects(effects_file)
    models = {name: arguments.structure_with(chosen, name, own) for name in names}
    for model in models.values():
        model.require(readings)
    _say_flags(readings)
    at = arguments.reference_of(asked, readings)
    fits = {
        name: bc.fit(model, readings, how, seed=seed, strict=False, reference=at)
        for name, model in models.items()
    }
    found = bc.compare(fits)
    _say(output.comparison_data(found) if json_ else found)
    failed = [f"{n}: {' '.join(c.verdict.reasons)}" for n, c in fits.items() if not c.verdict.ok]
    _leave(not failed, "; ".join(failed))


@app.command(epilog="Example: bayescal predict result/calibration.nc new.csv --out predicted.csv")
def predict(
    calibration: options.Saved,
    files: options.Files,
    out: Annotated[
        Path | None, typer.Option("--out", help="File to write: .csv, .parquet or .nc.")
    ] = None,
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
    json_: options.Json = False,
) -> None:
    """Predict readings with a calibration, and compare."""
    from bayescal._cli import arguments
    from bayescal._core.formatting import number
    from bayescal._readings.units import unit_label

    loaded = arguments.saved(calibration, effects_file, instrument)
    readings = arguments.read_files(loaded.model.instrument, files, columns, unit, local_gravity)
    _say_flags(readings)
    found = bc.predict(loaded, readings)
    if out is not None:
        arguments.write_prediction(found, readings, out)
    expected = float((found.sd**2).mean()) ** 0.5
    shown = unit_label(loaded.unit)
    text = (
        f"{len(readings)} readings: rms error {number(found.rmse)} {shown}, "
        f"expected {number(expected)} {shown}" + (f"\nwritten: {out}" if out else "")
    )
    said = {"rows": len(readings), "rmse": found.rmse, "expected_rmse": expected}
    _say({**said, "unit": loaded.unit, "file": str(out) if out else None} if json_ else text)


@app.command(epilog="Example: bayescal calibrate readings.csv --instrument mems_gyro --out result")
def calibrate(
    files: options.Files,
    instrument: options.Name,
    holdout: options.Holdout = None,
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    fix: options.Fix = None,
    reference: options.Ref = None,
    add: options.Add = None,
    structure: options.Structure = None,
    effects_file: options.OwnEffects = None,
    method: options.MethodName = "marginal",
    max_effects: options.MostEffects = 5,
    keep_spikes: options.KeepSpikes = False,
    seed: options.Seed = 0,
    out: options.Folder = None,
    json_: options.Json = False,
) -> None:
    """The whole loop: fit, see where it fails, find what is missing, add it, see the error fall."""
    from bayescal._cli import arguments
    from bayescal._cli.output import story
    from bayescal._report.result_json import result

    asked = arguments.Request(
        instrument, columns, unit, local_gravity, fix, reference, add, structure, effects_file
    )
    how = arguments.method_named(method)
    chosen, model, readings = arguments.open_up(asked, files)
    kept = arguments.read_files(chosen, holdout, columns, unit, local_gravity) if holdout else None
    _say_flags(readings)
    own = arguments.user_effects(effects_file)
    with arguments.folder(out) as folder:
        trail = bc.calibrate(
            model,
            readings,
            holdout=kept,
            effects=own,
            method=how,
            max_effects=max_effects,
            keep_spikes=keep_spikes,
            seed=seed,
            reference=arguments.reference_of(asked, readings),
        )
        if folder is not None:
            trail.save(folder)
    _say_flags(trail.final.calibration.readings, but=readings.flags)
    _say(result(trail) if json_ else story(trail, own))
    if folder is not None and not json_:
        print(f"\nwritten: {folder}/result.json, calibration.nc, loop.png")
    _leave(trail.ok, trail.gate.reason)


@app.command(epilog="Example: bayescal pairs readings.csv")
def pairs(
    files: options.Files,
    instrument: Annotated[
        str, typer.Option("--instrument", help="Whose devices are chosen in pairs.")
    ] = "differential_pair",
    criterion: Annotated[
        str, typer.Option(help="residual, ratio-variance or ratio-variance-raw.")
    ] = "residual",
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    add: options.Add = None,
    seed: options.Seed = 0,
    json_: options.Json = False,
) -> None:
    """Which two devices make the best pair, each pair with its probability."""
    from bayescal._cli import arguments
    from bayescal._cli.offered import PAIR_SELECTIONS, offered

    asked = arguments.Request(instrument, columns, unit, local_gravity, None, None, add, None, None)
    chosen, model, readings = arguments.open_up(asked, files)
    select = offered(PAIR_SELECTIONS, chosen.name)
    if select is None:
        raise InputError(f"instrument {chosen.name!r} does not choose its devices in pairs")
    _say_flags(readings)
    fitted = bc.fit(model, readings, seed=seed, strict=False)
    found = select(fitted, criterion=criterion)
    _say(found.data() if json_ else found)
    _leave(fitted.verdict.ok, " ".join(fitted.verdict.reasons))


@app.command(epilog="Example: bayescal demo --out demo_output")
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to write to.")] = Path("demo_output"),
    instrument: Annotated[
        str, typer.Option("--instrument", help="Whose demonstration.")
    ] = "mems_gyro",
    seed: options.Seed = 0,
    json_: Annotated[
        bool, typer.Option("--json", help="Print result.json on stdout, and the story on stderr.")
    ] = False,
) -> None:
    """A gyroscope's table against its published line, then a hidden effect found and added."""
    from bayescal._cli import arguments
    from bayescal._cli.offered import DEMONSTRATIONS, offered

    chosen = arguments.instrument_named(instrument)
    demonstrate = offered(DEMONSTRATIONS, chosen.name)
    if demonstrate is None:
        raise InputError(f"instrument {chosen.name!r} has no demonstration")
    with (
        arguments.folder(out) as folder,
        contextlib.redirect_stdout(sys.stderr if json_ else sys.stdout),
    ):
        demonstrate(folder, seed)
    if json_:
        print((out / "result.json").read_text(encoding="utf-8"), end="")


def _say_flags(readings: Measurements, but: tuple[str, ...] = ()) -> None:
    for flag in (f for f in readings.flags if f not in but):
        print(f"bayescal: note: {flag}", file=sys.stderr)


app.add_typer(commands)  # compensate, export, budget, report, batch


if __name__ == "__main__":
    main()
