"""Commands for what instruments offer, for the whole loop, and from readings to a calibration.

What instruments offer: instruments, effects, simulate; of some, pairs of devices, a demonstration. The whole loop:
`calibrate`, of one output or of several channels of one unit; `workbench`, by hand. From readings to a calibration:
fit, check, discover, compare, predict; and to the noise of a sensor.

Imports stand where they are first needed: a bad file is refused before a sampler loads.
"""

from __future__ import annotations

import contextlib
import inspect
import sys
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import (
    drawn,
    exit_unless,
    exit_unless_drawn,
    print_notes,
    print_result,
    result_folder,
)
from bayescal._cli.options import (
    ColumnOptions,
    Commands,
    ModelOptions,
    OwnParts,
    ReadRequest,
    SearchRequest,
    UsedParts,
)
from bayescal._core import deadline
from bayescal._core.as_json import as_json
from bayescal._core.errors import InputError
from bayescal._core.settings import Settings, use_settings
from bayescal._report.whole_folder import MANIFEST, files_of, whole_folder

if TYPE_CHECKING:
    from bayescal._cli.request import Early
    from bayescal._data.measurements import Measurements
    from bayescal._model.effect import Effect
    from bayescal._model.model import Model
    from bayescal._workbench.serve import Sessions
    from bayescal._workbench.start import Waiting

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
            made = drawn(demonstrate, hidden, seed)
        print(f"\nwritten to {out}: {', '.join([*files_of(out), MANIFEST])}")
    if json_:
        print((out / "result.json").read_text(encoding="utf-8"), end="")
    exit_unless_drawn(made)


def offered(group: str, instrument: str) -> Callable[..., Any] | None:
    """What an installed package offers in a group for the instrument of this name; None where none does."""
    for found in entry_points(group=group, name=instrument):
        return found.load()
    return None


@commands.example("bayescal calibrate readings.csv --instrument mems_gyro --out result")
def calibrate(
    *,
    channels: str | None = None,
    asked: SearchRequest,
    simple_noise: bool = False,
    covariates: str | None = None,
    out: Path | None = None,
    verbose: bool = False,
    output_unit: str | None = None,
    json_: bool = False,
) -> None:
    """The whole loop: fit, see where it fails, find what is missing, add it, see the error fall.

    The first table stands as soon as the first fit does; Ctrl-C then ends the search with the best so far. Channels of
    one unit are searched together: structures and noise of their own, one body for all.
    """
    settings = asked.settings() | options.causes(None, covariates)
    of_search = Settings(finer_noise=not simple_noise)
    with use_settings(of_search), deadline.until(asked.time_limit, apart=True):
        if channels is None:
            _one(asked, out, json_, settings, verbose, output_unit)
        elif output_unit is not None:
            raise InputError("--output-unit is of one output: leave it out, or --channels")
        else:
            _several(options.channel_names(channels), asked, out, json_, settings)


@commands.example("bayescal workbench readings.csv --instrument mems_gyro")
def workbench(
    *,
    channels: str | None = None,
    asked: SearchRequest,
    out: Path = Path("workbench_output"),
    trust: list[Path] | None = None,
    address: str = "127.0.0.1",
    no_open: bool = False,
) -> None:
    """The same loop in a browser, step by step: look, add, compare, go back. Ctrl-C ends it.

    It is served to this computer alone, under an address that nobody guesses, unless --address says otherwise.
    Channels of a unit have each a page of its own, with links to the others.
    """
    from bayescal._cli import request
    from bayescal._report.whole_folder import folders_of
    from bayescal._workbench import start

    start.refuse_without_panel()
    at = start.Address.new(address)
    print_notes([at.exposed] if at.exposed else [])
    # A file that cannot be used is refused before a browser opens.
    names = [] if channels is None else options.channel_names(channels)
    early = request.read_early(asked, names)
    method = None if asked.method == "marginal" else request.method_named(asked.method)
    settings = {**asked.settings(), "method": method, "time_limit": asked.time_limit}
    with result_folder(out) as folder:
        assert folder is not None
        folders = {n: folder / inner for n, inner in folders_of(names).items()} or {"": folder}
        name = [start.FIRST, *start.kept_sessions(next(iter(folders.values())))][-1]
        told = ", ".join(p.name for p in asked.files)
        said = f"bayescal workbench of {told}: {at.of(name)}\n(Ctrl-C ends it; kept in {folder})"
        with start.Waiting(at, told, "Loading the instrument …") as waiting:
            print(said, flush=True)
            if not no_open:
                webbrowser.open(at.of(name))
            sessions = _sessions(asked, early, folders, name, settings, waiting, trust or [])
        from bayescal._workbench.serve import serve

        serve(sessions, at)
    print("bayescal workbench: ended", flush=True)


def _sessions(
    asked: SearchRequest,
    early: Early,
    folders: Mapping[str, Path],
    name: str,
    settings: dict[str, Any],
    waiting: Waiting,
    trust: Sequence[Path],
) -> dict[str, Sessions]:
    """The sessions of a server, by channel ("" where there is one output); the first of them is open."""
    from bayescal._cli import request

    names = [n for n in folders if n]
    models, readings, kept = _opened(names, asked, early)
    waiting.doing = "Loading the page …"
    from bayescal._workbench.kept import Origin
    from bayescal._workbench.serve import Sessions
    from bayescal._workbench.session import Session

    def of_channel(channel: str, folder: Path) -> Sessions:
        own_files = [] if asked.choice.effects_file is None else [asked.choice.effects_file]
        own = request.own_effects(asked.choice, models[channel].instrument, readings[channel])
        if asked.choice.typed:
            own_files.append(_written(own, folder))
        reference = request.reference_of(asked.choice.reference, readings[channel]) or None
        how = asked.columns.for_read() | ({"outputs": names} if channel else {})
        averaged = {"average": asked.average, "keep_spikes": asked.keep_spikes}
        files = (asked.files, asked.holdout, how, own_files)
        origin = Origin.of(asked.instrument, *files, channel=channel, **averaged)
        given = {"holdout": kept.get(channel), "effects": own, "reference": reference, **settings}

        def begin(inner: Path) -> Session:
            one = models[channel], readings[channel]
            return Session.begin(*one, folder=inner, origin=origin, **given)

        return Sessions(folder, begin, partial(Session.resume, of=origin, trust=trust))

    found = {channel: of_channel(channel, folder) for channel, folder in folders.items()}
    waiting.doing = "Fitting the first model …"
    next(iter(found.values())).open(name)
    return found


def _written(own: Sequence[Effect], folder: Path) -> Path:
    """The effects that were typed as a file in the workbench's folder, which its sessions and scripts read."""
    from bayescal._core.atomic_file import write_text
    from bayescal._model.formula import Formula

    lines = [f"    bc.effect({e.basis.text!r})," for e in own if isinstance(e.basis, Formula)]
    code = ["import bayescal as bc", "", "EFFECTS = (", *lines, ")", ""]
    folder.mkdir(exist_ok=True)  # of a channel
    return write_text("\n".join(code), folder / "typed_effects.py")


def _one(
    asked: SearchRequest,
    out: Path | None,
    json_: bool,
    settings: dict[str, Any],
    verbose: bool,
    output_unit: str | None,
) -> None:
    """One output."""
    from bayescal._cli import request
    from bayescal._report.whole_folder import CHANNELS

    if out is not None and (out / CHANNELS).is_file():
        raise InputError(
            f"{out} holds the channels of a unit ({CHANNELS}), of which reports and parameters would still be made: "
            "give another folder, or remove it"
        )
    models, all_readings, kept = _opened([], asked)
    model, readings = models[""], all_readings[""]
    own = request.own_effects(asked.choice, model.instrument, readings)
    if output_unit is not None:
        from bayescal._report.report_text import output_factor

        scale = readings.scale or model.instrument.nominal_scale
        output_factor(output_unit, readings.unit("output") or "1", scale)
    with result_folder(out) as folder:
        from bayescal._cli.output import ConsoleReporter, loop_text
        from bayescal._report.result_json import earlier

        told = ConsoleReporter(folder, json_, verbose)
        seeds = earlier(folder, model, readings) if folder else ()
        if seeds:
            print_notes([f"goes on with the search in {folder}, which was ended early"])
        trail = bc.calibrate(
            model,
            readings,
            holdout=kept.get(""),
            effects=own,
            **_how(asked, readings, settings),
            seeds=seeds,
            follow=told,
        )
        from bayescal._report.result_json import result
        from bayescal._report.save_search import draw_search, write_results
        from bayescal._report.whole_folder import AVERAGED, files_of

        def write() -> bool:
            if folder is not None:
                write_results(trail, folder)
            flags = trail.final.calibration.readings.flags
            print_notes(f for f in flags if f not in readings.flags)
            print_result(
                result(trail) if json_ else loop_text(trail, own, told.begun, verbose, output_unit)
            )
            made = folder is None or drawn(draw_search, {"": trail}, folder)
            if folder is not None and not json_:
                there = files_of(folder)
                usual = ("result.json", "calibration.nc", AVERAGED, "loop.png")
                names = (n for n in usual if n in there)
                print(f"\nwritten: {folder}/{', '.join(names)}, manifest.json")
            return made

        made = deadline.finish(write)
    exit_unless(trail.ok, trail.gate.reason)
    exit_unless_drawn(made)


def _several(
    names: Sequence[str],
    asked: SearchRequest,
    out: Path | None,
    json_: bool,
    settings: dict[str, Any],
) -> None:
    """Channels of one unit."""
    from bayescal._cli import request

    models, readings, kept = _opened(names, asked)
    name, first = next(iter(readings.items()))
    own = request.own_effects(asked.choice, models[name].instrument, first)
    with result_folder(out) as folder:
        found = bc.calibrate_channels(
            models,
            readings,
            holdout=kept or None,
            effects=own,
            **_how(asked, first, settings),
        )
        from bayescal._cli.output import channels_in_short
        from bayescal._report.save_search import channels_data, draw_channels, write_channels

        def write() -> bool:
            if folder is not None:
                write_channels(found, folder)
            fitted = {n: t.final.calibration.readings for n, t in found.trails.items()}
            print_notes(flag for flag in _flags(fitted) if flag not in _flags(readings))
            print_result(channels_data(found) if json_ else found)
            if not json_:
                print(f"\nIN SHORT\n\n{channels_in_short(found)}")
            made = folder is None or drawn(draw_channels, found, folder)
            if folder is not None and not json_:
                print(f"\nwritten: {folder}/channels.json, and a folder for each channel")
            return made

        made = deadline.finish(write)
    exit_unless(found.ok, found.reason)
    exit_unless_drawn(made)


def _opened(
    names: Sequence[str], asked: SearchRequest, early: Early | None = None
) -> tuple[dict[str, Model], dict[str, Measurements], dict[str, Measurements]]:
    """Models, readings and hold-out data by channel ("" where there is one output); what is to be noted is said."""
    from bayescal._cli import request

    general, models, readings = request.open_channels(names, asked, early)
    kept = request.open_kept(general if names else models[""].instrument, asked, names)
    print_notes(_flags(readings))
    return models, readings, kept


def _how(asked: SearchRequest, readings: Measurements, settings: dict[str, Any]) -> dict[str, Any]:
    """How `calibrate` and `calibrate_channels` are to search."""
    from bayescal._cli import request

    method = request.method_named(asked.method)
    reference = request.reference_of(asked.choice.reference, readings)
    return {"method": method, "reference": reference, **settings}


def _flags(readings: Mapping[str, Measurements]) -> list[str]:
    """Notes on the readings of channels: what holds for all once, the others with the channel's name."""
    said = {
        flag: [n for n, one in readings.items() if flag in one.flags]
        for r in readings.values()
        for flag in r.flags
    }
    return [
        flag if len(names) == len(readings) else f"{', '.join(names)}: {flag}"
        for flag, names in said.items()
    ]


# The instrument whose output does not change but by its noise and temperature.
AT_REST = "still_sensor"


@commands.example("bayescal fit readings.csv --instrument mems_gyro --out result")
def fit(
    asked: ReadRequest,
    noise: str | None = None,
    method: str = "marginal",
    time_limit: float | None = None,
    seed: int = 0,
    out: Path | None = None,
    json_: bool = False,
) -> None:
    """Fit one model: coefficients with uncertainty."""
    from bayescal._cli.request import law_named, method_named, open_request, reference_of

    with deadline.until(time_limit, apart=True), result_folder(out) as folder:
        _, model, readings = open_request(asked)
        model = model if noise is None else model.with_noise(law_named(noise, model, readings))
        print_notes(readings.flags)
        calibration = bc.fit(
            model,
            readings,
            method_named(method),
            seed=seed,
            strict=False,
            reference=reference_of(asked.choice.reference, readings),
        )
        from bayescal._calibration.description import identity
        from bayescal._cli.output import fit_data
        from bayescal._report.whole_folder import whole_folder

        def write() -> bc.Calibration:
            judged = calibration
            if calibration.verdict.ok:
                judged = calibration.with_verdict(against=(*map(str, calibration.conflicts),))
            if folder is not None:
                with whole_folder(folder, identity(judged)) as hidden:
                    judged.save(hidden / "calibration.nc")
            print_result(fit_data(judged) if json_ else judged)
            if folder is not None and not json_:
                print(f"\nwritten: {folder / 'calibration.nc'}")
            return judged

        calibration = deadline.finish(write)
    exit_unless(calibration.verdict.reliable, calibration.verdict.why_not)


@commands.example("bayescal check result/calibration.nc")
def check(
    calibration: Path,
    own: OwnParts,
    json_: bool = False,
) -> None:
    """Where a fitted model fails."""
    from bayescal._cli.saved import load_saved

    checked = bc.check(load_saved(calibration, own))
    print_result([{"step": 0, **row} for row in checked.data()] if json_ else checked)


@commands.example("bayescal discover result/calibration.nc")
def discover(
    calibration: Path,
    own: OwnParts,
    typed: list[str] | None = None,
    max_effects: int = 5,
    time_limit: float | None = None,
    ignore: list[str] | None = None,
    covariates: str | None = None,
    next_experiment: bool = False,
    json_: bool = False,
) -> None:
    """Which effect is missing from a fitted model; and which experiment would tell rivals apart."""
    from bayescal._cli.output import unexplained_text
    from bayescal._cli.request import own_effects
    from bayescal._cli.saved import load_saved
    from bayescal._report.result_json import experiment_data, missing_data

    loaded = load_saved(calibration, own)
    model, readings = loaded.model, loaded.readings
    choice = ModelOptions(effects_file=own.effects_file, typed=typed)
    effects = own_effects(choice, model.instrument, readings)
    allowed = options.causes(ignore, covariates)
    with deadline.until(time_limit, apart=True) as end:
        found = bc.discover(loaded, effects=effects, max_effects=max_effects, **allowed)

        def tell() -> None:
            checked = bc.check(loaded)
            text = f"{found}\n{unexplained_text(loaded, checked, effects)}".rstrip()
            data = missing_data(found, 0, checked)
            if next_experiment and not end.over:
                ranked = bc.next_experiment(loaded, found.rivals) if len(found.rivals) > 1 else None
                text += (
                    f"\n\n{ranked or 'next experiment: nothing here has a rival to be told from'}"
                )
                data["next_experiment"] = None if ranked is None else experiment_data(ranked)
            if end.over and next_experiment:
                text += f"\n\nwhat was asked for beside the search was left out or cut short ({end.why})"
            print_result(data if json_ else text)

        deadline.finish(tell)


@commands.example(
    "bayescal compare readings.csv --instrument mems_gyro --structure line "
    "--structure line+bias.thermal_lag"
)
def compare(
    *,
    files: list[Path],
    instrument: str,
    structure: list[str] | None = None,
    columns: ColumnOptions,
    reference: list[str] | None = None,
    effects_file: Path | None = None,
    typed: list[str] | None = None,
    average: str | None = None,
    method: str = "marginal",
    seed: int = 0,
    json_: bool = False,
) -> None:
    """Set model structures side by side: leave-one-group-out, leave-one-out, evidence, weights."""
    from bayescal._cli import request

    choice = ModelOptions(effects_file=effects_file, typed=typed)
    asked = ReadRequest(instrument, files, columns, replace(choice, typed=None), average)
    chosen, _, readings = request.open_request(asked)
    names = structure or [name for name, _ in chosen.structures]
    if len(set(names)) < 2:
        raise InputError("compare needs two structures or more: give --structure twice, or never")
    own = request.own_effects(choice, chosen, readings)
    models = {name: request.structure_with(chosen, name, own) for name in names}
    for model in models.values():
        model.require(readings)
    print_notes(readings.flags)
    constants, how = request.reference_of(reference, readings), request.method_named(method)
    fits = {
        name: bc.fit(model, readings, how, seed=seed, strict=False, reference=constants)
        for name, model in models.items()
    }
    comparison = bc.compare(fits)
    print_result(as_json(comparison) if json_ else comparison)
    failed = [f"{n}: {' '.join(c.verdict.reasons)}" for n, c in fits.items() if not c.verdict.ok]
    exit_unless(not failed, "; ".join(failed))


@commands.example("bayescal predict result/calibration.nc new.csv --out predicted.csv")
def predict(
    *,
    calibration: Path,
    files: list[Path],
    out: Path | None = None,
    same_record: bool = False,
    columns: ColumnOptions,
    average: str | None = None,
    own: UsedParts,
    json_: bool = False,
) -> None:
    """Predict readings with a calibration, and compare."""
    from bayescal._cli.output import write_prediction
    from bayescal._cli.request import averaged
    from bayescal._cli.saved import load_saved
    from bayescal._core.formatting import number
    from bayescal._data.unit_conversion import unit_label

    loaded = load_saved(calibration, own)
    how = {"nominal_scale": loaded.readings.scale, **columns.for_read()}
    readings = bc.read(list(files), loaded.model.instrument, **how)
    columns.keep()
    readings = averaged(readings, average)
    print_notes(readings.flags)
    prediction = bc.predict(loaded, readings, same_record=same_record)
    if out is not None:
        write_prediction(prediction, readings, out)
    expected = float((prediction.sd**2).mean()) ** 0.5
    unit = unit_label(loaded.unit)
    text = (
        f"{len(readings)} readings: rms error {number(prediction.rmse)} {unit}, "
        f"expected {number(expected)} {unit}" + (f"\nwritten: {out}" if out else "")
    )
    data = {"rows": len(readings), "rmse": prediction.rmse, "expected_rmse": expected}
    print_result(
        {**data, "unit": loaded.unit, "file": str(out) if out else None} if json_ else text
    )
    exit_unless(loaded.verdict.reliable, loaded.verdict.why_not)


@commands.example(
    "bayescal noise still.csv --columns output=gyro_x --unit gyro_x=deg/s --yaml imu.yaml"
)
def noise(
    files: list[Path],
    columns: ColumnOptions,
    channels: str | None = None,
    yaml: Path | None = None,
    quantile: float = 0.95,
    topic: str = "/imu0",
    average: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    json_: bool = False,
) -> None:
    """Noise density, bias instability and random walk of a sensor at rest, with 95 % intervals."""
    from bayescal._cli.request import open_channels
    from bayescal._core.atomic_file import write_text
    from bayescal._report.whole_folder import drawing, folders_of, whole_folder
    from bayescal._use.kalibr_file import kalibr_yaml

    if not 0 < quantile < 1:
        raise InputError(
            f"--quantile {quantile:g}: give a probability between 0 and 1, such as 0.95"
        )
    asked = ReadRequest(AT_REST, files, columns, ModelOptions(), average)
    names = [] if channels is None else options.channel_names(channels)
    _, _, readings = open_channels(names, asked)
    if channels is None:  # called as the file calls its output
        one = readings[""]
        readings = {next((s.output for s in one.sources if s.output), "output"): one}
    with result_folder(out) as folder:
        found = {}
        for name, one in readings.items():
            print_notes(one.flags)
            found[name] = bc.noise(one, seed=seed)
            if not json_:
                print(f"{name}\n\n{found[name]}\n")
        if json_:
            print_result({name: one.data() for name, one in found.items()})
        written = []
        if yaml is not None:
            written.append(write_text(kalibr_yaml(found, topic, quantile), yaml))
        pictures = {f"noise_{place}.png": name for name, place in folders_of(found).items()}

        def draw() -> None:
            assert folder is not None
            with drawing("The Allan deviation"), whole_folder(folder) as hidden:
                from bayescal._report.plots import own_style

                for picture, name in pictures.items():
                    with own_style():
                        bc.plot.save(bc.plot.noise(found[name]), hidden / picture)
            written.extend(folder / picture for picture in pictures)

        made = folder is None or drawn(draw)
        if written and not json_:
            print(f"written: {', '.join(map(str, written))}")
    exit_unless_drawn(made)
