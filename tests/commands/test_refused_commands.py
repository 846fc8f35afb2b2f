"""Commands that cannot be followed: status 2, one sentence on stderr, nothing written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import GYRO, OWN_INSTRUMENT, QUICK, TABLE, needs_installation, run
from tests.support.golden import assert_golden

pytestmark = needs_installation
FIT = "fit {table} --instrument mems_gyro --out {new}"
CALIBRATE = "calibrate {table} --instrument mems_gyro --out {new}"
COMPARE = "compare {table} --instrument mems_gyro --structure line"
CHANNELS = "calibrate {table} --instrument still_sensor --out {new} --channels"
DECIDE = "decide {saved} --out {folder}/d.json --limit"
SIMULATE = "simulate --instrument mems_gyro --out {folder}/a.csv"

REFUSED = (
    "instruments --all", "instruments everything", *("effects", "effects --instrument gyro"),
    "effects --instrument {level}:LEVEL", "effects --instrument mems_gyro --effects no.py",
    "effects --instrument mems_gyro --effects {broken}",
    "effects --instrument mems_gyro --effects {empty}", f"{SIMULATE} --effect bias.moon=1",
    f"{SIMULATE} --effect bias.drift", f"{SIMULATE} --effect bias.drift=big",
    f"{SIMULATE} --effect bias.drift=nan", f"{SIMULATE} --seed -1",
    "simulate --instrument mems_gyro", "simulate --instrument mems_gyro --out {folder}/a.txt",
    "simulate --instrument mems_gyro --out {table}/a.csv",
    "simulate --instrument {level}:INSTRUMENT --out {folder}/a.csv",
    "fit no.csv --instrument mems_gyro --out {new}",
    "fit {text} --instrument mems_gyro --out {new}",
    "fit {no_unit} --instrument mems_gyro --out {new}",
    "fit {no_unit} --instrument mems_gyro --unit temperature=furlong --out {new}",
    f"{FIT} --columns output=gyro_x", f"{FIT} --columns output", f"{FIT} --method magic",
    f"{FIT} --fix bias.constant", f"{FIT} --fix bias.moon=1", f"{FIT} --fix bias.constant=nan",
    f"{FIT} --reference U0=1", f"{FIT} --reference T0=warm", f"{FIT} --add bias.moon",
    f"{FIT} --add bias.drift", *( f"{FIT} --add bias.own --effect 'own: {formula}'"
    for formula in ("s*1/0", "s*9**9**9**9", "s*sqrt(-1)", "s*10**-320", "s*temperature/0") ),
    f"{FIT} --add bias.own --effect 'own: s * supply_voltage'", f"{FIT} --structure cube",
    f"{FIT} --local-gravity 0", f"{FIT} --average 1m --save-mapping {{folder}}/m.toml",
    "fit {overload} --instrument mems_gyro --out {new}",
    "fit {table} --instrument mems_gyro --out {saved}",
    *("check no.nc", "check {folder}", "check {table}", "check {readings}"), "discover no.nc",
    "discover {saved} --effects no.py", "discover {saved} --max-effects 0", COMPARE,
    f"{COMPARE} --structure cube", f"{COMPARE} --structure line+bias.moon",
    f"{COMPARE} --structure line+bias.drift", "predict {saved} no.csv --out {folder}/p.csv",
    "predict {saved} {no_unit} --out {folder}/p.csv",
    "predict {saved} {table} --out {folder}/p.txt", "predict {table} {saved}",
    "calibrate --instrument mems_gyro", f"{CALIBRATE} --holdout no.csv",
    f"{CALIBRATE} --holdout {{level_table}}",
    "calibrate {table} --instrument mems_gyro --out {unit}", f"{CALIBRATE} --max-effects 0",
    f"{CALIBRATE} --seed x", f"{CALIBRATE} --time-limit -3", f"{CALIBRATE} --time-limit nan",
    f"{CALIBRATE} --covariates moon", f"{CHANNELS} gyro_x", f"{CHANNELS} gyro_x,gyro_x",
    "export {saved}", *("export {saved} --format pascal", "export {saved} --out {folder}/x.txt"),
    "export {saved} --format c --out {folder}",
    *("budget {saved} --at pressure=1", "budget {saved} -k -1"),
    "compensate {saved} no.csv --out {folder}/o.csv", f"{DECIDE} 'bias ±0.5'",
    f"{DECIDE} 'beauty: ±0.5'", f"{DECIDE} 'bias: ±1 °/s' --rule lucky",
    f"{DECIDE} 'bias: ±1 °/s' --false-accept 2.5",
    f"{DECIDE} 'bias: ±1 °/s' --population no/folder",
    f"{DECIDE} 'bias: ±1 °/s' --member device=A17", "decide {saved} --out {folder}/d.json",
    "batch {table} --instrument mems_gyro --out {folder}/b.csv",
    "batch no.csv --instrument mems_gyro --out {folder}/b.parquet",
    "batch {folder} --instrument mems_gyro --out {folder}/lot.parquet",
    "pairs {table} --instrument mems_gyro", "report no.nc --out {folder}/r.html",
    "workbench {no_unit} --instrument mems_gyro --no-open --out {new}",
    "demo --instrument gyro --out {new}", "demo --instrument {level}:INSTRUMENT --out {new}",
    "demo --out {saved}", "predict {saved} {text} --out {text}",
    "predict {saved} {table} --out {saved}",
    "compensate {saved} {text} --out {text} --save-mapping {text}",
    "compensate {saved} {readings} --out {saved}", "export {folder}/table -o {saved}",
    "export --axis gyro_x={saved} -o {saved} --format px4-params",
    "decide {saved} --limit 'bias: ±1 °/s' --out {folder}/table/manifest.json",
    "fit {text} --instrument mems_gyro --save-mapping {text}",
    "workbench {text} --instrument mems_gyro --no-open --save-mapping {text}",
    f"{CALIBRATE} --accept-conflict bias.nosuch", "triad {table} --instrument mems_gyro",
    "triad {table} --poses --shortest 3", "triad {table} --shortest -1 --out {new}",
    *("imu {table} --shortest 0 --out {new}", "imu {table} --out {saved}"),
    "imu {table} --accelerometers ax,ay --out {new}", "pairs {table} --criterion best",
    "report {table} --out {folder}/r.html", "report {damaged} --out {folder}/r.html",
    "compensate {damaged} {table} --out {folder}/c.csv", "check {vacant}",
)  # fmt: skip


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
    readings = bc.read(TABLE, mems_gyro.INSTRUMENT)
    readings.to_xarray().to_netcdf(folder / "readings.nc", engine="h5netcdf")
    readings.to_pandas().to_parquet(folder / "lot.parquet")
    for name in ("unit", "vacant", "damaged"):
        (folder / name).mkdir()
    for name in ("calibration.nc", "manifest.json", "result.json"):
        (folder / "damaged" / name).write_text("{", encoding="utf-8")
    (folder / "unit" / "channels.json").write_text("{}", encoding="utf-8")
    done = run("fit", TABLE, *GYRO, *QUICK, "--out", folder / "table")
    assert done.status == 0, done.err
    files = {"level": "level.py", "level_table": "level.csv", "readings": "readings.nc"}
    files |= {n: f"{n}.py" for n in ("broken", "empty")}
    files |= {n: f"{n}.csv" for n in ("text", "no_unit", "overload")}
    files |= {n: n for n in ("new", "unit", "vacant", "damaged")}
    return {
        **{name: folder / file for name, file in files.items()},
        "folder": folder,
        "table": TABLE,
        "saved": folder / "table" / "calibration.nc",
    }


def test_a_refusal_is_one_sentence(places: dict[str, Path]) -> None:
    """Status 2, nothing printed, nothing written or overwritten; what is said stands in refused.txt."""
    folder, told = places["folder"], {}
    before = {p: p.is_file() and p.read_bytes() for p in folder.rglob("*")}
    for command in REFUSED:
        done = run(*(word.format(**places) for word in shlex.split(command)))
        assert (done.status, done.out, len(done.said)) == (2, "", 1), (command, done.err)
        said = done.said[0]
        for name in sorted(places, key=lambda n: -len(str(places[n]))):
            said = said.replace(str(places[name]), f"{{{name}}}")
        told[command] = said
    assert {p: p.is_file() and p.read_bytes() for p in folder.rglob("*")} == before
    assert_golden(Path(__file__).with_name("refused.txt"), told)


def test_a_name_that_moves_the_cursor_is_shown_as_it_is(tmp_path) -> None:
    name = "a\x1b[2J\x1b[1;31mconverged.csv"
    (tmp_path / name).write_text("nothing [furlong]\n1\n2\n")
    done = run("calibrate", tmp_path / name, *GYRO)
    assert done.status == 2
    assert "\x1b" not in done.err
