"""The notebooks of the documentation run from top to bottom, and every result in them shows itself as a table."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.support.command_line import needs_installation

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = ROOT / "docs" / "notebooks"
DATA = Path(os.environ.get("BAYESCAL_SHARED", ROOT.parent / "shared")) / "data"
RECORD = DATA / "thermal_ramp" / "imu_thermal_ramp.csv"

pytestmark = pytest.mark.nightly


def executed(name: str, folder: Path):
    """A notebook, run in a folder."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    book = nbformat.read(NOTEBOOKS / name, as_version=4)
    client = nbclient.NotebookClient(book, timeout=600, resources={"metadata": {"path": folder}})
    return client.execute()


def shown(book) -> str:
    """All that its cells show."""
    parts = []
    for cell in book.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            parts.append(data.get("text/html") or data.get("text/plain") or output.get("text", ""))
    return "\n".join(parts)


@needs_installation
def test_an_effect_and_an_instrument_of_ones_own(tmp_path: Path) -> None:
    page = shown(executed("own_effect_and_instrument.ipynb", tmp_path))
    assert page.count("<table>") >= 6
    assert "elpd_loo" in page


@needs_installation
def test_a_record_to_firmware(tmp_path: Path) -> None:
    if not RECORD.is_file():
        pytest.skip(f"no {RECORD}: BAYESCAL_SHARED may name the folder of data/thermal_ramp")
    shutil.copy(RECORD, tmp_path)
    page = shown(executed("record_to_firmware.ipynb", tmp_path))
    assert page.count("<table") >= 5
    assert "missing: " in page
    assert (tmp_path / "acc_x.h").is_file()
