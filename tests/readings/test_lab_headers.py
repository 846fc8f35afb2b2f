"""What follows from files as laboratories write them: the same calibration, and gaps where rows are dropped."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayescal as bc
from bayescal._data.read import read
from bayescal._model.frame import build_frame, reference_of
from bayescal_models import mems_gyro
from tests.support.lab_files import RATE, TEMPERATURE, TIME, spaced, text, when, with_cell


def test_a_calibration_does_not_depend_on_how_its_file_is_written(put):
    noisy = RATE + 0.01 * np.sin(7 * TIME)
    head = ("t_s", "Temp_C", "gyro_z_dps")
    found = []
    files: tuple[tuple[str, dict[str, Any]], ...] = (
        (text(columns=(TIME, TEMPERATURE, noisy)), {}),
        (text(head, (TIME, TEMPERATURE, noisy)), {"columns": {"output": "gyro_z_dps"}}),
        (text(("Timestamp", "T/K", "output_rads"), (when(spaced), TEMPERATURE + 273.15, np.radians(noisy))), {}),
    )  # fmt: skip
    for content, options in files:
        readings = read(put(content), mems_gyro.INSTRUMENT, **options)
        line = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings, bc.LeastSquares())
        names = ("bias.constant", "bias.temperature", "noise.white")
        found.append([float(line.samples(name).mean()) for name in names])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    np.testing.assert_allclose(found[2], found[0], rtol=1e-6)


def test_a_dropped_row_is_a_gap_to_rates(put):
    spoilt = with_cell(5, 2, "", with_cell(6, 2, "NaN"))
    m = read(put(spoilt), mems_gyro.INSTRUMENT, missing="drop")
    assert len(m) == len(TIME) - 2
    frame = build_frame(m, reference_of(m))
    assert frame.step.tolist().count(30.0) == 1  # s, over the gap
    np.testing.assert_allclose(np.asarray(frame.rates["temperature"])[1:], 0.125, rtol=1e-9)
