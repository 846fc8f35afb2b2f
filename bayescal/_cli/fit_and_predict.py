"""Commands from readings to a calibration: fit, check, discover, compare, predict; and to the noise of a sensor.

Imports stand where they are first needed: a bad file is refused before a sampler loads.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import exit_unless, print_notes, print_result, result_folder
from bayescal._cli.options import (
    ColumnOptions,
    Commands,
    ModelOptions,
    OwnParts,
    ReadRequest,
    UsedParts,
)
from bayescal._core import deadline
from bayescal._core.as_json import as_json
from bayescal._core.errors import InputError

commands = Commands()
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
                judged = calibration.judged(calibration.conflicts)
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
    from bayescal._report.result_json import check_data

    checked = bc.check(load_saved(calibration, own))
    print_result(check_data(checked, 0) if json_ else checked)


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
    calibrate_screen: int | None = None,
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
            if calibrate_screen is not None and not end.over:
                rate = bc.false_reports(
                    loaded, calibrate_screen, effects=effects, max_effects=max_effects
                )
                text += f"\n\n{rate}"
                data["false_reports"] = as_json(rate)
            if end.over and (next_experiment or calibrate_screen):
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
    from bayescal._report.whole_folder import folders_of
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
        if folder is not None:
            written += [
                bc.plot.save(bc.plot.noise(found[name]), folder / f"noise_{place}.png")
                for name, place in folders_of(found).items()
            ]
        if written and not json_:
            print(f"written: {', '.join(map(str, written))}")
