"""Whichever way a command ends, it leaves the best that it had: fitted, saved, and with every channel of a unit."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from tests.support.command_line import GYRO, TABLE, needs_installation, run

HIDDEN = "bias.thermal_lag"
NO_TIME = 1e-6  # s
QUICK = bc.LeastSquares(draws=400)


@pytest.fixture
def at_a_terminal() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt: a shell starts its background commands with it ignored, and these tests too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    return mems_gyro.simulate({HIDDEN: 0.03}, seed=1).select(np.arange(0, 330, 3))


@pytest.fixture(scope="module")
def unit() -> dict[str, bc.Measurements]:
    return {n: still_sensor.simulate(seed=i, runs=1, interval=60) for i, n in enumerate("abc")}


def calibrate(readings: bc.Measurements, **how) -> bc.SearchPath:
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, method=QUICK, **how)


def added(steps: list[dict]) -> set[str]:
    """Effects of the last step of a result.json beyond its first."""
    return {*steps[-1]["effects"]} - {*steps[0]["effects"]}


@pytest.mark.parametrize("calls", [2, 6])
@pytest.mark.usefixtures("at_a_terminal")
def test_ctrl_c_returns_the_best_structure(readings, calls, tmp_path, monkeypatch) -> None:
    # How many are weighed in a second hangs on the machine.
    monkeypatch.setattr("bayescal._search.walk.FOLLOW_SECONDS", 0.0)
    shown = []

    def follow(trail: bc.SearchPath) -> None:
        assert trail.search is not None
        shown.extend(trail.search.structures[:1] if len(trail.steps) == 1 else ())
        if len(shown) == calls - 1:
            press()

    trail = calibrate(readings, follow=follow)
    trail.save(tmp_path)
    told = json.loads((tmp_path / "result.json").read_text("utf-8"))
    best, steps = told["search"]["structures"][0], told["steps"]
    assert told["complete"] is False and told["search"]["stopped"]
    assert (tuple(best["effects"]), best["noise"]) == (shown[-1].effects, shown[-1].noise)
    assert added(steps) == {*shown[-1].effects}
    assert bc.load(tmp_path / "calibration.nc").model.names == tuple(steps[-1]["effects"])
    assert all(one["nothing_missing_probability"] is None for one in told["missing"])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("at_a_terminal")
def test_a_second_ctrl_c_ends_without_a_result(readings) -> None:
    def follow(trail: bc.SearchPath) -> None:
        if trail.search is not None and trail.search.structures:
            press()
            press()

    with pytest.raises(KeyboardInterrupt):
        calibrate(readings, follow=follow)


def test_a_time_limit_of_nothing_leaves_the_first_model_fitted(readings) -> None:
    trail = calibrate(readings, time_limit=NO_TIME)
    assert [s.title for s in trail.steps] == ["baseline"] and not trail.complete
    assert trail.search is not None and trail.search.weighed == 1
    assert trail.final.discovery is not None and trail.final.discovery.nothing_missing is None


@pytest.mark.usefixtures("at_a_terminal")
def test_every_channel_is_there_after_ctrl_c_in_the_first_one_s_search(unit) -> None:
    models = {n: still_sensor.INSTRUMENT.for_readings(r).baseline() for n, r in unit.items()}
    told: list[str] = []

    def follow(name: str, trail: bc.SearchPath) -> None:
        assert trail.search is not None
        if trail.search.structures and not told:
            press()
        told.extend([name] * bool(trail.search.structures))

    found = bc.calibrate_channels(models, unit, method=QUICK, follow=follow)
    assert [*found.search_paths] == [*unit]
    assert all(t.search is not None and t.search.stopped for t in found.search_paths.values())


@pytest.mark.parametrize("method", [bc.Marginal(), bc.NUTS()])
def test_a_fit_without_time_is_the_gaussian_about_its_mode(readings, method) -> None:
    model = mems_gyro.INSTRUMENT.baseline()
    found = bc.fit(model, readings, method, time_limit=NO_TIME, strict=False)
    exact = bc.fit(model, readings, bc.LeastSquares())
    for name in ("bias.constant", "bias.temperature"):
        middle, sd = exact.samples(name).mean(), exact.samples(name).std()
        assert found.samples(name).mean() == pytest.approx(middle, abs=0.1 * sd)
        assert found.samples(name).std() == pytest.approx(sd, rel=0.1)


def test_what_is_missing_is_not_stated_without_time(readings) -> None:
    fitted = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings, QUICK)
    found = bc.discover(fitted, time_limit=NO_TIME)
    assert found.stopped and found.nothing_missing is None and not found.findings
    assert all(c.probability is None for c in found.candidates)


def shown(structure: dict) -> str:
    """A structure of result.json as progress tells of it."""
    noise = [f"{structure['noise']} noise"] if structure["noise"] else []
    named = [*noise, *structure["effects"]]
    return "+ " + " + ".join(named) if named else "nothing to add"


BEST = re.compile(r"best so far: (.*?), rms residual")


class Ended(NamedTuple):
    """A process: its exit status, and the best that it told of last, if any."""

    status: int
    best: str


def ended(words: list[str], pressed: Callable[[float, str], bool], folder: Path) -> Ended:
    """Run a command, Ctrl-C pressed once where `pressed(s since its start, what stands on stderr)` says so."""
    begun, once, said = time.monotonic(), False, folder / "stderr.txt"
    with said.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "bayescal", *words], stdout=subprocess.DEVNULL, stderr=file
        )
    while process.poll() is None:
        if not once and pressed(time.monotonic() - begun, said.read_text("utf-8")):
            process.send_signal(signal.SIGINT)
            once = True
        time.sleep(0.02)
    told = BEST.findall(said.read_text("utf-8"))
    return Ended(process.wait(), told[-1] if told else "")


def agrees(folder: Path, best: str) -> None:
    """What was told of last as the best is what a folder holds."""
    told = json.loads((folder / "result.json").read_text("utf-8"))
    first = told["search"]["structures"][0]
    assert shown(first) == best
    if not told["complete"]:
        assert added(told["steps"]) == {*first["effects"]}
    names = bc.load(folder / "calibration.nc").model.names
    assert [*names] == told["steps"][-1]["effects"]


CALIBRATED = (
    ("mems_gyro", ("--effect", "bias.thermal_lag=0.03")),
    ("still_sensor", ()),
    ("ng_accelerometer", ()),
    ("quartz_beam_accelerometer", ()),
    ("inclinometer", ()),
    ("accelerometer_dividing_head", ()),
)


def simulated(instrument: str, hidden: tuple[str, ...], folder: Path) -> list[str]:
    """A command that calibrates a simulated test."""
    file = folder / f"{instrument}.csv"
    assert run("simulate", "--instrument", instrument, *hidden, "--out", file).status == 0
    out = str(folder / "out")
    return ["calibrate", str(file), "--instrument", instrument, "--out", out]


def left(done: Ended, out: Path) -> None:
    """A process has left the best that it told of, or nothing where Ctrl-C came before the first model."""
    if done.status in (130, -signal.SIGINT):  # the latter before Python has loaded the command
        assert not done.best and not out.exists()
        return
    assert done.status in (0, 1)
    agrees(out, done.best or "nothing to add")


MOMENTS = [(i % len(CALIBRATED), kind) for i in range(10) for kind in ("limit", "ctrl-c")]


def ended_at(moment: float, kind: str, command: list[str], folder: Path) -> Ended:
    """Run a command that ends after so many seconds: of its limit, or by Ctrl-C once it tells of a best."""
    if kind == "limit":
        return ended([*command, "--time-limit", str(moment)], lambda *_: False, folder)
    told = list[float]()

    def pressed(since: float, said: str) -> bool:
        told.extend([since] * ("best so far" in said and not told))
        return bool(told) and since > told[0] + 0.5 * moment

    return ended(command, pressed, folder)


def test_every_channel_is_there_without_time(unit, tmp_path) -> None:
    models = {n: still_sensor.INSTRUMENT.for_readings(r).baseline() for n, r in unit.items()}
    found = bc.calibrate_channels(models, unit, method=QUICK, time_limit=NO_TIME)
    assert [*found.search_paths] == [*unit]
    found.save(tmp_path)
    for told in json.loads((tmp_path / "channels.json").read_text("utf-8"))["channels"].values():
        assert told["stopped"] and (tmp_path / told["folder"] / "calibration.nc").is_file()


@needs_installation
@pytest.mark.parametrize(
    "command",
    [
        ("calibrate", TABLE, *GYRO, "--method", "least-squares"),
        ("fit", TABLE, *GYRO),
        ("compare", TABLE, *GYRO, "--structure", "line", "--structure", "cubic"),
    ],
    ids=lambda c: c[0],
)
def test_command_with_a_time_limit_of_zero_answers(command) -> None:
    done = run(*command, "--time-limit", NO_TIME, "--json")
    assert done.status in (0, 1) and done.data, done.err


@needs_installation
@pytest.mark.slow
@pytest.mark.usefixtures("at_a_terminal")
@pytest.mark.parametrize("seconds", [0.4, 0.9, 1.4, 1.9])
def test_ctrl_c_during_process_start(seconds: float, tmp_path) -> None:
    command = simulated(*CALIBRATED[0], tmp_path)
    done = ended(command, lambda since, _: since > seconds, tmp_path)
    left(done, tmp_path / "out")


@needs_installation
@pytest.mark.nightly
@pytest.mark.usefixtures("at_a_terminal")
@pytest.mark.parametrize(("number", "which", "kind"), [(i, *m) for i, m in enumerate(MOMENTS)])
def test_last_checkpoint_is_returned_at_any_interruption(number, which, kind, tmp_path) -> None:
    command = simulated(*CALIBRATED[which], tmp_path)
    moment = float(np.random.default_rng(number).uniform(2.0, 12.0))
    done = ended_at(moment, kind, command, tmp_path)
    left(done, tmp_path / "out")
