"""Registration of the three-axis annex: commands, corrections, export formats, result entries; heavy imports on use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import bayescal as bc
from bayescal import workshop as ws

MAX_EFFECTS_ADDED = 5  # by the search
INSTRUMENT_NAMES = {"accelerometers": "accelerometer_triad", "gyroscopes": "gyro_triad"}
OUTPUTS = ("output_x", "output_y", "output_z")
CORRECTION_FILES = ("correction.h", "correction.py", "correction.json")
UNIT_FILES = ("imu.h", "imu.py")  # corrections of all triads of a unit
REPORT = "report.html"
CAPTION = "Three axes, with model inadequacy and effects of the test; without higher orders closer to zero than u/2"
FIT_CAPTION = "COEFFICIENTS (without f and effects of the test)"
USE_CAPTION = "CORRECTION FOR USE (u with f = {:.2f} and effects of the test; higher orders only if above u/2)"


class Triad(NamedTuple):
    """A calibrated triad: its search path, its correction, and the readings of poses or moves that were fitted."""

    search_path: bc.SearchPath
    correction: bc.VectorCorrection
    readings: bc.Measurements

    def __str__(self) -> str:
        """Format the search path, the coefficients, and the correction."""
        path = self.search_path
        text = f"{FIT_CAPTION}\n{ws.format_coefficients(path)}\nverdict: {path.gate}"
        caption = USE_CAPTION.format(path.calibration.form_factor)
        return f"{path}\n\n{text}\n\n{caption}\n{self.correction}"


class TriadOptions(ws.ReadRequest, ws.AsJson, ws.Options):
    """Options of the commands that calibrate one triad, or both triads of a unit."""

    shortest: float | None = ws.opt(
        "Minimum duration of a pose, s; default: 2, or 1 if over a quarter are shorter.", min=0.1
    )
    baseline: bool = ws.opt("Fit bias, scale, misalignment only, without a search.", False)
    time_limit: float | None = ws.Shared.time_limit
    seed: int = ws.Shared.seed
    out: Path | None = ws.Shared.folder
    name: str | None = ws.opt("Prefix of all names in C; default: the instrument's name.")

    def calibrate(self, model: bc.Model, readings: bc.Measurements, n_triads: int = 1) -> Triad:
        """Search for the effects of a triad and compute its correction; print both unless JSON is requested.

        Args:
            model: initial model of the search.
            readings: readings of poses or moves.
            n_triads: number of triads that are yet to be calibrated and share the remaining time, this one included.
        """
        unidentified = bc.undetermined(model, readings)
        if unidentified.add:
            ws.print_notes([str(unidentified)])
        # Chains would explore the priors of unidentified directions for minutes. With no more readings than
        # coefficients the noise is not estimated, and importance sampling would explore its prior.
        has_no_dof = len(readings) <= sum(len(e.coefficients) for e in model.effects)
        method = bc.LeastSquares() if has_no_dof else bc.Marginal(chains=not unidentified.add)
        max_effects = 0 if self.baseline or has_no_dof else MAX_EFFECTS_ADDED
        with ws.deadline.shorten(1 / n_triads):
            options = {"method": method, "seed": self.seed, "max_effects": max_effects}
            path = bc.calibrate(model, readings, **options)
        triad = Triad(path, bc.vector_correction(path.calibration), readings)
        ws.print_notes(triad.correction.notes)
        if not self.json_:
            print(triad)
        return triad

    def finish(self, triads: Mapping[str, Triad], folder: Path | None) -> ws.Answer:
        """Write the results and figures of triads, by subfolder, to `folder`, if any; return the command's answer."""
        is_drawn = True
        if folder is not None:
            with ws.replace_folder(folder) as staging:
                _write_results(triads, staging, self.name)
            is_drawn = _draw_results(triads, folder)
            for subfolder in dict.fromkeys((*triads, "")) if not self.json_ else ():
                names = (*ws.read_hashes(folder / subfolder), ws.MANIFEST)
                print(f"written: {folder / subfolder}/{', '.join(names)}")
        paths = [triad.search_path for triad in triads.values()]
        reason = next((path.gate.reason for path in paths if not path.ok), "")
        data = {subfolder: triad.correction.to_json_data() for subfolder, triad in triads.items()}
        return ws.Answer(data.get("", data) if self.json_ else None, why=reason, drawn=is_drawn)


class TriadCommand(TriadOptions, ws.Command):
    """Calibrate three axes from poses at rest or known rates."""

    example = "bayescal triad log.csv --instrument gyro_triad --out result"
    instrument: str = ws.opt("Or gyro_triad, magnetometer_triad.", "accelerometer_triad")
    poses: bool = ws.opt("Rows are poses or rates; default: find a log's static segments.", False)
    dry_run: bool = ws.opt("List unidentified parameters and poses to add, without a fit.", False)

    def answer(self) -> ws.Answer:
        ws.choose_name(self.name, "")  # refused before minutes of calibration
        if self.poses and self.shortest is not None:
            raise bc.InputError("--shortest applies to logs: omit it or --poses")
        if ws.instrument_named(self.instrument).vector is None:
            message = f"--instrument {self.instrument} has one output: use `bayescal calibrate`"
            raise bc.InputError(message)
        instrument, model, readings = ws.open_request(self)
        if not self.poses:
            readings = bc.poses(readings, instrument, min_duration=self.shortest)
            model = instrument.for_readings(readings).baseline()
        ws.print_notes(readings.flags)
        if self.dry_run:
            return ws.Answer(str(bc.undetermined(model, readings)))
        with ws.create_result_folder(self.out) as folder:
            return self.finish({"": self.calibrate(model, readings)}, folder)


class ImuCommand(TriadOptions, ws.Command):
    """Calibrate accelerometers and gyroscopes from one log."""

    example = "bayescal imu log.csv --accelerometers ax,ay,az --gyroscopes gx,gy,gz --out unit"
    accelerometers: str | None = ws.opt("Accelerometer columns ax,ay,az; default: common names.")
    gyroscopes: str | None = ws.opt("Gyroscope columns gx,gy,gz; default: common names.")

    def answer(self) -> ws.Answer:
        ws.choose_name(self.name, "")  # refused before minutes of calibration
        with ws.create_result_folder(self.out) as folder:
            (accs, forces), (gyros, rates) = self.read_logs()
            poses = bc.poses(forces, accs, min_duration=self.shortest)
            ws.print_notes(poses.flags)
            acc = self.calibrate(accs.for_readings(poses).baseline(), poses, n_triads=2)
            moves = bc.moves(rates, gyros, forces, acc.correction, min_duration=self.shortest)
            ws.print_notes(moves.flags)
            gyro = self.calibrate(dict(gyros.structures)["moves"](), moves)
            return self.finish({"accelerometer": acc, "gyroscope": gyro}, folder)

    def read_logs(self) -> list[tuple[bc.Instrument, bc.Measurements]]:
        """Read the columns of each triad from the log; raise one InputError with the errors of both triads."""
        logs, problems = [], ws.Objections()
        for kind, name in INSTRUMENT_NAMES.items():
            instrument, options = ws.instrument_named(name), self.read_options()
            names = ws.split_names(text := getattr(self, kind))
            if len(names) not in (0, 3):
                advice = f"give three columns, such as ax,ay,az, not {len(names)}"
                raise bc.InputError(f"--{kind} {text!r}: {advice}")
            options["columns"] = dict(zip(OUTPUTS, names, strict=False)) | options["columns"]
            try:
                logs.append((instrument, bc.read(self.files, instrument, **options)))
            except bc.InputError as error:
                unit = instrument.unit
                fault = f"has no three columns with common names of {kind} and a unit convertible to {unit}"
                example = ws.option(f"--{kind}", "X,Y,Z")
                remedy = f"Name them ({example}), or use a log that has them"
                if {*OUTPUTS} <= {p.column for p in error.problems}:
                    problems += [ws.Objection(self.files[0].name, fault, cure=remedy)]
                else:
                    problems += error.problems or [ws.Objection("", str(error))]
        problems.refuse()
        self.save_options()
        return logs


def _write_results(triads: Mapping[str, Triad], folder: Path, name: str | None) -> None:
    """Write the search, the corrections and the readings of each triad to a staging folder, without figures."""
    first, *others = (triad.correction for triad in triads.values())
    names = ws.name_sensors(name, [first, *others])
    for (subfolder, triad), sensor in zip(triads.items(), names, strict=True):
        ws.write_search(triad.search_path, folder / subfolder)
        for file in CORRECTION_FILES:
            bc.export_vector(triad.correction, folder / subfolder / file, name=sensor)
        triad.readings.write(folder / subfolder / "poses.csv")
    for file in UNIT_FILES if others else ():
        bc.export_vector(first, folder / file, others=others, name=name)


def _draw_results(triads: Mapping[str, Triad], folder: Path) -> bool:
    """Draw the figures and a report of each triad, and one report of all triads; return whether all were drawn."""
    paths = {subfolder: triad.search_path for subfolder, triad in triads.items()}
    outcomes = [ws.draw_safely(ws.draw_search, paths, folder)]

    def draw_reports() -> None:
        with ws.guard_drawing(REPORT), ws.replace_folder(folder, keep_results=True) as staging:
            for subfolder, chapters in {**paths, "": [*paths.values()]}.items():
                (staging / subfolder).mkdir(exist_ok=True)
                outcomes.append(ws.draw_safely(bc.report, chapters, staging / subfolder / REPORT))

    return all((ws.draw_safely(draw_reports), *outcomes))


def result_entries(calibration: bc.Calibration, average: bc.Calibration | None) -> dict[str, Any]:
    """Return result.json's entry `vector`: the three-axis correction with uncertainties, or None for one output."""
    if calibration.model.instrument.vector is None:
        return {"vector": None}

    def convert_correction(calibration: bc.Calibration) -> dict[str, Any]:
        correction = bc.vector_correction(calibration)
        data = {**correction.to_json_data(), "uncertainty": correction.uncertainty.tolist()}
        return {name: value for name, value in data.items() if name != "made_by"}

    average_data = None if average is None else {**convert_correction(average), "averaged": None}
    return {"vector": {**convert_correction(calibration), "averaged": average_data}}


def coefficient_tables(data: Mapping[str, Any]) -> list[tuple[str, ws.ResultTable]]:
    """Tabulate a three-axis correction's terms ± standard uncertainty, from result.json; no table for one output."""
    if not (vector := data.get("vector")):
        return []
    from bayescal._annexes.imu.vector_correction import VectorCorrection, tabulate_terms

    correction = VectorCorrection.from_data(vector["averaged"] or vector)
    caption = " ".join([f"{CAPTION}.", *correction.notes])
    return [(caption, tabulate_terms(correction.rows)), correction.tabulate_uncertainty()]


ANNEX = {
    "commands": (TriadCommand, ImuCommand),
    "exports": f"{__package__}.firmware_parameters:export_writers",
    "corrections": f"{__package__}.vector_files:CORRECTION_KINDS",
    "corrected": "bayescal:vector_correction",
    "result": result_entries,
    "coefficient_tables": coefficient_tables,
    "log": f"{__package__}.logs:open_log",
    "scalar_readings": f"{__package__}.scalar_readings:convert_to_scalar_readings",
}
