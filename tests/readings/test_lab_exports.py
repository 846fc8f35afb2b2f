"""Twenty files as instruments and programs export them: read, or refused once with the options that cure it."""

from __future__ import annotations

import re
import shlex
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from bayescal._cli.options import ColumnOptions, with_groups
from bayescal._core.errors import InputError
from bayescal._data.read import read
from bayescal_models import mems_gyro
from tests.support.lab_files import RATE, TEMPERATURE, TIME, lab_exports

EXPORTS = lab_exports()


def options_of(text: str) -> dict[str, object]:
    """Options as the command line hands them to `read`."""
    found: list[dict[str, object]] = []
    app = typer.Typer()

    @app.command()
    @with_groups
    def taken(columns: ColumnOptions) -> None:
        found.append(columns.for_read())

    assert CliRunner().invoke(app, shlex.split(text)).exit_code == 0
    return found[0]


def test_there_are_twenty() -> None:
    assert len(EXPORTS) == 20


@pytest.mark.parametrize("name", EXPORTS)
def test_it_is_read_with_at_most_one_refusal_that_names_its_cure(put, name) -> None:
    export = EXPORTS[name]
    path = put(export.content, export.name)
    if export.cure:
        with pytest.raises(InputError) as refused:
            read(path, mems_gyro.INSTRUMENT)
        said = " ".join(str(refused.value).split())
        for cure in re.split(r" (?=--)", export.cure):
            option, _, value = cure.partition(" ")
            named = re.sub(r"(?<==)(ms|degC|dps)$", "UNIT", value)
            named = re.sub(r"^'[\d.]+ VDC", "'NUMBER VDC", named).replace("'0.002 V/", "'NUMBER V/")
            asked = option if option == "--nominal-zero" else f"{option} {named}"
            assert asked in said, (asked, said)
    options: dict[str, Any] = options_of(export.cure)
    readings = read(path, mems_gyro.INSTRUMENT, **options)
    np.testing.assert_allclose(readings["time"], TIME, atol=2e-6)
    np.testing.assert_allclose(readings["temperature"], TEMPERATURE, rtol=1e-12)
    np.testing.assert_allclose(readings["output"], RATE, rtol=1e-12, atol=1e-12)
