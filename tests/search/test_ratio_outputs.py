"""Outputs without a dimension (ppm, ppb, %, 1), in Hz and in s: read, judged, shown and handed on in their unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor

SIZES = {"ppm": 1.0, "ppb": 800.0, "%": 0.1, "1": 1e-6, "Hz": 10.0, "s": 1e-7}  # of the output
QUICK = bc.LeastSquares(draws=300)
CURVED = -0.01  # per °C²


def record(unit: str, path: Path) -> bc.Measurements:
    """An oscillator's deviation over temperature."""
    random = np.random.default_rng(2)
    time = 10.0 * np.arange(400)
    temperature = 30 + 15 * np.sin(time / 900)
    moved = temperature - 30
    output = 3 + 0.2 * moved + CURVED * moved**2 + 0.05 * random.standard_normal(400)
    columns = np.column_stack([time, temperature, SIZES[unit] * output])
    header = f"time [s],temperature [degC],output [{unit}]"
    np.savetxt(path, columns, delimiter=",", header=header, comments="")
    return bc.read(path, still_sensor.INSTRUMENT)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [*SIZES])
def test_an_output_keeps_its_unit_and_no_shape_is_taken_for_a_size(
    unit: str, tmp_path: Path
) -> None:
    readings = record(unit, tmp_path / "record.csv")
    instrument = still_sensor.INSTRUMENT.for_readings(readings)
    model = instrument.baseline() + "bias.temperature_quadratic" + "unknown(time)" + "bias.warm_up"
    fitted = bc.fit(model, readings, QUICK, strict=False)
    assert "size.beyond_output" not in [one.code for one in fitted.conflicts]
    curved = fitted.samples("bias.temperature_quadratic")
    assert curved.mean() == pytest.approx(CURVED * SIZES[unit], abs=5 * curved.std())
    if unit != "1":
        row = next(
            r for r in str(fitted).splitlines() if r.startswith("bias.temperature_quadratic")
        )
        assert f" {unit}/°C²" in row
