"""The workbench's page at five widths, light and dark, measured: nothing beyond the window, clipped or over another.

And what axe-core finds in it and in its report: nothing serious.

What Bokeh draws stands on a canvas: there every figure has room for its ticks, and its labels give way to each other.
`make test-all ARGS='-k clipped'` with BAYESCAL_PICTURES=docs/workbench writes the pictures that the docs show.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from tests.support.command_line import needs_installation
from tests.workbench.real_page import Bench, Seen, browser, opened

pytestmark = [needs_installation, pytest.mark.nightly]
SIZES = {390: 844, 768: 1024, 1024: 768, 1280: 800, 1920: 1080}
TABS = (
    *("The error", "Side by side", "Verdict", "Budget", "Decision", "Next experiment"),
    *("Allan deviation", "Report", "Export", "Python", "File", "Own effect"),
)
SHOWN = {  # by the docs
    "start light 1280": "start",
    "preview light 1280": "preview",
    "found light 1280": "found",
    "The error dark 768": "narrow_dark",
}
FIGURE = 80, 110  # px, least height and width
# Lines of text with their boxes, cut where an ancestor scrolls; `clipped`: cut by one that does not, or across a scroll
# that is no printed table or code. Text of the same element, or of its own ancestor, is not over it.
MEASURED = """() => {
  const found = { wide: document.documentElement.scrollWidth - window.innerWidth, clipped: [], over: [], figures: [] };
  const up = (node) => node.assignedSlot || node.parentElement || (node.getRootNode().host || null);
  const lines = [];
  const look = (node) => {
    if (node.nodeType === 3 && node.textContent.trim()) return text(node);
    if (node.nodeType !== 1 && node.nodeType !== 11) return;
    if (node.nodeType === 1) {
      const style = getComputedStyle(node);
      if (style.display === "none" || style.visibility === "hidden") return;
      if (["STYLE", "SCRIPT", "OPTION"].includes(node.tagName)) return;
      if (node.id === "skeleton") return;
      if (node.classList.contains("bk-Figure")) {
        const box = node.getBoundingClientRect();
        found.figures.push([box.width, box.height]);
        return;
      }
    }
    for (const one of [...(node.shadowRoot ? node.shadowRoot.childNodes : []), ...node.childNodes]) look(one);
  };
  const text = (node) => {
    const button = node.parentElement.closest("button");
    if (button && button.scrollWidth > button.clientWidth + 1) found.clipped.push("button: " + button.textContent);
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects()) {
      if (box.width < 5) continue;  // a space that hangs at the end of a line
      const seen = { left: box.left, right: box.right, top: box.top, bottom: box.bottom };
      let prose = true;
      for (let at = node.parentElement; at; at = up(at)) {
        const style = getComputedStyle(at), own = at.getBoundingClientRect();
        prose = prose && !(at.tagName === "PRE" && style.whiteSpace === "pre");
        if (style.overflowX !== "visible") {
          const cut = box.left < own.left - 1 || box.right > own.right + 1;
          if (prose && cut) found.clipped.push(node.textContent.slice(0, 40));
          seen.left = Math.max(seen.left, own.left); seen.right = Math.min(seen.right, own.right);
        }
        if (style.overflowY !== "visible") {
          const cut = box.top < own.top - 2 || box.bottom > own.bottom + 2;
          if (cut && ["hidden", "clip"].includes(style.overflowY) && seen.bottom - seen.top > 2)
            found.clipped.push("down: " + node.textContent.slice(0, 40));
          seen.top = Math.max(seen.top, own.top); seen.bottom = Math.min(seen.bottom, own.bottom);
        }
      }
      if (seen.right - seen.left > 1 && seen.bottom - seen.top > 1) lines.push({ node, ...seen });
    }
  };
  look(document.body);
  lines.forEach((a, i) => lines.slice(i + 1).forEach((b) => {
    const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (a.node !== b.node && across > 2 && down > 4)
      found.over.push([a.node.textContent.slice(0, 30), b.node.textContent.slice(0, 30)]);
  }));
  return found;
}"""


def taken(seen: Seen, name: str) -> None:
    """A picture of what is seen, where pictures are asked for: under the name that the docs use, else under its own."""
    folder, kept = os.environ.get("BAYESCAL_PICTURES"), SHOWN.get(name)
    if folder is None or (kept is None and "BAYESCAL_ALL" not in os.environ):
        return
    seen.page.wait_for_timeout(400)
    seen.page.screenshot(path=Path(folder) / f"{kept or name.replace(' ', '_')}.png")


@pytest.mark.parametrize("ground", ["light", "dark"])
@pytest.mark.parametrize("width", SIZES)
def test_nothing_is_clipped_and_nothing_overlaps(begun: Bench, width: int, ground: str) -> None:
    with opened(begun.url, width=width, height=SIZES[width], dark=ground == "dark") as seen:
        seen.looked()
        shown = f"{ground} {width}"
        taken(seen, f"start {shown}")
        if len(seen.steps()) == 1:
            seen.point("bias.drift")
            taken(seen, f"preview {shown}")
            seen.add("bias.drift").looked().add("bias.thermal_lag").looked()
        taken(seen, f"found {shown}")
        wrong: dict[str, Any] = {}
        for name in TABS:
            seen.tab(name).page.wait_for_timeout(700)
            taken(seen, f"{name} {shown}")
            found = seen.page.evaluate(MEASURED)
            small = [f for f in found["figures"] if f[1] < FIGURE[0] or f[0] < FIGURE[1]]
            if found["wide"] > 0 or found["clipped"] or found["over"] or small:
                wrong[name] = {**found, "figures": small}
        assert not wrong
        seen.tab("The error").clean()


def serious(page: Any) -> list[tuple[str, str]]:
    """What axe-core finds that is serious or critical, with the element."""
    kept = pytest.importorskip("axe_playwright_python", reason="axe-core is not here")
    page.evaluate(f"{(Path(kept.__file__).parent / 'axe.min.js').read_text('utf-8')};0")
    found = page.evaluate("() => axe.run(document, { resultTypes: ['violations'] })")["violations"]
    return [
        (one["id"], node["html"][:80])
        for one in found
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"]
    ]


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_axe_finds_nothing_serious(begun: Bench, ground: str) -> None:
    dark = ground == "dark"
    with opened(begun.url, dark=dark) as seen:
        found = {}
        for name in TABS:
            seen.looked().tab(name).page.wait_for_timeout(700)
            at_rest = {"name": "Change … bias.constant", "disabled": False}
            seen.page.get_by_role("button", **at_rest).wait_for()
            found[name] = serious(seen.page)
        seen.tab("Report").press("Write the report")
        report = seen.download("Download report.html").read_text("utf-8")
    with browser(dark=dark) as seen:
        seen.page.set_content(report)
        found["the report"] = serious(seen.page)
    assert not any(found.values()), found
