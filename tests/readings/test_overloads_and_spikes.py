"""An instrument's overload code is named at the door; a few readings far from both neighbours are spikes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor

SENSOR = still_sensor.INSTRUMENT


def record(output: np.ndarray) -> bc.Measurements:
    time = np.arange(len(output)) * 1.0
    temperature = 20 + 5 * np.sin(time / 99)
    columns = {"time": time, "temperature": temperature, "output": output}
    return bc.Measurements.from_arrays(SENSOR, units={"output": "V"}, **columns)


def spikes(output: np.ndarray) -> list[int]:
    """The readings that are set aside."""
    kept = bc.exclude_faults(record(output))["time"]
    return sorted(set(range(len(output))) - set(kept.astype(int).tolist()))


def written(path: Path, code: str, column: int = 2) -> Path:
    random = np.random.default_rng(1)
    rows = [
        [f"{i}", f"{20 + i / 10:.1f}", f"{1 + 0.01 * random.normal():.6f}", "1000"]
        for i in range(60)
    ]
    rows[17][column] = code
    head = "time [s],temperature [degC],output [V],pressure [hPa]"
    path.write_text("\n".join([head, *map(",".join, rows)]) + "\n", "utf-8")
    return path


@pytest.mark.parametrize("code", ["9.9E37", "-9.9E+37", "9.91E37", "9.90000000E+37"])
def test_an_overload_code_is_refused_by_name_and_row(code: str, tmp_path: Path) -> None:
    with pytest.raises(bc.InputError) as refused:
        bc.read(written(tmp_path / "a.csv", code), SENSOR)
    str(refused.value)
    kept = bc.read(tmp_path / "a.csv", SENSOR, missing="drop")
    assert len(kept) == 59
    assert np.ptp(kept["output"]) < 1


def test_an_overload_in_a_column_beside_the_instruments_leaves_that_column_out(tmp_path) -> None:
    found = bc.read(written(tmp_path / "a.csv", "9.91E37", column=3), SENSOR)
    assert "pressure" not in found.columns
    assert any("pressure" in flag and "row 19 reads 9.91e+37" in flag for flag in found.flags)


def heavy(seed: int, rows: int = 2000) -> np.ndarray:
    """Noise of which one reading in 60 or so stands out."""
    return np.random.default_rng(seed).standard_t(1.6, rows)


@pytest.mark.parametrize("seed", range(5))
def test_heavy_tails_alone_are_no_spikes(seed: int) -> None:
    assert spikes(heavy(seed)) == []


def test_few_spikes_are_found_and_many_are_left_to_the_noise_law() -> None:
    output = np.random.default_rng(5).standard_normal(2000)
    at = np.arange(100, 1900, 200)
    output[at] += 700.0
    assert spikes(output) == at.tolist()
    output[at + 50] -= 700.0
    assert spikes(output) == []


def test_spikes_at_both_ends_are_found_and_their_neighbours_kept() -> None:
    output = np.random.default_rng(3).standard_normal(400)
    output[[0, 399]] = 700.0
    assert spikes(output) == [0, 399]
