"""The core commands.

Instruments: instruments, effects, simulate, pairs (of devices), demo. Calibration: calibrate (the full search), fit,
check, discover, compare, predict, noise. Use of results: compensate, export, budget, report.

Imports are local to the functions that need them, so that a bad file is refused before a sampler loads.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

from typer import Argument

import bayescal as bc
from bayescal._cli import options, request
from bayescal._cli.options import (
    Answer,
    AsJson,
    ColumnOptions,
    Command,
    DecisionRule,
    DefinitionOptions,
    FitRequest,
    MemberOptions,
    ModelOptions,
    ReadRequest,
    SearchRequest,
    Shared,
    StructureOptions,
    Texts,
    draw_safely,
    opt,
    parse_numbers,
    split_optional,
)
from bayescal._cli.request import instrument_named
from bayescal._core import deadline
from bayescal._core.annex import load_entries, load_entry
from bayescal._core.atomic_file import create_result_folder, write_text
from bayescal._core.errors import InputError
from bayescal._core.formatting import wrap
from bayescal._core.json_data import as_json
from bayescal._core.progress import iterate_with_progress, print_notes
from bayescal._core.settings import Settings, use_settings
from bayescal._report.whole_folder import (
    AVERAGED,
    CALIBRATION,
    CHANNELS,
    MANIFEST,
    guard_drawing,
    name_folders,
    read_hashes,
    replace_folder,
)

PAIR_SELECTIONS = "bayescal.pair_selections"
"""Group of entry points: functions `select(calibration, criterion=…)` that return a printable table."""
SIMULATED = (
    "simulated: bias.constant 21.5 °/s, bias.temperature 0.0535 °/s/°C, noise.white 0.05 °/s, bias.thermal_lag 0.05 "
    "°/s/°C with tau 300 s: the bias is 0.05·300/0.0535 = 280 s late, which is tau in forms where the sensor lags"
)


class InstrumentsCommand(AsJson, Command):
    """List installed instruments; describe or check one."""

    example = "bayescal instruments --check level.py:INSTRUMENT --readings bar.csv"
    name: str | None = Argument(
        None, metavar="NAME", help="Instrument to describe; default: list all instruments."
    )
    check: str | None = opt(
        "Check this instrument: fit simulated readings and compare with the truth.",
        metavar="my.py:INSTRUMENT",
    )
    readings: list[Path] | None = opt(
        "With --check: files whose columns replace those of the simulator.",
        callback=options.check_files_exist,
    )
    seed: int = Shared.seed

    def answer(self) -> Answer:
        from bayescal._model.installed import load_instruments

        if self.check is not None:
            instrument = instrument_named(self.check)
            readings = bc.read(self.readings, instrument) if self.readings else None
            check = bc.check_instrument(instrument, readings, seed=self.seed)
            return Answer(check, why=" ".join(check.errors))
        if self.readings:
            raise InputError("--readings needs --check my.py:INSTRUMENT")
        from bayescal._cli.output import format_instrument, format_instruments

        if self.name is not None:
            return Answer(*format_instrument(instrument_named(self.name)))
        return Answer(*format_instruments(load_instruments()))


class EffectsCommand(AsJson, Command):
    """List an instrument's effects with their sizes and sources."""

    example = "bayescal effects --instrument mems_gyro"
    instrument: str = Shared.instrument
    effects_file: Path | None = Shared.effects

    def answer(self) -> Answer:
        from bayescal._cli.output import format_effects

        instrument = instrument_named(self.instrument)
        effects_by_kind = {"baseline": instrument.effects, "candidate": instrument.candidates}
        effects_by_kind["your own"] = request.load_user_effects(self.effects_file)
        return Answer(*format_effects(effects_by_kind))


class SimulateCommand(AsJson, Command):
    """Simulate a test campaign with hidden effects."""

    example = "bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --out a.csv"
    instrument: str = Shared.instrument
    out: Path = opt("Output file (.csv).", ...)
    effect: Texts = opt("Effect to hide, name=size; repeatable.")
    seed: int = Shared.seed

    def answer(self) -> Answer:
        from bayescal._data.unit_conversion import unit_label

        instrument = instrument_named(self.instrument)
        hidden_effects = parse_numbers(self.effect, "--effect")
        try:
            readings = instrument.simulate(hidden_effects, seed=self.seed)
        except ValueError as error:
            raise InputError(str(error)) from None
        readings.write(self.out)
        units = {n: unit_label(e.coefficients[0].unit) for n, e in instrument.known.items()}
        terms = {n: e.equation.split(",")[0].split(" + ")[0] for n, e in instrument.known.items()}
        words = {n: f"{units[n]} in {term}".lstrip() for n, term in terms.items()}
        texts = (f"{n} = {v:g} {words.get(n, '')}".rstrip() for n, v in hidden_effects.items())
        listing = ", ".join(texts) or "none"
        text = f"{self.out}: {len(readings)} readings, hidden effects: {listing}; seed {self.seed}"
        data = {"file": str(self.out), "rows": len(readings), "seed": self.seed}
        return Answer(text, {**data, "effects": hidden_effects})


class PairsCommand(ReadRequest, AsJson, Command):
    """Rank device pairs by their probability of being the best."""

    example = "bayescal pairs readings.csv"
    instrument: str = opt("Instrument type of the devices.", "differential_pair")
    criterion: Literal["residual", "ratio-variance", "ratio-variance-raw"] = opt(
        "Selection criterion.", "residual"
    )
    add: Texts = Shared.add
    average: str | None = Shared.average
    seed: int = Shared.seed

    def answer(self) -> Answer:
        selections = [*entry_points(group=PAIR_SELECTIONS, name=self.instrument)]
        if not selections:
            raise InputError(
                f"instrument {self.instrument!r} does not support the selection of pairs: omit --instrument"
            )
        _, model, readings = request.open_request(self)
        print_notes(readings.flags)
        calibration = bc.fit(model, readings, seed=self.seed, strict=False)
        pairs = selections[0].load()(calibration, criterion=self.criterion)
        return Answer(pairs, why=" ".join(calibration.verdict.reasons))


class DemoCommand(AsJson, Command):
    """Find an effect hidden in simulated readings."""

    example = "bayescal demo --out demo_output"
    out: Path = opt("Output folder.", Path("demo_output"))
    seed: int = Shared.seed

    def answer(self) -> Answer:
        from bayescal._calibration.summary import format_rows

        gyro, files = "mems_gyro", (self.out / "readings.csv", self.out / "holdout.csv")
        hidden = ["bias.thermal_lag=0.05"]
        with create_result_folder(self.out):
            for seed, file in enumerate(files, self.seed + 1):
                simulation = SimulateCommand(instrument=gyro, out=file, effect=hidden, seed=seed)
                print_notes([simulation.answer().content])
            arguments = {"files": [files[0]], "holdout": [files[1]], "out": self.out}
            kwargs = {"instrument": gyro, "seed": self.seed, "json_": self.json_}
            calibrated = CalibrateCommand(**arguments, **kwargs).answer()
        program = sys.argv[0]
        command = "bayescal" if shutil.which("bayescal") == program else program
        line = f"{command} calibrate FILE.csv --instrument mems_gyro --out result"
        paths = [self.out / n for n in (CALIBRATION, AVERAGED) if (self.out / n).is_file()]
        rows = format_rows(bc.load(paths[-1]), bc.load(paths[0]).model.names).items()
        found = ", ".join(f"{n} {row[1]} {row[2]}" for n, row in rows if "[" not in n)
        hints = [wrap(SIMULATED), wrap(f"found: {found}"), f"picture: {self.out / 'loop.png'}"]
        written = "\n".join([calibrated.written, *hints, f"with your own readings: {line}"])
        return replace(calibrated, written=written)


class CalibrateCommand(SearchRequest, AsJson, Command):
    """Fit a model, find missing effects, add them.

    The first table is printed after the first fit; Ctrl-C then ends the search with the best model so far. Channels of
    a device are searched jointly: each with its own structure and noise, with common body temperatures.
    """

    example = "bayescal calibrate readings.csv --instrument mems_gyro --out result"
    channels: str | None = Shared.channels
    simple_noise: bool = opt("Omit sums of noise terms: faster for long records.", False)
    covariates: str | None = Shared.covariates
    out: Path | None = Shared.folder
    verbose: bool = opt("Print all candidates of every step.", False)

    def answer(self) -> Answer:
        names = options.parse_channels(self.channels)
        if not names and self.out is not None and (self.out / CHANNELS).is_file():
            raise InputError(
                f"{self.out} contains the channels of a device ({CHANNELS}), which reports and parameters would still "
                "include: give another folder, or remove this one"
            )
        search_settings = Settings(finer_noise=not self.simple_noise)
        with use_settings(search_settings), create_result_folder(self.out) as folder:
            models, readings, holdout = request.open_search(names, self)
            name, first_readings = next(iter(readings.items()))
            settings = {
                "effects": request.load_effects(self, models[name].instrument, first_readings),
                "method": request.create_method(self.method),
                "reference": dict(parse_numbers(self.reference, "--reference")),
                **self.settings(),
                "covariates": split_optional(self.covariates),
            }
            from bayescal._cli.output import ConsoleReporter, format_search

            reporter = ConsoleReporter(self.json_ or bool(names), self.verbose, names)
            if names:
                settings |= {"holdout": holdout or None, "follow": reporter.follow}
                search = bc.calibrate_channels(models, readings, **settings)
            else:
                settings |= {"holdout": holdout.get(""), "follow": partial(reporter.follow, "")}
                search = bc.calibrate(models[name], first_readings, **settings)
            all_drawn, written = True, ""
            if folder is not None:
                all_drawn = draw_safely(search.save, folder)
                possible_files = ("result.json", CALIBRATION, AVERAGED, "loop.png", MANIFEST)
                files = (n for n in possible_files if n in (*read_hashes(folder), MANIFEST))
                listing = f"{CHANNELS}, and a folder per channel" if names else ", ".join(files)
                written = f"{folder}/{listing}"
            paths = search.search_paths if isinstance(search, bc.Channels) else {"": search}
            fitted_readings = {n: t.final.calibration.readings for n, t in paths.items()}
            flags, first_flags = map(request.flags_of, (fitted_readings, readings))
            print_notes(flag for flag in flags if flag not in first_flags)
            text_options = {"has_begun": reporter.has_begun, "verbose": self.verbose}
            content = format_search(search, self.json_, **text_options)
            gate = search if isinstance(search, bc.Channels) else search.gate
            reason = "" if search.ok else gate.reason
            return Answer(content, why=reason, drawn=all_drawn, written=written)


class FitCommand(FitRequest, ModelOptions, ReadRequest, AsJson, Command):
    """Fit one model: coefficients with uncertainties."""

    example = "bayescal fit readings.csv --instrument mems_gyro --out result"
    noise: str | None = opt(
        "Noise law: student_t, ornstein_uhlenbeck, heteroscedastic(temperature), or one of --effects.",
        metavar="NAME",
    )
    out: Path | None = Shared.folder

    def answer(self) -> Answer:
        with create_result_folder(self.out) as folder:
            _, model, readings = request.open_request(self)
            if self.noise is not None:
                model = model.with_noise(request.find_noise_law(self.noise, model, readings))
            print_notes(readings.flags)
            reference = dict(parse_numbers(self.reference, "--reference"))
            kwargs = {"seed": self.seed, "strict": False, "reference": reference}
            calibration = bc.fit(model, readings, request.create_method(self.method), **kwargs)
            from bayescal._cli.output import convert_fit

            if calibration.verdict.ok:
                calibration = calibration.with_verdict(against=calibration.conflicts)
            content = convert_fit(calibration) if self.json_ else calibration
            verdict, written = calibration.verdict, ""
            if folder is not None:
                with replace_folder(folder) as partial_folder:
                    calibration.save(partial_folder / CALIBRATION)
                written = f"{folder / CALIBRATION}\nto test the residuals: bayescal check {shlex.quote(str(folder))}"
            return Answer(content, why=verdict.why_not, written=written)


class CheckCommand(DefinitionOptions, AsJson, Command):
    """Check the residuals of a fitted model."""

    example = "bayescal check result/calibration.nc"
    calibration: Path = Shared.calibration

    def answer(self) -> Answer:
        calibration = request.load_saved(self.calibration, self)
        from bayescal._calibration.check import why_not

        reason = why_not(calibration, check := bc.check(calibration))
        data = {"check": [{"step": 0, **row} for row in check.to_json_data()]}
        data["verdict"] = {"ok": not reason, "reason": reason}
        return Answer(f"{check}\nverdict: {'NOT ' if reason else ''}fit for use", data, why=reason)


class DiscoverCommand(DefinitionOptions, AsJson, Command):
    """Find missing effects, and tests to distinguish them."""

    example = "bayescal discover result/calibration.nc"
    calibration: Path = Shared.calibration
    typed: Texts = Shared.typed
    max_effects: int = Shared.max_effects
    time_limit: float | None = Shared.time_limit
    ignore: Texts = opt("Column to exclude as a covariate; repeatable.", metavar="COLUMN")
    covariates: str | None = Shared.covariates
    next_experiment: bool = opt("Rank campaigns by how well they distinguish candidates.", False)

    def answer(self) -> Answer:
        calibration = request.load_saved(self.calibration, self)
        effects = request.load_effects(self, calibration.model.instrument, calibration.readings)
        columns = {"ignore": self.ignore or (), "covariates": split_optional(self.covariates)}
        kwargs = {"effects": effects, "max_effects": self.max_effects, **columns}
        discovery = bc.discover(calibration, **kwargs)
        from bayescal._report.result_json import convert_missing, convert_ranking

        check, limit = bc.check(calibration), deadline.current()
        text, data = str(discovery), convert_missing(discovery, 0, check)
        if self.next_experiment and limit.is_over:
            text += f"\n\nnext experiment: omitted ({limit.reason})"
        elif self.next_experiment:
            rivals = discovery.rivals
            ranking = bc.next_experiment(calibration, rivals) if len(rivals) > 1 else None
            text += f"\n\n{ranking or 'next experiment: none to tell candidates apart (no second one is probable)'}"
            data["next_experiment"] = None if ranking is None else convert_ranking(ranking)
        return Answer(text, data)


class CompareCommand(FitRequest, ReadRequest, AsJson, Command):
    """Compare structures by leave-one-group-out and evidence."""

    example = (
        "bayescal compare readings.csv --instrument mems_gyro --structure line "
        "--structure line+bias.thermal_lag"
    )
    structures: Texts = opt(
        "Structure, also with added effects: line+bias.thermal_lag; repeatable; default: all.",
        *(None, "--structure"),
    )
    reference: Texts = Shared.reference
    reference_dcc: Texts = Shared.reference_dcc
    effects_file: Path | None = Shared.effects
    typed: Texts = Shared.typed

    def answer(self) -> Answer:
        instrument, _, readings = request.open_request(self)
        names = self.structures or [name for name, _ in instrument.structures]
        effects = request.load_effects(self, instrument, readings)
        if len(names) < 2:
            raise InputError(f"give at least two structures (--structure), not {len(names)}")
        models = {}
        for name in names:  # "line+bias.thermal_lag"
            model_options = ReadRequest()
            model_options.structure, *model_options.add = (p.strip() for p in name.split("+"))
            model_options.reference_dcc = self.reference_dcc
            models[name] = request.compose(instrument, model_options, effects)
            models[name].require(readings)
        print_notes(readings.flags)
        kwargs = {"seed": self.seed, "strict": False}
        kwargs["reference"] = parse_numbers(self.reference, "--reference")
        method, fits = request.create_method(self.method), {}
        for i, name in enumerate(iterate_with_progress([*models], "structures")):
            with deadline.shorten(1 / (len(models) - i)):
                fits[name] = bc.fit(models[name], readings, method, **kwargs)
        comparison, verdicts = bc.compare(fits), ((name, c.verdict) for name, c in fits.items())
        reasons = "; ".join(f"{n}: {' '.join(v.reasons)}" for n, v in verdicts if not v.ok)
        return Answer(comparison, as_json(comparison), why=reasons)


class PredictCommand(ColumnOptions, StructureOptions, AsJson, Command):
    """Predict readings with a calibration and compare them."""

    example = "bayescal predict result/calibration.nc new.csv --out predicted.csv"
    calibration: Path = Shared.calibration
    files: list[Path] = Shared.files
    out: Path | None = opt("Output file (.csv).")
    average: str | None = Shared.average

    def answer(self) -> Answer:
        calibration = request.load_saved(self.calibration, self)
        kwargs = {**self.read_options(), "like": calibration.readings}
        kwargs["allow_one_temperature"] = True
        readings = bc.read(self.files, calibration.model.instrument, **kwargs)
        readings = request.average_readings(readings, self.average)
        self.save_options()
        print_notes(readings.flags)
        prediction = bc.predict(calibration, readings)
        from bayescal._cli.output import write_prediction
        from bayescal._core.formatting import number
        from bayescal._data.unit_conversion import unit_label

        if self.out is not None:
            write_prediction(prediction, readings, self.out)
        expected_rmse, unit = float((prediction.sd**2).mean()) ** 0.5, unit_label(calibration.unit)
        text = f"{len(readings)} readings: rms error {number(prediction.rmse)} {unit} "
        text += f"({number(expected_rmse)} {unit} expected from the standard uncertainties)"
        text += "; averaged over structures" * (min(calibration.inclusion.values(), default=1) < 1)
        text += f"\nwritten: {self.out}" if self.out else ""
        data = {"rows": len(readings), "rmse": prediction.rmse, "expected_rmse": expected_rmse}
        data |= {"unit": calibration.unit, "file": str(self.out) if self.out else None}
        return Answer(text, data, why=calibration.verdict.why_not)


class NoiseCommand(ReadRequest, AsJson, Command):
    """Estimate noise density, bias instability and random walk."""

    example = "bayescal noise still.csv --columns output=gyro_x --unit gyro_x=deg/s --out noise"
    instrument = "still_sensor"  # at rest: its output changes by noise and temperature only
    channels: str | None = opt(
        "Output columns, analysed separately: gyro_x,acc_x.", metavar="NAME,NAME,…"
    )
    average: str | None = Shared.average
    time_limit: float | None = Shared.time_limit
    seed: int = Shared.seed
    out: Path | None = Shared.folder

    def answer(self) -> Answer:
        _, _, readings = request.open_channels(options.parse_channels(self.channels), self)
        if self.channels is None:  # named after the output column of the file
            record = readings[""]
            readings = {next((s.output for s in record.sources if s.output), "output"): record}
        with create_result_folder(self.out) as folder:
            print_notes(request.flags_of(readings))
            records, written = request.split_records(readings), list[Path]()
            results = dict[str, Any]()
            for i, name in enumerate(iterate_with_progress([*records], "records")):
                with deadline.shorten(1 / (len(records) - i)):
                    results[name] = bc.noise(records[name], seed=self.seed)

            def draw(folder: Path) -> None:
                from bayescal._report.plots import use_own_style

                folders = name_folders(results).items()
                pictures = {f"noise_{folder_name}.png": name for name, folder_name in folders}
                with guard_drawing("The Allan deviation"), replace_folder(folder) as hidden:
                    for picture, name in pictures.items():
                        with use_own_style():
                            bc.plot.save(bc.plot.noise(results[name]), hidden / picture)
                written.extend(folder / picture for picture in pictures)

            doubted = [n for n, r in results.items() if any(c.severity != "note" for c in r.claims)]
            warning = f"not to be used as they are: {', '.join(doubted)}" if doubted else ""
            return Answer(
                "\n\n".join(f"{name}\n\n{result}" for name, result in results.items()),
                {name: result.to_json_data() for name, result in results.items()},
                warning=warning,
                drawn=folder is None or draw_safely(draw, folder),  # before `written` is listed
                written=", ".join(map(str, written)),
            )


class CompensateCommand(ColumnOptions, MemberOptions, AsJson, Command):
    """Compute the measurand from the readings."""

    example = "bayescal compensate result/calibration.nc flight.csv --out done.csv"
    in_place = "file"
    calibration: Path = Shared.calibration
    file: Path = Argument(help="Readings: text, .parquet, .xlsx or .mat.")
    out: Path = opt("Output file (.csv, or .parquet if the input is .parquet).", ..., "--out", "-o")
    first_order: bool = opt("Propagate mean and covariance instead of draws.", False)
    without_noise: bool = opt("Exclude the noise of a reading from the uncertainty.", False)

    def answer(self) -> Answer:
        from bayescal._use.compensate_file import compensate_file

        correction = request.load_compensator(self.calibration, self)
        kwargs = {**self.read_options(), "missing": self.missing or "drop"}
        kwargs["method"] = "first order" if self.first_order else "draws"
        kwargs["noise"] = not self.without_noise
        result = compensate_file(correction, self.file, self.out, **kwargs)
        self.save_options()
        extrapolations = (
            f"{name} is outside its calibrated range in {count} of {result.rows} readings, which are extrapolated"
            for name, count in result.outside.items()
        )
        flags = (flag for flag in result.flags if getattr(flag, "code", "") != "rows.dropped")
        print_notes((*correction.notes, *flags, *extrapolations))
        added_text = f"columns {' and '.join(result.columns)} [{correction.unit}] added"
        text = f"{self.out}: {result.rows} readings, {added_text}"
        text += f"; {result.missing} rows are empty: readings are missing" * bool(result.missing)
        text += f"\n{result.columns[1]}: k = 1, with{'out' * self.without_noise} the noise of one reading"
        data = {"file": str(self.out), "rows": result.rows, "columns": list(result.columns)}
        data |= {"unit": correction.unit, "epoch": correction.about.epoch}
        data |= {name: getattr(result, name) for name in ("outside", "unsolved", "missing")}
        reason = request.describe_reliability({"": correction})
        if result.unsolved:
            reason = f"{result.unsolved} readings have no solution: their added columns are empty"
        return Answer(text, data, why=reason)


class ExportCommand(MemberOptions, DecisionRule, Command):
    """Write C99, Python, JSON, parameters or a certificate."""

    example = "bayescal export result/calibration.nc --format c --out gyro.h"
    calibrations: list[Path] = Argument(
        [], help="Result folders or calibrations (.nc): one, one per axis, or a device's."
    )
    format_: str | None = opt(
        "json, c, python, px4-params, ardupilot-params or dcc.", *(None, "--format")
    )
    out: Path | None = opt("Output file; default: standard output.", None, "--out", "-o")
    axis: Texts = opt("gyro_x=a.nc: calibration of an axis that its readings do not name.")
    device_id: Texts = opt("gyro=3670026: PX4's device id of a sensor; repeatable.")
    local_gravity: float | None = Shared.local_gravity
    certificate: Path | None = Shared.certificate
    limit: Texts = Shared.limit
    name: str | None = opt("Prefix of all names in C; default: the instrument's name.")
    without_uncertainty: bool = opt("Omit the coefficients' covariance in C and Python.", False)

    def answer(self) -> Answer:
        from bayescal._use.correction_files import iter_kinds

        writers = {n: write for load in load_entries("exports") for n, write in load().items()}
        formats = [*dict.fromkeys((*(n for kind in iter_kinds() for n in kind.writers), *writers))]
        if self.format_ is None and self.out is None:
            raise InputError(f"give --out, or one of the formats: --format {', '.join(formats)}")
        if self.format_ not in (None, *formats):
            raise InputError(f"--format {self.format_!r} is not one of {', '.join(formats)}")
        if self.format_ in writers:
            return writers[self.format_](self)
        self.refuse_unused("axis", "device_id", "local_gravity")
        corrections = [correction for _, correction in self.load_corrections()]
        if not corrections or isinstance(corrections[0], bc.Compensator):
            self.require_one()
        return self.write_corrections(corrections)

    def require_one(self) -> None:
        """Raise InputError unless exactly one calibration is given, by its path alone."""
        self.refuse_unused("axis", "device_id")
        if (count := len(self.calibrations)) != 1:
            advice = "several need --format px4-params or ardupilot-params"
            raise InputError(f"give one calibration to export, not {count}; {advice}")

    def refuse_unused(self, *options: str, subject: str = "") -> None:
        """Raise InputError if an option that the export does not use was given; `subject` qualifies the export."""
        for option in (f"--{o.replace('_', '-')}" for o in options if getattr(self, o)):
            export = f"--format {self.format_}" if self.format_ else f"--out {self.out}"
            raise InputError(f"{export}{subject} does not use {option}: leave it out")

    @property
    def gravity(self) -> float:
        """Return the local gravity, m/s²."""
        from bayescal._data.unit_conversion import STANDARD_GRAVITY  # loads NumPy

        return self.local_gravity or STANDARD_GRAVITY

    def load_corrections(self, paths: Sequence[Path] | None = None) -> list[tuple[Path, Any]]:
        """Load corrections with their paths; raise InputError if some have one output and others three axes."""
        corrections = [(p, request.load_correction(p, self)) for p in paths or self.calibrations]
        one_output = [path for path, c in corrections if isinstance(c, bc.Compensator)]
        if 0 < len(one_output) < len(corrections):
            raise InputError(
                f"{one_output[0]} has one output, not three axes: export it separately"
            )
        return corrections

    def write_corrections(self, corrections: Sequence[Any]) -> Answer:
        """Write corrections to one file, or answer with their text; print notes on what the format omits."""
        from bayescal._use import correction_files as files

        programs = [getattr(correction, "program", correction) for correction in corrections]
        kind, format = files.find_kind(programs[0]), files.choose_format(self.out, self.format_)
        first_program, *others = programs
        kwargs = {"name": self.name, "others": others, "uncertainty": not self.without_uncertainty}
        text = files.as_text(first_program, format, **kwargs)
        text = text if self.out is None else f"written: {write_text(text, self.out)}"
        names = [program.instrument for program in programs]
        omissions = zip(names, (kind.describe_omissions(p, format) for p in programs), strict=True)
        print_notes([f"{name}: {words}" for name, words in omissions if words])
        is_single = isinstance(corrections[0], bc.Compensator)
        verdict = {f"{n}:" * (not is_single): c for n, c in zip(names, corrections, strict=True)}
        return Answer(text.removesuffix("\n"), why=request.describe_reliability(verdict))


class BudgetCommand(MemberOptions, AsJson, Command):
    """Print the uncertainty budget of a corrected value."""

    example = "bayescal budget result/calibration.nc --at temperature=60"
    calibration: Path = Shared.calibration
    at: Texts = opt("temperature=60: operating point, in fixed units; repeatable.")
    k: float = opt("Coverage factor of the expanded uncertainty.", 2.0, "-k")

    def answer(self) -> Answer:
        correction = request.load_compensator(self.calibration, self)
        result = bc.budget(correction, parse_numbers(self.at, "--at"), k=self.k)
        return Answer(result, why=request.describe_reliability({"": correction}))


class ReportCommand(DefinitionOptions, DecisionRule, AsJson, Command):
    """Write a report for sign-off as one HTML file."""

    example = "bayescal report result -o report.html"
    calibrations: list[Path] = Argument(
        help="Calibrations (.nc), or result folders of `bayescal calibrate --out`."
    )
    out: Path = opt("Output file (.html).", Path("report.html"), "--out", "-o")
    title: str = opt("Title of the report.", "")
    certificate: Path | None = Shared.certificate
    limit: Texts = Shared.limit

    def answer(self) -> Answer:
        certificate = decisions = None
        if self.certificate:
            certificate = load_entry("certificate", "--certificate")(self.certificate)
        chapters = request.load_chapters(self.calibrations, self)
        if self.limit:
            if len(chapters) != 1:
                raise InputError(
                    f"--limit applies to one result, but {len(chapters)} were given: report them separately"
                )
            decide = load_entry("decided", "--limit")
            decisions = decide(chapters[0].used, self.limit, **self.decision_options())
        texts = {"title": self.title, "certificate": certificate}
        report = partial(bc.report, chapters, self.out, decisions=decisions, **texts)
        verdicts = [c.data["verdict"] for c in chapters]
        return Answer(
            f"written: {self.out}",
            {"file": str(self.out), "chapters": len(chapters)},
            why=" ".join(reason for v in verdicts if not v["ok"] for reason in v["reasons"]),
            warning=decisions.warning if decisions else "",
            drawn=draw_safely(report),
        )


COMMANDS = (
    *(InstrumentsCommand, EffectsCommand, SimulateCommand, PairsCommand, DemoCommand),
    *(CalibrateCommand, FitCommand, CheckCommand, DiscoverCommand, CompareCommand),
    *(PredictCommand, NoiseCommand, CompensateCommand, ExportCommand, BudgetCommand),
    ReportCommand,
)
