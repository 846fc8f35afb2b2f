"""The commands of the core.

Of instruments: instruments, effects, simulate; for some, pairs of devices. The whole loop:
`calibrate`, of one output or of several channels of one unit. From readings to a calibration: fit, check, discover,
compare, predict; and the noise of a sensor. Use of results: compensate, export, budget, report.

Imports are placed where they are first needed: a bad file is refused before a sampler loads.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from typer import Argument

import bayescal as bc
from bayescal._cli import options, request
from bayescal._cli.options import (
    Answer,
    AsJson,
    ColumnOptions,
    Command,
    DecisionRule,
    InUse,
    ModelOptions,
    OwnParts,
    ReadRequest,
    SearchRequest,
    Shared,
    Texts,
    UsedParts,
    drawn,
    named_numbers,
    opt,
    optional_names,
)
from bayescal._cli.request import instrument_named
from bayescal._core import deadline
from bayescal._core.annex import first_offered, offered
from bayescal._core.as_json import as_json
from bayescal._core.atomic_file import result_folder, write_text
from bayescal._core.errors import InputError
from bayescal._core.progress import counted, print_notes
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

PAIR_SELECTIONS = "bayescal.pair_selections"
"""`select(calibration, criterion=…)` gives a table of pairs that prints itself and has `data()`, plain JSON."""

CRITERIA = ("residual", "ratio-variance", "ratio-variance-raw")


class InstrumentsCommand(AsJson, Command):
    """List installed instruments, describe one, or check your own."""

    example = "bayescal instruments --check level.py:INSTRUMENT --readings bar.csv"
    named: str | None = Argument(
        None, metavar="NAME", help="Instrument whose columns and effects are listed; all if none."
    )
    check: str | None = opt(
        "Simulate this instrument, fit what was simulated, and say what came back.",
        metavar="my.py:INSTRUMENT",
    )
    readings: list[Path] | None = opt(
        "With --check: files whose columns are taken in place of a simulator's.",
        callback=options.refuse_missing,
    )
    seed: int = Shared.seed

    def answer(self) -> Answer:
        from bayescal._model.installed import installed_instruments

        if self.check is not None:
            chosen = instrument_named(self.check)
            readings = bc.read(self.readings, chosen) if self.readings else None
            checked = bc.check_instrument(chosen, readings, seed=self.seed)
            return Answer(checked, ok=checked.ok, why=" ".join(checked.errors))
        if self.readings:
            raise InputError("--readings are for --check: say which instrument, my.py:INSTRUMENT")
        from bayescal._cli.output import format_instrument, format_instruments

        if self.named is not None:
            return Answer(*format_instrument(instrument_named(self.named)))
        return Answer(*format_instruments(installed_instruments()))


class EffectsCommand(AsJson, Command):
    """List an instrument's effects with their sizes and sources."""

    example = "bayescal effects --instrument mems_gyro"
    instrument: str = Shared.instrument
    effects_file: Path | None = Shared.effects

    def answer(self) -> Answer:
        from bayescal._cli.output import format_effects

        chosen = instrument_named(self.instrument)
        kinds = {"baseline": chosen.effects, "candidate": chosen.candidates}
        kinds["your own"] = request.load_user_effects(self.effects_file)
        return Answer(*format_effects(kinds))


class SimulateCommand(AsJson, Command):
    """Simulate a test campaign, with effects hidden in it."""

    example = (
        "bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --out sim.csv"
    )
    instrument: str = Shared.instrument
    out: Path = opt("File to write: .csv.", ...)
    effect: Texts = opt("name=size: an effect to hide; repeat for more.")
    seed: int = Shared.seed

    def answer(self) -> Answer:
        from bayescal._data.unit_conversion import unit_label

        chosen = instrument_named(self.instrument)
        if chosen.simulator is None:
            raise InputError(f"instrument {chosen.name!r} has no simulator")
        hidden = named_numbers(self.effect, "--effect")
        try:
            readings = chosen.simulate(hidden, seed=self.seed)
        except ValueError as error:
            raise InputError(str(error)) from None
        readings.write(self.out)
        units = {n: unit_label(e.coefficients[0].unit) for n, e in chosen.known.items()}
        sizes = (f"{n} = {size:g} {units.get(n, '')}".rstrip() for n, size in hidden.items())
        listing = ", ".join(sizes) or "nothing"
        text = f"{self.out}: {len(readings)} readings, hidden effects: {listing}; seed {self.seed}"
        data = {"file": str(self.out), "rows": len(readings), "seed": self.seed}
        return Answer(text, {**data, "effects": hidden})


class PairsCommand(ReadRequest, AsJson, Command):
    """Rank pairs of devices by their probability to be the best."""

    example = "bayescal pairs readings.csv"
    instrument: str = opt("Whose devices are chosen in pairs.", "differential_pair")
    criterion: str = opt(f"{', '.join(CRITERIA)}.", "residual")
    add: Texts = Shared.add
    average: str | None = Shared.average
    seed: int = Shared.seed

    def answer(self) -> Answer:
        offers = [*entry_points(group=PAIR_SELECTIONS, name=self.instrument)]
        if not offers:
            raise InputError(
                f"instrument {self.instrument!r} does not choose its devices in pairs: leave --instrument out"
            )
        if self.criterion not in CRITERIA:
            raise InputError(f"--criterion {self.criterion!r} is not one of {', '.join(CRITERIA)}")
        _, model, readings = request.open_request(self)
        print_notes(readings.flags)
        fitted = bc.fit(model, readings, seed=self.seed, strict=False)
        verdict = fitted.verdict
        pairs = offers[0].load()(fitted, criterion=self.criterion)
        return Answer(pairs, ok=verdict.ok, why=" ".join(verdict.reasons))


class DemoCommand(AsJson, Command):
    """Find an effect that is hidden in simulated readings."""

    example = "bayescal demo --out demo_output"
    out: Path = opt("Folder to write to.", Path("demo_output"))
    seed: int = Shared.seed

    def answer(self) -> Answer:
        gyro, files = "mems_gyro", (self.out / "readings.csv", self.out / "holdout.csv")
        hidden = ["bias.thermal_lag=0.05"]
        with result_folder(self.out):
            for seed, file in enumerate(files, self.seed + 1):
                simulation = SimulateCommand(instrument=gyro, out=file, effect=hidden, seed=seed)
                print_notes([simulation.answer().shown])
            arguments = {"files": [files[0]], "holdout": [files[1]], "out": self.out}
            how = {"instrument": gyro, "seed": self.seed, "json_": self.json_}
            calibrated = CalibrateCommand(**arguments, **how).answer()
        program = sys.argv[0]
        command = "bayescal" if shutil.which("bayescal") == program else program
        line = f"{command} calibrate FILE.csv --instrument mems_gyro --out result"
        picture = f"the picture: {self.out / 'loop.png'}"
        hints = f"{picture}\nwith readings of your own: {line}"
        return replace(calibrated, written=f"{calibrated.written}\n{hints}")


class CalibrateCommand(SearchRequest, AsJson, Command):
    """Fit, find what is missing, add it, see the error fall.

    The first table stands as soon as the first fit does; Ctrl-C then ends the search with the best so far. Channels of
    one unit are searched together: structures and noise of their own, one body for all.
    """

    example = "bayescal calibrate readings.csv --instrument mems_gyro --out result"
    channels: str | None = Shared.channels
    simple_noise: bool = opt("Leave out sums of noise terms: faster on long records.", False)
    covariates: str | None = Shared.covariates
    out: Path | None = Shared.folder
    verbose: bool = opt("With all candidates of every step.", False)

    def answer(self) -> Answer:
        names = options.channel_names(self.channels)
        if not names and self.out is not None and (self.out / CHANNELS).is_file():
            raise InputError(
                f"{self.out} holds the channels of a unit ({CHANNELS}), of which reports and parameters would still "
                "be made: give another folder, or remove it"
            )
        noise = Settings(finer_noise=not self.simple_noise)
        with use_settings(noise), result_folder(self.out) as folder:
            models, readings, holdout = request.searched(names, self)
            name, first_readings = next(iter(readings.items()))
            settings = {
                "effects": request.load_effects(self, models[name].instrument, first_readings),
                "method": request.method_named(self.method),
                "reference": dict(named_numbers(self.reference, "--reference")),
                **self.settings(),
                "covariates": optional_names(self.covariates),
            }
            from bayescal._cli.output import ConsoleReporter, format_search

            reporter = ConsoleReporter(self.json_ or bool(names), self.verbose, names)
            if names:
                settings |= {"holdout": holdout or None, "follow": reporter.follow}
                searched = bc.calibrate_channels(models, readings, **settings)
            else:
                settings |= {"holdout": holdout.get(""), "follow": partial(reporter.follow, "")}
                searched = bc.calibrate(models[name], first_readings, **settings)
            drawn_all, written = True, ""
            if folder is not None:
                drawn_all = drawn(searched.save, folder)
                possible_files = ("result.json", CALIBRATION, AVERAGED, "loop.png", MANIFEST)
                files = (n for n in possible_files if n in (*files_of(folder), MANIFEST))
                listed = f"{CHANNELS}, and a folder for each channel" if names else ", ".join(files)
                written = f"{folder}/{listed}"
            paths = searched.search_paths if isinstance(searched, bc.Channels) else {"": searched}
            fitted = {n: t.final.calibration.readings for n, t in paths.items()}
            first_flags = request.flags_of(readings)
            print_notes(flag for flag in request.flags_of(fitted) if flag not in first_flags)
            text_options = {"started": reporter.begun, "verbose": self.verbose}
            content = format_search(searched, self.json_, **text_options)
            why = searched.reason if isinstance(searched, bc.Channels) else searched.gate.reason
            return Answer(content, ok=searched.ok, why=why, made=drawn_all, written=written)


class FitCommand(ModelOptions, ReadRequest, AsJson, Command):
    """Fit one model: coefficients with uncertainty."""

    example = "bayescal fit readings.csv --instrument mems_gyro --out result"
    instrument: str = Shared.instrument
    noise: str | None = opt(
        "Noise law: student_t, ornstein_uhlenbeck, heteroscedastic(temperature), or one of --effects.",
        metavar="NAME",
    )
    method: str = Shared.method
    average: str | None = Shared.average
    time_limit: float | None = Shared.time_limit
    seed: int = Shared.seed
    out: Path | None = Shared.folder

    def answer(self) -> Answer:
        with result_folder(self.out) as folder:
            _, model, readings = request.open_request(self)
            if self.noise is not None:
                model = model.with_noise(request.noise_named(self.noise, model, readings))
            print_notes(readings.flags)
            reference = dict(named_numbers(self.reference, "--reference"))
            how = {"seed": self.seed, "strict": False, "reference": reference}
            calibration = bc.fit(model, readings, request.method_named(self.method), **how)
            from bayescal._cli.output import fit_data

            if calibration.verdict.ok:
                calibration = calibration.with_verdict(against=calibration.conflicts)
            content = fit_data(calibration) if self.json_ else calibration
            verdict, written = calibration.verdict, ""
            if folder is not None:
                with whole_folder(folder) as hidden:
                    calibration.save(hidden / CALIBRATION)
                written = f"{folder / CALIBRATION}"
            return Answer(content, ok=verdict.reliable, why=verdict.why_not, written=written)


class CheckCommand(OwnParts, AsJson, Command):
    """Say where a fitted model fails."""

    example = "bayescal check result/calibration.nc"
    calibration: Path = Shared.calibration

    def answer(self) -> Answer:
        checked = bc.check(request.load_saved(self.calibration, self))
        return Answer(checked, [{"step": 0, **row} for row in checked.data()])


class DiscoverCommand(OwnParts, AsJson, Command):
    """Say which effect is missing, and how to tell rivals apart."""

    example = "bayescal discover result/calibration.nc"
    calibration: Path = Shared.calibration
    typed: Texts = Shared.typed
    max_effects: int = Shared.max_effects
    time_limit: float | None = Shared.time_limit
    ignore: Texts = opt("Exclude this column as a possible cause; repeatable.", metavar="COLUMN")
    covariates: str | None = Shared.covariates
    next_experiment: bool = opt("Rank campaigns by how well they tell rivals apart.", False)

    def answer(self) -> Answer:
        loaded = request.load_saved(self.calibration, self)
        effects = request.load_effects(self, loaded.model.instrument, loaded.readings)
        allowed = {"ignore": self.ignore or (), "covariates": optional_names(self.covariates)}
        discovery = bc.discover(loaded, effects=effects, max_effects=self.max_effects, **allowed)
        from bayescal._report.result_json import experiment_data, missing_data

        checked, end = bc.check(loaded), deadline.current()
        text, data = str(discovery), missing_data(discovery, 0, checked)
        if self.next_experiment and end.over:
            text += f"\n\nnext experiment: left out ({end.why})"
        elif self.next_experiment:
            rivals = discovery.rivals
            ranked = bc.next_experiment(loaded, rivals) if len(rivals) > 1 else None
            text += f"\n\n{ranked or 'next experiment: none proposed: no other candidate is probable enough'}"
            data["next_experiment"] = None if ranked is None else experiment_data(ranked)
        return Answer(text, data)


class CompareCommand(ReadRequest, AsJson, Command):
    """Compare structures by leave-one-group-out and evidence."""

    example = (
        "bayescal compare readings.csv --instrument mems_gyro --structure line "
        "--structure line+bias.thermal_lag"
    )
    instrument: str = Shared.instrument
    structures: Texts = opt(
        "Structure, or with effects added, as line+bias.thermal_lag; repeat; all if none.",
        *(None, "--structure"),
    )
    reference: Texts = Shared.reference
    reference_dcc: Texts = Shared.reference_dcc
    effects_file: Path | None = Shared.effects
    typed: Texts = Shared.typed
    average: str | None = Shared.average
    method: str = Shared.method
    time_limit: float | None = Shared.time_limit
    seed: int = Shared.seed

    def answer(self) -> Answer:
        chosen, _, readings = request.open_request(self)
        names = self.structures or [name for name, _ in chosen.structures]
        effects = request.load_effects(self, chosen, readings)
        models = {}
        for name in names:  # "line+bias.thermal_lag"
            first, *added = (part.strip() for part in name.split("+"))
            requested = ReadRequest()
            requested.structure, requested.add = first, added
            requested.reference_dcc = self.reference_dcc
            models[name] = request.compose(chosen, requested, effects)
            models[name].require(readings)
        if len(models) < 2:
            raise InputError(f"compare needs at least two structures, not {len(models)}")
        print_notes(readings.flags)
        how = {"seed": self.seed, "strict": False}
        how["reference"] = named_numbers(self.reference, "--reference")
        method, fits = request.method_named(self.method), {}
        for i, name in enumerate(counted([*models], "structures")):
            with deadline.sooner(1 / (len(models) - i)):
                fits[name] = bc.fit(models[name], readings, method, **how)
        comparison = bc.compare(fits)
        failed = [
            f"{n}: {' '.join(c.verdict.reasons)}" for n, c in fits.items() if not c.verdict.ok
        ]
        return Answer(comparison, as_json(comparison), ok=not failed, why="; ".join(failed))


class PredictCommand(ColumnOptions, UsedParts, AsJson, Command):
    """Predict readings with a calibration, and compare."""

    example = "bayescal predict result/calibration.nc new.csv --out predicted.csv"
    calibration: Path = Shared.calibration
    files: list[Path] = Shared.files
    out: Path | None = opt("File to write: .csv.")
    average: str | None = Shared.average

    def answer(self) -> Answer:
        loaded = request.load_saved(self.calibration, self)
        how = {**self.for_read(), "allow_one_temperature": True, "like": loaded.readings}
        readings = bc.read(self.files, loaded.model.instrument, **how)
        readings = request.average(readings, self.average)
        self.keep()
        print_notes(readings.flags)
        prediction = bc.predict(loaded, readings)
        from bayescal._cli.output import write_prediction
        from bayescal._core.formatting import number
        from bayescal._data.unit_conversion import unit_label

        if self.out is not None:
            write_prediction(prediction, readings, self.out)
        expected = float((prediction.sd**2).mean()) ** 0.5
        unit = unit_label(loaded.unit)
        text = f"{len(readings)} readings: rms error {number(prediction.rmse)} {unit} "
        text += f"({number(expected)} {unit} expected from the standard uncertainties)"
        text += f"\nwritten: {self.out}" if self.out else ""
        data = {"rows": len(readings), "rmse": prediction.rmse, "expected_rmse": expected}
        data |= {"unit": loaded.unit, "file": str(self.out) if self.out else None}
        return Answer(text, data, ok=loaded.verdict.reliable, why=loaded.verdict.why_not)


class NoiseCommand(ReadRequest, AsJson, Command):
    """Estimate noise density, bias instability and random walk."""

    example = "bayescal noise still.csv --columns output=gyro_x --unit gyro_x=deg/s --out noise"
    instrument = "still_sensor"  # whose output changes only by its noise and temperature
    channels: str | None = opt(
        "Columns that are outputs, one after another: gyro_x,acc_x.", metavar="NAME,NAME,…"
    )
    average: str | None = Shared.average
    time_limit: float | None = Shared.time_limit
    seed: int = Shared.seed
    out: Path | None = Shared.folder

    def answer(self) -> Answer:
        _, _, readings = request.open_channels(options.channel_names(self.channels), self)
        if self.channels is None:  # called as the file calls its output
            single = readings[""]
            readings = {next((s.output for s in single.sources if s.output), "output"): single}
        with result_folder(self.out) as folder:
            print_notes(request.flags_of(readings))
            devices, written = request.split_records(readings), list[Path]()
            results = dict[str, Any]()
            for i, name in enumerate(counted([*devices], "records")):
                with deadline.sooner(1 / (len(devices) - i)):
                    results[name] = bc.noise(devices[name], seed=self.seed)

            def draw(folder: Path) -> None:
                from bayescal._report.plots import own_style

                folders = folders_of(results).items()
                pictures = {f"noise_{folder_name}.png": name for name, folder_name in folders}
                with drawing("The Allan deviation"), whole_folder(folder) as hidden:
                    for picture, name in pictures.items():
                        with own_style():
                            bc.plot.save(bc.plot.noise(results[name]), hidden / picture)
                written.extend(folder / picture for picture in pictures)

            drawn_all = folder is None or drawn(draw, folder)
            claims = ((name, claim) for name, result in results.items() for claim in result.claims)
            doubts = (f"{name}: {claim}" for name, claim in claims if claim.severity != "note")
            return Answer(
                "\n\n".join(f"{name}\n\n{result}" for name, result in results.items()),
                {name: result.data() for name, result in results.items()},
                doubt=" ".join(doubts),
                made=drawn_all,
                written=", ".join(map(str, written)),
            )


class CompensateCommand(ColumnOptions, InUse, AsJson, Command):
    """Turn readings back into what was measured."""

    example = "bayescal compensate result/calibration.nc flight.csv --out done.csv"
    in_place = "file"
    calibration: Path = Shared.calibration
    file: Path = Argument(help="Readings: text, .parquet, .xlsx or .mat.")
    out: Path = opt("File to write: .csv, or .parquet of such.", ..., "--out", "-o")
    first_order: bool = opt("Propagate mean and covariance, as exports do, not draws.", False)
    without_noise: bool = opt("Leave the noise of each reading out.", False)

    def answer(self) -> Answer:
        from bayescal._use.compensate_file import compensate_file

        chosen = request.compensator_from(self.calibration, self)
        how = {**self.for_read(), "missing": self.missing or "drop"}
        how["method"] = "first order" if self.first_order else "draws"
        done = compensate_file(chosen, self.file, self.out, **how, noise=not self.without_noise)
        self.keep()
        outside = (
            f"{name} is outside its calibrated range in {count} of {done.rows} readings: an extrapolation there"
            for name, count in done.outside.items()
        )
        flags = (flag for flag in done.flags if getattr(flag, "code", "") != "rows.dropped")
        print_notes((*chosen.notes, *flags, *outside))
        noise = f"with{'out' * self.without_noise} the noise of one reading"
        added = f"columns {' and '.join(done.columns)} [{chosen.unit}] added"
        text = f"{self.out}: {done.rows} readings, {added}"
        text += f"; {done.missing} rows are empty, where a reading is missing" * bool(done.missing)
        text += f"\n{done.columns[1]}: k = 1, {noise}"
        data = {"file": str(self.out), "rows": done.rows, "columns": list(done.columns)}
        data |= {"unit": chosen.unit, "epoch": chosen.about.epoch, "outside": done.outside}
        data |= {"unsolved": done.unsolved, "missing": done.missing}
        verdict = request.reliable({"": chosen})
        if done.unsolved:
            why = f"{done.unsolved} readings have no solution and are written empty"
            verdict = {"ok": False, "why": why}
        return Answer(text, data, **verdict)


class ExportCommand(InUse, DecisionRule, Command):
    """Write C99, Python, JSON, parameters or a certificate.

    Of three axes too; those of a unit together in one file.
    """

    example = "bayescal export result/calibration.nc --format c --out gyro.h"
    calibrations: list[Path] = Argument(
        [], help="Folders of results, calibrations (.nc): one, one an axis, or a unit's."
    )
    format_: str | None = opt(
        "json, c or python; px4-params or ardupilot-params; dcc.",
        *(None, "--format"),
    )
    out: Path | None = opt("File to write; standard output if none.", None, "--out", "-o")
    axis: Texts = opt("gyro_x=a.nc: calibration of an axis, where its readings do not name it.")
    device_id: Texts = opt("gyro=3670026: PX4's number of a sensor; repeat.")
    local_gravity: float | None = Shared.local_gravity
    certificate: Path | None = Shared.certificate
    limit: Texts = Shared.limit
    name: str | None = opt("With which all names in C begin; else that of the instrument.")
    without_uncertainty: bool = opt("C and Python without the coefficients' covariance.", False)

    def answer(self) -> Answer:
        from bayescal._use.correction_files import kinds

        writers = {n: write for exports in offered("exports") for n, write in exports().items()}
        formats = [*dict.fromkeys((*(name for kind in kinds() for name in kind.writers), *writers))]
        if self.format_ is None and self.out is None:
            raise InputError(f"say which format: --format {', '.join(formats)}")
        if self.format_ not in (None, *formats):
            raise InputError(f"--format {self.format_!r} is not one of {', '.join(formats)}")
        if self.format_ in writers:
            return writers[self.format_](self)
        corrections = [correction for _, correction in self.loaded()]
        if not corrections or isinstance(corrections[0], bc.Compensator):
            self.refuse_several()
        return self.written(corrections)

    def refuse_several(self) -> None:
        """Raise InputError for more than one calibration, or none."""
        if len(self.calibrations) != 1 or self.axis or self.device_id:
            raise InputError(
                "a program is of one calibration, without --axis and --device-id: several, by axis, make parameters "
                "(--format px4-params or ardupilot-params)"
            )

    @property
    def gravity(self) -> float:
        """Return the local gravity, m/s²."""
        from bayescal._data.unit_conversion import STANDARD_GRAVITY  # loads NumPy

        return self.local_gravity or STANDARD_GRAVITY

    def loaded(self, paths: Sequence[Path] | None = None) -> list[tuple[Path, Any]]:
        """Load files and their corrections; raise InputError for several of which one is of one output."""
        corrections = [(p, request.correction_from(p, self)) for p in paths or self.calibrations]
        single = [path for path, c in corrections if isinstance(c, bc.Compensator)]
        if 0 < len(single) < len(corrections):
            why = f"{single[0]} is of one output, and others are of three axes: give it alone"
            raise InputError(why)
        return corrections

    def written(self, corrections: Sequence[Any]) -> Answer:
        """Write corrections to one file, or return them as text; warn of parts that the format cannot hold."""
        from bayescal._use import correction_files as files

        programs = [getattr(correction, "program", correction) for correction in corrections]
        kind, format = files.kind_of(programs[0]), files.format_of(self.out, self.format_)
        first_program, *others = programs
        how = {"name": self.name, "others": others, "uncertainty": not self.without_uncertainty}
        text = files.as_text(first_program, format, **how)
        if self.out is not None:
            text = f"written: {write_text(text, self.out)}"
        names = [program.about_it()[0] for program in programs]
        omissions = zip(names, (kind.describe_omissions(p, format) for p in programs), strict=True)
        print_notes([f"{name}: {words}" for name, words in omissions if words])
        is_single = isinstance(corrections[0], bc.Compensator)
        verdict = {f"{n}:" * (not is_single): c for n, c in zip(names, corrections, strict=True)}
        return Answer(text.removesuffix("\n"), **request.reliable(verdict))


class BudgetCommand(InUse, AsJson, Command):
    """Split the uncertainty of a compensated value (JCGM 100)."""

    example = "bayescal budget result/calibration.nc --at temperature=60"
    calibration: Path = Shared.calibration
    at: Texts = opt("temperature=60: operating point, in fixed units; repeat for more.")
    k: float = opt("Coverage factor of the expanded uncertainty.", 2.0, "-k")

    def answer(self) -> Answer:
        chosen = request.compensator_from(self.calibration, self)
        result = bc.budget(chosen, named_numbers(self.at, "--at"), k=self.k)
        return Answer(result, **request.reliable({"": chosen}))


class ReportCommand(OwnParts, DecisionRule, AsJson, Command):
    """Write the report for sign-off, in one HTML file."""

    example = "bayescal report result -o report.html"
    calibrations: list[Path] = Argument(
        help="Saved calibrations (.nc), or folders that `bayescal calibrate --out` wrote."
    )
    out: Path = opt("HTML file to write.", Path("report.html"), "--out", "-o")
    title: str = opt("Of the report.", "")
    certificate: Path | None = Shared.certificate
    limit: Texts = Shared.limit

    def answer(self) -> Answer:
        certificate = decisions = None
        if self.certificate:
            certificate = first_offered("certificate", "--certificate")(self.certificate)
        chapters = request.chapters_from(self.calibrations, self)
        if self.limit:
            if len(chapters) != 1:
                raise InputError(
                    f"--limit decides about one result, {len(chapters)} were given: report each by itself"
                )
            decide = first_offered("decided", "--limit")
            decisions = decide(chapters[0].used, self.limit, **self.deciding())
        texts = {"title": self.title, "certificate": certificate}
        is_complete = drawn(partial(bc.report, chapters, self.out, decisions=decisions, **texts))
        verdicts = [c.data["verdict"] for c in chapters]
        return Answer(
            f"written: {self.out}",
            {"file": str(self.out), "chapters": len(chapters)},
            ok=all(v["ok"] for v in verdicts),
            why=" ".join(reason for v in verdicts for reason in v["reasons"]),
            doubt=decisions.doubt if decisions else "",
            made=is_complete,
        )


COMMANDS = (
    *(InstrumentsCommand, EffectsCommand, SimulateCommand, PairsCommand, DemoCommand),
    *(CalibrateCommand, FitCommand, CheckCommand, DiscoverCommand, CompareCommand),
    *(PredictCommand, NoiseCommand, CompensateCommand, ExportCommand, BudgetCommand),
    ReportCommand,
)
