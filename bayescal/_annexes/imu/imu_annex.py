"""Registration of the annex of three axes: commands, corrections, formats of exports, parts of results.

Light: heavy modules load inside.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal import workshop as ws

MAX_EFFECTS_ADDED = 5  # effects that are added
SENSORS = {
    "accelerometer_triad": "accelerometers",
    "gyro_triad": "gyroscopes",
    "magnetometer_triad": "magnetometers",
}
FILES = ("correction.h", "correction.py", "correction.json", "correction.yaml")
REPORT = "report.html"


class TriadOptions(ws.ReadRequest, ws.AsJson, ws.Options):
    """Options of the commands for three axes, of one triad or of all triads of a unit."""

    shortest: float | None = ws.opt("Shortest pose in a log, s; 2, or 1 where many are shorter.")
    baseline: bool = ws.opt("Look for no effect beside bias, scale, misalignment.", False)
    time_limit: float | None = ws.Shared.time_limit
    seed: int = ws.Shared.seed
    out: Path | None = ws.Shared.folder
    name: str | None = ws.opt("With which all names in C begin; else that of the instrument.")

    def refuse_options(self) -> None:
        """Raise InputError for an invalid name or a pose duration that is not positive."""
        ws.sensor_name(self.name, "")
        if self.shortest is not None and not self.shortest > 0:
            raise bc.InputError(f"--shortest {self.shortest:g}: give a positive number of seconds")


class TriadCommand(TriadOptions, ws.Command):
    """Calibrate three axes by poses at rest or known rates."""

    example = "bayescal triad log.csv --instrument gyro_triad --out result"
    instrument: str = ws.opt("Or gyro_triad, magnetometer_triad.", "accelerometer_triad")
    poses: bool = ws.opt("Each row is a pose or a rate; else steady stretches of a log.", False)
    dry_run: bool = ws.opt("Say what these poses leave open and which to add; fit nothing.", False)

    def answer(self) -> ws.Answer:
        self.refuse_options()
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
            trail, correction = _calibrate(model, readings, self)
            if folder is not None:
                with ws.whole_folder(folder) as hidden:
                    _write(hidden, trail, correction, readings, self.name)
            return _answer({"": trail}, correction.data(), folder, self)


class ImuCommand(TriadOptions, ws.Command):
    """Calibrate the sensors of a unit by one log, in one frame."""

    example = "bayescal imu log.csv --accelerometers ax,ay,az --gyroscopes gx,gy,gz --out unit"
    accelerometers: str | None = ws.opt(
        "Their three columns, as ax,ay,az; else by the usual names."
    )
    gyroscopes: str | None = ws.opt("Their three columns, as gx,gy,gz; else by the usual names.")
    magnetometers: str | None = ws.opt("Their three columns, mx,my,mz; of a log, those it has.")

    def answer(self) -> ws.Answer:
        self.refuse_options()
        with ws.result_folder(self.out) as folder:
            logs = self.logs()
            (force, forces), (turns, rates), *others = logs.values()
            options, count = {"shortest": self.shortest}, len(logs)
            poses = bc.poses(forces, force, **options)
            ws.print_notes(poses.flags)
            model = force.for_readings(poses).baseline()
            (trail, first) = _calibrate(model, poses, self, uncalibrated=count)
            triads = {"accelerometer": (trail, first, poses)}
            moves = bc.moves(rates, turns, forces, first, **options)
            ws.print_notes(moves.flags)
            model = dict(turns.structures)["moves"]()
            triads["gyroscope"] = (*_calibrate(model, moves, self, uncalibrated=count - 1), moves)
            for field, log in others:

                def rotate(correction: Any, log: Any = log) -> Any:
                    return bc.in_frame_of(correction, log, first, forces, **options)

                at_rest = bc.poses(log, field, **options)
                ws.print_notes(at_rest.flags)
                model = field.for_readings(at_rest).baseline()
                triads["magnetometer"] = (*_calibrate(model, at_rest, self, rotate), at_rest)
            if folder is not None:
                vectors = [correction for _, correction, _ in triads.values()]
                c_names = ws.names_in_unit(self.name, vectors)
                with ws.whole_folder(folder) as hidden:
                    for (name, triad), c_name in zip(triads.items(), c_names, strict=True):
                        _write(hidden / name, *triad, c_name)
                    for file in ("imu.h", "imu.py"):
                        bc.export_vector(first, hidden / file, others=vectors[1:], name=self.name)
                    bc.export_vector(first, hidden / "imu.yaml", others=vectors[1:2])
            data = {name: correction.data() for name, (_, correction, _) in triads.items()}
            return _answer(
                {name: trail for name, (trail, _, _) in triads.items()}, data, folder, self
            )

    def logs(self) -> dict[str, tuple[Any, Any]]:
        """Read each sensor's columns of the log; raise InputError with the objections of all sensors."""
        from bayescal._annexes.imu.logs import LOG_FORMATS

        read_options, needed = self.for_read(), bool(self.magnetometers or self.local_field)
        names = {name: _three_names(s, getattr(self, s)) for name, s in SENSORS.items()}
        if not (needed or all(path.suffix.lower() in LOG_FORMATS for path in self.files)):
            names.popitem()
        logs, problems = dict[str, tuple[Any, Any]](), ws.Objections()
        for name, three in names.items():
            named = {**read_options, "columns": three | read_options["columns"]}
            instrument, sensors = ws.instrument_named(name), SENSORS[name]
            if sensors != "magnetometers":
                named.pop("local_field", None)
            try:
                logs[name] = instrument, bc.read(self.files, instrument, **named)
            except bc.InputError as error:
                if not error.problems:
                    raise
                if sensors == "magnetometers" and not needed and _missing_outputs(error.problems):
                    continue
                problems += _summarise_missing_columns(sensors, instrument, error.problems)
        problems.refuse()
        self.keep()
        return logs


def _answer(
    trails: Mapping[str, Any], data: Any, folder: Path | None, options: TriadOptions
) -> ws.Answer:
    """Draw and list the results of triads, whose summaries are printed already, as the answer of a command."""
    drawn = folder is None or _draw_triads(trails, folder)
    for place in dict.fromkeys((*trails, "")) if folder is not None and not options.json_ else ():
        names = (*ws.files_of(folder / place), ws.MANIFEST)
        print(f"written: {folder / place}/{', '.join(names)}")
    why = [trail.gate.reason for trail in trails.values() if not trail.ok]
    json_data = data if options.json_ else None
    return ws.Answer(json_data, ok=not why, why="; ".join(why[:1]), made=drawn)


def _three_names(sensors: str, text: str | None) -> dict[str, str]:
    """Return the columns of three outputs in a file, as the option of these sensors names them."""
    names = ws.names_in(text)
    if len(names) not in (0, 3):
        raise bc.InputError(f"--{sensors} {text!r}: give three, as ax,ay,az, not {len(names)}")
    return dict(zip((f"output_{a}" for a in "xyz"), names, strict=False))


def _missing_outputs(problems: Sequence[ws.Objection]) -> list[ws.Objection]:
    """Return the objections to three outputs, where a file has none of them."""
    missing = [p for p in problems if p.column in {f"output_{axis}" for axis in "xyz"}]
    return missing if len(missing) == 3 else []


def _summarise_missing_columns(
    sensors: str, instrument: Any, problems: Sequence[ws.Objection]
) -> Sequence[ws.Objection]:
    """Replace the objections to a sensor's three columns by one where the log has none of them."""
    if not (missing := _missing_outputs(problems)):
        return problems
    words = (word for p in missing for word in shlex.split(p.option.strip("()")))
    names = dict.fromkeys(w.partition("=")[2] for w in words if w.startswith("output_"))
    three = ",".join(names if len(names) == 3 else (f"{sensors[0]}{axis}" for axis in "xyz"))
    return [
        ws.Objection(
            missing[0].file,
            f"holds no three columns called as those of {sensors} are, in a unit that converts to {instrument.unit}",
            cure=f"Say which they are ({ws.option(f'--{sensors}', three)}), or take a log that has them",
        )
    ]


def _calibrate(
    model: Any,
    readings: Any,
    options: TriadOptions,
    to_axes: Callable[[Any], Any] = lambda correction: correction,
    uncalibrated: int = 1,
) -> tuple[Any, Any]:
    """Search for the effects of a triad and compute its correction; print both unless JSON is asked for.

    Args:
        model: start of the search.
        readings: of poses or moves.
        options: of the command.
        to_axes: rotates the correction to other axes.
        uncalibrated: number of sensors of the unit that are not calibrated yet, and share the time.
    """
    undetermined = bc.undetermined(model, readings)
    if undetermined.add:
        ws.print_notes([str(undetermined)])
    # Where poses leave directions open, chains would go through the priors of these for minutes; where they leave
    # nothing to tell the noise by, so would draws.
    is_open = len(readings) <= sum(len(e.coefficients) for e in model.effects)
    method = bc.LeastSquares() if is_open else bc.Marginal(chains=not undetermined.add)
    limit = 0 if options.baseline or is_open else MAX_EFFECTS_ADDED
    with ws.deadline.sooner(1 / uncalibrated):
        trail = bc.calibrate(model, readings, method=method, seed=options.seed, max_effects=limit)
    correction = bc.vector_correction(trail.calibration)  # averaged over the structures
    correction = to_axes(correction)
    ws.print_notes(correction.notes)
    if not options.json_:
        print(triad_text(trail, correction))
    return trail, correction


def triad_text(trail: bc.SearchPath, correction: bc.VectorCorrection) -> str:
    """Format the result of a triad: the search, the coefficients, and offset and matrix as exports have them."""
    return f"{trail}\n\n{ws.coefficients_text(trail)}\n\n{correction}"


def _write(folder: Path, trail: Any, correction: Any, readings: Any, sensor: str | None) -> None:
    """Write the search, the corrections and the poses of a triad to a staging folder, without pictures."""
    from bayescal._annexes.imu.vector_parameters import left_out

    ws.write_search(trail, folder)
    for name in FILES:
        bc.export_vector(correction, folder / name, name=sensor)
    if omitted := left_out(correction, "yaml"):
        ws.print_notes([f"{correction.instrument}, YAML: {omitted}"])
    readings.write(folder / "poses.csv")


def _draw_triads(trails: Mapping[str, Any], folder: Path) -> bool:
    """Draw pictures and reports of each triad in its subfolder, and one report of all."""
    outcomes = [ws.drawn(ws.draw_search, trails, folder)]

    def reports() -> None:
        with ws.drawing(REPORT), ws.whole_folder(folder, leaving=True) as hidden:
            for place, trail in trails.items():
                (hidden / place).mkdir(exist_ok=True)
                outcomes.append(ws.drawn(bc.report, trail, hidden / place / REPORT))
            if len(trails) > 1:
                outcomes.append(ws.drawn(bc.report, [*trails.values()], hidden / REPORT))

    return all((ws.drawn(reports), *outcomes))


def parameters(cmd: ws.ExportCommand) -> ws.Answer:
    """Export parameters of an autopilot, from calibrations of single axes or of a triad."""
    several = ws.of_units(cmd.calibrations, ws.CALIBRATION)
    loaded = cmd.loaded(several)
    if loaded and not isinstance(loaded[0][1], bc.Compensator):
        return cmd.written([compensator for _, compensator in loaded])
    compensators, numbers = by_axis(loaded, cmd.axis, cmd), parse_device_ids(cmd.device_id)
    options = {"devices": numbers, "local_gravity": cmd.gravity}
    file = bc.firmware_parameters(compensators, str(cmd.format_), **options)
    text = file.text() if cmd.out is None else f"{file}\n\nwritten: {file.write(cmd.out)}"
    return ws.Answer(text.removesuffix("\n"), **ws.reliable(compensators))


def by_axis(
    loaded: Sequence[tuple[Path, bc.Compensator]], axes: list[str] | None, options: ws.InUse
) -> dict[str, bc.Compensator]:
    """Return calibrations by axis, as their readings or the user name it."""
    from bayescal._annexes.imu.firmware_parameters import axis_of

    compensators, files = dict[str, bc.Compensator](), dict[str, Path]()
    candidates = [(axis_of(c.calibration) if c.calibration else None, p, c) for p, c in loaded]
    pairs = (pair for text in axes or [] for pair in ws.named_values([text], "--axis").items())
    candidates += [(name, Path(p), ws.compensator_from(Path(p), options)) for name, p in pairs]
    for name, path, chosen in candidates:
        if name is None:
            raise bc.InputError(
                f"{path}: its readings do not say of which axis it is: --axis gyro_x={path} in its place"
            )
        if name in compensators:
            raise bc.InputError(
                f"{path} and {files[name]} are both of {name}: give one, or say of which axis each is "
                f"(--axis gyro_y={path})"
            )
        compensators[name], files[name] = chosen, path
    return compensators


def parse_device_ids(options: list[str] | None) -> dict[str, int]:
    """Parse the values of --device-id to numbers by sensor."""
    values_by_sensor = ws.named_values(options, "--device-id")
    for name, value in values_by_sensor.items():
        if not value.isdecimal():
            raise bc.InputError(f"--device-id {name}={value}: {value!r} is not a whole number")
    return {name: int(value) for name, value in values_by_sensor.items()}


def _exports() -> dict[str, Callable[[ws.ExportCommand], ws.Answer]]:
    from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS

    return dict.fromkeys(AUTOPILOTS, parameters)


def _result(calibration: bc.Calibration, average: bc.Calibration | None) -> dict[str, Any]:
    if calibration.model.instrument.vector is None:
        return {"vector": None}
    from bayescal._annexes.imu.vector_files import vector_data

    return {"vector": vector_data(calibration, average)}


ROOM = "bayescal._annexes.imu"
ANNEX = {
    "commands": (TriadCommand, ImuCommand),
    "exports": _exports,
    "corrections": f"{ROOM}.vector_files:KINDS",
    "corrected": "bayescal:vector_correction",
    "noise_file": "bayescal:kalibr_yaml",
    "result": _result,
    "coefficient_tables": f"{ROOM}.vector_files:coefficient_tables",
    "log": f"{ROOM}.logs:open_log",
    "scalar_readings": f"{ROOM}.scalar_readings:scalar_readings",
}
