"""Run what was exported, in C and in Python: what the tests of exports share."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import inclinometer
from tests.support.inside import to_identifier
from tests.support.references import shared

COMPILER = shutil.which("cc")
FLAGS = (
    "-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O2",
    "-ffp-contract=off",
)  # fmt: skip

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler called cc")

DRIVER = """
#include "{header}"
#include <stdio.h>
int main(void)
{{
    double row[{width}];
    while (fread(row, sizeof(double), {width}, stdin) == {width}) {{
        {name}_input in;
        {name}_result out;
        double found[4];
        {fill}
        out = {name}_compensate(&in);
        found[0] = out.value;
        found[1] = out.uncertainty;
        found[2] = out.uncertainty_reading;
        found[3] = (double)out.outside;
        fwrite(found, sizeof(double), 4, stdout);
    }}
    return 0;
}}
"""


@shared
def tilted() -> tuple[bc.Compensator, bc.Measurements]:
    """Of an axis of an inclinometer that reads arcsec and is turned back into rad, by the whole geometry."""
    campaign = replace(inclinometer.VERIFICATION, grid=(-40.0, -20.0, 0.0, 20.0, 40.0), exact=True)
    readings = inclinometer.simulate(seed=0, campaign=campaign)
    model = dict(inclinometer.INSTRUMENT.structures)["projection, exact geometry"]()
    fit = bc.fit(model, readings, bc.LeastSquares(draws=400))
    return bc.compensator(fit, members={"axis": "x"}), readings


def random_rows(compensator: bc.Compensator, count: int) -> np.ndarray:
    """Random readings, and inputs all over their calibrated ranges, (count, 1 + inputs)."""
    assert compensator.calibration is not None
    random = np.random.default_rng(7)
    largest = float(np.abs(compensator.calibration.readings["output"]).max())
    columns = [random.uniform(-largest, largest, count)]
    columns += [random.uniform(i.low, i.high, count) for i in compensator.inputs]
    return np.column_stack(columns)


def inputs_of(compensator: bc.Compensator, rows: np.ndarray) -> dict[str, Any]:
    """The inputs of such rows by their names."""
    return {i.name: rows[:, 1 + k] for k, i in enumerate(compensator.inputs)}


def run_c(source: str, rows: np.ndarray, folder: Path, real: str = "double") -> np.ndarray:
    """Compile a program beside the headers that it includes, warnings being errors, and feed it numbers.

    Args:
        source: of the program, C99; it reads doubles from standard input and writes doubles.
        rows: what it reads.
        folder: of the headers; to work in.
        real: precision of the header, "double" or "float".

    Returns:
        What it wrote, one after the other, (n,).
    """
    assert COMPILER is not None
    file, program = folder / "driver.c", folder / f"driver_{real}"
    file.write_text(source, "utf-8")
    command = [COMPILER, *FLAGS, f"-DBAYESCAL_REAL={real}", str(file), "-o", str(program), "-lm"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    given = np.ascontiguousarray(rows, dtype=float).tobytes()
    ran = subprocess.run([str(program)], input=given, capture_output=True, check=True)
    return np.frombuffer(ran.stdout)


def run_header(
    compensator: bc.Compensator, rows: np.ndarray, folder: Path, real: str = "double"
) -> np.ndarray:
    """Compile the header and run it.

    Args:
        compensator: whose header it is.
        rows: the reading and then every input, (n, 1 + inputs).
        folder: to work in.
        real: precision, "double" or "float".

    Returns:
        Value, uncertainty, uncertainty with noise, flags, (n, 4).
    """
    header = compensator.export(folder / "calibration.h")
    name = to_identifier(compensator.program.about.instrument)
    fields = ["reading", *(to_identifier(i.name) for i in compensator.inputs)]
    fill = " ".join(f"in.{field} = (BAYESCAL_REAL)row[{k}];" for k, field in enumerate(fields))
    source = DRIVER.format(header=header.name, width=len(fields), name=name, fill=fill)
    return run_c(source, rows, folder, real).reshape(-1, 4)
