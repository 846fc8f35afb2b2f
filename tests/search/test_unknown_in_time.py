"""A jump and a cycle in time, of no known cause, are told from wandering noise, measured, drafted and saved."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._discovery import calibrate
from bayescal._discovery.calibrate import _other_path
from bayescal._discovery.candidate import Candidate
from bayescal._discovery.draft_effect import shape_of, template
from bayescal._discovery.refit import nearly
from bayescal._model.unknown_effect import free_curve
from bayescal_models import mems_gyro

INSTRUMENT = mems_gyro.INSTRUMENT
METHOD = bc.LeastSquares(draws=200)
PLACE, HEIGHT = 0.53, 0.2  # of the record, within the second run; °/s, four times the noise
CYCLES, WAVE = 6.3, 0.06  # in the record; °/s


def part_of_the_record(readings: bc.Measurements) -> np.ndarray:
    time = readings["time"]
    return (time - time.min()) / np.ptp(time)


def changed(seed: int, contribution) -> bc.Measurements:
    readings = mems_gyro.simulate({}, seed=seed)
    at = part_of_the_record(readings)
    return readings.with_column("output", readings["output"] + contribution(at))


def drafted(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


@pytest.fixture(scope="module")
def jumped() -> bc.Trail:
    readings = changed(41, lambda at: np.where(at > PLACE, HEIGHT, 0.0))
    return bc.calibrate(INSTRUMENT.baseline(), readings, method=METHOD)


@pytest.fixture(scope="module")
def cycled() -> bc.Trail:
    readings = changed(42, lambda at: WAVE * np.sin(2 * np.pi * CYCLES * at + 0.4))
    return bc.calibrate(INSTRUMENT.baseline(), readings, method=METHOD)


def test_a_jump_is_found_where_it_is_and_as_high_as_it_is(jumped: bc.Trail) -> None:
    final = jumped.final.calibration
    assert [s.added for s in jumped.steps] == [None, "unknown(time, jump)"]
    assert final.model.noise.law == "white"
    at = part_of_the_record(final.readings)
    beside = np.sort(at[np.argsort(np.abs(at - PLACE))[:2]])  # no reading tells more than these
    place = float(final.samples("unknown(time, jump).place").mean())
    assert beside[0] - 0.01 < place < beside[1] + 0.01
    height = final.samples("unknown(time, jump)[1]") * final.samples(
        "unknown(time, jump).amplitude"
    )
    assert abs(height.mean() - HEIGHT) < 4 * height.std()
    assert jumped.final.rmse == pytest.approx(0.05, rel=0.1)


def test_a_cycle_is_found_with_its_period_and_amplitude(cycled: bc.Trail) -> None:
    final = cycled.final.calibration
    assert [s.added for s in cycled.steps] == [None, "unknown(time, cycle)"]
    assert final.model.noise.law == "white"
    cycles = float(final.samples("unknown(time, cycle).cycles").mean())
    assert cycles == pytest.approx(CYCLES, abs=0.05)
    parts = [final.samples(f"unknown(time, cycle)[{i}]") for i in (1, 2)]
    wave = np.hypot(*parts) * final.samples("unknown(time, cycle).amplitude")
    assert wave.mean() == pytest.approx(WAVE, rel=0.2)


def test_their_shapes_are_drafted_as_what_they_are(jumped: bc.Trail, cycled: bc.Trail) -> None:
    jump = template(jumped.final.calibration, "unknown(time, jump)")
    assert drafted(r"a jump at (\S+) of the range", jump) == pytest.approx(PLACE, abs=0.02)
    assert "jnp.where(x >" in jump
    wave = template(cycled.final.calibration, "unknown(time, cycle)")
    period = drafted(r"a sine of period (\S+) of the range", wave)
    assert period == pytest.approx(1 / CYCLES, rel=0.05)
    assert shape_of(cycled.final.calibration, "unknown(time, cycle)").covariate == "time"
    for text in (jump, wave):
        compile(text, "draft", "exec")


def test_a_calibration_with_one_is_saved_and_loaded(jumped: bc.Trail, tmp_path) -> None:
    final = jumped.final.calibration
    final.save(tmp_path / "c.nc")
    again = bc.load(tmp_path / "c.nc")
    assert again.model.names == final.model.names
    fresh = mems_gyro.simulate({}, seed=43)
    np.testing.assert_allclose(bc.predict(again, fresh).mean, bc.predict(final, fresh).mean)


def candidate(effect: str) -> Candidate:
    return Candidate(effect, prior=0.1)


@pytest.mark.parametrize(
    ("law", "curve", "first"),
    [
        (300.0, 500.0, True),  # half of the log evidence
        (959.0, 2417.0, True),  # less, but 0.967 of the variance where the curve takes 1.000
        (240.0, 2417.0, False),  # 0.57 of it
        (-1e300, 2417.0, False),  # no mode was found
    ],
)
def test_a_law_comes_before_a_free_curve_if_it_explains_most_of_it(law, curve, first) -> None:
    verified = {"unknown(temperature)": curve, "bias.temperature_quadratic": law}
    found = nearly(verified, [candidate(n) for n in verified], "unknown(temperature)", 563)
    assert found == (("bias.temperature_quadratic",) if first else ())


def test_only_smooth_functions_are_free_curves() -> None:
    assert free_curve("unknown(time)")
    assert free_curve("unknown(temperature rate)")
    assert not free_curve("unknown(time, jump)")
    assert not free_curve("unknown(time, cycle)")
    assert not free_curve("bias.drift")


@pytest.mark.parametrize(
    ("newest", "gain", "kept"),
    [
        ("unknown(time)", 2.9, True),
        ("unknown(time)", 3.1, False),
        ("unknown(time, jump)", 0.1, False),
        ("bias.warm_up", 0.1, False),
    ],
)
def test_a_law_gives_way_to_a_free_curve_only_at_odds_of_twenty(
    newest, gain, kept, monkeypatch
) -> None:
    start = INSTRUMENT.baseline()
    monkeypatch.setattr(
        calibrate,
        "laplace_evidence",
        lambda model, _: 0.0 if "bias.drift" in model.names else gain,
    )
    loop = calibrate._Loop(
        mems_gyro.simulate({}, seed=1),
        effects=(),
        method=None,
        max_effects=5,
        seed=0,
        reference=None,
        start=frozenset(start.names),
    )
    steps: list[Any] = [SimpleNamespace(calibration=None)]
    model, dropped = loop._look_back(start + "bias.drift" + newest, steps, newest)
    assert ("bias.drift" in model.names) == kept
    assert dropped == (() if kept else ("bias.drift",))


def test_forms_need_enough_readings_and_their_names_bear_any_space() -> None:
    effect = INSTRUMENT.unknown("time,jump")
    assert effect.name == "unknown(time, jump)"
    readings = mems_gyro.simulate({}, seed=1)
    assert effect.untestable is not None
    assert effect.untestable(readings) is None
    assert effect.untestable(readings.select(np.arange(29))) == (
        "needs 30 different times; there are 29"
    )


@pytest.mark.slow
def test_a_fast_wave_is_found_and_measured_by_the_default_method() -> None:
    readings = changed(44, lambda at: WAVE * np.sin(2 * np.pi * 13.2 * at))
    trail = bc.calibrate(INSTRUMENT.baseline(), readings)
    assert trail.final.calibration.verdict.ok
    draws = trail.final.calibration.samples("unknown(time, cycle).cycles")
    assert abs(draws.mean() - 13.2) < max(4 * draws.std(), 0.02)
    assert 0 < draws.std() < 0.1


@pytest.mark.slow
def test_a_jump_is_measured_by_the_default_method() -> None:
    readings = changed(45, lambda at: np.where(at > PLACE, HEIGHT, 0.0))
    sampled = bc.fit(INSTRUMENT.baseline() + "unknown(time, jump)", readings)
    assert sampled.verdict.ok
    height = sampled.samples("unknown(time, jump)[1]") * sampled.samples(
        "unknown(time, jump).amplitude"
    )
    assert abs(height.mean() - HEIGHT) < 4 * height.std()
    assert 0 < sampled.samples("unknown(time, jump).place").std() < 0.02


def steps(law: str, *added: str) -> list:
    model = SimpleNamespace(noise=SimpleNamespace(law=law))
    first = SimpleNamespace(added=None, calibration=SimpleNamespace(model=model))
    return [first, *(SimpleNamespace(added=a, calibration=first.calibration) for a in added)]


def test_an_end_is_named_if_it_differs_and_is_within_odds_of_twenty() -> None:
    white, wandering = steps("white", "unknown(time)"), steps("ornstein_uhlenbeck")
    near = _other_path(white, "ornstein_uhlenbeck", wandering, -2.0)
    assert near is not None
    assert (near.noise, near.added, near.log_bayes_factor) == ("ornstein_uhlenbeck", (), -2.0)
    assert "wandering noise with nothing added" in str(near)
    assert _other_path(white, "ornstein_uhlenbeck", wandering, -3.1) is None
    assert _other_path(white, "white", steps("white", "unknown(time)"), -0.5) is None
    other = _other_path(wandering, "white", white, -1.0)
    assert other is not None
    assert "white noise with unknown(time) added" in str(other)
