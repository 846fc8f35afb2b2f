"""The door on the command line: all problems in one list, options that cure them, a mapping kept for the next file."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import GYRO, QUICK, needs_installation, run
from tests.support.inside import load_mapping, save_mapping
from tests.support.lab_files import RATE, TEMPERATURE, TIME, text, with_cell

pytestmark = needs_installation
NOISY = RATE + 0.01 * np.sin(7 * TIME)
UNNAMED = text(("time", "Temp (C)", "gyro z"), (TIME, TEMPERATURE, NOISY))


def test_all_problems_stand_in_one_list_and_its_options_cure_them(tmp_path: Path) -> None:
    path, out = tmp_path / "lab.csv", tmp_path / "out"
    path.write_text(with_cell(5, 1, "", UNNAMED))
    refused = run("fit", path, *GYRO, *QUICK, "--out", out, "--save-mapping", tmp_path / "lab.toml")
    assert refused.status == 2 and refused.out == ""
    assert list(tmp_path.iterdir()) == [path]
    cures = refused.said[-1].partition(": ")[2]
    cures = cures.replace("time=UNIT", "time=s").replace("z=UNIT", "z=dps")
    again = run("fit", path, *GYRO, *QUICK, *shlex.split(cures))
    assert again.status == 0, again.err


def test_mapping_is_reused_for_the_next_file(tmp_path: Path) -> None:
    path, mapping = tmp_path / "lab.csv", tmp_path / "lab.toml"
    path.write_text(UNNAMED)
    said = ("--columns", "output=gyro z", "--unit", "gyro z=dps", "--unit", "time=s")
    first = run("fit", path, *GYRO, *QUICK, *said, "--save-mapping", mapping)
    assert first.status == 0, first.err
    assert 'output = "gyro z"' in mapping.read_text().replace('"output"', "output")
    second = run("fit", path, *GYRO, *QUICK, "--mapping", mapping)
    assert second.out == first.out
    other = run("fit", path, *GYRO, *QUICK, "--mapping", mapping, "--unit", "gyro z=rad/s")
    assert other.status in (0, 1) and other.out != first.out


@given(
    st.dictionaries(st.text(min_size=1), st.text()),
    st.dictionaries(st.text(min_size=1), st.text()),
    st.floats(9.7, 9.9),
)
def test_a_mapping_is_read_as_it_was_written(tmp_path_factory, columns, units, gravity) -> None:
    path = tmp_path_factory.getbasetemp() / "lab.toml"
    made = {"columns": columns, "units": units, "local_gravity": gravity, "missing": "drop"}
    save_mapping(path, made)
    assert load_mapping(path) == {name: value for name, value in made.items() if value}


def test_files_that_call_a_column_differently_are_read_together(tmp_path: Path) -> None:
    files = [tmp_path / "ours.csv", tmp_path / "theirs.csv"]
    files[0].write_text(text(("time [s]", "Oven (C)", "gyro z (dps)"), (TIME, TEMPERATURE, NOISY)))
    others = ("t / s", "Temp / °C", "Rate / (dps)")
    files[1].write_text(text(others, (TIME, TEMPERATURE, NOISY)))
    refused = run("fit", *files, *GYRO, *QUICK)
    cures = refused.said[-1].partition(": ")[2]  # what stands there for each of them, together
    assert refused.status == 2 and cures.count("--columns output=") + cures.count("'output=") == 2
    kept = tmp_path / "lab.toml"
    again = run("fit", *files, *GYRO, *QUICK, *shlex.split(cures), "--save-mapping", kept)
    assert again.status in (0, 1), again.err
    assert run("fit", *files, *GYRO, *QUICK, "--mapping", kept).out == again.out
    columns = load_mapping(kept)["columns"]
    found = bc.read(files, mems_gyro.INSTRUMENT, columns=columns)
    assert np.allclose(found["output"][: len(TIME)], found["output"][len(TIME) :])
