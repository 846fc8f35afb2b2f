"""Whichever way a command ends, it leaves the best that it had: fitted, saved, and with every channel of a unit."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor

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
    made = mems_gyro.simulate({HIDDEN: 0.03}, seed=1)
    return made.select(np.arange(0, len(made), 3))


@pytest.fixture(scope="module")
def unit() -> dict[str, bc.Measurements]:
    made = {n: still_sensor.simulate(seed=i, runs=1, interval=60) for i, n in enumerate("abc")}
    return made


def calibrate(readings: bc.Measurements, **how) -> bc.SearchPath:
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, method=QUICK, **how)


def added(steps: list[dict]) -> set[str]:
    """Effects of the last step of a result.json beyond its first."""
    return {*steps[-1]["effects"]} - {*steps[0]["effects"]}


@pytest.mark.parametrize("calls", [2, 3])
@pytest.mark.usefixtures("at_a_terminal")
def test_ctrl_c_returns_the_best_structure_evaluated(readings, calls, tmp_path) -> None:
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
    assert [*found.trails] == [*unit]
    assert all(t.search is not None and t.search.stopped for t in found.trails.values())


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
    assert found.stopped and found.nothing_missing is None and not found.sets
    assert all(c.probability is None for c in found.candidates)


def test_devices_of_a_batch_that_are_not_reached_say_so() -> None:
    devices = {f"D{i}": mems_gyro.simulate(seed=i) for i in range(3)}
    model = mems_gyro.INSTRUMENT.baseline()
    found = bc.fit_batch(model, devices, chunk=1, time_limit=NO_TIME)
    assert found.ok.tolist() == [True, False, False] and all(found.reasons[1:])


# Real processes ------------------------------------------------------------------------------------------------------


def shown(structure: dict) -> str:
    """A structure of result.json as progress tells of it."""
    noise = [f"{structure['noise']} noise"] if structure["noise"] else []
    named = [*noise, *structure["effects"]]
    return "+ " + " + ".join(named) if named else "nothing to add"
