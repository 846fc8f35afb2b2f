"""A fleet made on the fly: gyroscopes, a line in temperature each, in partitions of Parquet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

READINGS = 60  # of each device
OFFSET, SLOPE = (2.0, 1.5), (0.03, 0.01)  # mean and sd over devices: °/s; °/s per °C
T0, NOISE = 20.0, 0.2  # °C; °/s


def arrays(seed: list[int], devices: int) -> tuple[np.ndarray, np.ndarray]:
    """Temperature, °C, and output, °/s, (devices, readings)."""
    rng = np.random.default_rng(seed)
    temperature = rng.uniform(-40.0, 85.0, (devices, READINGS))
    offset, slope = rng.normal(*OFFSET, (devices, 1)), rng.normal(*SLOPE, (devices, 1))
    noise = rng.normal(0.0, NOISE, temperature.shape)
    return temperature, offset + slope * (temperature - T0) + noise


def write_partition(folder: Path, number: int, devices: int, seed: int) -> Path:
    """One file of the fleet; the same for the same seed and number."""
    temperature, output = arrays([seed, number], devices)
    names = pa.array([f"G{number * devices + i:07d}" for i in range(devices)])
    codes = pa.array(np.repeat(np.arange(devices, dtype=np.int32), READINGS))
    table = pa.table(
        {
            "device": pa.DictionaryArray.from_arrays(codes, names).cast(pa.string()),
            "temperature [degC]": temperature.ravel(),
            "output [deg/s]": output.ravel(),
        }
    )
    path = folder / f"lot-{number:04d}.parquet"
    pq.write_table(table, path)
    return path
