"""The report for sign-off: complete, self-contained, escaped, readable by those who cannot see its figures."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import bayescal as bc
from bayescal._data.column import Source
from bayescal._report import report as report_room
from bayescal._report import report_text
from bayescal._report.section import Chapter, chapters, of_folder
from bayescal_models import accelerometer_triad, mems_gyro, ng_accelerometer
from tests.support.browser import Opened, chromium
from tests.support.command_line import needs_installation, run
from tests.support.reported import HIDDEN, Page, trail, unpaint
from tests.support.tiers import slow_but

FIGURES = {
    "The error, step by step",
    "What is missing from",
    "Posterior of each unknown",
    "The most correlated unknowns",
    "Posterior over prior standard deviation",
    "Readings against their predictive probabilities",
    "Residuals of the last model against temperature",
}
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
        "not converged": lambda: bc.NotConverged("The chains disagree.", lost),
        "a folder": lambda: of_folder(folder, instruments=[mems_gyro.INSTRUMENT]),
    }

    @cache
    def page(kind: str) -> Page:
        path = folder / f"{kind.replace(' ', '_')}.html"
        with pytest.MonkeyPatch.context() as patch:
            if kind == "a folder":  # its pictures are those of the trail
                unpaint(patch)
            return Page(bc.report(given[kind](), path))

    return page


def nasty(calibration: bc.Calibration) -> bc.Calibration:
    """The same of readings whose labels and file name would be HTML, and a formula."""
    readings = calibration.readings
    label = np.full(len(readings), NASTY)
    readings = replace(
        readings.with_column("device", label),
        sources=(Source(NASTY, "0" * 64, len(readings)),),
        flags=(NASTY,),
    )
    levels = {**calibration.levels, "run": (NASTY, *calibration.levels["run"][1:])}
    return replace(calibration, readings=readings, levels=levels)


KINDS = slow_but(
    ["a trail"], ["a trail", "a folder", "one calibration", "several", "not converged"]
)


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


@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_there(pages, kind: str) -> None:
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", pages(kind).source)
    wanted = FIGURES if kind != "not converged" else FIGURES - {"What is missing from"}
    absent = [f for f in wanted if not any(c.startswith(f) for c in captions)]
    assert not absent
    assert len(captions) == len(pages(kind).all("svg")) + len(pages(kind).all("img"))


@pytest.mark.parametrize(
    "kind", [pytest.param("several", marks=pytest.mark.slow), "a trail", "a folder"]
)
def test_the_page_tells_what_was_missing_and_how_the_error_fell(pages, kind: str) -> None:
    text = " ".join(pages(kind).text.split())
    _first, _final = (f"{s.rmse_fitted:.3g}" for s in trail().steps)
    assert f"Finding: {HIDDEN}" in text
    assert "temperature 30" in text  # the range that was covered


def test_intervals_are_not_confused(pages) -> None:
    """U is twice the standard uncertainty and says k; the credible interval has a column of its own."""
    draws = trail().calibration.samples(
        HIDDEN
    )  # averaged over structures, as everything that leaves
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
    assert page.text.count(NASTY) >= 4  # device, file, flag
    assert "<script" not in page.source
    assert "<img" not in page.source


def test_the_budget_is_in_it(pages) -> None:
    found = bc.budget(trail().calibration)
    assert f"(k = {found.k:g})" in pages("a trail").text
    assert all(c.name in pages("a trail").text for c in found.coefficients)


def test_readings_of_two_tests_make_two_chapters() -> None:
    not_asked = bc.Verdict(False, ("Stopped early.",))  # what is missing is then not looked for
    final = replace(trail().final.calibration, verdict=not_asked)
    shifted = final.readings.with_column("output", final.readings["output"] + 1e-3)
    other = replace(final, readings=shifted)
    made = chapters([final, final, other])
    assert [len(c.data["steps"]) for c in made] == [2, 1]
    assert made[1].calibration is other


@pytest.mark.slow
@needs_installation
def test_the_command_writes_it_or_nothing(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    ran = run("report", folder, "-o", out)
    assert (ran.status, ran.out) == (0, f"written: {out}\n")
    assert f"Finding: {HIDDEN}" in " ".join(Page(out).text.split())


def test_a_folder_without_a_calibration_is_refused(folder: Path, tmp_path: Path) -> None:
    own = [mems_gyro.INSTRUMENT]
    data = json.loads((folder / "result.json").read_text("utf-8"))
    (tmp_path / "result.json").write_text(json.dumps(data), "utf-8")
    with pytest.raises(bc.InputError):
        of_folder(tmp_path, instruments=own)


def test_an_interrupted_write_leaves_the_old_report_whole(tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "report.html"
    out.write_text("the old one", "utf-8")

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(report_room, "page", lambda *_: "the new one")
    monkeypatch.setattr(Path, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        bc.report(trail(), out)
    assert out.read_text("utf-8") == "the old one"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("nothing", "report.html"),
        ([], "report.html"),
        (None, "report.pdf"),
    ],
)
def test_what_makes_no_report_is_refused(tmp_path: Path, given, name: str) -> None:
    with pytest.raises(bc.InputError):
        bc.report(trail() if given is None else given, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.nightly
def test_it_prints_on_one_page_and_four_of_appendices(pages, folder: Path) -> None:
    """A4, by Chromium: what is signed on the first."""
    chromium()
    page = pages("a trail")
    assert page.source.index('class="two result"') < page.source.index('class="appendix"')
    printed = Opened(folder / "a_trail.html", folder).pdf().read_bytes()
    assert 2 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 5


def test_columns_that_the_equation_takes_are_said_to_be_used() -> None:
    calibration = bc.fit(
        ng_accelerometer.INSTRUMENT.baseline(), ng_accelerometer.simulate(seed=1), bc.LeastSquares()
    )
    part = {row["name"]: row["part"] for row in report_text.ranges(calibration)}
    assert {part[n] for n in ("tilt", "position_angle", "temperature")} == {
        "the model depends on it"
    }
    assert part["lab_temperature"] == report_text.UNUSED


def test_a_customer_is_not_told_how_to_write_an_instrument(monkeypatch) -> None:
    monkeypatch.setattr(report_text, "ok", lambda _: True)
    used = SimpleNamespace(model=SimpleNamespace(instrument=accelerometer_triad.INSTRUMENT))
    found, why = report_room._budget(cast("Chapter", SimpleNamespace(used=used)))
    assert found is None and "use=" not in why


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
