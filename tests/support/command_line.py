"""Run commands in the test's own process: what the tests of the command line share."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest
import typer

from bayescal._cli import main
from bayescal.workshop import ColumnOptions, Command
from bayescal_models import mems_gyro

TABLE = mems_gyro.TABLE
GYRO = ("--instrument", "mems_gyro")
QUICK = ("--method", "least-squares")
PRINTED_LINE = (
    *("--reference", "T0=0"),
    *("--fix", "bias.constant=19.80", "--fix", "bias.temperature=0.041"),
)

# An instrument is found by name where its package is installed, as `make test` does it.
needs_installation = pytest.mark.skipif(
    "mems_gyro" not in entry_points(group="bayescal.instruments").names,
    reason="bayescal is not installed here: pip install -e .",
)

OWN_INSTRUMENT = """
import bayescal as bc
from bayescal import effects

INSTRUMENT = bc.Instrument(
    name="level",
    title="an electronic level",
    columns=(bc.Column("temperature", "degC"), bc.Column("output", "arcsec")),
    slots=(bc.Slot("zero", "arcsec"),),
    response=lambda slots, r: slots["zero"],
    effects=(effects.constant("zero", 100.0, "arcsec", source="data sheet"),),
    candidates=(effects.linear("zero", 1.0, "arcsec/degC", source="data sheet"),),
    noise=bc.White(bc.HalfCauchy(1.0)),
)
"""


def write_bent_table(path: Path) -> Path:
    """The gyro's table with a strong quadratic term, 1e-3 °/s/°C² about 57 °C, added to it."""
    table = pd.read_csv(TABLE)
    temperature, output = table.columns
    table[output] += 1e-3 * (table[temperature] - 57.0) ** 2
    table.to_csv(path, index=False)
    return path


class Ran(NamedTuple):
    """What a command left: exit status, standard output, standard error."""

    status: int
    out: str
    err: str

    @property
    def said(self) -> list[str]:
        """Lines on standard error, without those that tell how far it is."""
        return [line for line in self.err.splitlines() if not line.endswith("…")]

    @property
    def data(self) -> Any:
        return json.loads(self.out, parse_constant=_refuse)


def _refuse(token: str) -> None:
    raise AssertionError(f"{token} is not JSON")


def run(*arguments: object) -> Ran:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["bayescal", *map(str, arguments)])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main.run_command()
    return Ran(status, out.getvalue(), err.getvalue())


def commands() -> dict[str, Any]:
    """Every command by its name, as typer has it."""
    group: Any = typer.main.get_command(main.build_application())
    return group.commands


def options_of(said: str) -> dict[str, Any]:
    """How columns are to be understood, as the command line hands it to `read`.

    Raises:
        InputError: an option is not of its form.
    """

    class Taken(ColumnOptions, Command):
        """Takes options."""

    app = typer.Typer()
    app.command()(Taken)
    return app(shlex.split(said), standalone_mode=False).read_options()
