"""Files as instruments and programs export them: read, or refused once with the options that cure it; and fitted."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import options_of
from tests.support.lab_files import (
    RATE,
    TEMPERATURE,
    TIME,
    lab_exports,
    spaced,
    text,
    when,
)

EXPORTS = lab_exports()


@pytest.mark.parametrize("name", EXPORTS)
def test_it_is_read_with_at_most_one_refusal_that_names_its_cure(put, name) -> None:
    export = EXPORTS[name]
    path = put(export.content, export.name)
    if export.cure:
        with pytest.raises(bc.InputError) as refused:
            bc.read(path, mems_gyro.INSTRUMENT)
        said = " ".join(str(refused.value).split())
        for cure in re.split(r" (?=--)", export.cure):
            option, _, value = cure.partition(" ")
            named = re.sub(r"(?<==)(ms|degC|dps)$", "UNIT", value)
            named = re.sub(r"^'[\d.]+ VDC", "'NUMBER VDC", named).replace("'0.002 V/", "'NUMBER V/")
            asked = option if option == "--nominal-zero" else f"{option} {named}"
            assert asked in said, (asked, said)
    options: dict[str, Any] = options_of(export.cure)
    readings = bc.read(path, mems_gyro.INSTRUMENT, **options)
    np.testing.assert_allclose(readings["time"], TIME, atol=2e-6)
    np.testing.assert_allclose(readings["temperature"], TEMPERATURE, rtol=1e-12)
    np.testing.assert_allclose(readings["output"], RATE, rtol=1e-12, atol=1e-12)


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
        readings = bc.read(put(content), mems_gyro.INSTRUMENT, **options)
        line = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings, bc.LeastSquares())
        names = ("bias.constant", "bias.temperature", "noise.white")
        found.append([float(line.samples(name).mean()) for name in names])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    np.testing.assert_allclose(found[2], found[0], rtol=1e-6)
