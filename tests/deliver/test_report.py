"""The report for sign-off: complete, self-contained, escaped, readable by those who cannot see its figures."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from tests.support.browser import Opened, chromium
from tests.support.reported import HIDDEN, Page, trail
from tests.support.tiers import slow_but

NASTY = "<script>alert('x')</script> & \"$\\frac{$ $E=mc^2$\" <img src=//x.org/y.png>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What `bayescal calibrate --out` leaves."""
    made = tmp_path_factory.mktemp("result")
    trail().save(made)
    return made


@pytest.fixture(scope="module")
def pages(folder: Path) -> Callable[[str], Page]:
    """A report of a kind, made when it is first asked for."""
    first, final = (s.calibration for s in trail().steps)
    lost = replace(final, verdict=bc.Verdict(False, ("The chains disagree.",), sampler="NUTS"))
    given = {
        "one calibration": lambda: nasty(final),
        "several": lambda: [first, final],
        "a trail": trail,
        "not converged": lambda: lost,
    }

    @cache
    def page(kind: str) -> Page:
        path = folder / f"{kind.replace(' ', '_')}.html"
        return Page(bc.report(given[kind](), path))

    return page


def nasty(calibration: bc.Calibration) -> bc.Calibration:
    """The same of readings whose labels and flags would be HTML, and a formula."""
    readings = calibration.readings
    label = np.full(len(readings), NASTY)
    readings = replace(readings.with_column("device", label), flags=(NASTY,))
    levels = {**calibration.levels, "run": (NASTY, *calibration.levels["run"][1:])}
    return replace(calibration, readings=readings, levels=levels)


KINDS = slow_but(["a trail"], ["a trail", "one calibration", "several", "not converged"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_needs_nothing_else_and_runs_nothing(pages, kind: str) -> None:
    page = pages(kind)
    assert not page.elsewhere
    assert not page.unclosed
    tags = {tag for tag, _ in page.elements}
    assert not tags & {"script", "link", "iframe", "object", "embed", "form", "base"}
    assert not [a for _, a in page.elements if any(name.startswith("on") for name in a)]
    (policy,) = [m for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in str(policy["content"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_can_be_read_without_seeing_it(pages, kind: str) -> None:
    page = pages(kind)
    assert page.all("html") == [{"lang": "en"}]
    assert page.headings[0] == 1
    assert page.headings.count(1) == 1
    steps = np.diff(page.headings)
    assert steps.max() <= 1, "a heading skips a level"
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(ids) == len(set(ids))
    links = [str(a["href"]) for a in page.all("a")]
    assert {link[1:] for link in links} <= set(ids)
    assert all(a.get("role") == "img" and a.get("aria-label") for a in page.all("svg"))
    assert all(a.get("alt") for a in page.all("img"))
    assert len(page.all("caption")) == len(page.all("table")) >= 6
    assert all(a.get("scope") in ("col", "row") for a in page.all("th"))


def test_intervals_are_not_confused(pages) -> None:
    """U is twice the standard uncertainty and says k; the credible interval has a column of its own."""
    average = trail().calibration  # over structures, as everything that leaves
    draws = average.samples(HIDDEN)[average.inclusion_masks[HIDDEN]]
    page = pages("a trail")
    heads = re.findall(r"<th scope=\"col\"[^>]*>(.*?)</th>", page.source)
    assert {"value ± U (k = 2)", "k = 2 interval", "95 % credible interval"} <= set(heads)
    table = page.source.split(
        "Coefficients, between-group standard deviations, shapes, noise</caption>"
    )[1]
    row = re.search(rf'<tr><th scope="row" class="t">{HIDDEN}</th>(.*?)</tr>', table)
    assert row is not None
    _, value, u, k2, credible, _ = re.findall(r"<td[^>]*>(.*?)</td>", row[1])
    expanded = float(value.split(" ± ")[1])
    assert expanded == pytest.approx(2 * draws.std(ddof=1), rel=0.05)
    assert float(u) == pytest.approx(draws.std(ddof=1), rel=0.05)
    low, high = map(float, k2.replace("−", "-").split(" to "))
    assert high - low == pytest.approx(4 * draws.std(ddof=1), rel=0.05)
    ends = list(map(float, credible.replace("−", "-").split(" to ")))
    assert ends == pytest.approx(np.quantile(draws, [0.025, 0.975]), abs=0.1 * draws.std())


@pytest.mark.slow
def test_names_from_files_are_text(pages) -> None:
    page = pages("one calibration")
    assert page.text.count(NASTY) >= 2  # device, run
    assert "<script" not in page.source
    assert "<img" not in page.source


@pytest.mark.nightly
@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.slow)])
def test_a_browser_shows_it_whole_and_asks_for_nothing(pages, folder: Path, width: int) -> None:
    """Skipped where there is no Chromium. The content policy would log a request that leaves the page."""
    chromium()
    assert pages("a trail")
    opened = Opened(folder / "a_trail.html", folder)
    picture, console = opened.screenshot(width, 2000)
    assert picture.stat().st_size > 20_000
    assert console == []
    assert Page(opened.dom(width)).all("svg") == pages("a trail").all("svg")


def test_time_constants_stand_on_the_page_that_is_signed(pages) -> None:
    model = trail().final.calibration.model
    names = [e.shape_name(shape) for e in model.effects for shape in e.shapes]
    signed = pages("a trail").source.split("<caption>Result</caption>")[1].split("</table>")[0]
    assert names
    assert all(f">{name}</th>" in signed for name in names)
