"""Groups that an instrument declares, such as stations: one deviation for each member; others are refused in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro

STATION = effects.deviation("bias", "station", 0.2, "deg/s", source="ours")
WITH_STATIONS = replace(
    mems_gyro.INSTRUMENT,
    columns=(*mems_gyro.INSTRUMENT.columns, bc.Column("station", None, required=False)),
)
BIASES = {"hall": 0.0, "cellar": 0.3, "roof": -0.2}  # °/s


def readings(stations: list[str]) -> bc.Measurements:
    noise = np.random.default_rng(1).standard_normal(len(stations))
    temperature = np.linspace(20.0, 60.0, len(stations))
    output = 0.02 * (temperature - 40) + [BIASES.get(s, 0.0) for s in stations] + 0.01 * noise
    columns = {"temperature": temperature, "station": stations, "output": output}
    return bc.Measurements.from_arrays(WITH_STATIONS, **columns)


def test_an_effect_of_an_unknown_group_is_refused_when_the_model_is_made() -> None:
    with pytest.raises(
        bc.ModelError,
        match="one coefficient for each 'station', and instrument 'mems_gyro' has no such group; it has run, ",
    ):
        mems_gyro.INSTRUMENT.baseline() + STATION


def test_each_member_of_a_declared_group_has_its_deviation(tmp_path) -> None:
    stations = [name for name in BIASES for _ in range(40)]
    model = WITH_STATIONS.baseline() + STATION
    fitted = bc.fit(model, readings(stations), bc.LeastSquares())
    means = fitted.posterior["bias.station"].mean(("chain", "draw"))
    found = {name: float(means.sel(station=name)) for name in BIASES}
    assert found["cellar"] - found["hall"] == pytest.approx(0.3, abs=0.03)
    assert found["roof"] - found["hall"] == pytest.approx(-0.2, abs=0.03)
    new = bc.predict(fitted, readings(["garden"] * 3))  # a station that was not there has its own
    assert (np.asarray(new.sd) > 0.1).all()
    path = fitted.save(tmp_path / "c.nc")
    assert bc.load(path, effects=[STATION], instruments=[WITH_STATIONS]).levels["station"] == (
        "hall",
        "cellar",
        "roof",
    )


def test_readings_without_the_group_are_refused_in_words() -> None:
    one = bc.Measurements.from_arrays(
        WITH_STATIONS, temperature=np.linspace(20, 60, 9), output=np.arange(9.0)
    )
    with pytest.raises(bc.ModelError, match="needs the column 'station'"):
        bc.fit(WITH_STATIONS.baseline() + STATION, one, bc.LeastSquares())
