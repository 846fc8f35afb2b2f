"""Commands for what instruments offer, for the whole loop, and from readings to a calibration.

What instruments offer: instruments, effects, simulate; of some, pairs of devices. The whole loop:
`calibrate`, of one output or of several channels of one unit. From readings to a calibration: fit, check, discover,
compare, predict; and to the noise of a sensor.

Imports stand where they are first needed: a bad file is refused before a sampler loads.
"""

from __future__ import annotations

import inspect
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal._cli import options, request, saved
from bayescal._cli.console import Answer, drawn, print_notes, print_result, result_folder
from bayescal._cli.options import (
    ColumnOptions,
    Commands,
    ModelOptions,
    OwnParts,
    ReadRequest,
    SearchRequest,
    UsedParts,
)
from bayescal._cli.request import instrument_named
from bayescal._core import deadline
from bayescal._core.annex import first_offered
from bayescal._core.as_json import as_json
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.settings import Settings, use_settings
from bayescal._report.whole_folder import (
    AVERAGED,
    CALIBRATION,
    CHANNELS,
    MANIFEST,
    drawing,
    files_of,
    folders_of,
    whole_folder,
)

commands = Commands()
PAIR_SELECTIONS = "bayescal.pair_selections"
"""`select(calibration, criterion=…)` gives a table of pairs that prints itself and has `data()`, plain JSON."""

# The instrument whose output does not change but by its noise and temperature.
AT_REST = "still_sensor"


@commands.example("bayescal instruments --check level.py:INSTRUMENT")
def instruments(
    named: str | None = None,
    check: str | None = None,
    readings: list[Path] | None = None,
    seed: int = 0,
) -> Answer:
    """List installed instruments, describe one, or check your own."""
    from bayescal._model.installed import installed_instruments

    if check is not None:
        chosen = instrument_named(check)
        given = bc.read(list(readings), chosen) if readings else None
        found = bc.check_instrument(chosen, given, seed=seed)
        return Answer(found, ok=found.ok, why=" ".join(found.errors))
    if readings:
        raise InputError("--readings are for --check: say which instrument, my.py:INSTRUMENT")
    from bayescal._cli.output import instrument_shown, instruments_listed

    if named is not None:
        return Answer(*instrument_shown(instrument_named(named)))
    return Answer(*instruments_listed(installed_instruments()))


@commands.example("bayescal effects --instrument mems_gyro")
def effects(instrument: str, effects_file: Path | None = None) -> Answer:
    """List an instrument's effects with their sizes and sources."""
    from bayescal._cli.output import effects_listed

    chosen = instrument_named(instrument)
    own = request.user_effects(effects_file)
    kinds = {"baseline": chosen.effects, "candidate": chosen.candidates, "your own": own}
    return Answer(*effects_listed(kinds))


@commands.example(
    "bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --out sim.csv"
)
def simulate(
    instrument: str,
    out: Path,
    effect: list[str] | None = None,
    noise_law: str = "white",
    seed: int = 0,
) -> Answer:
    """Simulate a test campaign, with effects hidden in it."""
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
    text = f"{out}: {len(readings)} readings, hidden: {hiding}; seed {seed}"
    data = {"file": str(out), "rows": len(readings), "seed": seed, "noise_law": noise_law}
    return Answer(text, {**data, "effects": hidden})


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
) -> Answer:
    """Rank pairs of devices by their probability to be the best."""
    asked = ReadRequest(instrument, files, columns, ModelOptions(add=add), average)
    chosen, model, readings = request.open_request(asked)
    select = offered(PAIR_SELECTIONS, chosen.name)
    if select is None:
        raise InputError(f"instrument {chosen.name!r} does not choose its devices in pairs")
    print_notes(readings.flags)
    fitted = bc.fit(model, readings, seed=seed, strict=False)
    verdict = fitted.verdict
    return Answer(select(fitted, criterion=criterion), ok=verdict.ok, why=" ".join(verdict.reasons))


@commands.example("bayescal demo --out demo_output")
def demo(out: Path = Path("demo_output"), seed: int = 0, json_: bool = False) -> Answer:
    """Find an effect that is hidden in simulated readings."""
    files = out / "readings.csv", out / "holdout.csv"
    with result_folder(out):
        for number, file in enumerate(files, 1):
            how = {"effect": ["bias.thermal_lag=0.05"], "seed": seed + number}
            print_notes([simulate(instrument="mems_gyro", out=file, **how).shown])
        given = "mems_gyro", [files[0]], ColumnOptions(), ModelOptions()
        asked = SearchRequest(*given, holdout=[files[1]], seed=seed)
        found = calibrate(asked=asked, out=out, json_=json_)
    called = sys.argv[0]
    own = "bayescal" if shutil.which("bayescal") == called else called
    line = f"{own} calibrate FILE.csv --instrument mems_gyro --out result"

    def written() -> str:
        of_demo = found.written() if found.written else ""
        return f"{of_demo}\nthe picture: {out / 'loop.png'}\nwith readings of your own: {line}"

    return replace(found, written=written)


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
) -> Answer:
    """Fit, find what is missing, add it, see the error fall.

    The first table stands as soon as the first fit does; Ctrl-C then ends the search with the best so far. Channels of
    one unit are searched together: structures and noise of their own, one body for all.
    """
    names = options.channel_names(channels)
    if names and output_unit is not None:
        raise InputError("--output-unit is of one output: leave it out, or --channels")
    if not names and out is not None and (out / CHANNELS).is_file():
        raise InputError(
            f"{out} holds the channels of a unit ({CHANNELS}), of which reports and parameters would still be made: "
            "give another folder, or remove it"
        )
    models, readings, kept = request.searched(names, asked)
    name, first = next(iter(readings.items()))
    own = request.own_effects(asked.choice, models[name].instrument, first)
    how = {
        "effects": own,
        "method": request.method_named(asked.method),
        "reference": request.reference_of(asked.choice.reference, first),
        **asked.settings(),
        **options.causes(None, covariates),
    }
    with use_settings(Settings(finer_noise=not simple_noise)), result_folder(out) as folder:
        if output_unit is not None:
            from bayescal._report.report_text import output_factor

            scale = first.scale or models[name].instrument.nominal_scale
            output_factor(output_unit, first.unit("output") or "1", scale)
        from bayescal._cli.output import ConsoleReporter, channels_text, loop_text
        from bayescal._report.result_json import result
        from bayescal._report.save_search import (
            channels_data,
            draw_search,
            searches_of,
            write_results,
        )

        told = ConsoleReporter(json_ or bool(names), verbose)
        if names:
            how |= {"holdout": kept or None, "follow": told.of_channel}
            found = bc.calibrate_channels(models, readings, **how)
        else:
            found = bc.calibrate(models[name], first, holdout=kept.get(""), follow=told, **how)
        if folder is not None:
            write_results(found, folder)
        trails = found.trails if isinstance(found, bc.Channels) else {"": found}
        fitted = {n: t.final.calibration.readings for n, t in trails.items()}
        before = request.flags_of(readings)
        print_notes(flag for flag in request.flags_of(fitted) if flag not in before)
        if isinstance(found, bc.Channels):
            shown, why = channels_data(found) if json_ else channels_text(found), found.reason
        else:
            text = "" if json_ else loop_text(found, own, told.begun, verbose, output_unit)
            shown, why = result(found) if json_ else text, found.gate.reason
        answered = Answer(shown, ok=found.ok, why=why)
        if folder is None:
            return answered
        usual = ("result.json", CALIBRATION, AVERAGED, "loop.png", MANIFEST)

        def written() -> str:
            if names:
                return f"{folder}/{CHANNELS}, and a folder for each channel"
            return f"{folder}/{', '.join(n for n in usual if n in (*files_of(folder), MANIFEST))}"

        pictures = partial(drawn, draw_search, searches_of(found), folder)
        return replace(answered, pictures=pictures, written=written)


@commands.example("bayescal fit readings.csv --instrument mems_gyro --out result")
def fit(
    asked: ReadRequest,
    noise: str | None = None,
    method: str = "marginal",
    time_limit: float | None = None,
    seed: int = 0,
    out: Path | None = None,
    json_: bool = False,
) -> Answer:
    """Fit one model: coefficients with uncertainty."""
    with result_folder(out) as folder:
        _, model, readings = request.open_request(asked)
        if noise is not None:
            model = model.with_noise(request.law_named(noise, model, readings))
        print_notes(readings.flags)
        reference = request.reference_of(asked.choice.reference, readings)
        how = {"seed": seed, "strict": False, "reference": reference}
        calibration = bc.fit(model, readings, request.method_named(method), **how)
        from bayescal._calibration.storage import identity
        from bayescal._cli.output import fit_data

        if calibration.verdict.ok:
            calibration = calibration.with_verdict(against=calibration.conflicts)
        shown, verdict = fit_data(calibration) if json_ else calibration, calibration.verdict
        answered = Answer(shown, ok=verdict.reliable, why=verdict.why_not)
        if folder is None:
            return answered
        with whole_folder(folder, identity(calibration)) as hidden:
            calibration.save(hidden / CALIBRATION)
        return replace(answered, written=lambda: f"{folder / CALIBRATION}")


@commands.example("bayescal check result/calibration.nc")
def check(calibration: Path, own: OwnParts) -> Answer:
    """Say where a fitted model fails."""
    checked = bc.check(saved.load_saved(calibration, own))
    return Answer(checked, [{"step": 0, **row} for row in checked.data()])


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
) -> Answer:
    """Say which effect is missing, and how to tell rivals apart."""
    loaded = saved.load_saved(calibration, own)
    choice = ModelOptions(effects_file=own.effects_file, typed=typed)
    effects = request.own_effects(choice, loaded.model.instrument, loaded.readings)
    allowed = options.causes(ignore, covariates)
    found = bc.discover(loaded, effects=effects, max_effects=max_effects, **allowed)
    from bayescal._cli.output import unexplained_text
    from bayescal._report.result_json import experiment_data, missing_data

    checked, end = bc.check(loaded), deadline.current()
    text = f"{found}\n{unexplained_text(loaded, checked, effects)}".rstrip()
    data = missing_data(found, 0, checked)
    if next_experiment and end.over:
        text += f"\n\nnext experiment: left out ({end.why})"
    elif next_experiment:
        ranked = bc.next_experiment(loaded, found.rivals) if len(found.rivals) > 1 else None
        text += f"\n\n{ranked or 'next experiment: nothing here has a rival to be told from'}"
        data["next_experiment"] = None if ranked is None else experiment_data(ranked)
    return Answer(text, data)


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
    time_limit: float | None = None,
    seed: int = 0,
) -> Answer:
    """Compare structures by leave-one-group-out and evidence."""
    choice = ModelOptions(effects_file=effects_file, typed=typed)
    asked = ReadRequest(instrument, files, columns, replace(choice, typed=None), average)
    chosen, _, readings = request.open_request(asked)
    names = structure or [name for name, _ in chosen.structures]
    if len(set(names)) < 2:
        raise InputError("compare needs two structures or more: give --structure twice, or never")
    own = request.own_effects(choice, chosen, readings)
    models = {}
    for name in names:  # "line+bias.thermal_lag"
        first, *added = (part.strip() for part in name.split("+"))
        models[name] = request.compose(chosen, ModelOptions(structure=first, add=added), own)
        models[name].require(readings)
    print_notes(readings.flags)
    constants, how = request.reference_of(reference, readings), request.method_named(method)
    fits, given = {}, {"seed": seed, "strict": False, "reference": constants}
    for i, (name, model) in enumerate(models.items()):
        with deadline.sooner(1 / (len(models) - i)):
            fits[name] = bc.fit(model, readings, how, **given)
    comparison = bc.compare(fits)
    failed = [f"{n}: {' '.join(c.verdict.reasons)}" for n, c in fits.items() if not c.verdict.ok]
    return Answer(comparison, as_json(comparison), ok=not failed, why="; ".join(failed))


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
) -> Answer:
    """Predict readings with a calibration, and compare."""
    loaded = saved.load_saved(calibration, own)
    how = columns.for_read()
    readings = bc.read(list(files), loaded.model.instrument, like=loaded.readings, **how)
    columns.keep()
    readings = request.averaged(readings, average)
    print_notes(readings.flags)
    prediction = bc.predict(loaded, readings, same_record=same_record)
    from bayescal._cli.output import write_prediction
    from bayescal._core.formatting import number
    from bayescal._data.unit_conversion import unit_label

    if out is not None:
        write_prediction(prediction, readings, out)
    expected = float((prediction.sd**2).mean()) ** 0.5
    unit = unit_label(loaded.unit)
    text = (
        f"{len(readings)} readings: rms error {number(prediction.rmse)} {unit}, "
        f"expected {number(expected)} {unit}" + (f"\nwritten: {out}" if out else "")
    )
    data = {"rows": len(readings), "rmse": prediction.rmse, "expected_rmse": expected}
    data |= {"unit": loaded.unit, "file": str(out) if out else None}
    return Answer(text, data, ok=loaded.verdict.reliable, why=loaded.verdict.why_not)


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
    time_limit: float | None = None,
    seed: int = 0,
    out: Path | None = None,
    json_: bool = False,
) -> Answer:
    """Estimate noise density, bias instability and random walk."""
    if not 0 < quantile < 1:
        raise InputError(
            f"--quantile {quantile:g}: give a probability between 0 and 1, such as 0.95"
        )
    asked = ReadRequest(AT_REST, files, columns, ModelOptions(), average)
    _, _, readings = request.open_channels(options.channel_names(channels), asked)
    if channels is None:  # called as the file calls its output
        one = readings[""]
        readings = {next((s.output for s in one.sources if s.output), "output"): one}
    with result_folder(out) as folder:
        found = {}
        print_notes(request.flags_of(readings))
        channels = request.each_device(readings)
        for i, (name, one) in enumerate(channels.items()):
            with deadline.sooner(1 / (len(channels) - i)):
                found[name] = bc.noise(one, seed=seed)
            if not json_:
                print(f"{name}\n\n{found[name]}\n")
        if json_:
            print_result({name: one.data() for name, one in found.items()})
        written = []
        if yaml is not None:
            text = first_offered("noise_file", "--yaml")(found, topic, quantile)
            written.append(write_text(text, yaml))
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
        claims = ((name, claim) for name, one in found.items() for claim in one.claims)
        doubts = (f"{name}: {claim}" for name, claim in claims if claim.severity != "note")
        return Answer(None, doubt=" ".join(doubts), pictures=lambda: made)
