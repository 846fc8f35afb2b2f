"""Which columns may be causes: no channel of the same unit, none that the user leaves out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro, still_sensor

SENSOR, QUICK = still_sensor.INSTRUMENT, bc.LeastSquares(draws=200)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three axes that follow the temperature alike, a pressure, and a drive voltage that the output follows."""
    random, time = np.random.default_rng(4), 10.0 * np.arange(300)
    temperature = 30 + 10 * np.sin(time / 700)
    drive, curved = 5 + 0.05 * np.cos(time / 150), 0.2 * (temperature - 30) ** 2
    axes = [
        curved * s + 20 * (drive - 5) * s + 0.05 * random.standard_normal(300) for s in (1, -2, 1.5)
    ]
    columns = np.column_stack([time, temperature, *axes, drive, 1000 + random.standard_normal(300)])
    names = "time [s],temperature [degC],acc_x [mg],acc_y [mg],acc_z [mg],drive [V],pressure [hPa]"
    path = tmp_path_factory.mktemp("log") / "imu.csv"
    np.savetxt(path, columns, delimiter=",", header=names, comments="")
    return path


def searched(found: bc.Discovery) -> set[str]:
    return {c.effect for c in found.candidates if c.kind != "not testable"}


@pytest.fixture(scope="module")
def line(log: Path) -> bc.Calibration:
    readings = bc.read(log, SENSOR, columns={"output": "acc_z"})
    return bc.fit(SENSOR.for_readings(readings).baseline(), readings, QUICK, strict=False)


def test_channels_of_one_unit_are_not_each_others_causes(line: bc.Calibration) -> None:
    found = searched(bc.discover(line, widen_noise=False, max_effects=2))
    assert {"unknown(drive)", "unknown(pressure)"} <= found
    assert not {"unknown(acc_x)", "unknown(acc_y)"} & found
    assert {"acc_x", "acc_y"} <= set(line.readings.columns)  # an effect of one's own may take them
    assert {"acc_x", "acc_y"}.isdisjoint(e.covariate for e in bc.check(line).entries)


def test_the_mark_stays_with_the_readings(line: bc.Calibration, tmp_path: Path) -> None:
    readings = line.readings
    for same in (readings.select(range(90)), readings.average("30 s"), bc.exclude_faults(readings)):
        assert same.no_causes == {"acc_x", "acc_y"}
    assert bc.load(line.save(tmp_path / "c.nc")).readings.no_causes == {"acc_x", "acc_y"}


def test_a_column_is_ignored(line: bc.Calibration) -> None:
    found = bc.discover(line, widen_noise=False, max_effects=1, ignore=["drive"])
    assert "unknown(drive)" not in searched(found)
    found = bc.discover(line, widen_noise=False, max_effects=1, ignore=["time"])
    with pytest.raises(bc.InputError):
        bc.discover(line, ignore=["suply"])


def test_only_covariates_that_are_named_are_causes(line: bc.Calibration) -> None:
    found = searched(bc.discover(line, widen_noise=False, max_effects=1, covariates=["acc_x"]))
    assert "unknown(acc_x)" in found and "unknown(temperature)" in found
    assert not {"unknown(drive)", "unknown(pressure)", "unknown(acc_y)"} & found
    with pytest.raises(bc.InputError):
        bc.discover(line, ignore=["drive"], covariates=["drive"])


@pytest.mark.parametrize(
    ("output", "others"),
    [
        ("acc_z", ["acc_x", "acc_y", "gyro_x"]),
        ("AccZ", ["AccX", "GyrY"]),
        ("zacc", ["xacc", "ygyro"]),
        ("gyro_z_dps", ["acc_x_g"]),
        ("dut 3", ["dut 1", "dut 12"]),
    ],
)
def test_channels_are_known_by_their_names(output: str, others: list[str], tmp_path: Path) -> None:
    names = [
        "time",
        "temperature",
        output,
        *others,
        "max",
        "drive",
        "index",
        "oxygen",
        "T1",
        "zinc",
    ]
    table = np.arange(9)[:, None] + np.random.default_rng(1).random((9, len(names)))
    units = {"time": "s", "temperature": "degC"}
    head = ",".join(f"{n} [{units.get(n, 'V')}]" for n in names)
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=head, comments="")
    found = bc.read(tmp_path / "log.csv", SENSOR, columns={"output": output})
    assert found.no_causes == set(others) and {"drive", "max", "zinc"} <= set(found.columns)


# A candidate with one coefficient for each label of a column is searched like any other.


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
    stations, temperature = np.repeat([*BIASES], 30), np.linspace(20.0, 60.0, 90)
    noise = np.random.default_rng(1).standard_normal(90)
    output = 0.02 * (temperature - 40) + [share * BIASES[s] for s in stations] + 0.01 * noise
    columns = {"temperature": temperature, "station": stations, "output": output}
    return bc.Measurements.from_arrays(AT_STATIONS, **columns)


@pytest.mark.parametrize("effect", [STATION, EACH_ITS_OWN], ids=["learned", "fixed"])
def test_a_candidate_per_station_is_found(effect: bc.Effect) -> None:
    line = bc.fit(AT_STATIONS.baseline(), at_stations(), bc.LeastSquares(draws=100), strict=False)
    found = bc.discover(line, effects=[effect], widen_noise=False)
    named = [name for one in found.findings for name in one.effects]
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
