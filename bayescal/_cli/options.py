"""What options say, in one table by their parameters' names, and options that several commands share in groups.

A command's parameters have a type and a default, no more; `answering` shows them to typer with their words, and in
place of a parameter of a group (a data class) the fields of the group. Light: `bayescal --help` reads it.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from bayescal._cli.console import Answer
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.progress import EVERY, stage
from bayescal._tables.mapping_file import load_mapping, save_mapping

METHODS = {"marginal": "Marginal", "least-squares": "LeastSquares", "nuts": "NUTS"}  # public names


def said_values(given: list[str] | None, option: str) -> dict[str, list[str]]:
    """name=value options, every value of a name.

    Raises:
        InputError: one is not of that form.
    """
    values = dict[str, list[str]]()
    for one in given or []:
        name, equals, value = (part.strip() for part in one.partition("="))
        if not (name and equals and value):
            raise InputError(f"{option} {one!r} is not of the form name=value")
        if value not in values.setdefault(name, []):
            values[name].append(value)
    return values


def named_values(given: list[str] | None, option: str) -> dict[str, str]:
    """name=value options as a dictionary; a name that has two values is refused too."""
    found = said_values(given, option)
    for name, values in found.items():
        if len(values) > 1:
            raise InputError(f"{option} says {name} twice, {' and '.join(values)}: say it once")
    return {name: value for name, (value,) in found.items()}


def named_numbers(given: list[str] | None, option: str) -> dict[str, float]:
    """name=number options as a dictionary.

    Raises:
        InputError: one is not of that form, or its number is none or not finite.
    """
    numbers = {}
    for name, value in named_values(given, option).items():
        try:
            numbers[name] = float(value)
        except ValueError:
            raise InputError(f"{option} {name}={value}: {value!r} is not a number") from None
        if not math.isfinite(numbers[name]):
            raise InputError(f"{option} {name}={value}: give a finite number")
    return numbers


def names_in(given: str | None) -> list[str]:
    """The names between commas."""
    return [name for part in (given or "").split(",") if (name := part.strip())]


def channel_names(given: str | None) -> list[str]:
    """Those of --channels; none where it is not given.

    Raises:
        InputError: fewer than two, or one twice.
    """
    names = names_in(given)
    if given is not None and (len(names) < 2 or len(set(names)) < len(names)):
        raise InputError(
            f"--channels {given!r}: give two names or more, each once, as gyro_x,gyro_y"
        )
    return names


def causes(ignore: list[str] | None, covariates: str | None) -> dict[str, Any]:
    """--ignore and --covariates as `calibrate` and `discover` take them."""
    return {
        "ignore": ignore or (),
        "covariates": None if covariates is None else names_in(covariates),
    }


def refuse_missing(files: list[Path] | None) -> list[Path] | None:
    """Refuse files that are not there before an instrument loads, which takes seconds.

    Raises:
        InputError: a file is not there; the words are those of `read`.
    """
    if files and not all(map(os.path.isfile, files)):
        from bayescal._tables.open_table import check_files

        check_files(files)
    return files


def refuse_unknown_method(name: str) -> str:
    if name not in METHODS:
        raise InputError(f"--method {name!r} is not one of {', '.join(METHODS)}")
    return name


def _refuse_no_time(seconds: float | None) -> float | None:
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"--time-limit {seconds:g}: give a positive number of seconds")
    return seconds


def _refuse_no_duration(text: str | None) -> str | None:
    if text is not None:
        from bayescal._data.averaging import duration  # a second that `--help` does without

        duration(text)
    return text


Options = Mapping[str, str | tuple[str, str] | Mapping[str, Any]]
BY_NAME = inspect.Parameter.KEYWORD_ONLY  # so that a required one may follow others
ARGUMENTS = ("files", "file", "calibration", "calibrations", "named")  # which are no options

# By the parameter's name, or as "command.name" where a command means something else by it: its words, with what stands
# for its value, or with all that typer is told; `names` where an option is not called after its parameter.
# fmt: off
OPTIONS: Options = {
    "accept_conflict": "bias.constant: may differ greatly from its plausible size; repeat for others.",
    "add": "Effect to add to the baseline; repeat for more.",
    "at": "temperature=60: operating point, in fixed units; repeat for more.",
    "average": {"help": "1s, 0.5s or 2min: means over this time in place of single readings; spikes are set aside "
        "first.", "metavar": "TIME", "callback": _refuse_no_duration},
    "axis": "gyro_x=a.nc: calibration of an axis, where its readings do not name it.",
    "begin": ("FILE=DATE, or the DATE alone of files without dates: when the first reading was taken; or a time on the "
        "clock of the calibration, '9 days'; repeat for more.", "'FILE=DATE'"),
    "calibration": "A folder of results, or its calibration (.nc).",
    "certificate": "TOML file of what a certificate states: device, place, operator, conditions, standards, dates.",
    "channels": ("Columns that are outputs of one unit, searched together: gyro_x,gyro_y,gyro_z.", "NAME,NAME,…"),
    "check": ("Simulate this instrument, fit what was simulated, and say what came back.", "my.py:INSTRUMENT"),
    "columns": "output=gyro_x: our column = the file's; repeat for more, and where files call one differently.",
    "compare.structure": "Structure to compare, or with effects added, as line+bias.thermal_lag; repeat; all if none.",
    "compensate.calibration": "Folder of results, its calibration (.nc), or a JSON export.",
    "compensate.out": {"help": "File to write, of the same format (Excel, MATLAB: .csv).", "names": ["--out", "-o"]},
    "covariates": ("Of the columns that the instrument does not know, those that may be causes; all but other channels "
        "of the unit if not given.", "NAME,NAME,…"),
    "criterion": "residual, ratio-variance or ratio-variance-raw.",
    "date_order": ("Of dates such as 05/06/2026, where no day above 12 shows it; hms for times such as 10.11.12.",
        "mdy|dmy|ymd|hms"),
    "decimal": ("In numbers of text files, where they do not show it.", ".|,"),
    "demo.json_": "Print result.json on stdout, and the story on stderr.",
    "device_id": "gyro=3670026: PX4's number of a sensor; repeat.",
    "discover.ignore": ("Exclude this column as a possible cause; repeatable.", "COLUMN"),
    "effect": "name=size: an effect to hide; repeat for more.",
    "effects_file": {"help": "Python file with effects or a noise law of your own.", "names": ["--effects"]},
    "export.calibrations": "Folders of results, calibrations (.nc), JSON exports: one, one an axis, or a unit's.",
    "export.out": {"help": "File to write; standard output if not given.", "names": ["--out", "-o"]},
    "false_accept": "Probability of a false acceptance that 'guarded' allows.",
    "file": "Readings: text, .parquet, .nc, .xlsx or .mat.",
    "files": {"help": "CSV, Parquet, NetCDF, Excel or MATLAB files of readings, or logs: .ulg, .bin, .bag, .mcap, "
        ".db3.", "callback": refuse_missing},
    "first_order": "Propagate mean and covariance, as exports do, not draws.",
    "fix": "bias.temperature=0.041: hold an unknown at a value, in its unit; repeat.",
    "format_": "json, c or python; of three axes yaml, openvins, realsense, ros; px4-params or ardupilot-params; dcc.",
    "holdout": {"help": "Hold-out data, only read after the last step; repeat for more.", "callback": refuse_missing},
    "ignore": ("Column to leave out; repeat for more.", "HEADER"),
    "instrument": "Name of an installed instrument, or my.py:INSTRUMENT.",
    "instrument_file": {"help": "my.py:INSTRUMENT, if that of the calibration is not installed.",
        "names": ["--instrument"]},
    "json_": "Print the result as JSON on stdout.",
    "k": {"help": "Coverage factor of the expanded uncertainty.", "names": ["-k"]},
    "keep_spikes": "Keep single readings far from both neighbours, and those of a wrong thermometer.",
    "limit": "Also decide whether it conforms, as `bayescal decide`; of one result.",
    "local_field": ("Local magnetic field that magnetometers are turned in; ratios of scales without it.", "'48.2 uT'"),
    "local_gravity": {"help": "Local gravity, m/s², for files in m/s²; 9.80665, with its uncertainty on Earth, if not "
        "given.", "min": 1.0},
    "mapping": "TOML file that --save-mapping wrote; options on the command line take precedence.",
    "max_effects": {"help": "Most effects that may be missing.", "min": 1},
    "member": "device=A17: which device is used; repeat for more.",
    "method": {"help": "marginal, least-squares or nuts.", "callback": refuse_unknown_method},
    "missing": ("Rows with a missing reading: refuse the file, or drop them (a gap).", "refuse|drop"),
    "name": "Of the sensor or unit, with which all names in C begin; that of its instrument if not given.",
    "named": ("One instrument, of which columns and effects are listed; all of them if not given.", "NAME"),
    "next_experiment": "Rank feasible campaigns by how well they tell rivals apart.",
    "noise": ("Noise law: student_t, ornstein_uhlenbeck, heteroscedastic(temperature), or one of --effects.", "NAME"),
    "noise.channels": ("Columns that are outputs, one after another: gyro_x,acc_x.", "NAME,NAME,…"),
    "noise_law": "white, student_t or ornstein_uhlenbeck.",
    "nominal_scale": ("Raw output per unit of output, in place of the instrument's own: turns V, mV, Hz, counts into "
        "it.", "'250 V/g'"),
    "nominal_zero": ("Raw output at zero; 0 if not given.", "'1.21 V'"),
    "one_structure": {"help": "'average' over the structures that share the probability, or 'best', the one of "
        "calibration.nc.", "names": ["--structure"]},
    "out": "Folder to write to.",
    "output_unit": "Errors and coefficients in this unit of the output too, such as the file's mV; JSON stays.",
    "pairs.instrument": "Whose devices are chosen in pairs.",
    "predict.out": "File to write: .csv, .parquet or .nc.",
    "prior_sensitivity": "Also how much the priors matter (psense).",
    "quantile": "Of the posterior, that the numbers for Kalibr are.",
    "readings": {"help": "With --check: files whose columns, the output aside, are taken in place of a simulator's.",
        "callback": refuse_missing},
    "reference": "T0=0: reference temperature of the bases, °C.",
    "report.calibrations": "Saved calibrations (.nc), or folders that `bayescal calibrate --out` wrote.",
    "report.out": {"help": "HTML file to write.", "names": ["--out", "-o"]},
    "rule": "Of decisions: guarded, simple or shared-risk, as agreed on beforehand.",
    "same_record": "The readings are of the record that was fitted: give its correlated noise between fitted readings.",
    "save_mapping": "TOML file to keep these options in, for --mapping.",
    "seed": {"help": "Seed of every random number.", "min": 0},
    "simple_noise": "Where noise is correlated, leave out sums of terms: faster on long records.",
    "simulate.out": "File to write: .csv, .parquet or .nc.",
    "structure": "A model structure of the instrument in place of its baseline.",
    "time_limit": {"help": "End after this time with what there is, as Ctrl-C does at any time.", "metavar": "SECONDS",
        "callback": _refuse_no_time},
    "title": "Of the report.",
    "topic": "Of the messages, for Kalibr.",
    "typed": {"help": "An effect of your own in one line, as a candidate: 'supply: s * (supply_voltage - 5); s = 0.1 "
        "V/V'.", "names": ["--effect"], "metavar": "'NAME: FORMULA; s = SIZE'"},
    "unit": "gyro_x=rad/s: unit of a column; repeat for more.",
    "unwrap": "time=2^32us: what a clock or counter held when it began anew.",
    "verbose": "With all candidates of every step, and drafts of effects.",
    "without_noise": "Leave the noise of each reading out.",
    "without_uncertainty": "C and Python that give the value alone, without the covariance of the coefficients.",
    "yaml": "File to write for Kalibr: noise densities and random walks.",
}
# fmt: on


@dataclass(frozen=True)
class ColumnOptions:
    """How the columns of the files are to be understood."""

    columns: list[str] | None = None
    unit: list[str] | None = None
    unwrap: list[str] | None = None
    local_gravity: float | None = None
    local_field: str | None = None
    missing: str | None = None
    decimal: str | None = None
    date_order: str | None = None
    nominal_scale: str | None = None
    nominal_zero: str | None = None
    ignore: list[str] | None = None
    begin: list[str] | None = None
    mapping: Path | None = None
    save_mapping: Path | None = None

    def for_read(self) -> dict[str, Any]:
        """As the arguments of `read` that they are; those of the mapping where no option says otherwise.

        Raises:
            InputError: an option is not of its form, or the mapping cannot be used.
        """
        saved = {} if self.mapping is None else load_mapping(self.mapping)
        given = {n: v for n, v in vars(self).items() if v is not None and "mapping" not in n}
        columns = said_values(given.pop("columns", None), "--columns")
        own: dict[str, dict[str, Any]] = {
            "columns": {n: v[0] if len(v) == 1 else v for n, v in columns.items()},
            "units": named_values(given.pop("unit", None), "--unit"),
            "unwrap": named_values(given.pop("unwrap", None), "--unwrap"),
            "begin": {f: t for f, _, t in (b.rpartition("=") for b in given.pop("begin", ()))},
        }
        saved |= {name: saved.get(name, {}) | values for name, values in own.items()}
        usual = {"missing": "refuse", "decimal": ""}
        return {**usual, **saved, **given}

    def keep(self) -> None:
        """Save the mapping, where that is asked for, once the files have been read with it.

        Raises:
            InputError: the place cannot be written to.
        """
        if self.save_mapping is not None:
            save_mapping(self.save_mapping, self.for_read())


@dataclass(frozen=True)
class ModelOptions:
    """Which model of an instrument: its structure, effects added, coefficients fixed, constants of the bases."""

    fix: list[str] | None = None
    reference: list[str] | None = None
    add: list[str] | None = None
    structure: str | None = None
    effects_file: Path | None = None
    typed: list[str] | None = None


@dataclass(frozen=True)
class OwnParts:
    """What a saved calibration needs that is not installed: effects and an instrument of the user's own."""

    effects_file: Path | None = None
    instrument_file: str | None = None


@dataclass(frozen=True)
class UsedParts(OwnParts):
    """The same where a number leaves: it comes from all structures that share the probability, or from one."""

    one_structure: str = "average"


@dataclass(frozen=True)
class InUse(UsedParts):
    """The same of an instrument in use: which run, cell or device it is."""

    member: list[str] | None = None

    @property
    def members(self) -> dict[str, str]:
        """Group → its member."""
        return named_values(self.member, "--member")


@dataclass(frozen=True)
class DecisionRule:
    """By which rule it is decided whether a limit is met."""

    rule: str = "guarded"
    false_accept: float = 0.025


@dataclass(frozen=True)
class ReadRequest:
    """What a command is asked to fit: instrument, files, how these are understood, which model, means or readings."""

    instrument: str
    files: list[Path]
    columns: ColumnOptions
    choice: ModelOptions
    average: str | None = None

    keep_spikes = False  # single readings far from both neighbours are set aside


@dataclass(frozen=True)
class SearchRequest(ReadRequest):
    """What a command is asked to search, and how."""

    holdout: list[Path] | None = None
    method: str = "marginal"
    max_effects: int = 5
    time_limit: float | None = None
    keep_spikes: bool = False  # pyright: ignore[reportIncompatibleVariableOverride]
    accept_conflict: list[str] | None = None
    seed: int = 0

    def settings(self) -> dict[str, Any]:
        """What a search takes by the same names, on the command line and in a browser."""
        return {
            "max_effects": self.max_effects,
            "keep_spikes": self.keep_spikes,
            "accept_conflicts": self.accept_conflict or (),
            "seed": self.seed,
        }


class Command(NamedTuple):
    """A function as a command: how it is called, whether --json prints its answer, whether it tells what it does."""

    function: Callable[..., Answer | None]
    line: str
    data: bool
    endless: bool


class Commands(list[Command]):
    """Commands whose options have their words from the table here.

    Args:
        own: options that these alone have, or of which they say something else, as `OPTIONS`.
    """

    def __init__(self, own: Options | None = None) -> None:
        super().__init__()
        self.options = {**OPTIONS, **(own or {})}

    def example(
        self, line: str, *, data: bool = True, endless: bool = False
    ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        """Have a function as a command; it stays callable.

        Args:
            line: how it is called, for the end of its help.
            data: whether its answer is printed as JSON with --json, an option that it need not declare.
            endless: whether it says itself what it does.
        """

        def taken(function: Callable[..., Any]) -> Callable[..., Any]:
            self.append(Command(function, line, data, endless))
            return function

        return taken

    def add_to(self, app: typer.Typer, asked: str | None = None) -> None:
        """Have an application run them; all but the one that is asked for, if one is, by name and words alone."""
        for one in self:
            name = one.function.__name__
            whole = asked in (None, name)
            shown = answering(one, self.options) if whole else lambda: None
            words = inspect.getdoc(one.function)
            app.command(name, help=words, epilog=f"Example: {one.line}")(shown)


def answering(command: Command, options: Options) -> Callable[..., None]:
    """The command as typer is to see it: its options with their words, those of a group in place of the group.

    What it answers is printed; its time limit, if it has one, is that of everything.
    """
    function, name = command.function, command.function.__name__
    declared = _parameters(function)
    shown = [p for one in declared.values() for p in _single(one)]
    if command.data and "json_" not in {p.name for p in shown}:
        shown.append(inspect.Parameter("json_", BY_NAME, default=False, annotation=bool))

    def run(**values: Any) -> None:
        with ExitStack() as during:
            if not command.endless:
                during.enter_context(stage(name, EVERY))
                during.enter_context(deadline.until(values.get("time_limit")))
            answer = function(**{n: _taken(p.annotation, n, values) for n, p in declared.items()})
            if answer is not None and not answer.tell(values.get("json_", False)):
                raise typer.Exit(1)

    run.__signature__ = inspect.Signature([_told(p, name, options) for p in shown])  # pyright: ignore[reportAttributeAccessIssue]
    run.__annotations__ = {}
    return run


def _parameters(of: Any) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(of, eval_str=True).parameters


def _single(parameter: inspect.Parameter) -> Iterator[inspect.Parameter]:
    """A parameter, or those of its group."""
    if not is_dataclass(parameter.annotation):
        yield parameter
        return
    for inner in _parameters(parameter.annotation).values():
        yield from _single(inner)


def _told(parameter: inspect.Parameter, command: str, options: Options) -> inspect.Parameter:
    """A parameter with its words, by name alone."""
    own = options.get(f"{command}.{parameter.name}") or options[parameter.name]
    if isinstance(own, Mapping):
        how = dict(own)
    else:
        how = dict(zip(("help", "metavar"), (own,) if isinstance(own, str) else own, strict=False))
    names = how.pop("names", [f"--{parameter.name.strip('_').replace('_', '-')}"])
    required = parameter.default is parameter.empty
    kind: Any = typer.Option
    if parameter.name in ARGUMENTS:
        kind, names = typer.Argument, []
    told = kind(*names, show_default=not required, **how)
    shown = Annotated[parameter.annotation, told]
    return parameter.replace(kind=BY_NAME, annotation=shown)


def _taken(kind: Any, name: str, values: Mapping[str, Any]) -> Any:
    """The value of a parameter, or the group made of its own."""
    if not is_dataclass(kind):
        return values[name]
    return kind(**{n: _taken(p.annotation, n, values) for n, p in _parameters(kind).items()})  # pyright: ignore[reportCallIssue]
