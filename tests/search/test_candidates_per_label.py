"""A candidate with one coefficient for each label of a column is searched like any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro

STATION = effects.deviation("bias", "station", 0.2, "deg/s", source="ours")
AT_STATIONS = replace(
    mems_gyro.INSTRUMENT,
    columns=(*mems_gyro.INSTRUMENT.columns, bc.Column("station", None, required=False)),
    candidates=(effects.quadratic("bias", 1e-4, "deg/s/degC^2", source="ours"), STATION),
)
BIASES = {"hall": 0.0, "cellar": 0.3, "roof": -0.2}  # °/s
EACH_ITS_OWN = replace(
    STATION,
    name="bias.of_station",
    coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 0.2), per="station"),),
)


def at_stations(share: float = 1.0) -> bc.Measurements:
    stations = np.repeat([*BIASES], 30)
    temperature = np.linspace(20.0, 60.0, 90)
    noise = np.random.default_rng(1).standard_normal(90)
    output = 0.02 * (temperature - 40) + [share * BIASES[s] for s in stations] + 0.01 * noise
    columns = {"temperature": temperature, "station": stations, "output": output}
    return bc.Measurements.from_arrays(AT_STATIONS, **columns)


@pytest.mark.parametrize("effect", [STATION, EACH_ITS_OWN], ids=["learned", "fixed"])
def test_a_candidate_per_station_is_found(effect: bc.Effect) -> None:
    line = bc.fit(AT_STATIONS.baseline(), at_stations(), bc.LeastSquares(draws=100), strict=False)
    found = bc.discover(line, effects=[effect], widen_noise=False)
    named = [name for one in found.sets for name in one.effects]
    assert effect.name in named


@pytest.mark.slow
def test_the_average_holds_labels_that_only_other_structures_know() -> None:
    """Little is hidden at the stations: the last model has no coefficient for them, some of the average has."""
    with bc.use_settings(bc.Settings(averaged_probability=1e-6)):
        path = bc.calibrate(
            AT_STATIONS.baseline(), at_stations(0.015), method=bc.LeastSquares(draws=100)
        )
    assert "bias.station" not in path.final.calibration.model.names
    assert path.average is not None and "bias.station" in path.average.model.names
    assert path.average.posterior["bias.station"].sizes["station"] == len(BIASES)
    assert bc.predict(path.average, at_stations(0.015)).rmse < 0.02
