"""The workbench's page in a real browser: what it shows, what the pointer and the keyboard do, what it must not do."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.browser import chromium
from tests.support.command_line import GYRO, needs_installation
from tests.workbench.real_page import Bench, Seen, bench, opened, write_campaign

pytestmark = [needs_installation, pytest.mark.nightly]
NAME = "<img src=x onerror=alert(1)>"  # of a column
FOCUSED = """() => {
  let at = document.activeElement;
  while (at && at.shadowRoot && at.shadowRoot.activeElement) at = at.shadowRoot.activeElement;
  const row = at && at.dataset && at.dataset.row ? `row ${at.dataset.row}` : "";
  const label = at.labels && at.labels.length ? at.labels[0].textContent.trim() : "";
  return row || label || at.getAttribute("aria-label") || (at.tagName === "BUTTON" ? at.textContent : at.tagName);
}"""


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    chromium()
    pytest.importorskip("playwright.sync_api", reason="Playwright for Python is not here")
    folder = tmp_path_factory.mktemp("workbench")
    test, later = write_campaign(folder, also=f"{NAME} [degC]")
    text = test.read_text("utf-8").replace("\n3,", "\n<b>third</b>,")
    test.write_text(text, "utf-8")
    with bench(test, *GYRO, "--holdout", later, "--out", folder / "kept") as running:
        yield running


@pytest.fixture(scope="module")
def seen(begun: Bench) -> Iterator[Seen]:
    with opened(begun.url) as page:
        yield page.looked()


def test_the_keyboard_reaches_everything(seen: Seen) -> None:
    page, reached = seen.page, []
    page.evaluate("() => document.activeElement && document.activeElement.blur()")
    for _ in range(90):
        page.keyboard.press("Tab")
        reached.append(page.evaluate(FOCUSED))
    for wanted in (
        "row bias.drift",
        "Add bias.drift",
        "Change … bias.constant",
        "Find all",
        "The error",
        "time",
    ):
        assert wanted in reached, f"{wanted!r} is not reached by Tab: {reached}"  # fmt: skip
    page.locator('[data-row="bias.thermal_lag"]').focus()
    page.get_by_text("bias.thermal_lag would be").wait_for()
    page.keyboard.press("ArrowUp")
    page.wait_for_timeout(300)
    assert page.evaluate(FOCUSED).startswith("row "), "the arrows go from row to row"


def test_names_from_files_are_text(seen: Seen) -> None:
    assert seen.page.get_by_text("run <b>third", exact=False).count() == 1
    assert seen.page.locator("img").count() == 0
    seen.clean()
