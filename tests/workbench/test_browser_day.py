"""A day at the workbench, by clicking: a file dropped, data and fit, undo, two steps compared, budget and decision,
where to measure next, channels of a unit; a server that is gone, begun again, and seen by two tabs.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bayescal_models import still_sensor
from tests.support.browser import chromium
from tests.support.command_line import GYRO, needs_installation
from tests.workbench.real_page import Bench, Seen, bench, browser, opened, write_campaign

pytestmark = [needs_installation, pytest.mark.nightly]
SECOND = 1000  # ms
DROP = """text => {
  const given = new DataTransfer();
  given.items.add(new File([text], "mine.csv", { type: "text/csv" }));
  window.dispatchEvent(new DragEvent("drop", { dataTransfer: given, bubbles: true, cancelable: true }));
}"""
GONE = "The workbench has ended or cannot be reached"


@pytest.fixture
def seen(begun: Bench) -> Iterator[Seen]:
    with opened(begun.url.partition("?")[0]) as page:  # a session of its own
        yield page.looked()


def fill(seen: Seen, label: str, text: str) -> None:
    field = seen.page.get_by_label(label)
    field.fill(text)
    field.press("Tab")


def wait_for_step(seen: Seen, number: int) -> None:
    seen.page.locator(f'tr[data-row="{number}"][aria-current]').wait_for()


def test_output_and_residuals_stand_over_each_column(seen: Seen) -> None:
    count = lambda: seen.page.locator(".bk-Figure").count()  # noqa: E731
    both = count()
    seen.page.get_by_text("output", exact=True).click()
    seen.page.wait_for_timeout(SECOND)
    assert count() == both - 2, "of each of two columns the output is gone"
    seen.page.get_by_text("output", exact=True).click()
    seen.clean()


def test_a_step_is_undone_and_two_are_compared(seen: Seen) -> None:
    seen.add("bias.drift").looked()
    seen.press("Undo")
    wait_for_step(seen, 0)
    seen.looked().add("bias.thermal_lag").looked()
    assert "├" in seen.steps()[2][0], "the second way is drawn as a branch"
    seen.press("Compare 1")
    seen.page.get_by_text("the best first, by log evidence").wait_for()
    assert seen.page.get_by_label("with step").input_value() == "1 + bias.drift"
    assert seen.page.get_by_text("step 1", exact=True).is_visible(), "its residuals are at hand"
    seen.page.keyboard.press("Escape")
    seen.page.locator("h1").click()
    seen.page.keyboard.press("Control+z")
    seen.tab("The error")
    wait_for_step(seen, 0)
    seen.clean()


def test_budget_verdict_and_decision_follow_the_model(seen: Seen) -> None:
    seen.add("bias.drift").looked().add("bias.thermal_lag").looked()
    seen.tab("Verdict")
    seen.page.get_by_text("This result may be used").wait_for()
    seen.tab("Budget")
    seen.page.get_by_text("Uncertainty budget of rate_input").wait_for()
    fill(seen, "temperature [°C]", "40")
    seen.press("Make the budget")
    seen.page.get_by_text("temperature = 40 °C").wait_for()
    seen.tab("Decision")
    fill(seen, "Limits, one a line", "corrected reading: ±0.2 °/s over 30..80 °C")
    seen.press("Decide")
    seen.page.get_by_text(re.compile(r"guarded acceptance.*accept;", re.DOTALL)).wait_for()
    assert seen.page.get_by_text("Of step 2.").is_visible()
    seen.tab("The error").press("Go back 1")
    wait_for_step(seen, 1)
    seen.tab("Decision")
    seen.page.get_by_text("This answer is of step 2; step 1 is shown.").wait_for()
    seen.press("Decide")
    seen.page.get_by_text("Of step 1.").wait_for()
    fill(seen, "Limits, one a line", "colour: ±1")
    seen.press("Decide")
    seen.page.get_by_text("colour").last.wait_for()
    seen.clean()


def test_a_file_is_dropped_anywhere_and_read_by_the_form(seen: Seen, tmp_path: Path) -> None:
    readings, _ = write_campaign(tmp_path)
    text = readings.read_text("utf-8").replace("temperature [degC]", "oven", 1)
    seen.page.evaluate(DROP, text.replace("output [deg/s]", "rate [deg/s]"))
    seen.page.get_by_text("mine.csv").first.wait_for()
    seen.page.get_by_text("no such column").first.wait_for()
    assert seen.page.get_by_text("--columns").count() == 0, "the form needs no command line"
    for name, header in (("temperature is", "oven"), ("output is", "rate")):
        seen.page.get_by_label(name, exact=True).select_option(header)
    units = seen.page.get_by_label("in", exact=True)
    boxes = [box for i in range(units.count()) if (box := units.nth(i).bounding_box())]
    assert not any(_overlap(a, b) for a in boxes for b in boxes if a is not b)
    units.nth(2).fill("degC")
    units.nth(2).press("Tab")
    seen.press("Read again")
    seen.press("Begin with these readings")
    seen.page.get_by_text("330 readings of").first.wait_for()
    seen.looked().clean()


def _overlap(a: dict[str, float], b: dict[str, float]) -> bool:
    across = a["x"] < b["x"] + b["width"] and b["x"] < a["x"] + a["width"]
    return across and a["y"] < b["y"] + b["height"] and b["y"] < a["y"] + a["height"]


def test_two_tabs_of_a_session_show_the_same(begun: Bench) -> None:
    with opened(begun.url.partition("?")[0]) as seen:
        seen.looked()
        other = Seen(seen.page.context.new_page()).open(seen.page.url).looked()
        seen.add("bias.drift")
        wait_for_step(other, 1)
        other.looked().add("bias.thermal_lag")
        wait_for_step(seen, 2)
        assert [s[:3] for s in seen.steps()] == [s[:3] for s in other.steps()]
        seen.clean()
        other.clean()


def test_a_server_that_is_gone_is_said_and_the_session_is_as_it_was(tmp_path: Path) -> None:
    chromium()
    test, later = write_campaign(tmp_path)
    arguments = (test, *GYRO, "--holdout", later, "--out", tmp_path / "kept")
    first = Bench(*arguments)
    with opened(first.url) as seen:
        seen.looked().add("bias.drift")
        steps = [s[:4] for s in seen.steps()]
        seen.page.context.new_page().goto(first.url.partition("?")[0])  # a second session
        seen.page.context.pages[-1].locator('tr[data-row="0"]').wait_for()
        seen.looked().add("bias.thermal_lag")
        first.kill()
        begun = time.monotonic()
        seen.page.get_by_text(GONE).wait_for(state="visible")
        assert time.monotonic() - begun < 3
    with bench(*arguments) as again, opened(again.url) as seen:
        wait_for_step(seen, 2)
        assert [s[:4] for s in seen.steps()[:2]] == steps, "the session worked in last, as it was"
        link = seen.page.get_by_role("link", name="session_2")
        assert link.get_attribute("title") == "step 0: baseline"
        link.click()
        seen.page.get_by_text("Where it fails").wait_for()
        wait_for_step(seen, 0)
        seen.clean()


def test_a_skeleton_stands_until_the_page_does(tmp_path: Path) -> None:
    """Panel's scripts held back: what is seen is the panes, empty, with what is being done."""
    chromium()
    test, _ = write_campaign(tmp_path)
    with bench(test, *GYRO, "--out", tmp_path / "kept") as running, browser() as seen:
        seen.open(running.url)
        seen.page.route("**/*.js*", lambda route: None)
        seen.page.goto(running.url, wait_until="commit")
        panes = seen.page.locator("#skeleton div")
        panes.first.wait_for()
        assert panes.count() == 4
        assert seen.page.get_by_text("Loading the page").is_visible()


def test_each_channel_of_a_unit_has_its_page(tmp_path: Path) -> None:
    chromium()
    readings = still_sensor.INSTRUMENT.simulate(seed=1).to_pandas()
    table = readings.rename(columns={"output": "gyro_x [deg/s]"})
    table["gyro_y [deg/s]"] = 0.5 - table["gyro_x [deg/s]"]
    units = {"time": "time [s]", "temperature": "temperature [degC]"}
    table.rename(columns=units).to_csv(tmp_path / "unit.csv", index=False)
    arguments = ("--instrument", "still_sensor", "--channels", "gyro_x,gyro_y")
    with (
        bench(tmp_path / "unit.csv", *arguments, "--out", tmp_path / "kept") as running,
        opened(running.url) as seen,
    ):
        constant = seen.page.locator('[data-row="bias.constant"]')
        first = constant.inner_text()
        seen.page.get_by_role("link", name="gyro_y").click()
        seen.page.get_by_role("link", name="gyro_x").wait_for()
        constant.wait_for()
        assert constant.inner_text() != first
        seen.tab("Python")
        seen.download("Download workbench.py").read_text("utf-8")
        assert (tmp_path / "kept" / "gyro_y" / "session_1" / "session.json").is_file()
        seen.clean()
