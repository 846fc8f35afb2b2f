"""The inclinometer's zero: source 4's lines come back, a projection is told from a line, aliases are named."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import inclinometer
from bayescal_models.inclinometer import model, reference_problem
from bayescal_models.inclinometer.campaign import Accelerometer, Campaign
from tests.support.inside import frame_of

INSTRUMENT = inclinometer.INSTRUMENT
LINES = {"x": (62.6211, 0.72105), "y": (96.3284, 0.06818)}  # source 4: arcsec, arcsec/deg
# True zero: S_p of 100″ and S_d as in source 4's line; noise 2″, its table's accuracy.
PROJECTED = (
    ("x", Accelerometer(constant=-40.0, pendulum=100.0, door=41.3)),
    ("y", Accelerometer(constant=190.0, pendulum=-100.0, door=3.9)),
)


@pytest.fixture(scope="module")
def lines() -> bc.Calibration:
    return bc.fit(INSTRUMENT.baseline(), inclinometer.simulate(seed=0))


def test_the_documents_lines_come_back(lines: bc.Calibration) -> None:
    for place, axis in enumerate(lines.levels["axis"]):
        for name, true, sharp in zip(
            ("zero.constant", "zero.placement"), LINES[axis], (2.0, 0.015), strict=True
        ):
            values = lines.samples(name)[:, place]
            assert values.std() < sharp
            assert abs(values.mean() - true) < 3.5 * values.std(), name


def test_a_reference_temperature_is_stated_where_something_depends_on_it(
    lines: bc.Calibration,
) -> None:
    """Lines alone hold at no temperature; a thermometer that read 40 °C too high for a while moved their T0."""
    assert lines.hold_at == {}
    warm = bc.fit(lines.model + "zero.temperature", lines.readings, bc.LeastSquares(draws=100))
    assert warm.hold_at == {"T0": warm.reference["T0"]}


def test_a_new_mounting_is_predicted_for_each_axis(lines: bc.Calibration) -> None:
    found = bc.predict(lines, inclinometer.simulate(seed=8))
    assert found.rmse < 1.5 * Campaign().noise  # the axes differ by 34″
    assert 0.85 < np.mean(np.abs(found.residual) < 2 * found.sd) <= 1.0


def test_a_projection_is_told_from_a_line_and_a_line_is_left(lines: bc.Calibration) -> None:
    models = dict(INSTRUMENT.structures)
    gains = {}
    for truth, campaign in (("line", Campaign()), ("projection", Campaign(axes=PROJECTED))):
        readings = inclinometer.simulate(seed=0, campaign=campaign)
        line = lines if truth == "line" else bc.fit(INSTRUMENT.baseline(), readings)
        other = bc.fit(models["projection"](), readings, bc.LeastSquares())
        assert line.log_evidence is not None
        assert other.log_evidence is not None
        gains[truth] = other.log_evidence[0] - line.log_evidence[0]
    assert gains["line"] < -3
    assert gains["projection"] > 20


@pytest.mark.slow
def test_what_the_zero_test_cannot_see_is_said(lines: bc.Calibration) -> None:
    found = bc.discover(lines)
    assert (found.nothing_missing or 0.0) > 0.5
    said = {c.effect: c for c in found.candidates}
    assert said["dividing.face"].kind == "not visible"
    for name in reference_problem.ON_TILT:
        assert said[name].kind == "not testable"


def _columns(name: str, readings: bc.Measurements) -> np.ndarray:
    frame = frame_of(readings)
    return np.asarray(INSTRUMENT.effect(name).evaluate(frame, {}))


def test_aliases_of_the_zero_test_are_exact() -> None:
    one = inclinometer.simulate(seed=0, campaign=Campaign(axes=PROJECTED[:1]))
    projection, wobble = _columns("zero.projection", one), _columns("dividing.wobble", one)
    np.testing.assert_array_equal(wobble[:, :2], projection)  # m = 1
    np.testing.assert_array_equal(_columns("dividing.face", one), _columns("zero.constant", one))
    # m·sin ω enters through its own slot: as a coefficient of the output it is S_d·sin ω.
    frame = frame_of(one)
    slots = {s.name: jnp.zeros(len(one)) for s in INSTRUMENT.slots}
    leaked = INSTRUMENT.response({**slots, "cross_axis": jnp.ones(len(one))}, frame)
    np.testing.assert_allclose(np.asarray(leaked), projection[:, 1], rtol=1e-12)


def test_the_spline_table_goes_through_its_knots() -> None:
    angles = np.concatenate([model.KNOTS, np.deg2rad([-60.0, 60.0, 10.0])])
    readings = bc.Measurements.from_arrays(
        INSTRUMENT, placement_angle=angles, output=np.arange(10.0)
    )
    frame = frame_of(readings)
    basis = np.asarray(model.EFFECTS["zero.table"].evaluate(frame, {}))
    np.testing.assert_allclose(basis[:7], np.eye(7), atol=1e-12)
    np.testing.assert_allclose(
        basis @ model.KNOTS, angles, atol=1e-12
    )  # lines stay lines, beyond the table too


def test_devices_and_their_mountings_are_told_apart() -> None:
    campaign = Campaign(devices=2, angles=(-45.0, 0.0, 45.0), runs=1)
    apart = inclinometer.accelerometers(inclinometer.simulate(seed=0, campaign=campaign))
    assert apart.groups("axis")[0] == ("1 x", "1 y", "2 x", "2 y")
    assert len(apart.groups("run")[0]) == 4


@pytest.mark.slow
def test_a_population_of_devices_is_learned() -> None:
    campaign = Campaign(devices=6, runs=1, angles=tuple(range(-45, 46, 15)))
    readings = inclinometer.accelerometers(inclinometer.simulate(seed=2, campaign=campaign))
    fitted = bc.fit(dict(INSTRUMENT.structures)["line, hierarchy of axes"](), readings)
    # Devices differ by 30″ and 0.3″/deg; the document's two axes by 34″ and 0.65″/deg beside that.
    spread, slope = (
        fitted.samples(f"{n}.group_sd").mean() for n in ("zero.axis", "zero.placement_axis")
    )
    assert 18 < spread < 60
    assert 0.25 < slope < 0.8
