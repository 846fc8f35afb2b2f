"""The command line.

Exit status: 0 done; 1 not converged, or the noise gate failed, or a picture could not be drawn (results are written all
the same); 2 bad input: one sentence on stderr, or a list of all that is wrong with the files; nothing written. Ctrl-C
ends with what there is, and the status that this has; 130 where there is nothing yet, and where it is pressed again.

Heavy modules load inside the commands, so that `bayescal --help` answers at once.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import os
import re
import signal
import sys
from typing import NoReturn

import typer

from bayescal._cli import commands as basic
from bayescal._cli import deliverables
from bayescal._core.annex import absent_annexes, offered
from bayescal._core.errors import BayescalError, NotConverged, NotDrawn
from bayescal._core.jax_setup import obey_no_folder
from bayescal._core.quoting import one_line
from bayescal._search.own_files import in_one_line, own_file_line

# New objects between two looks for unreachable ones: a look at a million takes a quarter of a second.
# Python's own 700 look thirty times while modules load.
OBJECTS = 1_000_000
INTERRUPTED = 130  # 128 + SIGINT, as shells have it
TOO_LITTLE_MEMORY = "too little memory: give fewer readings (--average), or allow more (ulimit -v)"
OUT_OF_MEMORY = re.compile("RESOURCE_EXHAUSTED|bad_alloc")  # of XLA, and of C++ beneath it


def application(asked: str | None = None) -> typer.Typer:
    """Every command; with the options of one alone, if one is asked for: those of all take as long as loading typer."""
    app = typer.Typer(
        name="bayescal",
        help="Bayesian calibration of inertial and tilt sensors: compare, see where the model fails, "
        "find the missing effect, add it, watch the error fall.",
        epilog="Start with: bayescal demo",
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    for commands in (basic.commands, deliverables.commands, *offered("commands")):
        commands.add_to(app, asked)
    return app


def main() -> NoReturn:
    """Run the command line and end the process there and then.

    Files are closed and workers gone by now. What Python and JAX would take down on their way out, a hundred programs
    and a thousand modules, is memory that goes with the process: it took 0.9 s of each command.
    """
    status = _in_child() if _is_limited() else command()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    if not (sys.getprofile() or sys.gettrace()):  # who watches has still to tell what was seen
        os._exit(status)
    sys.exit(status)


def _is_limited() -> bool:
    """Return whether the process may have only so much address space (ulimit -v)."""
    try:
        import resource
    except ImportError:  # Windows
        return False
    return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY


def _in_child() -> int:
    """Run the command in a child process: C++ aborts where an allocation fails, which only another process can say."""
    child = os.fork()
    if not child:
        os.setpgid(0, 0)  # the terminal's Ctrl-C comes once, from here
        return command()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: os.kill(child, number))
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if -ended in (signal.SIGABRT, signal.SIGBUS, signal.SIGKILL, signal.SIGSEGV):
        return _failed(TOO_LITTLE_MEMORY, 2)
    return ended if ended >= 0 else 128 - ended


def command() -> int:
    """Run the command that is asked for: its exit status. Every refusal is a sentence on stderr, never a traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where ° or µ cannot be shown, ? is
    obey_no_folder()
    gc.set_threshold(OBJECTS)
    try:
        asked = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
        status = application(asked)(standalone_mode=False, prog_name="bayescal")
        sys.stdout.flush()
        return status if isinstance(status, int) else 0
    except (NotConverged, NotDrawn) as error:
        return _failed(str(error), 1)
    except BayescalError as error:
        return _failed(str(error), 2, listed=bool(getattr(error, "problems", ())))
    except typer.Abort:
        return _failed("stopped: what was written before stays as it was", INTERRUPTED)
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno == errno.ENOMEM:
            return _failed(TOO_LITTLE_MEMORY, 2)
        where = error.filename or "standard output, or a file"
        return _failed(f"{where}: {error.strerror or error}", 2)
    except BaseException as error:
        short = isinstance(error, MemoryError)
        if not short and (at := own_file_line(error))[1]:  # a basis, say, that fails when asked
            said = f"{at[0]}, line {at[1]} failed: {in_one_line(error)}. Mend it, or leave --effects out"
            return _failed(said, 2)
        # Where a limit holds, neither a thread starts nor a library loads once it is reached.
        at_limit = type(error) in (ImportError, RuntimeError) and _is_limited()
        if short or at_limit or OUT_OF_MEMORY.search(str(error)):
            return _failed(TOO_LITTLE_MEMORY, 2)
        usage = getattr(error, "format_message", None)  # an option that the parser refused
        if usage is None:
            raise
        context = getattr(error, "ctx", None)
        path = context.command_path if context else "bayescal"
        said = (usage() or "Give a command, such as: bayescal demo").rstrip(".")
        if context and context.parent is None and (absent := absent_annexes()):
            said = f"{said}. {absent}"  # whose command it may be
        return _failed(f"{said}. See: {path} --help", 2)


def _failed(message: str, status: int, listed: bool = False) -> int:
    """The status, once the message is on stderr."""
    with contextlib.suppress(OSError):  # nowhere to say it: the status still does
        text = message if listed else " ".join(message.split())
        text = "\n".join(map(one_line, text.split("\n")))  # no name moves the cursor
        print(f"bayescal: {text}", file=sys.stderr)
    return status


if __name__ == "__main__":
    main()
