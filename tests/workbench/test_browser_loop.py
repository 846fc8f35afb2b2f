"""The whole loop by clicking, on a test with two hidden effects, and what is taken away from it."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.browser import chromium
from tests.support.command_line import GYRO, needs_installation
from tests.workbench.real_page import MAIN, ROOT, Bench, bench, opened, write_campaign

pytestmark = [needs_installation, pytest.mark.nightly]
FLOOR = 0.05  # °/s: the noise of the readings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    chromium()
    pytest.importorskip("playwright.sync_api", reason="Playwright for Python is not here")
    made = tmp_path_factory.mktemp("workbench")
    write_campaign(made)
    return made


@pytest.fixture
def begun(folder: Path, tmp_path: Path) -> Iterator[Bench]:
    arguments = (*GYRO, "--holdout", folder / "later.csv", "--out", tmp_path / "kept")
    with bench(folder / "test.csv", *arguments) as running:
        yield running


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
        assert "├" in seen.steps()[-1][0], "a branch begins where one went back to"

        seen.page.get_by_role("button", name="Go back 2").click()
        seen.page.locator('tr[data-row="2"][aria-current]').wait_for()
        seen.tab("Python")
        script = seen.download("Download workbench.py").read_text("utf-8")
        seen.tab("Report").press("Write the report")
        report = seen.download("Download report.html").read_bytes()
        seen.tab("Export").press("C header")
        header = seen.download("Download compensation.h").read_bytes()
        seen.clean()

    run_script(script, tmp_path, held_out[-1])
    result = next((tmp_path / "kept").rglob("result_002"))
    command(tmp_path, "export", result / "calibration.nc", "--format", "c", "--out", "by_command.h")
    assert header == (tmp_path / "by_command.h").read_bytes()
    command(tmp_path, "report", result, "--out", "by_command.html")
    assert undated(report) == undated((tmp_path / "by_command.html").read_bytes())


def run_script(script: str, folder: Path, held_out: float) -> None:
    """What was clicked, in a process of its own: equal numbers."""
    path = folder / "workbench.py"
    path.write_text(script, "utf-8")
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", path], capture_output=True, text=True, cwd=folder,
        env={"PYTHONPATH": f"{ROOT}:{ROOT / 'models'}", "PATH": "/usr/bin:/bin", "HOME": str(Path.home())},
        timeout=300, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert f"{held_out:.3g}" in ran.stdout


def command(folder: Path, *arguments: str | Path) -> None:
    """A command of the command line, in a process of its own; 1 says that the model is not the whole story."""
    ran = subprocess.run(
        [sys.executable, "-c", MAIN, *map(str, arguments)], check=False, cwd=folder, timeout=300,
        env={"PYTHONPATH": f"{ROOT}:{ROOT / 'models'}", "PATH": "/usr/bin:/bin", "HOME": str(Path.home())},
    )  # fmt: skip
    assert ran.returncode in (0, 1)


def undated(page: bytes) -> bytes:
    """A report without the moment at which it was written."""
    return re.sub(rb"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}(:\d{2})?", b"", page)


def test_find_all_is_stopped_half_way(begun: Bench) -> None:
    with opened(begun.url) as seen:
        seen.looked().press("Find all")
        seen.page.get_by_text("rms as fitted").wait_for()
        seen.press("Stop")
        seen.page.get_by_role("button", name="Find all", disabled=False).wait_for()
        after_stop = len(seen.steps())
        seen.press("Find all")
        seen.page.get_by_text("rms as fitted").wait_for()
        seen.page.get_by_role("button", name="Find all", disabled=False).wait_for()
        assert len(seen.steps()) >= after_stop
        assert min(float(cells[3].split()[0]) for cells in seen.steps()) == pytest.approx(
            FLOOR, rel=0.2
        )
        seen.clean()


def test_two_tabs_are_two_sessions(begun: Bench) -> None:
    with opened(begun.url) as seen:
        seen.looked().add("bias.drift")
        other = seen.page.context.new_page()
        other.goto(begun.url.partition("?")[0])
        other.get_by_text("Where it fails").wait_for()
        other.locator('tr[data-row="0"]').wait_for()
        assert other.locator("tr[data-row]").count() == 1, "a new tab begins at the baseline"
        assert len(seen.steps()) == 2
        seen.clean()


def test_a_killed_server_is_resumed(folder: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    arguments = (folder / "test.csv", *GYRO, "--holdout", folder / "later.csv", "--out", kept)
    first = Bench(*arguments)
    with opened(first.url) as seen:
        seen.looked().add("bias.drift")
        before = [cells[:5] for cells in seen.steps()]
        first.kill()
    with bench(*arguments) as again, opened(again.url) as seen:
        seen.page.locator('tr[data-row="1"]').wait_for()
        assert [cells[:5] for cells in seen.steps()] == before
        seen.clean()
