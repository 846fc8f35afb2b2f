"""What a person changes by hand, by clicking: an unknown held and set free, a size, an effect of one's own."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from tests.support.command_line import needs_installation
from tests.workbench.real_page import Bench, Seen, opened

pytestmark = [needs_installation, pytest.mark.nightly]


@pytest.fixture
def seen(begun: Bench) -> Iterator[Seen]:
    with opened(begun.url) as page:
        yield page.looked()


def stepped(seen: Seen, press: str) -> list[str]:
    """Press a button that makes a state; its row in the table of steps."""
    before = len(seen.steps())
    seen.press(press)
    seen.page.locator(f'tr[data-row="{before}"][aria-current]').wait_for()
    return seen.steps()[-1]


def test_an_unknown_is_held_and_set_free(seen: Seen) -> None:
    fitted = seen.steps()[0]
    seen.press("Change … bias.constant")
    seen.page.get_by_text("Without it:").wait_for()
    assert seen.page.get_by_role("button", name="Free", exact=True).is_disabled()
    field = seen.page.get_by_label("held at")
    field.fill("19.0")
    field.press("Tab")
    held = stepped(seen, "Fix")
    assert float(held[1]) > float(fitted[1]), "a wrong value costs error"
    assert seen.page.get_by_text("held: bias.constant = 19").first.is_visible()
    assert stepped(seen, "Free")[1:4] == fitted[1:4], "as it was"
    seen.clean()


def test_an_effect_is_resized_and_taken_out(seen: Seen) -> None:
    seen.add("bias.thermal_lag")
    with_it = seen.steps()[-1]
    seen.press("Change … bias.thermal_lag")
    field = seen.page.get_by_label("plausible size")
    field.fill("1e-6")
    field.press("Tab")
    resized = stepped(seen, "Resize")
    assert float(resized[1]) > 1.2 * float(with_it[1]), "held back by a size that is far too small"
    out = stepped(seen, "Take out")
    assert float(out[1]) == pytest.approx(float(resized[1]), rel=0.05)
    seen.clean()


def test_an_unknown_dependence_is_drafted_and_the_draft_loaded(seen: Seen) -> None:
    from playwright.sync_api import expect

    seen.add("unknown(board_temperature)")
    seen.tab("Own effect")
    seen.press("Draft it")
    code, load = seen.page.get_by_label("Draft of an effect"), "Load the effect"
    expect(code).to_have_value(re.compile("bc.Effect"), timeout=60_000)
    code.fill(re.sub(r'"bias\.\w+"', '"bias.mine"', code.input_value()))
    code.press("Tab")
    assert seen.page.get_by_role("button", name=load).is_disabled(), "only when the user said so"
    seen.tab("I have read it: run it")
    seen.page.get_by_role("button", name=load, disabled=False).click()
    seen.page.locator('[data-row="bias.mine"]').wait_for()
    seen.clean()


def test_experiments_are_ranked_where_two_effects_are_confounded(seen: Seen) -> None:
    seen.tab("Next experiment")
    told = seen.page.get_by_text(re.compile("To tell apart|Nothing is confounded here"))
    told.wait_for()
    ranked = seen.page.get_by_role("button", name="Rank the experiments")
    assert ranked.is_disabled() == told.inner_text().startswith("Nothing")
    if not ranked.is_disabled():
        ranked.click()
        seen.page.get_by_text("least expected for").wait_for()
    seen.clean()


def test_a_typed_formula_is_drawn_and_then_added(seen: Seen) -> None:
    before, typed = seen.count(), seen.page.get_by_label("type a formula")
    typed.fill("square: a*(temperatur - 40)^2; a = 1e-3 deg/s")
    typed.press("Enter")
    seen.page.get_by_text("▸").wait_for()
    typed.fill("square: a*(temperature - 40)^2; a = 1e-3 deg/s/degC^2")
    typed.press("Enter")
    seen.page.get_by_text("bias.square would be").wait_for()
    assert seen.count() == before, "drawn, and not added"
    seen.page.get_by_role("button", name="Add it", disabled=False).click()
    seen.page.locator(f'tr[data-row="{before}"]').wait_for()
    assert "bias.square" in seen.steps()[-1][0]
    seen.clean()
