"""`--output-unit`: errors and coefficients once more in the file's own unit."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import QUICK, needs_installation, run

pytestmark = needs_installation
GAIN = 2.44  # mV/(deg/s)


def cell(text: str, row: str) -> tuple[float, str]:
    """Value and unit of a row of a table on the screen, uncertainty aside."""
    found = re.search(rf"^{re.escape(row)}\s+(\S+)(?: ± \S+)?\s+(\S+)", text, re.MULTILINE)
    assert found, text
    return float(found[1].replace("−", "-")), found[2]


@pytest.mark.usefixtures("unpainted")
def test_a_gyroscope_in_millivolts_reads_the_same_numbers_in_both_units(tmp_path: Path) -> None:
    readings = mems_gyro.simulate(seed=1, campaign=mems_gyro.Campaign(average=300, runs=2))
    raw = readings.with_column("output", readings["output"] * GAIN)
    table = replace(raw, units={**raw.units, "output": "mV"}).write(tmp_path / "raw.csv")
    asked = ("--instrument", "mems_gyro", "--nominal-scale", f"{GAIN} mV/(deg/s)", *QUICK)
    done = run("calibrate", table, *asked, "--nominal-zero", "0 mV", "--output-unit", "uV")
    assert done.status in (0, 1), done.err
    plain, own = done.out.split("COEFFICIENTS", 1)[1].split("IN µV", 1)
    for name, unit in (("bias.constant", "µV"), ("bias.temperature", "µV/°C")):
        value, kept = cell(plain, name)
        shown, found = cell(own, name)
        assert kept == unit.replace("µV", "°/s")
        assert found == unit
        assert shown == pytest.approx(
            1000 * GAIN * value, rel=0.05
        )  # both are rounded for a reader
    refused = run("calibrate", table, *asked, "--output-unit", "hPa")
    assert refused.status == 2
    page = bc.report(
        bc.fit(mems_gyro.INSTRUMENT.baseline(), readings), tmp_path / "r.html", output_unit="mdeg/s"
    )
    assert "The same in m°/s" in page.read_text("utf-8") or "mdeg/s" in page.read_text("utf-8")
