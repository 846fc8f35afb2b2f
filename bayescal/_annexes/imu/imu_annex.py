"""Registration of the annex of three axes: commands, corrections, formats of exports, parts of results.

Light: heavy modules load inside.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import bayescal as bc
from bayescal import workshop as ws

MAX_EFFECTS_ADDED = 5  # effects that are added
SENSORS = {"accelerometers": "accelerometer_triad", "gyroscopes": "gyro_triad"}
OUTPUTS = ("output_x", "output_y", "output_z")
FILES = ("correction.h", "correction.py", "correction.json")
UNIT_FILES = ("imu.h", "imu.py")  # of all triads of a unit
REPORT = "report.html"
CAPTION = "Three axes: outputs = offset + matrix · what acts, each a polynomial of T − T0; ± one standard uncertainty"


class Triad(NamedTuple):
    """A calibrated triad: its search, its correction, and the readings of poses or moves."""

    trail: bc.SearchPath
    correction: bc.VectorCorrection
    readings: bc.Measurements

    def __str__(self) -> str:
        """Format the search, the coefficients, and offset and matrix as exports have them."""
        return f"{self.trail}\n\n{ws.coefficients_text(self.trail)}\n\n{self.correction}"


class TriadOptions(ws.ReadRequest, ws.AsJson, ws.Options):
    """Options of the commands for three axes, of one triad or of both triads of a unit."""

    shortest: float | None = ws.opt(
        "Shortest pose in a log, s; 2, or 1 where many are shorter.", min=0.1
    )
    baseline: bool = ws.opt("Look for no effect beside bias, scale, misalignment.", False)
    time_limit: float | None = ws.Shared.time_limit
    seed: int = ws.Shared.seed
    out: Path | None = ws.Shared.folder
    name: str | None = ws.opt("With which all names in C begin; else that of the instrument.")

    def calibrate(self, model: bc.Model, readings: bc.Measurements, uncalibrated: int = 1) -> Triad:
        """Search for the effects of a triad and compute its correction; print both unless JSON is asked for.

        Args:
            model: start of the search.
            readings: of poses or moves.
            uncalibrated: number of triads of the unit that are not calibrated yet, and share the time.
        """
        undetermined = bc.undetermined(model, readings)
        if undetermined.add:
            ws.print_notes([str(undetermined)])
        # Where poses leave directions open, chains would go through the priors of these for minutes; where they leave
        # nothing to tell the noise by, so would draws.
        is_open = len(readings) <= sum(len(e.coefficients) for e in model.effects)
        method = bc.LeastSquares() if is_open else bc.Marginal(chains=not undetermined.add)
        limit = 0 if self.baseline or is_open else MAX_EFFECTS_ADDED
        with ws.deadline.sooner(1 / uncalibrated):
            trail = bc.calibrate(model, readings, method=method, seed=self.seed, max_effects=limit)
        # Averaged over the structures.
        triad = Triad(trail, bc.vector_correction(trail.calibration), readings)
        ws.print_notes(triad.correction.notes)
        if not self.json_:
            print(triad)
        return triad

    def finish(self, triads: Mapping[str, Triad], folder: Path | None) -> ws.Answer:
        """Write and draw triads, by their subfolders of a folder, if there is one; return the command's answer."""
        drawn = True
        if folder is not None:
            with ws.whole_folder(folder) as hidden:
                _write(triads, hidden, self.name)
            drawn = _draw(triads, folder)
            for place in dict.fromkeys((*triads, "")) if not self.json_ else ():
                names = (*ws.files_of(folder / place), ws.MANIFEST)
                print(f"written: {folder / place}/{', '.join(names)}")
        why = [triad.trail.gate.reason for triad in triads.values() if not triad.trail.ok]
        data = {place: triad.correction.data() for place, triad in triads.items()}
        json_data = data.get("", data) if self.json_ else None
        return ws.Answer(json_data, ok=not why, why="; ".join(why[:1]), drawn=drawn)


class TriadCommand(TriadOptions, ws.Command):
    """Calibrate three axes by poses at rest or known rates."""

    example = "bayescal triad log.csv --instrument gyro_triad --out result"
    instrument: str = ws.opt("Or gyro_triad, magnetometer_triad.", "accelerometer_triad")
    poses: bool = ws.opt("Rows are poses or rates (else: finds steady stretches of a log).", False)
    dry_run: bool = ws.opt("Say what these poses leave open and which to add; fit nothing.", False)

    def answer(self) -> ws.Answer:
        ws.sensor_name(self.name, "")  # refused before minutes of calibration
        if self.poses and self.shortest is not None:
            raise bc.InputError("--shortest is of poses in a log: leave it out, or --poses")
        if ws.instrument_named(self.instrument).vector is None:
            raise bc.InputError(
                f"--instrument {self.instrument}: it has one output; `bayescal calibrate` is for it"
            )
        chosen, model, readings = ws.open_request(self)
        if not self.poses:
            readings = bc.poses(readings, chosen, shortest=self.shortest)
            model = chosen.for_readings(readings).baseline()
        ws.print_notes(readings.flags)
        if self.dry_run:
            return ws.Answer(str(bc.undetermined(model, readings)))
        with ws.result_folder(self.out) as folder:
            return self.finish({"": self.calibrate(model, readings)}, folder)


class ImuCommand(TriadOptions, ws.Command):
    """Calibrate accelerometers and gyroscopes by one log."""

    example = "bayescal imu log.csv --accelerometers ax,ay,az --gyroscopes gx,gy,gz --out unit"
    accelerometers: str | None = ws.opt(
        "Their three columns, as ax,ay,az; else by the usual names."
    )
    gyroscopes: str | None = ws.opt("Their three columns, as gx,gy,gz; else by the usual names.")

    def answer(self) -> ws.Answer:
        ws.sensor_name(self.name, "")  # refused before minutes of calibration
        with ws.result_folder(self.out) as folder:
            (force, forces), (turns, rates) = self.logs()
            poses = bc.poses(forces, force, shortest=self.shortest)
            ws.print_notes(poses.flags)
            first = self.calibrate(force.for_readings(poses).baseline(), poses, uncalibrated=2)
            moves = bc.moves(rates, turns, forces, first.correction, shortest=self.shortest)
            ws.print_notes(moves.flags)
            second = self.calibrate(dict(turns.structures)["moves"](), moves)
            return self.finish({"accelerometer": first, "gyroscope": second}, folder)

    def logs(self) -> list[tuple[bc.Instrument, bc.Measurements]]:
        """Read each triad's columns of the log; raise InputError with the objections of both."""
        logs, problems = [], ws.Objections()
        for sensors, name in SENSORS.items():
            instrument, options = ws.instrument_named(name), self.read_options()
            three = ws.split_names(text := getattr(self, sensors))
            if len(three) not in (0, 3):
                raise bc.InputError(
                    f"--{sensors} {text!r}: give three, as ax,ay,az, not {len(three)}"
                )
            options["columns"] = dict(zip(OUTPUTS, three, strict=False)) | options["columns"]
            try:
                logs.append((instrument, bc.read(self.files, instrument, **options)))
            except bc.InputError as error:
                missing = {*OUTPUTS} <= {p.column for p in error.problems}
                came = (
                    f"holds no three columns called as those of {sensors} are, in a unit that converts to "
                    f"{instrument.unit}"
                )
                cure = f"Say which they are ({ws.option(f'--{sensors}', 'X,Y,Z')}), or take a log that has them"
                problem = ws.Objection(self.files[0].name, came, cure=cure)
                problems += (
                    [problem] if missing else error.problems or [ws.Objection("", str(error))]
                )
        problems.refuse()
        self.keep()
        return logs


def _write(triads: Mapping[str, Triad], folder: Path, name: str | None) -> None:
    """Write the search, the corrections and the readings of each triad to a staging folder, without pictures."""
    first, *others = (triad.correction for triad in triads.values())
    names = ws.names_in_unit(name, [first, *others])
    for (place, triad), sensor in zip(triads.items(), names, strict=True):
        ws.write_search(triad.trail, folder / place)
        for file in FILES:
            bc.export_vector(triad.correction, folder / place / file, name=sensor)
        triad.readings.write(folder / place / "poses.csv")
    for file in UNIT_FILES if others else ():
        bc.export_vector(first, folder / file, others=others, name=name)


def _draw(triads: Mapping[str, Triad], folder: Path) -> bool:
    """Draw pictures and a report of each triad, and one report of all; return whether all were drawn."""
    trails = {place: triad.trail for place, triad in triads.items()}
    outcomes = [ws.draw_safely(ws.draw_search, trails, folder)]

    def reports() -> None:
        with ws.drawing(REPORT), ws.whole_folder(folder, leaving=True) as hidden:
            for place, chapters in {**trails, "": [*trails.values()]}.items():
                (hidden / place).mkdir(exist_ok=True)
                outcomes.append(ws.draw_safely(bc.report, chapters, hidden / place / REPORT))

    return all((ws.draw_safely(reports), *outcomes))


def result_entries(calibration: bc.Calibration, average: bc.Calibration | None) -> dict[str, Any]:
    """Return the entry `vector` of result.json: terms with standard uncertainties; None for one output."""
    if calibration.model.instrument.vector is None:
        return {"vector": None}

    def data_of(calibration: bc.Calibration) -> dict[str, Any]:
        correction = bc.vector_correction(calibration)
        data = {**correction.data(), "uncertainty": correction.uncertainty.tolist()}
        return {name: value for name, value in data.items() if name != "made_by"}

    averaged = None if average is None else {**data_of(average), "averaged": None}
    return {"vector": {**data_of(calibration), "averaged": averaged}}


def coefficient_tables(data: Mapping[str, Any]) -> list[tuple[str, ws.ResultTable]]:
    """Tabulate the terms of a correction of three axes, at T0 and by temperature, each ± u; none for one output."""
    if not (last := data.get("vector")):
        return []
    from bayescal._annexes.imu.vector_correction import term_rows, terms_table

    terms = last["averaged"] or last
    rows = term_rows(terms["terms"], terms["uncertainty"], terms["unit"], terms["beside"])
    return [(CAPTION, terms_table(rows))]


ROOM = "bayescal._annexes.imu"
ANNEX = {
    "commands": (TriadCommand, ImuCommand),
    "exports": f"{ROOM}.firmware_parameters:export_writers",
    "corrections": f"{ROOM}.vector_files:KINDS",
    "corrected": "bayescal:vector_correction",
    "result": result_entries,
    "coefficient_tables": coefficient_tables,
    "log": f"{ROOM}.logs:open_log",
    "scalar_readings": f"{ROOM}.scalar_readings:scalar_readings",
}
