"""Options that several commands share, one by one and in groups. Light: `bayescal --help` reads them.

A group is a data class of options, or of groups. `with_groups` shows typer its fields in place of a command's
parameter of that class, so that each group is said once.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from bayescal._core.errors import InputError
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._tables.mapping_file import load_mapping, save_mapping

METHODS = {"marginal": "Marginal", "least-squares": "LeastSquares", "nuts": "NUTS"}  # public names


def named_values(given: list[str] | None, option: str) -> dict[str, str]:
    """name=value options as a dictionary.

    Raises:
        InputError: one is not of that form.
    """
    values = {}
    for one in given or []:
        name, equals, value = one.partition("=")
        if not (name and equals and value):
            raise InputError(f"{option} {one!r} is not of the form name=value")
        values[name.strip()] = value.strip()
    return values


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


def channel_names(given: str) -> list[str]:
    """The names between commas.

    Raises:
        InputError: fewer than two, or one twice.
    """
    names = [name for part in given.split(",") if (name := part.strip())]
    if len(names) < 2 or len(set(names)) < len(names):
        raise InputError(
            f"--channels {given!r}: give two names or more, each once, as gyro_x,gyro_y"
        )
    return names


def causes(ignore: list[str] | None, covariates: str | None) -> dict[str, Any]:
    """--ignore and --covariates as `calibrate` and `discover` take them."""
    named = None if covariates is None else [n for p in covariates.split(",") if (n := p.strip())]
    return {"ignore": tuple(ignore or ()), "covariates": named}


def refuse_missing(files: list[Path] | None) -> list[Path] | None:
    """Refuse files that are not there before an instrument loads, which takes seconds.

    Raises:
        InputError: a file is not there; the words are those of `read`.
    """
    if files and not all(map(os.path.isfile, files)):
        from bayescal._tables.open_table import check_files

        check_files(files)
    return files


def _refuse_unknown_method(name: str) -> str:
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


Files = Annotated[
    list[Path],
    typer.Argument(
        help="CSV, Parquet, NetCDF, Excel or MATLAB files of readings, or logs: .ulg, .bin, .bag, .mcap, .db3.",
        show_default=False,
        callback=refuse_missing,
    ),
]
Saved = Annotated[
    Path, typer.Argument(help="A folder of results, or its calibration (.nc).", show_default=False)
]
Name = Annotated[
    str,
    typer.Option(
        "--instrument",
        help="Name of an installed instrument, or my.py:INSTRUMENT.",
        show_default=False,
    ),
]
OwnInstrument = Annotated[
    str | None,
    typer.Option(
        "--instrument",
        help="my.py:INSTRUMENT, if the calibration is of an instrument that is not installed.",
    ),
]
Fix = Annotated[
    list[str] | None,
    typer.Option(
        "--fix", help="bias.temperature=0.041: hold an unknown at a value, in its unit; repeat."
    ),
]
Ref = Annotated[
    list[str] | None,
    typer.Option("--reference", help="T0=0: reference temperature of the bases, °C."),
]
Add = Annotated[
    list[str] | None,
    typer.Option("--add", help="Effect to add to the baseline; repeat for more."),
]
Structure = Annotated[
    str | None,
    typer.Option(help="A model structure of the instrument in place of its baseline."),
]
Structures = Annotated[
    list[str] | None,
    typer.Option(
        "--structure",
        help="Structure to set beside the others, or with effects added, as "
        "line+bias.thermal_lag; repeat. All of the instrument's if none is given.",
    ),
]
OwnEffects = Annotated[
    Path | None,
    typer.Option("--effects", help="Python file with effects or a noise law of your own."),
]
Typed = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        metavar="'NAME: FORMULA; s = SIZE'",
        help="An effect of your own in one line, as a candidate: 'supply: s * (supply_voltage - 5); s = 0.1 V/V'.",
    ),
]
Members = Annotated[
    list[str] | None,
    typer.Option("--member", help="device=A17: which device is used; repeat for more."),
]
MethodName = Annotated[
    str,
    typer.Option(
        "--method", help="marginal, least-squares or nuts.", callback=_refuse_unknown_method
    ),
]
BatchMethod = Annotated[
    str,
    typer.Option("--method", help="least-squares or marginal.", callback=_refuse_unknown_method),
]
MostEffects = Annotated[
    int, typer.Option("--max-effects", min=1, help="Most effects that may be missing.")
]
SimpleNoise = Annotated[
    bool,
    typer.Option(
        "--simple-noise",
        help="Where noise is correlated, leave out sums of terms (random walk, flicker, two times, a tone): faster on "
        "long records.",
    ),
]
Next = Annotated[
    bool,
    typer.Option(
        "--next-experiment", help="Rank feasible campaigns by how well they tell rivals apart."
    ),
]
Screen = Annotated[
    int | None,
    typer.Option(
        "--calibrate-screen",
        metavar="N",
        min=1,
        help="Search N campaigns simulated from this model, and print how often something is reported.",
    ),
]
Hidden = Annotated[
    list[str] | None,
    typer.Option("--effect", help="name=size: an effect to hide; repeat for more."),
]
NoiseName = Annotated[
    str | None,
    typer.Option(
        "--noise",
        metavar="NAME",
        help="Noise law by name: student_t, ornstein_uhlenbeck, heteroscedastic(temperature), or one of --effects.",
    ),
]
NoiseLaw = Annotated[str, typer.Option(help="white, student_t or ornstein_uhlenbeck.")]
Channels = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,NAME,…",
        help="Columns of the file that are outputs of one unit, searched together: gyro_x,gyro_y,gyro_z.",
    ),
]
Holdout = Annotated[
    list[Path] | None,
    typer.Option(
        help="Hold-out data, only read after the last step; repeat for more.",
        callback=refuse_missing,
    ),
]
TimeLimit = Annotated[
    float | None,
    typer.Option(
        "--time-limit",
        metavar="SECONDS",
        help="End after this time with what there is, as Ctrl-C does at any time, and say what was left out.",
        callback=_refuse_no_time,
    ),
]
Average = Annotated[
    str | None,
    typer.Option(
        "--average",
        metavar="TIME",
        help="1s, 0.5s or 2min: means over this time in place of single readings; spikes are set aside first.",
        callback=_refuse_no_duration,
    ),
]
KeepSpikes = Annotated[
    bool, typer.Option("--keep-spikes", help="Keep single readings far from both neighbours.")
]
AcceptConflict = Annotated[
    list[str] | None,
    typer.Option(
        "--accept-conflict",
        help="bias.constant: may differ greatly from its plausible size; repeat for others.",
    ),
]
Ignore = Annotated[
    list[str] | None,
    typer.Option("--ignore", metavar="COLUMN", help="A column that is no cause; repeat for more."),
]
Covariates = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,NAME,…",
        help="Of the columns that the instrument does not know, those that may be causes; all but other channels "
        "of the unit if not given.",
    ),
]
Certificate = Annotated[
    Path | None,
    typer.Option(
        "--certificate",
        help="TOML file of what a certificate states: device, serial number, place, operator, conditions, "
        "standards, dates.",
    ),
]
AlsoLimit = Annotated[
    list[str] | None,
    typer.Option(
        "--limit", help="Also decide whether it conforms, as `bayescal decide`; of one result."
    ),
]
Rule = Annotated[
    str,
    typer.Option(
        "--rule", help="Of decisions: guarded, simple or shared-risk, as agreed on beforehand."
    ),
]
FalseAccept = Annotated[
    float,
    typer.Option("--false-accept", help="Probability of a false acceptance that 'guarded' allows."),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of every random number.")]
Folder = Annotated[Path | None, typer.Option("--out", help="Folder to write to.")]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", help="With all candidates of every step, and drafts of effects."),
]
OutputUnit = Annotated[
    str | None,
    typer.Option(
        "--output-unit",
        help="Errors and coefficients in this unit of the output too, such as the file's mV; raw units by the nominal "
        "scale. JSON stays as it is.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


Columns = Annotated[
    list[str] | None,
    typer.Option("--columns", help="output=gyro_x: our column = the file's; repeat for more."),
]
Units = Annotated[
    list[str] | None,
    typer.Option("--unit", help="gyro_x=rad/s: unit of a column; repeat for more."),
]
Gravity = Annotated[
    float | None,
    typer.Option(min=1.0, help="Local gravity, m/s², for files in m/s²; 9.80665 if not given."),
]
Missing = Annotated[
    str | None,
    typer.Option(
        "--missing",
        metavar="refuse|drop",
        help="Rows with a missing reading: refuse the file, or drop them (a gap).",
    ),
]
Decimal = Annotated[
    str | None,
    typer.Option(
        "--decimal", metavar=".|,", help="In numbers of text files, where they do not show it."
    ),
]
Scale = Annotated[
    str | None,
    typer.Option(
        "--nominal-scale",
        metavar="'250 V/g'",
        help="Raw output per unit of output, in place of the instrument's own: turns V, mV, Hz, counts into it.",
    ),
]
Zero = Annotated[
    str | None,
    typer.Option("--nominal-zero", metavar="'1.21 V'", help="Raw output at zero; 0 if not given."),
]
DateOrder = Annotated[
    str | None,
    typer.Option(
        "--date-order",
        metavar="mdy|dmy|ymd",
        help="Of dates such as 05/06/2026, where no day above 12 shows it.",
    ),
]
LeftOut = Annotated[
    list[str] | None,
    typer.Option("--ignore", metavar="HEADER", help="Column to leave out; repeat for more."),
]
MappingFile = Annotated[
    Path | None,
    typer.Option(
        "--mapping",
        help="TOML file that --save-mapping wrote; options on the command line take precedence.",
    ),
]
SaveMapping = Annotated[
    Path | None,
    typer.Option("--save-mapping", help="TOML file to keep these options in, for --mapping."),
]


@dataclass(frozen=True)
class ColumnOptions:
    """How the columns of the files are to be understood."""

    columns: Columns = None
    unit: Units = None
    local_gravity: Gravity = None
    missing: Missing = None
    decimal: Decimal = None
    date_order: DateOrder = None
    nominal_scale: Scale = None
    nominal_zero: Zero = None
    ignore: LeftOut = None
    mapping: MappingFile = None
    save_mapping: SaveMapping = None

    def for_read(self) -> dict[str, Any]:
        """As the arguments of `read` that they are; those of the mapping where no option says otherwise.

        Raises:
            InputError: an option is not of its form, or the mapping cannot be used.
        """
        saved = {} if self.mapping is None else load_mapping(self.mapping)
        names = ("local_gravity", "missing", "decimal", "date_order", "nominal_scale")
        single = {name: getattr(self, name) for name in (*names, "nominal_zero", "ignore")}
        usual = {"local_gravity": STANDARD_GRAVITY, "missing": "refuse", "decimal": ""}
        given = {name: value for name, value in single.items() if value is not None}
        return {
            "columns": saved.pop("columns", {}) | named_values(self.columns, "--columns"),
            "units": saved.pop("units", {}) | named_values(self.unit, "--unit"),
            **usual,
            **saved,
            **given,
        }

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

    fix: Fix = None
    reference: Ref = None
    add: Add = None
    structure: Structure = None
    effects_file: OwnEffects = None
    typed: Typed = None


OneStructure = Annotated[
    str,
    typer.Option(
        help="'average' over the structures that share the probability, where the folder has several; or 'best', "
        "the one of calibration.nc."
    ),
]


@dataclass(frozen=True)
class OwnParts:
    """What a saved calibration needs that is not installed: effects and an instrument of the user's own."""

    effects_file: OwnEffects = None
    instrument: OwnInstrument = None


@dataclass(frozen=True)
class UsedParts(OwnParts):
    """The same where a number leaves: it comes from all structures that share the probability, or from one."""

    structure: OneStructure = "average"


@dataclass(frozen=True)
class InUse(UsedParts):
    """The same of an instrument in use: which run, cell or device it is."""

    member: Members = None

    @property
    def members(self) -> dict[str, str]:
        """Group → its member."""
        return named_values(self.member, "--member")


@dataclass(frozen=True)
class DecisionRule:
    """By which rule it is decided whether a limit is met."""

    rule: Rule = "guarded"
    false_accept: FalseAccept = 0.025


@dataclass(frozen=True)
class ReadRequest:
    """What a command is asked to fit.

    Attributes:
        instrument: its name, or my.py:INSTRUMENT.
        files: of readings.
        columns: how the files are to be understood.
        choice: which model.
        average: time over which means are taken; None for single readings.
    """

    instrument: Name
    files: Files
    columns: ColumnOptions
    choice: ModelOptions
    average: Average = None

    keep_spikes = False  # single readings far from both neighbours are set aside


@dataclass(frozen=True)
class SearchRequest(ReadRequest):
    """What a command is asked to search, and how."""

    holdout: Holdout = None
    method: MethodName = "marginal"
    max_effects: MostEffects = 5
    time_limit: TimeLimit = None
    keep_spikes: KeepSpikes = False  # pyright: ignore[reportIncompatibleVariableOverride]
    accept_conflict: AcceptConflict = None
    seed: Seed = 0

    def settings(self) -> dict[str, Any]:
        """What a search takes by the same names, on the command line and in a browser."""
        return {
            "max_effects": self.max_effects,
            "keep_spikes": self.keep_spikes,
            "accept_conflicts": self.accept_conflict or (),
            "seed": self.seed,
        }


class Commands(typer.Typer):
    """Commands, each with a line of its use, whose groups of options typer sees one by one."""

    def example(self, line: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
        """A command, as `typer.Typer.command` takes it.

        Args:
            line: how it is called, for the end of its help.
        """
        return lambda command: self.command(epilog=f"Example: {line}")(with_groups(command))


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer is to see it: each option of a group in place of the group, of groups in it too."""
    declared = _parameters(command)

    @functools.wraps(command)
    def run(**values: Any) -> None:
        command(**{name: _taken(p.annotation, name, values) for name, p in declared.items()})

    keyword = inspect.Parameter.KEYWORD_ONLY  # a required option may then follow others
    seen = [p.replace(kind=keyword) for one in declared.values() for p in _single(one)]
    run.__signature__ = inspect.Signature(seen)  # pyright: ignore[reportAttributeAccessIssue]
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


def _taken(kind: Any, name: str, values: Mapping[str, Any]) -> Any:
    """The value of a parameter, or the group made of its own."""
    if not is_dataclass(kind):
        return values[name]
    return kind(**{n: _taken(p.annotation, n, values) for n, p in _parameters(kind).items()})  # pyright: ignore[reportCallIssue]
