"""What a thermometer, a clock and a supply's voltage record has a name in every instrument, and the same one."""

from __future__ import annotations

import pytest

import bayescal as bc
from bayescal_models import catalogue, mems_gyro, still_sensor
from bayescal_models.mems_gyro.simulator import simulated_columns

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
    columns = simulated_columns(hidden, seed=1)
    del columns["board_temperature"]
    for instrument in (mems_gyro.INSTRUMENT, still_sensor.INSTRUMENT):
        readings = bc.Measurements.from_arrays(instrument, units={"output": "deg/s"}, **columns)
        line = bc.fit(instrument.for_readings(readings).baseline(), readings, bc.LeastSquares())
        found = bc.discover(line)
        assert {e.name for e in found.best} == {*hidden}, instrument.name
        assert {s.effects for s in found.sets} == {(name,) for name in hidden}, instrument.name


def test_a_row_of_the_instruments_own_stands_in_the_place_of_the_catalogues() -> None:
    rows = catalogue.recorded("bias", "deg/s", size=0.6, span=25.0, pace=1.0)
    own = ("bias.drift", catalogue.drift, 0.1, "deg/s")
    table = catalogue.EffectTable.of("a test", baseline=rows[:1], candidates=(own, *rows))
    assert [e.name for e in table.candidates] == [
        "bias.drift",
        *(e.name for e in rows[1:] if e.name != "bias.drift"),
    ]
    assert table["bias.drift"].coefficients[0].size == 0.1
    hysteresis = table["bias.hysteresis"]
    assert hysteresis.coefficients[0].size == 0.15
