"""Any logged channel can be tried: read in its own unit, plausible sizes taken from the record."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from bayescal_models.mems_gyro.simulator import simulate_columns

UNITS = [
    ("m/s^2", "ug", 1e6 / 9.80665), ("mg", "ug", 1e3), ("rad/s", "deg/s", 180 / np.pi),
    ("dps", "deg/s", 1.0), ("arcsec", "rad", np.pi / 648000), ("mV", "V", 1e-3), ("kHz", "Hz", 1e3),
    ("degC", "degC", 1.0), ("1", "1", 1.0),
]  # fmt: skip


@pytest.mark.parametrize(("logged", "kept", "factor"), UNITS)
def test_a_channel_is_kept_in_the_fixed_unit_of_its_kind(logged, kept, factor) -> None:
    readings = bc.Measurements.from_arrays(
        still_sensor.INSTRUMENT,
        units={"output": logged, "output_uncertainty": logged},
        time=[0.0, 60.0, 120.0],
        temperature=[20.0, 21.0, 25.0],
        output=[1.0, 2.0, 4.0],
        output_uncertainty=0.5,
    )
    assert readings.unit("output") == readings.unit("output_uncertainty") == kept
    np.testing.assert_allclose(readings["output"], np.array([1.0, 2.0, 4.0]) * factor, rtol=1e-12)
    np.testing.assert_allclose(readings["output_uncertainty"], 0.5 * factor, rtol=1e-12)
    instrument = still_sensor.INSTRUMENT.for_readings(readings)
    assert instrument.unit == instrument.slot("bias").unit == kept
    assert instrument.effect("bias.rate").coefficients[0].unit == f"{kept}/(degC/min)"


def test_plausible_sizes_grow_with_the_record_and_say_so() -> None:
    small, large = (
        still_sensor.simulate({"bias.constant": 0.0, "bias.temperature": c}, seed=1)
        for c in (30.0, 300.0)
    )
    one, ten = (dict(still_sensor.INSTRUMENT.for_readings(r).settings) for r in (small, large))
    assert float(ten["size"]) / float(one["size"]) == pytest.approx(10, rel=0.05)
    assert one["span"] == ten["span"] == pytest.approx(38, abs=2)
    # 150 °C in 40 minutes, less what the chamber's air rounds off.
    assert one["pace"] == pytest.approx(3.7, abs=0.3)
    instrument = still_sensor.INSTRUMENT.for_readings(large)
    for effect in (*instrument.effects, *instrument.candidates):
        assert "empirical" in effect.source
    line = instrument.effect("bias.temperature").coefficients[0]
    assert 100 < line.size < 1000


def test_a_saved_calibration_keeps_the_sizes_it_was_made_with(tmp_path: Path) -> None:
    readings = still_sensor.simulate(seed=5, unit="V", runs=1, interval=60)
    own = still_sensor.instrument("V", size=500.0, constant=9e3)
    bc.fit(own.baseline(), readings, bc.LeastSquares()).save(tmp_path / "own.nc")
    loaded = bc.load(tmp_path / "own.nc")
    assert loaded.unit == "V"
    assert loaded.model.instrument.settings == own.settings
    assert loaded.model.effect("bias.constant").coefficients[0].size == 9e3


# What a thermometer, a clock and a supply's voltage record has a name in every instrument, and the same one.


SEVERAL = {"bias.hysteresis": 0.15, "bias.temperature_x_lag": 0.003, "bias.supply": 0.6}
HIDDEN = (
    pytest.param(SEVERAL, id="several"),
    *(pytest.param({n: s}, id=n, marks=pytest.mark.slow) for n, s in SEVERAL.items()),
    pytest.param(
        {"bias.supply": 0.6, "bias.temperature_x_supply": 0.06}, id="supply", marks=pytest.mark.slow
    ),
)


@pytest.mark.parametrize("hidden", HIDDEN)
def test_a_file_is_the_same_whatever_instrument_reads_it(hidden: dict[str, float]) -> None:
    """A gyroscope's campaign read as that of a gyroscope, and as that of any sensor at rest."""
    columns = simulate_columns(hidden, seed=1)
    del columns["board_temperature"]
    for instrument in (mems_gyro.INSTRUMENT, still_sensor.INSTRUMENT):
        readings = bc.Measurements.from_arrays(instrument, units={"output": "deg/s"}, **columns)
        line = bc.fit(instrument.for_readings(readings).baseline(), readings, bc.LeastSquares())
        found = bc.discover(line)
        assert {e.family_name for e in found.best} == {*hidden}, instrument.name
        assert {s.effects for s in found.findings} == {(name,) for name in hidden}, instrument.name
