"""Commands for what the user takes away: triad, imu, compensate, export, budget, decide, report.

Heavy modules load inside the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli import request, saved
from bayescal._cli.console import Answer, drawn, print_notes, result_folder
from bayescal._cli.options import (
    ColumnOptions,
    Commands,
    DecisionRule,
    InUse,
    ModelOptions,
    OwnParts,
    ReadRequest,
    named_numbers,
    names_in,
)
from bayescal._core.as_json import write_json
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.flag import code_of
from bayescal._report.whole_folder import MANIFEST, drawing, files_of, list_files, whole_folder

if TYPE_CHECKING:
    from bayescal._tables.raw_table import Objection

commands = Commands()
MOST_ADDED = 5  # effects that are added
SENSORS = {
    "accelerometer_triad": "accelerometers",
    "gyro_triad": "gyroscopes",
    "magnetometer_triad": "magnetometers",
}
FILES = ("correction.h", "correction.py", "correction.json", "correction.yaml")
REPORT = "report.html"
DCC = "dcc"  # the format of a digital calibration certificate


def reliable(given: Mapping[str, bc.Compensator | bc.VectorCorrection]) -> dict[str, Any]:
    """Of what was written, whether it is of results that may be used, as an `Answer` has it."""
    told = [f"{name} {one.why_not}".strip() for name, one in given.items() if one.why_not]
    return {"ok": not told, "why": "; ".join(told)}


def not_shown(found: bc.Decisions | None) -> str:
    """Which limits are not met, or undecided; empty where none is."""
    decisions = () if found is None else found.decisions
    open_ = [f"{d.limit} ({d.decision})" for d in decisions if d.decision != "accept"]
    return f"not shown to conform: {', '.join(open_)}" * bool(open_)


@dataclass(frozen=True)
class TriadOptions:
    """What is asked of three axes, one triad or all of a unit."""

    shortest: float | None = None
    baseline: bool = False
    seed: int = 0
    out: Path | None = None
    name: str | None = None
    json_: bool = False


@commands.example(
    "bayescal triad log.csv --columns output_x=ax --columns output_y=ay --columns output_z=az "
    "--out result"
)
def triad(
    files: list[Path],
    columns: ColumnOptions,
    asked: TriadOptions,
    instrument: str = "accelerometer_triad",
    poses: bool = False,
    dry_run: bool = False,
) -> Answer:
    """Calibrate three axes by poses at rest or known rates; corrections as C99, Python, JSON and YAML."""
    from bayescal._use.correction_files import sensor_name

    sensor_name(asked.name, "")  # refused before anything takes time
    given = ReadRequest(instrument, files, columns, ModelOptions())
    chosen, model, readings = request.open_request(given)
    if chosen.vector is None:
        raise InputError(
            f"--instrument {instrument}: it has one output; `bayescal calibrate` is for it"
        )
    print_notes(readings.flags)
    with result_folder(asked.out) as folder:
        if not poses:
            readings = bc.poses(readings, chosen, shortest=asked.shortest)
            model = chosen.for_readings(readings).baseline()
            print_notes(readings.flags)
        untold = bc.undetermined(model, readings)
        if dry_run:
            return Answer(str(untold))
        if untold.add:
            print_notes([str(untold)])
        # Where poses leave directions open, chains would go through the priors of these for minutes.
        method = bc.Marginal(chains=not untold.add)
        trail, correction = _calibrated(model, readings, asked, method=method)
        if folder is not None:
            with whole_folder(folder) as hidden:
                _write(hidden, trail, correction, readings, asked.name)
        return _answer({"": trail}, correction.data(), folder, asked)


@commands.example("bayescal imu log.csv --accelerometers ax,ay,az --gyroscopes gx,gy,gz --out unit")
def imu(
    files: list[Path],
    columns: ColumnOptions,
    asked: TriadOptions,
    accelerometers: str | None = None,
    gyroscopes: str | None = None,
    magnetometers: str | None = None,
) -> Answer:
    """Calibrate accelerometers by poses, gyroscopes by moves between them, magnetometers: one log, one frame."""
    from bayescal._tables.raw_table import Objections
    from bayescal._use.correction_files import names_in_unit, sensor_name

    sensor_name(asked.name, "")
    how, field = columns.for_read(), columns.local_field
    if field is not None and not magnetometers:
        raise InputError(
            f"--local-field {field!r}: it is of magnetometers; say which they are (--magnetometers mx,my,mz)"
        )
    given = dict(zip(SENSORS, (accelerometers, gyroscopes), strict=False))
    given |= {"magnetometer_triad": magnetometers} if magnetometers else {}
    instruments = {name: request.instrument_named(name) for name in given}
    logs, problems = {}, Objections()
    for name, three in given.items():
        named = {**how, "columns": _three(three) | how["columns"]}
        if SENSORS[name] != "magnetometers":
            named.pop("local_field", None)
        try:
            logs[name] = bc.read(list(files), instruments[name], **named)
        except InputError as error:
            if not error.problems:
                raise
            problems += _of_sensor(SENSORS[name], instruments[name], error.problems)
    problems.refuse()
    columns.keep()
    (force, forces), (turns, rates), *others = zip(instruments.values(), logs.values(), strict=True)
    long = {"shortest": asked.shortest}
    with result_folder(asked.out) as folder:
        poses = bc.poses(forces, force, **long)
        print_notes(poses.flags)
        (trail, first) = _calibrated(force.for_readings(poses).baseline(), poses, asked)
        found = {"accelerometer": (trail, first, poses)}
        moves = bc.moves(rates, turns, forces, first, **long)
        print_notes(moves.flags)
        model = dict(turns.structures)["moves"]()
        found["gyroscope"] = (*_calibrated(model, moves, asked), moves)
        for field, log in others:

            def turned(own: Any, log: Any = log) -> Any:
                return bc.in_frame_of(own, log, first, forces, **long)

            its = bc.poses(log, field, **long)
            model = field.for_readings(its).baseline()
            found["magnetometer"] = (*_calibrated(model, its, asked, turned), its)
        if folder is not None:
            each = [correction for _, correction, _ in found.values()]
            named = names_in_unit(asked.name, each)
            with whole_folder(folder) as hidden:
                for (name, one), own in zip(found.items(), named, strict=True):
                    _write(hidden / name, *one, own)
                for file in ("imu.h", "imu.py"):
                    bc.export_vector(first, hidden / file, others=each[1:], name=asked.name)
                bc.export_vector(first, hidden / "imu.yaml", others=each[1:2])
        data = {name: correction.data() for name, (_, correction, _) in found.items()}
        return _answer({name: trail for name, (trail, _, _) in found.items()}, data, folder, asked)


def _answer(
    trails: Mapping[str, Any], data: Any, folder: Path | None, asked: TriadOptions
) -> Answer:
    """What was found of three axes, by the folder in this one: its words are printed already."""

    def pictures() -> bool:
        made = folder is None or _draw(trails, folder)
        for place in dict.fromkeys((*trails, "")) if folder is not None and not asked.json_ else ():
            names = (*files_of(folder / place), MANIFEST)
            print(f"written: {folder / place}/{', '.join(names)}")
        return made

    why = [trail.gate.reason for trail in trails.values() if not trail.ok]
    shown = data if asked.json_ else None
    return Answer(shown, ok=not why, why="; ".join(why[:1]), pictures=pictures)


def _three(given: str | None) -> dict[str, str]:
    """Of three outputs, their columns in a file.

    Raises:
        InputError: these are not three.
    """
    names = names_in(given)
    if len(names) not in (0, 3):
        raise InputError(f"{given!r} names {len(names)} columns: give three, as ax,ay,az")
    return dict(zip((f"output_{a}" for a in "xyz"), names, strict=False))


def _of_sensor(sensors: str, instrument: Any, problems: Sequence[Objection]) -> Sequence[Objection]:
    """Objections of a log, with one sentence in place of three where it has none of a sensor's three columns."""
    from bayescal._tables.raw_table import Objection

    three = {f"output_{axis}" for axis in "xyz"}
    missing = [p for p in problems if p.column in three]
    if len(missing) < len(three):
        return problems
    columns = ",".join(f"{sensors[0]}{axis}" for axis in "xyz")
    return [
        Objection(
            missing[0].file,
            f"holds no three columns called as those of {sensors} are, in a unit that converts to {instrument.unit}",
            cure=f"Say which they are (--{sensors} {columns}), or take a log that has them",
        )
    ]


def _calibrated(
    model: Any,
    readings: Any,
    asked: TriadOptions,
    turned: Callable[[Any], Any] = lambda correction: correction,
    method: Any = None,
) -> tuple[Any, Any]:
    """Search and correction, printed or to be printed as JSON.

    Args:
        model: to begin with.
        readings: of poses or moves.
        asked: what is.
        turned: takes the correction to other axes.
        method: of the last fit.
    """
    most = 0 if asked.baseline else MOST_ADDED
    trail = bc.calibrate(model, readings, method=method, seed=asked.seed, max_effects=most)
    correction = bc.vector_correction(trail.calibration)  # averaged over the structures
    correction = turned(correction)
    print_notes(correction.notes)
    if not asked.json_:
        print(triad_text(trail, correction))
    return trail, correction


def triad_text(trail: bc.SearchPath, correction: bc.VectorCorrection) -> str:
    """What is found of three axes: the errors, the coefficients, and offset and matrix as exports have them."""
    from bayescal._cli.output import coefficients_text

    return f"{trail}\n\n{coefficients_text(trail)}\n\n{correction}"


def _write(folder: Path, trail: Any, correction: Any, readings: Any, sensor: str | None) -> None:
    """All that there is of three axes but what is drawn, to a folder that is not seen yet."""
    from bayescal._report.save_search import write_search
    from bayescal._use.vector_parameters import left_out

    write_search(trail, folder)
    for name in FILES:
        bc.export_vector(correction, folder / name, name=sensor)
    if said := left_out(correction, "yaml"):
        print_notes([f"{correction.instrument}, YAML: {said}"])
    readings.write(folder / "poses.csv")
    list_files(folder, None)


def _draw(trails: Mapping[str, Any], folder: Path) -> bool:
    """Pictures and reports of three axes, in the folders of their results in this one, and a report of all.

    Returns:
        Whether all could be made; what could not is said.
    """
    from bayescal._report.save_search import draw_search

    made = [drawn(draw_search, trails, folder)]

    def reports() -> None:
        with drawing(REPORT), whole_folder(folder, more=True) as hidden:
            for place, trail in trails.items():
                made.append(drawn(bc.report, trail, hidden / place / REPORT))
                list_files(hidden / place, None)
            if len(trails) > 1:
                made.append(drawn(bc.report, [*trails.values()], hidden / REPORT))

    return all((drawn(reports), *made))


@commands.example("bayescal compensate result/calibration.nc flight.csv --out done.csv")
def compensate(
    *,
    calibration: Path,
    file: Path,
    out: Path,
    first_order: bool = False,
    without_noise: bool = False,
    columns: ColumnOptions,
    own: InUse,
) -> Answer:
    """Turn readings back into what was measured, with standard uncertainty: two columns more."""
    from bayescal._use.compensate_file import compensate_file

    chosen = saved.compensator_from(calibration, own)
    how = {**columns.for_read(), "missing": columns.missing or "drop"}
    method = "first order" if first_order else None
    done = compensate_file(chosen, file, out, **how, method=method, noise=not without_noise)
    columns.keep()
    beyond = (
        f"{name} is outside its calibrated range in {count} of {done.rows} readings: an extrapolation there"
        for name, count in done.outside.items()
    )
    flags = (flag for flag in done.flags if code_of(flag) != "rows.dropped")
    print_notes((*chosen.notes, *flags, *beyond))
    text = (
        f"{out}: {done.rows} readings, columns {' and '.join(done.columns)} [{chosen.unit}] added"
    )
    gaps = f"; {done.missing} rows are empty, where a reading is missing" * bool(done.missing)
    data = {"file": str(out), "rows": done.rows, "columns": list(done.columns), "unit": chosen.unit}
    data |= {"outside": done.outside, "unsolved": done.unsolved, "missing": done.missing}
    judged = reliable({"": chosen})
    if done.unsolved:
        why = f"{done.unsolved} readings have no solution and are written empty"
        judged = {"ok": False, "why": why}
    return Answer(text + gaps, data, **judged)


@commands.example("bayescal export result/calibration.nc --format c --out gyro.h", data=False)
def export(
    *,
    calibrations: list[Path] | None = None,
    format_: str | None = None,
    out: Path | None = None,
    axis: list[str] | None = None,
    device_id: list[str] | None = None,
    local_gravity: float | None = None,
    certificate: Path | None = None,
    limit: list[str] | None = None,
    by: DecisionRule,
    own: InUse,
    name: str | None = None,
    without_uncertainty: bool = False,
) -> Answer:
    """Write the calibration for use elsewhere: C99, Python, JSON, a page, autopilot parameters, a certificate.

    Of three axes too, also YAML; those of a unit together in one file.
    """
    from bayescal._data.unit_conversion import STANDARD_GRAVITY
    from bayescal._use import correction_files as files
    from bayescal._use.autopilot import AUTOPILOTS
    from bayescal._use.vector_parameters import READ_BY_OTHERS, left_out

    known = ", ".join((*files.OF_ONE_OUTPUT, *READ_BY_OTHERS, *AUTOPILOTS, DCC))
    paths = calibrations or []
    if format_ is None and out is None:
        raise InputError(f"say which format: --format {known}")
    if format_ not in (None, *known.split(", ")):
        raise InputError(f"--format {format_!r} is not one of {known}")
    gravity = local_gravity or STANDARD_GRAVITY
    several = saved.of_units(paths, saved.CALIBRATION) if format_ in AUTOPILOTS else paths
    loaded = [(p, saved.correction_from(p, own)) for p in several if format_ != DCC]
    triads = [one for _, one in loaded if isinstance(one, bc.VectorCorrection)]
    single = [(path, one) for path, one in loaded if isinstance(one, bc.Compensator)]
    if single and triads:
        raise InputError(
            f"{single[0][0]} is of one output, and others are of three axes: give it alone"
        )
    how: dict[str, Any] = {"name": name, "uncertainty": not without_uncertainty}
    if triads:
        how["others"] = triads[1:]
        format_ = files.format_of(out, format_)
        if out is None:
            text = files.as_text(triads[0], format_, **how)
        else:
            text = f"written: {bc.export_vector(triads[0], out, format_, **how)}"
        said = ((c.instrument, left_out(c, format_)) for c in triads)
        print_notes([f"{name}: {words}" for name, words in said if words])
        given = {f"{c.instrument}:": c for c in triads}
    elif format_ in AUTOPILOTS:
        given = saved.by_axis(single, axis, own)
        numbers = saved.device_numbers(device_id)
        found = bc.firmware_parameters(given, format_, devices=numbers, local_gravity=gravity)
        text = found.text() if out is None else f"{found}\n\nwritten: {found.write(out)}"
    elif len(paths) != 1 or axis or device_id:
        raise InputError(
            f"a program is of one calibration, {len(paths)} were given"
            + (", and --axis or --device-id" if axis or device_id else "")
            + f": several, by axis, make parameters (--format {' or '.join(AUTOPILOTS)})"
        )
    elif format_ == DCC:
        given, text = {}, saved.certified(paths[0], own, certificate, gravity, limit, by)
        text = text if out is None else f"written: {write_text(text, out)}"
    else:
        ((_, chosen),) = single
        given = {"": chosen}
        if out is None:
            text = files.as_text(chosen.program, str(format_), **how)
        else:
            text = f"written: {chosen.export(out, format_, **how)}"
    return Answer(text.removesuffix("\n"), **reliable(given))


@commands.example("bayescal budget result/calibration.nc --at temperature=60")
def budget(
    *,
    calibration: Path,
    at: list[str] | None = None,
    k: float = 2.0,
    prior_sensitivity: bool = False,
    own: InUse,
) -> Answer:
    """The uncertainty budget of a compensated value (JCGM 100): who contributes how much."""
    from bayescal._calibration.prior_influence import prior_sensitivity as influence

    chosen = saved.compensator_from(calibration, own)
    found = bc.budget(chosen, named_numbers(at, "--at"), k=k)
    text, data = str(found), found.data()
    if prior_sensitivity and chosen.calibration is not None:
        priors = influence(chosen.calibration)
        text += f"\n\nPrior sensitivity (above 0.05 it matters):\n{priors}"
        data = {**data, "prior_sensitivity": priors.to_dict("index")}
    return Answer(text, data, **reliable({"": chosen}))


@commands.example('bayescal decide result --limit "bias: ±0.5 °/s"')
def decide(
    *,
    calibration: Path,
    limit: list[str],
    by: DecisionRule,
    population: list[str] | None = None,
    capability: float = 3.0,
    conformity: float = 0.95,
    out: Path | None = None,
    local_gravity: float | None = None,
    own: InUse,
) -> Answer:
    """Does it conform? Decisions about limits, with guard bands, risks and when to calibrate again.

    Exit status: 0 where every limit is met; 1 where one is not, or is undecided.
    """
    from bayescal._data.unit_conversion import STANDARD_GRAVITY

    found = bc.decide(
        saved.load_saved(calibration, own),
        limit,
        **vars(by),
        population=population or None,
        capability=capability,
        conformity=conformity,
        members=own.members,
        local_gravity=local_gravity or STANDARD_GRAVITY,
    )
    if out is not None:
        write_json(found.data(), out, indent=1)
    return Answer(found, doubt=not_shown(found))


@commands.example("bayescal report result -o report.html")
def report(
    *,
    calibrations: list[Path],
    out: Path = Path("report.html"),
    title: str = "",
    certificate: Path | None = None,
    limit: list[str] | None = None,
    by: DecisionRule,
    output_unit: str | None = None,
    own: OwnParts,
) -> Answer:
    """Write the report for sign-off: a one-page summary with appendices, in one HTML file."""
    from bayescal._report.certificate import read_certificate

    stated = read_certificate(certificate) if certificate else None
    given = saved.chapters_from(calibrations, own)
    decided = None
    if limit:
        if len(given) != 1:
            raise InputError(
                f"--limit decides about one result, {len(given)} were given: report each by itself"
            )
        decided = bc.decide(given[0].used, limit, **vars(by))
    how = {"title": title, "certificate": stated, "output_unit": output_unit}
    made = drawn(partial(bc.report, given, out, decisions=decided, **how))
    verdicts = [c.data["verdict"] for c in given]
    return Answer(
        f"written: {out}",
        {"file": str(out), "chapters": len(given)},
        ok=all(v["ok"] for v in verdicts),
        why=" ".join(reason for v in verdicts for reason in v["reasons"]),
        doubt=not_shown(decided),
        pictures=lambda: made,
    )
