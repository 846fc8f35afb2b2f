"""Entry point of the command line.

Exit status: 0: success; 1: not converged, acceptance checks failed, or a figure could not be drawn (results are
written); 2: invalid input, with a sentence or a list of problems on stderr, and nothing written. Ctrl-C ends with the
result so far and its status; 130 if there is none yet, or if it is pressed again.

Heavy modules load inside the commands, so that `bayescal --help` is fast.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import inspect
import io
import os
import re
import sys
from typing import NoReturn

import typer

from bayescal._cli import commands
from bayescal._cli.options import Command
from bayescal._core.annex import load_entries
from bayescal._core.errors import BayescalError, NotConverged, NotDrawn
from bayescal._core.lazy_jax import ignore_local_configuration
from bayescal._core.quoting import to_printable
from bayescal._search.own_files import find_file_line, format_error

# New objects between two garbage collections; collecting a million takes a quarter of a second. With Python's default
# of 700 there are thirty collections while modules load.
GC_THRESHOLD_OBJECTS = 1_000_000
# Placeholder of an option's value in the help, by type.
METAVARS = {"Path": "FILE", "float": "NUMBER", "int": "INTEGER", "str": "TEXT", "Texts": "TEXT"}
INTERRUPT_STATUS = 130  # exit status 128 + SIGINT, by the convention of shells
OUT_OF_MEMORY = re.compile("RESOURCE_EXHAUSTED|bad_alloc|Cannot allocate memory")  # XLA, C++, C


def build_application(name: str | None = None) -> typer.Typer:
    """Build the typer application of all commands; if `name` is given, only that command has options, to save time."""
    app = typer.Typer(
        name="bayescal",
        help="Bayesian calibration of inertial and tilt sensors: fit a model, check its residuals, "
        "find missing effects, and add them.",
        epilog="Start with: bayescal demo",
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    for group in (commands.COMMANDS, *load_entries("commands")):
        for command in group:
            command_name, help_text = command.command_name(), inspect.getdoc(command)
            for parameter in inspect.signature(command).parameters.values():
                kind = re.search("Path|float|int|str|Texts", str(parameter.annotation))
                is_option = hasattr(parameter.default, "count")
                if kind and is_option and parameter.default.metavar is None:
                    parameter.default.metavar = METAVARS[kind[0]]
            target = command if name in (None, command_name) else lambda: None
            app.command(command_name, help=help_text, epilog=f"Example: {command.example}")(target)
    return app


def main() -> NoReturn:
    """Run the command line and exit without Python's clean-up.

    Files are closed and workers have ended; the clean-up of Python and JAX would take 0.9 s and only free memory.
    """
    status = run_command()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    if not (sys.getprofile() or sys.gettrace()):  # a profiler writes its result at exit
        os._exit(status)
    sys.exit(status)


def run_command() -> int:
    """Run the requested command and return its exit status; print an error as a sentence on stderr, no traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # for encodings without ° or µ
    ignore_local_configuration()
    gc.set_threshold(GC_THRESHOLD_OBJECTS)
    try:
        name = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
        outcome = build_application(name)(standalone_mode=False, prog_name="bayescal")
        if isinstance(outcome, Command):
            outcome.refuse_overwriting()
            outcome = outcome.run()
        sys.stdout.flush()
        return outcome if isinstance(outcome, int) else 0
    except (NotConverged, NotDrawn) as error:
        return _report_failure(str(error), 1)
    except BayescalError as error:
        return _report_failure(str(error), 2, is_list=bool(getattr(error, "problems", ())))
    except (typer.Abort, KeyboardInterrupt):
        return _report_failure("interrupted: files written before are unchanged", INTERRUPT_STATUS)
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except BaseException as error:
        return _report_failure(_format_user_error(error), 2)


def _format_user_error(error: BaseException) -> str:
    """Return the message for an error that the user can resolve; raise any other error again."""
    is_memory = isinstance(error, MemoryError) or OUT_OF_MEMORY.search(str(error))
    if is_memory or getattr(error, "errno", None) == errno.ENOMEM:
        return "out of memory: average the readings (--average), or provide more memory"
    if isinstance(error, OSError):
        return f"{error.filename or 'standard output, or a file'}: {error.strerror or error}"
    file, line = find_file_line(error)
    if line:  # an exception in the user's code, such as a basis
        return f"{file}, line {line} failed: {format_error(error)}. Correct it, or omit --effects"
    usage = getattr(error, "format_message", None)  # an option that the parser refused
    if usage is None:
        raise error
    context = getattr(error, "ctx", None)
    text = (usage() or "Give a command, such as: bayescal demo").replace("Value error, ", "")
    return f"{text.rstrip('.')}. See: {context.command_path if context else 'bayescal'} --help"


def _report_failure(message: str, status: int, is_list: bool = False) -> int:
    """Print a message on stderr, on one line unless it `is_list`, and return `status`."""
    with contextlib.suppress(OSError):  # stderr may be closed
        text = message if is_list else " ".join(message.split())
        text = "\n".join(map(to_printable, text.split("\n")))  # escapes control characters
        print(f"bayescal: {text}", file=sys.stderr)
    return status


if __name__ == "__main__":
    main()
