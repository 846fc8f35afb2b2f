"""The whole loop by clicking, on a test with two hidden effects, and what is taken away from it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from bayescal_models import mems_gyro
from tests.support.browser import chromium
from tests.support.command_line import GYRO, needs_installation
from tests.workbench.real_page import Bench, opened

pytestmark = [needs_installation, pytest.mark.nightly]
FLOOR = 0.05  # °/s: the noise of the readings
HIDDEN = {"bias.thermal_lag": 0.05, "bias.drift": 0.3}  # °/s per °C, °/s over the record


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[Bench]:
    """Of a gyroscope's test with two hidden effects, and a second one kept apart."""
    chromium()
    pytest.importorskip("playwright.sync_api", reason="Playwright for Python is not here")
    files = tmp_path / "test.csv", tmp_path / "later.csv"
    for seed, file in enumerate(files, start=1):
        mems_gyro.simulate(HIDDEN, seed=seed).write(file)
    running = Bench(files[0], *GYRO, "--holdout", files[1], "--out", tmp_path / "kept")
    yield running
    running.close()


def test_the_loop_by_clicking(begun: Bench, tmp_path: Path) -> None:
    with opened(begun.url) as seen:
        seen.looked().add("bias.drift").looked()
        seen.add("bias.thermal_lag")
        held_out = [float(cells[3].split()[0]) for cells in seen.steps()]
        assert held_out[0] > 4 * FLOOR
        assert held_out[-1] == pytest.approx(FLOOR, rel=0.2)

        seen.page.get_by_role("button", name="Go back 0").click()
        seen.page.locator('tr[data-row="0"][aria-current]').wait_for()
        seen.looked().add("bias.thermal_lag")
        assert "(from 0)" in seen.steps()[-1][0], "a branch begins where one went back to"

        seen.page.get_by_role("button", name="Go back 2").click()
        seen.page.locator('tr[data-row="2"][aria-current]').wait_for()
        seen.tab("Python")
        script = seen.download("Download workbench.py").read_text("utf-8")
        seen.tab("Files").press("Report")
        report = seen.download("Download report.html").read_bytes()
        seen.press("C header")
        header = seen.download("Download compensation.h").read_bytes()
        seen.clean()

    # What is downloaded is what the folder keeps, of which other tests hold what it does.
    result = next((tmp_path / "kept").rglob("result_002"))
    assert header == (result / "compensation.h").read_bytes()
    assert report == (result / "report.html").read_bytes()
    assert script == (result.parent / "script.py").read_text("utf-8")
