"""Base classes of commands, which are data classes of their options; their answers; groups of shared options.

Typer treats a data class as a function. Annotations are not postponed here, since typer would resolve their names in
the module of the command. This module has few imports, since `bayescal --help` loads it.
"""

import inspect
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, dataclass_transform

from typer import Argument, Option
from typer.models import ParameterInfo

from bayescal._core import deadline
from bayescal._core.errors import InputError, NotDrawn
from bayescal._core.json_data import as_json, format_json
from bayescal._core.progress import INTERVAL_SECONDS, print_notes, track
from bayescal._report.whole_folder import AVERAGED, CALIBRATION, CHANNELS, MANIFEST
from bayescal._tables.mapping_file import load_mapping, save_mapping

MethodName = Literal["marginal", "least-squares", "nuts"]
OUTPUTS = ("out", "save_mapping")  # options that name output files
RESULT_FILES = (CALIBRATION, AVERAGED, MANIFEST, CHANNELS, "result.json")  # of a result folder
Texts = list[str] | None


def parse_values(texts: Texts, option: str) -> dict[str, list[str]]:
    """Parse name=value options to name → list of values; raise InputError for a malformed option."""
    values = dict[str, list[str]]()
    for text in texts or []:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{option} {text!r} is not of the form name=value")
        if value not in values.setdefault(name, []):
            values[name].append(value)
    return values


def parse_pairs(pairs: Texts, option: str) -> dict[str, str]:
    """Parse name=value options to name → value; raise InputError for a name with several values."""
    values_by_name = parse_values(pairs, option)
    for name, values in values_by_name.items():
        if len(values) > 1:
            raise InputError(f"{option} gives {name} twice, {' and '.join(values)}: give one value")
    return {name: value for name, (value,) in values_by_name.items()}


def parse_numbers(pairs: Texts, option: str) -> dict[str, float]:
    """Parse name=number options to name → number; raise InputError if a value is not a finite number."""
    numbers = {}
    for name, value in parse_pairs(pairs, option).items():
        try:
            numbers[name] = float(value)
        except ValueError:
            raise InputError(f"{option} {name}={value}: {value!r} is not a number") from None
        if not math.isfinite(numbers[name]):
            raise InputError(f"{option} {name}={value}: give a finite number")
    return numbers


def split_names(texts: str | None) -> list[str]:
    """Split a comma-separated list of names; [] for None."""
    return [name for part in (texts or "").split(",") if (name := part.strip())]


def split_optional(text: str | None) -> list[str] | None:
    """Split a comma-separated list of names; return None for None."""
    return None if text is None else split_names(text)


def parse_channels(texts: str | None) -> list[str]:
    """Split the names of --channels, [] for None; raise InputError for a single name or duplicates."""
    names = split_names(texts)
    if texts is not None and (len(names) < 2 or len(set(names)) < len(names)):
        message = f"--channels {texts!r}: give two or more different names, such as gyro_x,gyro_y"
        raise InputError(message)
    return names


def check_files_exist(files: list[Path] | None) -> list[Path] | None:
    """Return the files; raise InputError if one is missing. Called before the instrument loads, which takes seconds."""
    if files and not all(map(os.path.isfile, files)):
        from bayescal._tables.open_table import check_files

        check_files(files)
    return files


def check_time_limit(seconds: float | None) -> float | None:
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"--time-limit {seconds:g}: give a positive number of seconds")
    return seconds


@dataclass_transform(kw_only_default=True)
class Options:
    """Options of a command, as fields of a data class whose defaults are typer's option objects."""

    def __init_subclass__(cls) -> None:
        """Convert a command class to a data class: its own options first, then those of its base classes."""
        if hasattr(cls, "answer"):
            pairs = [p for base in cls.__mro__ for p in inspect.get_annotations(base).items()]
            types = {**dict(pairs), **dict(reversed(pairs))}  # own options first and overriding
            for name in (n for n, annotation in types.items() if annotation in (bool, "bool")):
                getattr(cls, name).param_decls = (f"--{name.strip('_').replace('_', '-')}",)
            cls.__annotations__ = types
            dataclass(kw_only=True, eq=False, repr=False)(cls)

    def __post_init__(self) -> None:
        """Replace typer's option objects by their defaults, for a command constructed in Python."""
        for name, value in vars(self).items():
            if isinstance(value, ParameterInfo):
                setattr(self, name, value.default)


@dataclass(frozen=True)
class Answer:
    """Result of a command, printed as text or as JSON; it determines the exit status."""

    content: Any  # printed as text, plain data as JSON; nothing for None
    data: Any = None  # printed with --json; default: `content.to_json_data()`
    why: str = ""  # reason why the result is not fit for use; the exit status is then 1
    warning: str = ""  # warning about a usable result; the exit status is 1 too
    drawn: bool = True  # whether all figures were drawn; if not, the exit status is 1
    written: str = ""  # names of the written files

    def print(self, json_: bool) -> bool:
        """Print the answer; return True for exit status 0: fit for use, all figures drawn, no warning."""
        content = self.content
        if json_:
            if self.data is not None:
                content = self.data
            elif hasattr(content, "to_json_data"):
                content = content.to_json_data()
        if isinstance(content, dict | list):
            content = format_json(as_json(content)).rstrip("\n")
        if content is not None:
            print(content)
        if self.written and not json_:
            print(f"\nwritten: {self.written}")
        if self.why:
            print(f"bayescal: result not reliable: {self.why}", file=sys.stderr)
        elif self.warning:
            print_notes([self.warning])
        return self.drawn and not (self.why or self.warning)


def draw_safely(draw: Callable[..., Any], *arguments: Any) -> bool:
    """Call a function that draws; return whether all figures were drawn; print a note if it raises NotDrawn."""
    try:
        draw(*arguments)
    except NotDrawn as error:
        print_notes([str(error)])
        return False
    return True


class Command(Options):
    """Base class of commands: the docstring is the help text, `answer` runs the command."""

    # Example call; name of the input option whose file `out` may overwrite; whether to print JSON.
    example, in_place, json_ = "", "", False

    def answer(self) -> Answer | None:
        raise NotImplementedError

    @classmethod
    def command_name(cls) -> str:
        """Return the name of the command on the command line."""
        return cls.__name__.removesuffix("Command").lower()

    def run(self) -> int:
        """Run the command and print its answer; return the exit status."""
        limit = getattr(self, "time_limit", None)
        with track(self.command_name(), INTERVAL_SECONDS), deadline.limit(limit):
            answer = self.answer()
            return int(answer is not None and not answer.print(self.json_))

    def refuse_overwriting(self) -> None:
        """Raise InputError if an output file is an input file."""
        options = {n: v for n, v in vars(self).items() if v and n not in (*OUTPUTS, "mapping")}
        for name in OUTPUTS:
            out = str(getattr(self, name, None) or "")
            inputs = (v for n, v in options.items() if (name, n) != ("out", self.in_place))
            paths = (path for value in inputs for path in _files_in(value) if os.path.isfile(path))
            if os.path.isfile(out) and any(os.path.samefile(out, path) for path in paths):
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"{option} {out} is an input file: give another name")


def _files_in(value: Any) -> Iterator[Path]:
    """Yield the files that a value may name: a path, those of a result folder, gyro_x=a.nc, my.py:INSTRUMENT."""
    for item in value if isinstance(value, list) else [value]:
        names = (str(item).rpartition("=")[2], str(item).rpartition(":")[0])
        for path in (item,) if isinstance(item, Path) else (Path(name) for name in names if name):
            folder = path.parent if path.name in RESULT_FILES else path
            yield from (path, *(folder / name for name in RESULT_FILES))


class AsJson(Options):
    """The option --json, which prints the answer as JSON."""

    json_: bool = Option(False, help="Print the result as JSON on stdout.")


def opt(help: str, default: Any = None, *names: str, **settings: Any) -> Any:
    """Return a typer option as the default of a field; `names`: its names, by default that of the field."""
    return Option(default, *names, help=help, **settings)


class Shared:
    """Options and arguments shared by several commands."""

    calibration = Argument(help="Result folder, or calibration (.nc).")
    files = Argument(
        help="Readings: CSV, Parquet, NetCDF, Excel, MATLAB; logs: .ulg, .bin.",
        callback=check_files_exist,
    )
    instrument = opt("Installed instrument, or my.py:INSTRUMENT.", ...)
    seed = opt("Seed of the random-number generator.", 0, min=0)
    time_limit = opt(
        "Time limit; the result so far is printed, as with Ctrl-C.",
        metavar="SECONDS",
        callback=check_time_limit,
    )
    method = opt("Method of inference.", "marginal")
    average = opt("Averaging time (1s, 0.5s, 2min); spikes are removed before.", metavar="TIME")
    channels = opt("Outputs of a device, analysed jointly: gyro_x,gyro_y.", metavar="NAME,NAME,…")
    max_effects = opt("Maximum number of missing effects.", 5, min=1)
    covariates = opt(
        "Undeclared columns used as covariates; default: all but other channels.",
        metavar="NAME,NAME,…",
    )
    effects = opt("Python file that defines effects or a noise law.", None, "--effects")
    typed = opt(
        "Additional candidate effect: 'supply: s * (supply_voltage - 5); s = 0.1 V/V'.",
        *(None, "--effect"),
        metavar="'NAME: FORMULA; s = SIZE'",
    )
    add = opt("Effect to add to the baseline; repeatable.")
    reference = opt("T0=0: reference temperature of the effects, °C.")
    reference_dcc = opt("Calibration certificate: thermometer.xml, or rate_input=table.xml.")
    folder = opt("Output folder.")
    certificate = opt(
        "TOML file with the certificate's data: device, place, operator, standards, dates."
    )
    limit = opt("Limit for a conformity decision, as in `bayescal decide`; for one result.")
    local_gravity = opt("Local gravity, m/s²; default: 9.80665.", min=1.0)


NO_OPTION: Any = None  # value of a setting without an option in a command


class ColumnOptions(Options):
    """Options for reading the columns of files."""

    columns: Texts = opt("output=gyro_x: bayescal's column = the file's; repeatable.")
    unit: Texts = opt("gyro_x=rad/s: unit of a column; repeatable.")
    unwrap: Texts = opt("time=2^32us: period after which a counter wraps around.")
    local_gravity: float | None = Shared.local_gravity
    local_field: str | None = opt("Magnitude of the field, for magnetometers.", metavar="'48.2 uT'")
    missing: str | None = opt("Treatment of rows with missing readings.", metavar="refuse|drop")
    decimal: str | None = opt("Decimal mark; default: detected.", metavar=".|,")
    date_order: str | None = opt("Order in dates such as 05/06/2026.", metavar="mdy|dmy|ymd|hms")
    nominal_scale: str | None = opt("Raw output per unit of output.", metavar="'250 V/g'")
    nominal_zero: str | None = opt("Raw output at zero input.", metavar="'1.21 V'")
    ignore: Texts = opt("Column to exclude; repeatable.", metavar="HEADER")
    begin: Texts = opt(
        "Date of the first reading, or '9 days' of the calibration's clock.", metavar="'FILE=DATE'"
    )
    mapping: Path | None = opt("File written by --save-mapping; options take precedence.")
    save_mapping: Path | None = opt("TOML file to save these options to, for --mapping.")

    def read_options(self) -> dict[str, Any]:
        """Return arguments of `read`, options before those of --mapping; raise InputError for a malformed option."""
        saved = {} if self.mapping is None else load_mapping(self.mapping)
        columns = parse_values(self.columns, "--columns")
        repeated: dict[str, dict[str, Any]] = {
            "columns": {n: v[0] if len(v) == 1 else v for n, v in columns.items()},
            "units": parse_pairs(self.unit, "--unit"),
            "unwrap": parse_pairs(self.unwrap, "--unwrap"),
            "begin": {f: t for f, _, t in (b.rpartition("=") for b in self.begin or ())},
        }
        saved |= {name: saved.get(name, {}) | values for name, values in repeated.items()}
        single = (
            "local_gravity local_field missing decimal date_order nominal_scale nominal_zero ignore"
        )
        single_values = {n: v for n in single.split() if (v := getattr(self, n)) is not None}
        return {"missing": "refuse", "decimal": "", **saved, **single_values}

    def save_options(self) -> None:
        """Save these options to a mapping file, if --save-mapping is given."""
        if self.save_mapping is not None:
            save_mapping(self.save_mapping, self.read_options())


class ReadRequest(ColumnOptions):
    """Options of a fit: files, their columns, and the model."""

    files: list[Path] = Shared.files
    fix = reference = reference_dcc = add = structure = effects_file = typed = average = NO_OPTION
    keep_spikes = False  # spikes are excluded
    instrument = ""


class ModelOptions(Options):
    """Options of the model: structure, added effects, fixed coefficients, reference temperature."""

    fix: Texts = opt("bias.temperature=0.041: fix an unknown, in its unit; repeatable.")
    reference: Texts = Shared.reference
    reference_dcc: Texts = Shared.reference_dcc
    add: Texts = Shared.add
    structure: str | None = opt("Structure of the instrument; default: its baseline.")
    effects_file: Path | None = Shared.effects
    typed: Texts = Shared.typed


class FitRequest(Options):
    """Options of a fit: instrument, averaging, method, time limit, seed."""

    instrument: str = Shared.instrument
    method: MethodName = Shared.method
    average: str | None = Shared.average
    time_limit: float | None = Shared.time_limit
    seed: int = Shared.seed


class SearchRequest(FitRequest, ModelOptions, ReadRequest):
    """Options of a search for missing effects."""

    holdout: list[Path] | None = opt(
        "Hold-out data, read after the last step; repeatable.", callback=check_files_exist
    )
    max_effects: int = Shared.max_effects
    keep_spikes: bool = opt("Keep spikes, and readings with wrong temperatures.", False)
    accept_conflict: Texts = opt("bias.constant: accept a conflict with its prior; repeatable.")

    def settings(self) -> dict[str, Any]:
        """Return the search settings common to command line and workbench."""
        values = {n: getattr(self, n) for n in ("max_effects", "keep_spikes", "seed")}
        return values | {"accept_conflicts": self.accept_conflict or ()}


class DefinitionOptions(Options):
    """Options for the user's files that define the effects and the instrument of a saved calibration."""

    effects_file: Path | None = Shared.effects
    instrument_file: str | None = opt(
        "my.py:INSTRUMENT, if the calibration's instrument is not installed.", None, "--instrument"
    )


class StructureOptions(DefinitionOptions):
    """Options that select the result to use: the model average, or the most probable structure."""

    one_structure: Literal["average", "best"] = opt(
        "'average' over structures, or the 'best' structure.", "average", "--structure"
    )


class MemberOptions(StructureOptions):
    """Options for the group members in use: the device, run or cell."""

    member: Texts = opt("device=A17: device (or run, cell) in use; repeatable.")

    @property
    def members(self) -> dict[str, str]:
        """Return the member in use of each group: group → member."""
        return parse_pairs(self.member, "--member")


class DecisionRule(Options):
    """Options of the decision rule for conformity with limits."""

    rule: str = opt("Decision rule agreed with the customer: guarded or simple.", "guarded")
    false_accept: float = opt("Maximum probability of false acceptance; sets guard bands.", 0.025)

    def decision_options(self) -> dict[str, Any]:
        """Return keyword arguments of `decide`."""
        return {"rule": self.rule, "false_accept": self.false_accept}
