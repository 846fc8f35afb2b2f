"""Base classes of commands (data classes of their options), their answers, and groups of shared options.

Typer accepts a data class like a function. Annotations are not postponed here, since typer would resolve their names
in the module of the command. This module imports little, since `bayescal --help` loads it.
"""

import inspect
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, dataclass_transform

from typer import Argument, Option
from typer.models import ParameterInfo

from bayescal._core import deadline
from bayescal._core.as_json import as_json, json_text
from bayescal._core.errors import InputError, NotDrawn
from bayescal._core.progress import INTERVAL_SECONDS, print_notes, stage
from bayescal._report.whole_folder import AVERAGED, CALIBRATION, CHANNELS, MANIFEST
from bayescal._tables.mapping_file import load_mapping, save_mapping

METHODS = {"marginal": "Marginal", "least-squares": "LeastSquares", "nuts": "NUTS"}  # public names
OUTPUTS = ("out", "save_mapping")  # options that name output files
RESULT_FILES = (CALIBRATION, AVERAGED, MANIFEST, CHANNELS, "result.json")  # of a result folder
Texts = list[str] | None


def parse_values(texts: Texts, option: str) -> dict[str, list[str]]:
    """Parse repeated name=value options into the values of each name; raise InputError if one has another form."""
    values = dict[str, list[str]]()
    for text in texts or []:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{option} {text!r} is not of the form name=value")
        if value not in values.setdefault(name, []):
            values[name].append(value)
    return values


def named_values(pairs: Texts, option: str) -> dict[str, str]:
    """Parse name=value options to a dictionary; raise InputError for a name with two values."""
    values_by_name = parse_values(pairs, option)
    for name, values in values_by_name.items():
        if len(values) > 1:
            raise InputError(f"{option} says {name} twice, {' and '.join(values)}: say it once")
    return {name: value for name, (value,) in values_by_name.items()}


def named_numbers(pairs: Texts, option: str) -> dict[str, float]:
    """Parse name=number options to a dictionary; raise InputError for a value that is no finite number."""
    numbers = {}
    for name, value in named_values(pairs, option).items():
        try:
            numbers[name] = float(value)
        except ValueError:
            raise InputError(f"{option} {name}={value}: {value!r} is not a number") from None
        if not math.isfinite(numbers[name]):
            raise InputError(f"{option} {name}={value}: give a finite number")
    return numbers


def names_in(texts: str | None) -> list[str]:
    """Split names at commas."""
    return [name for part in (texts or "").split(",") if (name := part.strip())]


def optional_names(text: str | None) -> list[str] | None:
    """Split names at commas; return None for None."""
    return None if text is None else names_in(text)


def channel_names(texts: str | None) -> list[str]:
    """Split the names of --channels; [] without the option; raise InputError for fewer than two, or duplicates."""
    names = names_in(texts)
    if texts is not None and (len(names) < 2 or len(set(names)) < len(names)):
        why = f"--channels {texts!r}: give two names or more, each once, as gyro_x,gyro_y"
        raise InputError(why)
    return names


def refuse_missing(files: list[Path] | None) -> list[Path] | None:
    """Raise InputError for missing files, before the instrument loads, which takes seconds."""
    if files and not all(map(os.path.isfile, files)):
        from bayescal._tables.open_table import check_files

        check_files(files)
    return files


def refuse_unknown_method(name: str) -> str:
    if name not in METHODS:
        raise InputError(f"--method {name!r} is not one of {', '.join(METHODS)}")
    return name


def refuse_no_time(seconds: float | None) -> float | None:
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"--time-limit {seconds:g}: give a positive number of seconds")
    return seconds


@dataclass_transform(kw_only_default=True)
class Options:
    """Some options of a command: fields of a data class, whose defaults are typer's."""

    def __init_subclass__(cls) -> None:
        """Convert a command to a data class: its own options first, then those of its base classes."""
        if hasattr(cls, "answer"):
            pairs = [p for base in cls.__mro__ for p in inspect.get_annotations(base).items()]
            types = {**dict(pairs), **dict(reversed(pairs))}  # own options first, and theirs count
            for name in (n for n, kind in types.items() if kind in (bool, "bool")):
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
    """Result of a command: printed, as text or as data, and the source of the exit status."""

    shown: Any  # printed as text; plain data as JSON; None prints nothing
    data: Any = None  # printed with --json; default: `shown.data()`
    ok: bool = True  # whether the result is fit for use; if not, the exit status is 1
    why: str = ""  # the reason against its use
    doubt: str = ""  # a warning about a usable result; sets the exit status 1 too
    made: bool = True  # whether all figures were drawn; if not, the exit status is 1
    written: str = ""  # names of the written files

    def tell(self, json_: bool) -> bool:
        """Print the answer; return whether the exit status is 0: fit for use, all drawn, no warning."""
        content = self.shown
        if json_:
            data = content.data() if self.data is None and hasattr(content, "data") else self.data
            content = content if data is None else data
        if isinstance(content, dict | list):
            content = json_text(as_json(content)).rstrip("\n")
        if content is not None:
            print(content)
        if self.written and not json_:
            print(f"\nwritten: {self.written}")
        if not self.ok:
            print(f"bayescal: result not reliable: {self.why}", file=sys.stderr)
        elif self.doubt:
            print_notes([self.doubt])
        return self.ok and self.made and not self.doubt


def drawn(make: Callable[..., Any], *arguments: Any) -> bool:
    """Draw pictures or a page of a written result; return whether that succeeded, with a note on stderr if not."""
    try:
        make(*arguments)
    except NotDrawn as error:
        print_notes([str(error)])
        return False
    return True


class Command(Options):
    """A command: its docstring is its help, and `answer` runs it."""

    # An example call; the input option whose file `out` may overwrite; whether to print JSON.
    example, in_place, json_ = "", "", False

    def answer(self) -> Answer | None:
        raise NotImplementedError

    @classmethod
    def called(cls) -> str:
        """Return the command's name on the command line."""
        return cls.__name__.removesuffix("Command").lower()

    def run(self) -> int:
        """Run the command and print its answer; return the exit status."""
        limit = getattr(self, "time_limit", None)
        with stage(self.called(), INTERVAL_SECONDS), deadline.until(limit):
            answer = self.answer()
            return int(answer is not None and not answer.tell(self.json_))

    def refuse_overwriting(self) -> None:
        """Raise InputError for an output whose path is an input's."""
        options = {n: v for n, v in vars(self).items() if v and n not in (*OUTPUTS, "mapping")}
        for name in OUTPUTS:
            out = str(getattr(self, name, None) or "")
            inputs = (v for n, v in options.items() if (name, n) != ("out", self.in_place))
            existing = filter(
                os.path.isfile, (path for value in inputs for path in _files_in(value))
            )
            if os.path.isfile(out) and any(os.path.samefile(out, path) for path in existing):
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"{option} {out} is a file that is read: name another")


def _files_in(value: Any) -> Iterator[Path]:
    """Yield the files that an option value may name: a path, a result folder, gyro_x=a.nc, my.py:INSTRUMENT."""
    for item in value if isinstance(value, list) else [value]:
        names = (str(item).rpartition("=")[2], str(item).rpartition(":")[0])
        for path in (item,) if isinstance(item, Path) else (Path(name) for name in names if name):
            folder = path.parent if path.name in RESULT_FILES else path
            yield from (path, *(folder / name for name in RESULT_FILES))


class AsJson(Options):
    """Option to print an answer as JSON."""

    json_: bool = Option(False, help="Print the result as JSON on stdout.")


def opt(help: str, default: Any = None, *names: str, **how: Any) -> Any:
    """Return a typer option as the default of a field; its name is the field's, unless `names` are given."""
    return Option(default, *names, help=help, **how)


class Shared:
    """Options and arguments that many commands have, declared once."""

    calibration = Argument(help="Folder of results, or its calibration (.nc).")
    files = Argument(
        help="Readings: CSV, Parquet, NetCDF, Excel, MATLAB; logs: .ulg, .bin.",
        callback=refuse_missing,
    )
    instrument = opt("Name of an installed instrument, or my.py:INSTRUMENT.", ...)
    seed = opt("Seed of every random number.", 0, min=0)
    time_limit = opt(
        "End after this time with what there is, as Ctrl-C does at any time.",
        metavar="SECONDS",
        callback=refuse_no_time,
    )
    method = opt("marginal, least-squares or nuts.", "marginal", callback=refuse_unknown_method)
    average = opt("1s, 0.5s or 2min: fit means over this time, spikes set aside.", metavar="TIME")
    channels = opt("Outputs of a device, searched together: gyro_x,gyro_y.", metavar="NAME,NAME,…")
    max_effects = opt("Most effects that may be missing.", 5, min=1)
    covariates = opt(
        "Of the columns unknown to the instrument, those that may be causes; else all but other channels.",
        metavar="NAME,NAME,…",
    )
    effects = opt("Python file with effects or a noise law of your own.", None, "--effects")
    typed = opt(
        "An effect of your own, as a candidate: 'supply: s * (supply_voltage - 5); s = 0.1 V/V'.",
        *(None, "--effect"),
        metavar="'NAME: FORMULA; s = SIZE'",
    )
    add = opt("Effect to add to the baseline; repeat for more.")
    reference = opt("T0=0: reference temperature of the bases, °C.")
    reference_dcc = opt("thermometer.xml, or rate_input=table.xml: its calibration certificate.")
    folder = opt("Folder to write to.")
    certificate = opt(
        "TOML file of what a certificate states: device, place, operator, standards, dates."
    )
    limit = opt("Also decide whether it conforms, as `bayescal decide`; of one result.")
    local_gravity = opt("Local gravity, m/s², if it is not 9.80665.", min=1.0)


NO_OPTION: Any = None  # default of a setting that a command has no option for


class ColumnOptions(Options):
    """Options of reading the columns of files."""

    columns: Texts = opt("output=gyro_x: our column = the file's; repeat, also where files differ.")
    unit: Texts = opt("gyro_x=rad/s: unit of a column; repeat for more.")
    unwrap: Texts = opt("time=2^32us: where a counter began anew.")
    local_gravity: float | None = Shared.local_gravity
    local_field: str | None = opt("Magnetic field there, of magnetometers.", metavar="'48.2 uT'")
    missing: str | None = opt("Rows with a missing reading.", metavar="refuse|drop")
    decimal: str | None = opt("Decimal mark, where text does not show it.", metavar=".|,")
    date_order: str | None = opt("Of dates such as 05/06/2026.", metavar="mdy|dmy|ymd|hms")
    nominal_scale: str | None = opt("Raw output per unit of output.", metavar="'250 V/g'")
    nominal_zero: str | None = opt("Raw output at zero.", metavar="'1.21 V'")
    ignore: Texts = opt("Column to leave out; repeat for more.", metavar="HEADER")
    begin: Texts = opt(
        "Date of the first reading, or '9 days' on the clock.", metavar="'FILE=DATE'"
    )
    mapping: Path | None = opt("TOML file that --save-mapping wrote; options take precedence.")
    save_mapping: Path | None = opt("TOML file to keep these options in, for --mapping.")

    def for_read(self) -> dict[str, Any]:
        """Return arguments of `read`, from options before the mapping; raise InputError for one that is malformed."""
        saved = {} if self.mapping is None else load_mapping(self.mapping)
        columns = parse_values(self.columns, "--columns")
        repeated: dict[str, dict[str, Any]] = {
            "columns": {n: v[0] if len(v) == 1 else v for n, v in columns.items()},
            "units": named_values(self.unit, "--unit"),
            "unwrap": named_values(self.unwrap, "--unwrap"),
            "begin": {f: t for f, _, t in (b.rpartition("=") for b in self.begin or ())},
        }
        saved |= {name: saved.get(name, {}) | values for name, values in repeated.items()}
        single = (
            "local_gravity local_field missing decimal date_order nominal_scale nominal_zero ignore"
        )
        single_values = {n: v for n in single.split() if (v := getattr(self, n)) is not None}
        return {"missing": "refuse", "decimal": "", **saved, **single_values}

    def keep(self) -> None:
        """Save the options as a mapping file if --save-mapping is given."""
        if self.save_mapping is not None:
            save_mapping(self.save_mapping, self.for_read())


class ReadRequest(ColumnOptions):
    """Options of a fit: files, their columns, and the model."""

    files: list[Path] = Shared.files
    fix = reference = reference_dcc = add = structure = effects_file = typed = average = NO_OPTION
    keep_spikes = False  # single readings far from both neighbours are set aside
    instrument = ""


class ModelOptions(Options):
    """Options of model of an instrument: its structure, effects added, coefficients fixed, constants of the bases."""

    fix: Texts = opt("bias.temperature=0.041: hold an unknown at a value, in its unit; repeat.")
    reference: Texts = Shared.reference
    reference_dcc: Texts = Shared.reference_dcc
    add: Texts = Shared.add
    structure: str | None = opt("Structure of the instrument in place of its baseline.")
    effects_file: Path | None = Shared.effects
    typed: Texts = Shared.typed


class SearchRequest(ModelOptions, ReadRequest):
    """Options of a search."""

    instrument: str = Shared.instrument
    average: str | None = Shared.average
    holdout: list[Path] | None = opt(
        "Hold-out data, only read after the last step; repeat for more.", callback=refuse_missing
    )
    method: str = Shared.method
    max_effects: int = Shared.max_effects
    time_limit: float | None = Shared.time_limit
    keep_spikes: bool = opt("Keep single outliers, and readings of a wrong thermometer.", False)
    accept_conflict: Texts = opt(
        "bias.constant: may differ greatly from its plausible size; repeat."
    )
    seed: int = Shared.seed

    def settings(self) -> dict[str, Any]:
        """Return the settings of a search that have the same names on the command line and in a browser."""
        return {
            "max_effects": self.max_effects,
            "keep_spikes": self.keep_spikes,
            "accept_conflicts": self.accept_conflict or (),
            "seed": self.seed,
        }


class OwnParts(Options):
    """Options of a saved calibration that needs effects and an instrument of the user's own."""

    effects_file: Path | None = Shared.effects
    instrument_file: str | None = opt(
        "my.py:INSTRUMENT, if that of the calibration is not installed.",
        None,
        "--instrument",
    )


class UsedParts(OwnParts):
    """Options of a result in use, which is averaged over the probable structures, or of the best one."""

    one_structure: str = opt(
        "'average' over the probable structures, or 'best' of them.", "average", "--structure"
    )


class InUse(UsedParts):
    """Options of an instrument in use: its run, cell or device."""

    member: Texts = opt("device=A17: which device is used; repeat for more.")

    @property
    def members(self) -> dict[str, str]:
        """Return group → its member."""
        return named_values(self.member, "--member")


class DecisionRule(Options):
    """Options of the decision rule for limits."""

    rule: str = opt("guarded or simple, as agreed on beforehand.", "guarded")
    false_accept: float = opt("Largest probability of false acceptance; sets guard bands.", 0.025)

    def deciding(self) -> dict[str, Any]:
        """Return the options as keyword arguments of `decide`."""
        return {"rule": self.rule, "false_accept": self.false_accept}
