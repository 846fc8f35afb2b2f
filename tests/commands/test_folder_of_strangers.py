"""What stands in the current folder is data: no command runs a module of it, or obeys a library's settings there."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pandas as pd
import pytest

from bayescal_models import accelerometer_triad, differential_pair, gyro_triad
from tests.commands.test_command_answers import COMMANDS
from tests.support.command_line import TABLE, needs_installation
from tests.support.folder_of_strangers import SETTINGS, ran, strangers_folder
from tests.support.made_up.gyro_lot import table

pytestmark = needs_installation
SCRIPT = Path(sys.executable).with_name("bayescal")
LIMIT = "bias: ±500 °/s"
# By command: what is given to it. {data} holds readings, {result} a calibration, {out} is new.
GIVEN = {
    "instruments": "",
    "effects": "--instrument mems_gyro",
    "simulate": "--instrument mems_gyro --out {out}/sim.csv",
    "pairs": "{data}/pairs.csv",
    "demo": "--out {out}/demo",
    "calibrate": "{data}/table.csv --instrument mems_gyro --method least-squares --out {out}/loop",
    "workbench": "{data}/table.csv --instrument mems_gyro --out {out}/bench --no-open",
    "fit": "{data}/table.csv --instrument mems_gyro --out {out}/fit",
    "check": "{result}",
    "discover": "{result}",
    "compare": "{data}/table.csv --instrument mems_gyro",
    "predict": "{result} {data}/table.csv --out {out}/predicted.csv",
    "noise": "{data}/still.csv --columns output=gyro_x --unit gyro_x=deg/s --out {out}/noise",
    "triad": "{data}/triad.csv --poses --baseline --out {out}/triad",
    "imu": "{data}/unit.csv --baseline --out {out}/unit",
    "compensate": "{result} {data}/table.csv --out {out}/done.csv",
    "export": "{result} --format c --out {out}/gyro.h",
    "budget": "{result}",
    "decide": "{result} --limit|" + LIMIT,
    "validate": "--standard|JCGM 106|--out {out}/validation.pdf",
    "report": "{result} --out {out}/report.html",
    "batch": "{data}/lot.csv --instrument mems_gyro --workers 2 --out {out}/lot.parquet",
}


def words(command: str, **places: Path) -> list[str]:
    parts = GIVEN[command].format(**places).split("|")  # between bars: one word, spaces and all
    return [word for i, part in enumerate(parts) for word in ([part] if i % 2 else part.split())]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    shutil.copy(TABLE, folder / "table.csv")
    table(count=3).to_csv(folder / "lot.csv", index=False)
    batch = differential_pair.simulate(seed=5, campaign=differential_pair.Campaign(samples=20))
    batch.write(folder / "pairs.csv")
    accelerometer_triad.simulate(seed=4).write(folder / "triad.csv")
    log = gyro_triad.simulate_log(seed=1, campaign=gyro_triad.MovesByHand(poses=14))
    units = {"time": "s", "gyro": "deg/s", "accel": "g", "mag": "uT"}
    named = {f"{n} [{units[n.partition('_')[0]]}]": values for n, values in log.items()}
    pd.DataFrame(named).to_csv(folder / "unit.csv", index=False)
    still = {"time [s]": log["time"][:400], "gyro_x": log["gyro_x"][:400]}
    pd.DataFrame(still).to_csv(folder / "still.csv", index=False)
    return folder


def ready(told: str) -> None:
    """Wait until the workbench's own page stands at the address that it told."""
    url = re.search(r"http://\S+", told)
    assert url is not None
    for _ in range(3000):
        with contextlib.suppress(OSError), urllib.request.urlopen(url[0], timeout=30) as answer:
            if b"bokeh" in answer.read():
                return
        time.sleep(0.1)
    raise AssertionError("the workbench did not come up")


def at(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command as a user gives it in a folder."""
    command = (
        [str(SCRIPT), *arguments]
        if SCRIPT.exists()
        else [sys.executable, "-P", "-m", "bayescal", *arguments]
    )
    done = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={k: v for k, v in os.environ.items() if k not in ("MPLBACKEND", "PYTHONPATH")},
    )  # fmt: skip
    try:
        if arguments[0] == "workbench":
            assert done.stdout is not None
            told = ""
            while "Ctrl-C" not in told:
                told += done.stdout.readline()
            ready(told)
            done.send_signal(signal.SIGINT)
        out, err = done.communicate(timeout=300)
    finally:
        done.kill()
    return subprocess.CompletedProcess(command, done.returncode, out, err)


def unharmed(done: subprocess.CompletedProcess[str], folder: Path) -> None:
    assert ran(folder) == "", "modules of the current folder were run"
    assert done.returncode in (0, 1), done.stderr[-2000:]
    assert "Traceback" not in done.stderr, done.stderr[-2000:]
    assert not any(name in done.stderr for name in SETTINGS), done.stderr[-2000:]


def test_every_command_is_tested_here() -> None:
    assert sorted(GIVEN) == sorted(COMMANDS)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_runs_or_obeys_the_current_folder(
    command: str, data: Path, saved: Path, tmp_path: Path
) -> None:
    folder = strangers_folder(tmp_path)
    (tmp_path / "out").mkdir()
    done = at(folder, command, *words(command, data=data, result=saved, out=tmp_path / "out"))
    unharmed(done, folder)
