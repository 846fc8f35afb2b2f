"""Run an exported header on many inputs: what the tests of exports share."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal._core.quoting import identifier

COMPILER = shutil.which("cc")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off")

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
    assert COMPILER is not None
    header = compensator.export(folder / "calibration.h")
    name = identifier(compensator.program.about.instrument)
    fields = ["reading", *(identifier(i.name) for i in compensator.inputs)]
    fill = " ".join(f"in.{field} = (BAYESCAL_REAL)row[{k}];" for k, field in enumerate(fields))
    source, program = folder / "driver.c", folder / f"driver_{real}"
    source.write_text(DRIVER.format(header=header.name, width=len(fields), name=name, fill=fill))
    command = [COMPILER, *FLAGS, f"-DBAYESCAL_REAL={real}", str(source), "-o", str(program), "-lm"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    ran = subprocess.run(
        [str(program)], input=np.ascontiguousarray(rows).tobytes(), capture_output=True, check=True
    )
    return np.frombuffer(ran.stdout).reshape(-1, 4)
