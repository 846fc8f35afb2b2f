"""What the annex of three axes offers: commands, corrections, formats of exports, parts of results.

Light: heavy modules load inside.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal import workshop as ws

MOST_ADDED = 5  # effects that are added
SENSORS = {
    "accelerometer_triad": "accelerometers",
    "gyro_triad": "gyroscopes",
    "magnetometer_triad": "magnetometers",
}
FILES = ("correction.h", "correction.py", "correction.json", "correction.yaml")
REPORT = "report.html"


class TriadOptions(ws.ReadRequest, ws.AsJson, ws.Options):
    """What is asked of three axes, one triad or all of a unit."""

    shortest: float | None = ws.opt("Shortest pose in a log, s; 2, or 1 where many are shorter.")
    baseline: bool = ws.opt("Look for no effect beside bias, scale, misalignment.", False)
    time_limit: float | None = ws.Shared.time_limit
    seed: int = ws.Shared.seed
    out: Path | None = ws.Shared.folder
    name: str | None = ws.opt("With which all names in C begin; else that of the instrument.")

    def refuse_options(self) -> None:
        """Refuse a name or a length that cannot be."""
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
            trail, correction = _calibrated(model, readings, self)
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
            long, left = {"shortest": self.shortest}, len(logs)
            poses = bc.poses(forces, force, **long)
            ws.print_notes(poses.flags)
            model = force.for_readings(poses).baseline()
            (trail, first) = _calibrated(model, poses, self, left=left)
            found = {"accelerometer": (trail, first, poses)}
            moves = bc.moves(rates, turns, forces, first, **long)
            ws.print_notes(moves.flags)
            model = dict(turns.structures)["moves"]()
            found["gyroscope"] = (*_calibrated(model, moves, self, left=left - 1), moves)
            for field, log in others:

                def turned(own: Any, log: Any = log) -> Any:
                    return bc.in_frame_of(own, log, first, forces, **long)

                its = bc.poses(log, field, **long)
                ws.print_notes(its.flags)
                model = field.for_readings(its).baseline()
                found["magnetometer"] = (*_calibrated(model, its, self, turned), its)
            if folder is not None:
                each = [correction for _, correction, _ in found.values()]
                named = ws.names_in_unit(self.name, each)
                with ws.whole_folder(folder) as hidden:
                    for (name, one), own in zip(found.items(), named, strict=True):
                        _write(hidden / name, *one, own)
                    for file in ("imu.h", "imu.py"):
                        bc.export_vector(first, hidden / file, others=each[1:], name=self.name)
                    bc.export_vector(first, hidden / "imu.yaml", others=each[1:2])
            data = {name: correction.data() for name, (_, correction, _) in found.items()}
            return _answer(
                {name: trail for name, (trail, _, _) in found.items()}, data, folder, self
            )

    def logs(self) -> dict[str, tuple[Any, Any]]:
        """Read each sensor's columns of the log; refuse with all that is wrong, of all sensors."""
        from bayescal._annexes.imu.logs import LOG_FORMATS

        how, needed = self.for_read(), bool(self.magnetometers or self.local_field)
        given = {name: _three(sensors, getattr(self, sensors)) for name, sensors in SENSORS.items()}
        if not (needed or all(path.suffix.lower() in LOG_FORMATS for path in self.files)):
            given.popitem()
        logs, problems = dict[str, tuple[Any, Any]](), ws.Objections()
        for name, three in given.items():
            named = {**how, "columns": three | how["columns"]}
            instrument, sensors = ws.instrument_named(name), SENSORS[name]
            if sensors != "magnetometers":
                named.pop("local_field", None)
            try:
                logs[name] = instrument, bc.read(self.files, instrument, **named)
            except bc.InputError as error:
                if not error.problems:
                    raise
                if sensors == "magnetometers" and not needed and _lacks_outputs(error.problems):
                    continue
                problems += _of_sensor(sensors, instrument, error.problems)
        problems.refuse()
        self.keep()
        return logs


def _answer(
    trails: Mapping[str, Any], data: Any, folder: Path | None, asked: TriadOptions
) -> ws.Answer:
    """What was found of three axes, by the folder in this one: its words are printed already."""
    made = folder is None or _draw(trails, folder)
    for place in dict.fromkeys((*trails, "")) if folder is not None and not asked.json_ else ():
        names = (*ws.files_of(folder / place), ws.MANIFEST)
        print(f"written: {folder / place}/{', '.join(names)}")
    why = [trail.gate.reason for trail in trails.values() if not trail.ok]
    shown = data if asked.json_ else None
    return ws.Answer(shown, ok=not why, why="; ".join(why[:1]), made=made)


def _three(sensors: str, given: str | None) -> dict[str, str]:
    """Return the columns of three outputs in a file, as the option of these sensors names them."""
    names = ws.names_in(given)
    if len(names) not in (0, 3):
        raise bc.InputError(f"--{sensors} {given!r}: give three, as ax,ay,az, not {len(names)}")
    return dict(zip((f"output_{a}" for a in "xyz"), names, strict=False))


def _lacks_outputs(problems: Sequence[ws.Objection]) -> list[ws.Objection]:
    """Return the objections to three outputs, where a file has none of them."""
    found = [p for p in problems if p.column in {f"output_{axis}" for axis in "xyz"}]
    return found if len(found) == 3 else []


def _of_sensor(
    sensors: str, instrument: Any, problems: Sequence[ws.Objection]
) -> Sequence[ws.Objection]:
    """Objections of a log, with one sentence in place of three where it has none of a sensor's three columns."""
    if not (missing := _lacks_outputs(problems)):
        return problems
    words = (word for p in missing for word in shlex.split(p.option.strip("()")))
    own = dict.fromkeys(w.partition("=")[2] for w in words if w.startswith("output_"))
    three = ",".join(own if len(own) == 3 else (f"{sensors[0]}{axis}" for axis in "xyz"))
    return [
        ws.Objection(
            missing[0].file,
            f"holds no three columns called as those of {sensors} are, in a unit that converts to {instrument.unit}",
            cure=f"Say which they are ({ws.option(f'--{sensors}', three)}), or take a log that has them",
        )
    ]


def _calibrated(
    model: Any,
    readings: Any,
    asked: TriadOptions,
    turned: Callable[[Any], Any] = lambda correction: correction,
    left: int = 1,
) -> tuple[Any, Any]:
    """Search and correction, printed or to be printed as JSON.

    Args:
        model: to begin with.
        readings: of poses or moves.
        asked: what is.
        turned: takes the correction to other axes.
        left: sensors of the unit that are not calibrated yet, and share the time.
    """
    untold = bc.undetermined(model, readings)
    if untold.add:
        ws.print_notes([str(untold)])
    # Where poses leave directions open, chains would go through the priors of these for minutes; where they leave
    # nothing to tell the noise by, so would draws.
    few = len(readings) <= sum(len(e.coefficients) for e in model.effects)
    method = bc.LeastSquares() if few else bc.Marginal(chains=not untold.add)
    most = 0 if asked.baseline or few else MOST_ADDED
    with ws.deadline.sooner(1 / left):
        trail = bc.calibrate(model, readings, method=method, seed=asked.seed, max_effects=most)
    correction = bc.vector_correction(trail.calibration)  # averaged over the structures
    correction = turned(correction)
    ws.print_notes(correction.notes)
    if not asked.json_:
        print(triad_text(trail, correction))
    return trail, correction


def triad_text(trail: bc.SearchPath, correction: bc.VectorCorrection) -> str:
    """What is found of three axes: the errors, the coefficients, and offset and matrix as exports have them."""
    return f"{trail}\n\n{ws.coefficients_text(trail)}\n\n{correction}"


def _write(folder: Path, trail: Any, correction: Any, readings: Any, sensor: str | None) -> None:
    """All that there is of three axes but what is drawn, to a folder that is not seen yet."""
    from bayescal._annexes.imu.vector_parameters import left_out

    ws.write_search(trail, folder)
    for name in FILES:
        bc.export_vector(correction, folder / name, name=sensor)
    if said := left_out(correction, "yaml"):
        ws.print_notes([f"{correction.instrument}, YAML: {said}"])
    readings.write(folder / "poses.csv")


def _draw(trails: Mapping[str, Any], folder: Path) -> bool:
    """Pictures and reports of three axes, in the folders of their results in this one, and a report of all."""
    made = [ws.drawn(ws.draw_search, trails, folder)]

    def reports() -> None:
        with ws.drawing(REPORT), ws.whole_folder(folder, more=True) as hidden:
            for place, trail in trails.items():
                (hidden / place).mkdir(exist_ok=True)
                made.append(ws.drawn(bc.report, trail, hidden / place / REPORT))
            if len(trails) > 1:
                made.append(ws.drawn(bc.report, [*trails.values()], hidden / REPORT))

    return all((ws.drawn(reports), *made))


def parameters(asked: ws.ExportCommand) -> ws.Answer:
    """`bayescal export` to parameters of an autopilot: of calibrations by axis, or of a triad."""
    several = ws.of_units(asked.calibrations, ws.CALIBRATION)
    loaded = asked.loaded(several)
    if loaded and not isinstance(loaded[0][1], bc.Compensator):
        return asked.written([one for _, one in loaded])
    given, numbers = by_axis(loaded, asked.axis, asked), device_numbers(asked.device_id)
    how = {"devices": numbers, "local_gravity": asked.gravity}
    found = bc.firmware_parameters(given, str(asked.format_), **how)
    text = found.text() if asked.out is None else f"{found}\n\nwritten: {found.write(asked.out)}"
    return ws.Answer(text.removesuffix("\n"), **ws.reliable(given))


def by_axis(
    given: Sequence[tuple[Path, bc.Compensator]], named: list[str] | None, own: ws.InUse
) -> dict[str, bc.Compensator]:
    """Calibrations by their axis: as their readings name it, or as the user does."""
    from bayescal._annexes.imu.firmware_parameters import axis_of

    found, files = dict[str, bc.Compensator](), dict[str, Path]()
    every = [(axis_of(c.calibration) if c.calibration else None, p, c) for p, c in given]
    pairs = (pair for one in named or [] for pair in ws.named_values([one], "--axis").items())
    every += [(name, Path(p), ws.compensator_from(Path(p), own)) for name, p in pairs]
    for name, path, chosen in every:
        if name is None:
            raise bc.InputError(
                f"{path}: its readings do not say of which axis it is: --axis gyro_x={path} in its place"
            )
        if name in found:
            raise bc.InputError(
                f"{path} and {files[name]} are both of {name}: give one, or say of which axis each is "
                f"(--axis gyro_y={path})"
            )
        found[name], files[name] = chosen, path
    return found


def device_numbers(given: list[str] | None) -> dict[str, int]:
    """--device-id as `firmware_parameters` takes it."""
    said = ws.named_values(given, "--device-id")
    for name, value in said.items():
        if not value.isdecimal():
            raise bc.InputError(f"--device-id {name}={value}: {value!r} is not a whole number")
    return {name: int(value) for name, value in said.items()}


def _exports() -> dict[str, Callable[[ws.ExportCommand], ws.Answer]]:
    from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS

    return dict.fromkeys(AUTOPILOTS, parameters)


def _result(calibration: bc.Calibration, average: bc.Calibration | None) -> dict[str, Any]:
    if calibration.model.instrument.vector is None:
        return {"vector": None}
    from bayescal._annexes.imu.vector_files import vector_data

    return {"vector": vector_data(calibration, average)}


HERE = "bayescal._annexes.imu"
ANNEX = {
    "commands": (TriadCommand, ImuCommand),
    "exports": _exports,
    "corrections": f"{HERE}.vector_files:KINDS",
    "corrected": "bayescal:vector_correction",
    "noise_file": "bayescal:kalibr_yaml",
    "result": _result,
    "coefficient_tables": f"{HERE}.vector_files:coefficient_tables",
    "pictures": f"{HERE}.sphere:pictures",
    "log": f"{HERE}.logs:open_log",
    "scalar_readings": f"{HERE}.scalar_readings:scalar_readings",
}
