"""What laboratories write: clocks that begin anew, labels of runs, masses, encodings, headers made up at random.

Nothing of it may be read silently wrong: it is read right, or asked about with options after which it is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import (
    accelerometer_dividing_head,
    accelerometer_triad,
    inclinometer,
    mems_gyro,
    still_sensor,
)
from tests.support.command_line import options_of

RECORDED = Path(__file__).parents[1] / "data" / "logs"
STILL, GYRO = still_sensor.INSTRUMENT, mems_gyro.INSTRUMENT
TRIAD, LEVEL = accelerometer_triad.INSTRUMENT, inclinometer.INSTRUMENT
HEAD = accelerometer_dividing_head.INSTRUMENT
STEPS = np.arange(60) * 10.0


def table(**columns: object) -> str:
    rows = zip(*(np.asarray(v).tolist() for v in columns.values()), strict=True)
    return "\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows), ""])


def at_rest(**columns: object) -> str:
    usual = {"temperature [degC]": 20 + STEPS / 20, "output [deg/s]": 0.5 + STEPS / 1e4}
    return table(**{**usual, **columns})


def options_said(path: Path, instrument: bc.Instrument) -> str:
    with pytest.raises(bc.InputError) as refused:
        bc.read(path, instrument)
    return " ".join(dict.fromkeys(p.option for p in refused.value.problems if p.option))


def test_a_unit_of_differences_is_refused_with_file_and_column(tmp_path: Path) -> None:
    path = tmp_path / "milli.csv"
    path.write_text(at_rest(**{"time [s]": STEPS, "temperature [mK]": 20000 + STEPS}), "utf-8")
    path.write_text(path.read_text("utf-8").replace("temperature [degC]", "set aside"), "utf-8")
    with pytest.raises(bc.InputError):
        bc.read(path, GYRO)


@pytest.mark.parametrize(
    ("head", "period", "size", "said"),
    [
        ("time [us]", 2**32, 1e-6, "2^32us"),
        ("time [ms]", 2**32, 1e-3, "2^32ms"),
        ("time [s]", 604800, 1.0, "604800s"),
        ("time [s]", 86400, 1.0, "86400s"),
    ],
)
def test_a_clock_that_begins_anew_is_named_and_undone(put, head, period, size, said) -> None:
    counts = (period + np.round((STEPS - 305) / size).astype(int)) % period
    path = put(at_rest(**{head: counts}))
    asked = options_said(path, STILL)
    assert said in asked
    found = bc.read(path, STILL, **options_of(asked))
    np.testing.assert_allclose(np.diff(found["time"]), 10.0, atol=1e-3)


def test_runs_without_labels_are_no_clock_that_begins_anew(put) -> None:
    path = put(at_rest(**{"time [s]": STEPS % 300}))
    with pytest.raises(bc.InputError):
        bc.read(path, STILL)


@pytest.mark.parametrize("leap", [1608017922.0, -1.5e9])
def test_a_clock_that_was_set_within_a_run_is_refused(put, leap) -> None:
    time = 1608015601.0 + STEPS + leap * (STEPS > 300)
    path = put(at_rest(**{"time [s]": time}))
    with pytest.raises(bc.InputError):
        bc.read(path, STILL)
    runs = np.where(STEPS > 300, "b", "a")
    assert len(bc.read(put(at_rest(**{"time [s]": time, "run": runs})), STILL)) == 60


def test_yearly_readings_do_not_leap(put) -> None:
    assert len(bc.read(put(at_rest(**{"time [day]": STEPS * 36.5})), STILL)) == 60


def test_signed_counts_that_were_written_as_unsigned_are_asked_about(put) -> None:
    signed = np.arange(60) - 30
    path = put(
        table(
            **{
                "time [s]": STEPS,
                "temperature [degC]": STEPS / 20,
                "output [count]": signed % 65536,
            }
        )
    )
    found = bc.read(path, STILL, **options_of(options_said(path, STILL)))
    np.testing.assert_array_equal(found["output"], signed)


def test_seconds_since_1904_are_taken_as_such(put) -> None:
    path = put(at_rest(**{"time [s]": 3_850_000_000 + STEPS}))
    found = bc.read(path, STILL)
    assert found.since == 3_850_000_000 - 2_082_844_800
    assert any("since 1904" in flag for flag in found.flags)


def test_a_period_is_a_number_with_a_unit(put) -> None:
    path = put(at_rest(**{"time [s]": STEPS}))
    with pytest.raises(bc.InputError):
        bc.read(path, STILL, unwrap={"time": "often"})
    with pytest.raises(bc.InputError):
        bc.read(path, STILL, unwrap={"tim": "2^32us"})


@pytest.mark.parametrize(
    ("head", "ours"),
    [("Cycle [#]", "run"), ("Zyklus", "run"), ("Run [-]", "run"), ("Messung Nr.", "run")]
    + [("Prüfling", "device"), ("DUT", "device"), ("Seriennummer", "device")],
)
def test_labels_are_known_by_their_names_and_values(put, head, ours) -> None:
    labels = STEPS // 200 if ours == "run" else STEPS // 10 % 3
    found = bc.read(put(at_rest(**{"time [s]": STEPS, head: labels.astype(int)})), STILL)
    assert found.groups(ours)[0] == ("0", "1", "2")


def test_cycle_column_without_labels_is_no_group(put) -> None:
    for values in (STEPS / 7, np.arange(60)):
        found = bc.read(put(at_rest(**{"time [s]": STEPS, "Cycle": values})), STILL)
        assert not found.has("run") and any("Cycle" in flag for flag in found.flags)


def numbers(rows: int = 24, columns: int = 3) -> list[list[float]]:
    return np.random.default_rng(3).uniform(-0.9, 0.9, (rows, columns)).round(4).tolist()


@pytest.mark.parametrize("head", ["Angle (°)", "Winkel/°", "Head angle (deg)", "theta_deg"])
def test_degrees_of_a_column_that_the_user_names_are_known(put, head) -> None:
    rows = numbers()
    path = put("\n".join([f"temp_c,{head},acc [g]", *(",".join(map(str, r)) for r in rows)]))
    found = bc.read(path, HEAD, **options_of(options_said(path, HEAD)))
    assert np.allclose(found["position_angle"], np.deg2rad([row[1] for row in rows]))


@pytest.mark.parametrize("heads", ["Beschl. X (g);Beschl. Y (g);Beschl. Z (g)", "z/g;y/g;x/g"])
def test_axes_are_told_apart_by_the_letters_in_their_names(put, heads) -> None:
    rows = numbers()
    path = put("\n".join([heads, *(";".join(map(str, row)) for row in rows)]))
    found = bc.read(path, TRIAD)
    x = 0 if "X" in heads else 2
    assert np.allclose(found["output_x"], [row[x] for row in rows])


@pytest.mark.parametrize(
    ("head", "unit", "size"),
    [("gyro_deg_s", "deg/s", 1.0), ("w_deg_h", "deg/s", 1 / 3600), ("Rate in deg/hr", "deg/s", 1 / 3600)]
    + [("acc_m_s2", "ug", 1e6 / 9.80665), ("a (ms-2)", "ug", 1e6 / 9.80665), ("a m/s²", "ug", 1e6 / 9.80665)]
    + [("v in km/h", "m/s", 1 / 3.6), ("p [N.m-2]", "N/m^2", 1.0), ("Thermo 1 (°F)", "degC", 5 / 9)],
)  # fmt: skip
def test_a_unit_is_all_of_what_a_header_ends_in(put, head, unit, size) -> None:
    path = put("\n".join([f"time [s];{head}", *(f"{10 * i};{3 + i * 0.5}" for i in range(30))]))
    found = bc.read(path, STILL, columns={"output": head})
    assert found.unit("output") == unit
    assert np.allclose(np.diff(found["output"]), 0.5 * size)


def test_commas_in_names_and_numbers_part_nothing_beside_semicolons(put) -> None:
    rows = (f"{i},5;{20 + i},25;0,{i:02}" for i in range(30))
    found = bc.read(put("\n".join(["time, s;temp, °C;output, deg/s", *rows])), GYRO)
    assert np.allclose(found["temperature"][:2], [20.25, 21.25])


def test_the_separator_is_what_parts_the_readings(put) -> None:
    rows = [f"{10 * i}\t{20 + i / 20}\t{0.1 * (i % 5):.1f}" for i in range(30)]
    found = bc.read(put("\n".join(["Time,s\tTemp,degC\toutput,deg/s", *rows])), GYRO)
    assert np.allclose(found["output"][:3], [0.0, 0.1, 0.2])


@pytest.mark.parametrize("head", ["supply [V]", "Vcc (V)", "VDD_V", "Versorgungsspannung [V]"])
def test_the_voltage_of_the_supply_is_known(put, head) -> None:
    lines = [f"{10 * i},{20 + i / 20},{5 + 0.01 * (i % 7)},{0.1 * (i % 5)}" for i in range(60)]
    path = put("\n".join([f"time [s],temperature [degC],{head},output [deg/s]", *lines]))
    assert bc.read(path, mems_gyro.INSTRUMENT).unit("supply_voltage") == "V"


def test_windows_1252_is_read(put) -> None:
    content = at_rest(**{"time [s]": STEPS, "Gehäuse – außen [°C]": STEPS})
    found = bc.read(put(content.encode("windows-1252")), STILL)
    assert "Gehäuse – außen" in found.columns
    with pytest.raises(bc.InputError):
        bc.read(put(content.encode() + "é,1,1,1\n".encode("windows-1252")), STILL)


@pytest.mark.parametrize("name", ["drop400", "ms400", "pairs400"])
def test_stamps_of_drivers_have_the_noise_of_the_sensor(name) -> None:
    path = RECORDED / f"{name}_short.csv"
    found = bc.noise(bc.read(path, STILL, columns={"output": "gyro_x"}))
    density = next(f for f in found.figures if f.symbol == "N")
    assert density.unit == "deg/h^0.5" and density.low < 0.24 < density.high
    assert ("noise.lost" in [c.code for c in found.claims]) == (name == "drop400")


def test_poses_that_are_held_briefly_are_all_found() -> None:
    columns = {f"output_{a}": f"a{a}" for a in "xyz"}
    path = RECORDED / "shortposes.csv"
    log = bc.read(path, TRIAD, columns=columns)
    poses = bc.poses(log, TRIAD)
    assert len(poses) == 30
    found = bc.fit(TRIAD.baseline(), poses, bc.LeastSquares())
    true = {
        "bias.constant": (8.0, -4.0, 12.0),
        "scale.constant": (2000.0, 5000.0, 5500.0),
    }  # mg, ppm
    for name, values in true.items():
        for axis, value in zip("xyz", values, strict=True):
            draws = found.samples(f"{name}[{axis}]")
            assert abs(draws.mean() - value) < 3 * draws.std()
