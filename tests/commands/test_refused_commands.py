"""Commands that cannot be followed: status 2, one sentence on stderr, nothing written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import GYRO, OWN_INSTRUMENT, QUICK, TABLE, needs_installation, run

pytestmark = needs_installation
FIT = "fit {table} --instrument mems_gyro --out {new}"
CALIBRATE = "calibrate {table} --instrument mems_gyro --out {new}"
COMPARE = "compare {table} --instrument mems_gyro --structure line"
CHANNELS = "calibrate {table} --instrument still_sensor --out {new} --channels"
DECIDE = "decide {saved} --out {folder}/d.json --limit"
SIMULATE = "simulate --instrument mems_gyro --out {folder}/a.csv"

REFUSED = (
    ("instruments --all", "No such option: --all"),
    ("instruments everything", "no instrument is called 'everything'; installed:"),
    ("effects", "Missing option '--instrument'"),
    ("effects --instrument gyro", "no instrument is called 'gyro'; installed:"),
    ("effects --instrument {level}:LEVEL", "defines no instrument called 'LEVEL'"),
    ("effects --instrument mems_gyro --effects no.py", "there is no file no.py"),
    ("effects --instrument mems_gyro --effects {broken}", "could not be run: ZeroDivisionError"),
    ("effects --instrument mems_gyro --effects {empty}", "defines no effect"),
    (f"{SIMULATE} --effect bias.moon=1", "no effect 'bias.moon' can be hidden"),
    (f"{SIMULATE} --effect bias.drift", "--effect 'bias.drift' is not of the form name=value"),
    (f"{SIMULATE} --effect bias.drift=big", "'big' is not a number"),
    (f"{SIMULATE} --effect bias.drift=nan", "give a finite number"),
    (f"{SIMULATE} --noise-law pink", "known are white, student_t, ornstein_uhlenbeck"),
    (f"{SIMULATE} --seed -1", "'--seed'"),
    ("simulate --instrument mems_gyro", "Missing option '--out'"),
    ("simulate --instrument mems_gyro --out {folder}/a.txt", "choose .csv, .parquet, .nc"),
    ("simulate --instrument mems_gyro --out {table}/a.csv", "cannot be written"),
    ("simulate --instrument {level}:INSTRUMENT --out {folder}/a.csv", "has no simulator"),
    ("fit no.csv --instrument mems_gyro --out {new}", "'no.csv' cannot be read"),
    ("fit {text} --instrument mems_gyro --out {new}", "'hot'"),
    ("fit {no_unit} --instrument mems_gyro --out {new}", "unit"),
    ("fit {no_unit} --instrument mems_gyro --unit temperature=furlong --out {new}", "furlong"),
    (f"{FIT} --columns output=gyro_x", "gyro_x"),
    (f"{FIT} --columns output", "--columns 'output' is not of the form name=value"),
    (f"{FIT} --method magic", "--method 'magic' is not one of marginal, least-squares, nuts"),
    (f"{FIT} --fix bias.constant", "--fix 'bias.constant' is not of the form name=value"),
    (f"{FIT} --fix bias.moon=1", "bias.moon"),
    (f"{FIT} --fix bias.constant=nan", "give a finite number"),
    (f"{FIT} --reference U0=1", "no constant 'U0'; they have: T0"),
    (f"{FIT} --reference T0=warm", "'warm' is not a number"),
    (f"{FIT} --add bias.moon", "bias.moon"),
    (f"{FIT} --add bias.drift", "needs the column 'time'"),
    *(
        (f"{FIT} --add bias.own --effect 'own: {formula}'", "ffect")
        for formula in ("s*1/0", "s*9**9**9**9", "s*sqrt(-1)", "s*10**-320", "s*temperature/0")
    ),
    (f"{FIT} --add bias.own --effect 'own: s * supply_voltage'", "'supply_voltage'"),
    (f"{FIT} --structure cube", "has no structure 'cube'"),
    (f"{FIT} --local-gravity 0", "'--local-gravity'"),
    (f"{FIT} --average 1m", "'1m' is no time to average over: write a positive number with a"),
    ("fit {overload} --instrument mems_gyro --out {new}", "code for an overload"),
    ("fit {table} --instrument mems_gyro --out {saved}", "cannot write to the folder"),
    ("check no.nc", "There is no file no.nc"),
    ("check {folder}", "is a folder: give the calibration in it, "),
    ("check {table}", "Expected a saved calibration"),
    ("check {readings}", "readings.nc has no checksum at its end"),
    ("discover no.nc", "There is no file no.nc"),
    ("discover {saved} --effects no.py", "there is no file no.py"),
    ("discover {saved} --max-effects 0", "'--max-effects'"),
    (COMPARE, "two structures or more"),
    (f"{COMPARE} --structure cube", "has no structure 'cube'"),
    (f"{COMPARE} --structure line+bias.moon", "bias.moon"),
    (f"{COMPARE} --structure line+bias.drift", "needs the column 'time'"),
    ("predict {saved} no.csv --out {folder}/p.csv", "'no.csv' cannot be read"),
    ("predict {saved} {no_unit} --out {folder}/p.csv", "unit"),
    ("predict {saved} {table} --out {folder}/p.txt", "'.txt'"),
    ("predict {table} {saved}", "Expected a saved calibration"),
    ("calibrate --instrument mems_gyro", "Missing argument"),
    (f"{CALIBRATE} --holdout no.csv", "'no.csv' cannot be read"),
    (f"{CALIBRATE} --holdout {{level_table}}", "level.csv"),
    ("calibrate {table} --instrument mems_gyro --out {unit}", "holds the channels of a unit"),
    (f"{CALIBRATE} --max-effects 0", "'--max-effects'"),
    (f"{CALIBRATE} --seed x", "'--seed'"),
    (f"{CALIBRATE} --time-limit -3", "--time-limit"),
    (f"{CALIBRATE} --time-limit nan", "--time-limit"),
    (f"{CALIBRATE} --covariates moon", "no column 'moon'"),
    (f"{CHANNELS} gyro_x", "two names or more"),
    (f"{CHANNELS} gyro_x,gyro_x", "each once"),
    ("export {saved}", "say which format"),
    ("export {saved} --format pascal", "is not one of json, c, python"),
    ("export {saved} --out {folder}/x.txt", "a correction is written as .json, .h, .py"),
    ("budget {saved} --at pressure=1", "'pressure' plays no part"),
    ("budget {saved} -k -1", "a coverage factor is a positive number"),
    ("compensate {saved} no.csv --out {folder}/o.csv", "cannot be read: No such file"),
    (f"{DECIDE} 'bias ±0.5'", "names no quantity"),
    (f"{DECIDE} 'beauty: ±0.5'", "nothing is called 'beauty'"),
    (f"{DECIDE} 'bias: ±1 °/s' --rule lucky", "rule 'lucky' is none"),
    (f"{DECIDE} 'bias: ±1 °/s' --false-accept 2.5", "above 0 and below 0.5"),
    (f"{DECIDE} 'bias: ±1 °/s' --population no/folder", 'write "sd 0.2 °/s"'),
    (f"{DECIDE} 'bias: ±1 °/s' --member device=A17", "was not in the calibration"),
    ("decide {saved} --out {folder}/d.json", "--limit"),
    ("batch {table} --instrument mems_gyro --out {folder}/b.csv", "a batch is saved as Parquet"),
    ("batch no.csv --instrument mems_gyro --out {folder}/b.parquet", "'no.csv' cannot be read"),
    ("pairs {table} --instrument mems_gyro", "does not choose its devices in pairs"),
    ("report no.nc --out {folder}/r.html", "There is no file no.nc"),
    ("workbench {no_unit} --instrument mems_gyro --no-open --out {new}", "unit"),
    ("demo --instrument gyro --out {new}", "no instrument is called 'gyro'"),
    ("demo --instrument {level}:INSTRUMENT --out {new}", "has no demonstration"),
    ("demo --out {saved}", "cannot write to the folder"),
)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files that commands are pointed at, and `new`, a folder that is not there."""
    folder = tmp_path_factory.mktemp("refused")
    texts = {
        "level.py": OWN_INSTRUMENT,
        "broken.py": "1/0\n",
        "empty.py": "answer = 42\n",
        "text.csv": "temperature [degC],output [deg/s]\n20,1\n21,hot\n",
        "overload.csv": "temperature [degC],output [deg/s]\n20,1\n21,9.9E37\n22,2\n",
        "no_unit.csv": "temperature,output [deg/s]\n20,1\n21,2\n",
        "level.csv": "temperature [degC],output [arcsec]\n20,1\n21,2\n22,3\n23,5\n24,5\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    bc.read(TABLE, mems_gyro.INSTRUMENT).write(folder / "readings.nc")
    (folder / "unit").mkdir()
    (folder / "unit" / "channels.json").write_text("{}", encoding="utf-8")
    done = run("fit", TABLE, *GYRO, *QUICK, "--out", folder / "table")
    assert done.status == 0, done.err
    return {
        "folder": folder,
        "new": folder / "new",
        "table": TABLE,
        "level": folder / "level.py",
        "level_table": folder / "level.csv",
        "broken": folder / "broken.py",
        "empty": folder / "empty.py",
        "text": folder / "text.csv",
        "no_unit": folder / "no_unit.csv",
        "overload": folder / "overload.csv",
        "readings": folder / "readings.nc",
        "unit": folder / "unit",
        "saved": folder / "table" / "calibration.nc",
    }


@pytest.mark.parametrize(("command", "words"), REFUSED, ids=[c for c, _ in REFUSED])
def test_a_refusal_is_one_sentence(command: str, words: str, places: dict[str, Path]) -> None:
    before = sorted(places["folder"].rglob("*"))
    done = run(*(word.format(**places) for word in shlex.split(command)))
    assert done.status == 2
    assert done.out == ""
    assert len(done.said) == 1, done.err
    assert done.said[0].startswith("bayescal: ")
    assert sorted(places["folder"].rglob("*")) == before


def test_a_log_without_the_sensors_of_a_unit_is_asked_for_them(tmp_path: Path) -> None:
    done = run("imu", TABLE, "--out", tmp_path / "unit")
    " ".join(done.err.split())
    assert (done.status, done.out) == (2, "")


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    out = tmp_path / "full"
    (out / "calibration.nc").mkdir(parents=True)  # in the way
    done = run("fit", TABLE, *GYRO, *QUICK, "--out", out)
    assert done.status == 2
    assert "Traceback" not in done.err


def test_a_name_that_moves_the_cursor_is_shown_as_it_is(tmp_path) -> None:
    name = "a\x1b[2J\x1b[1;31mconverged.csv"
    (tmp_path / name).write_text("nothing [furlong]\n1\n2\n")
    done = run("calibrate", tmp_path / name, *GYRO)
    assert done.status == 2
