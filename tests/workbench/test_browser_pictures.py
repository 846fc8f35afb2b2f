"""Pictures of every pane at three widths, light and dark: made, whole, and within their widths.

`make test-all ARGS='-k pictures'` with BAYESCAL_PICTURES=docs/workbench writes those that the docs show.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.support.command_line import needs_installation
from tests.workbench.real_page import Bench, Seen, opened

pytestmark = [needs_installation, pytest.mark.nightly]
TABS = (
    *("Side by side", "Verdict", "Budget", "Decision", "Next experiment"),
    *("Allan deviation", "Report", "Export", "Python", "File", "Describe"),
)
SIZES = {"1280": (1280, 800), "768": (768, 1024), "1920": (1920, 1080)}
SHOWN = {  # by the docs
    "start 1280": "start",
    "preview 1280": "preview",
    "found 1280": "found",
    "dark 768": "narrow_dark",
}
CUT = """() => {
  const cut = [];
  const walk = (node) => {
    for (const one of [...(node.shadowRoot ? node.shadowRoot.children : []), ...node.children]) walk(one);
    if (node.tagName !== "BUTTON") return;
    if (node.scrollWidth > node.clientWidth + 1) cut.push(node.textContent);
  };
  walk(document.body);
  return cut;
}"""


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    asked = os.environ.get("BAYESCAL_PICTURES")
    return Path(asked) if asked else tmp_path_factory.mktemp("pictures")


def taken(seen: Seen, folder: Path, name: str) -> None:
    """A picture of what is seen: into the docs under the name that they use, else under its own."""
    kept = SHOWN.get(name)
    if "BAYESCAL_PICTURES" in os.environ and kept is None and "BAYESCAL_ALL" not in os.environ:
        return
    folder.mkdir(parents=True, exist_ok=True)
    seen.page.wait_for_timeout(400)
    seen.page.screenshot(path=folder / f"{kept or name.replace(' ', '_')}.png")


@pytest.mark.parametrize("width", SIZES)
@pytest.mark.parametrize("ground", ["light", "dark"])
def test_nothing_is_cut_off(begun: Bench, pictures: Path, width: str, ground: str) -> None:
    wide, high = SIZES[width]
    with opened(begun.url, width=wide, height=high, dark=ground == "dark") as seen:
        seen.looked()
        if len(seen.steps()) == 1 and ground == "light":
            taken(seen, pictures, f"start {width}")
            seen.point("bias.drift")
            taken(seen, pictures, f"preview {width}")
            seen.add("bias.drift").looked().add("bias.thermal_lag").looked()
            taken(seen, pictures, f"found {width}")
        taken(seen, pictures, f"{ground} {width}")
        for name in TABS:
            seen.tab(name)
            taken(seen, pictures, f"{name} {ground} {width}")
        across = seen.page.evaluate("() => document.documentElement.scrollWidth")
        assert across <= wide, "the page is wider than the window"
        assert not seen.page.evaluate(CUT), "text of these buttons does not fit"
        seen.tab("The error").clean()
