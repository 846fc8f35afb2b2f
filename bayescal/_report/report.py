"""The report for sign-off: one HTML file that needs nothing else.

Everything that comes from files (names of files, devices, effects) is escaped; nothing in the page is run. Figures are
SVG within the page: one colour with its text, names of their own, nothing from elsewhere.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import Check, check_table
from bayescal._calibration.storage import identity, sources_of
from bayescal._core.annex import first_offered, offered
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import BayescalError, InputError, NotDrawn
from bayescal._core.formatting import number, probability
from bayescal._core.templates import template
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS
from bayescal._report import plots, report_text
from bayescal._report.result_json import RESULT, Chapter, Foreword, Foreworded, chapters
from bayescal._search.discover import candidates_table, confounded, not_tested
from bayescal._search.search_path import SearchPath
from bayescal._use.budget import Budget, budget
from bayescal._use.compensation_program import averaged_over

SVG = {"svg.fonttype": "none", "svg.hashsalt": "bayescal", "font.size": 9.0}
RESIDUAL_PANELS = 4  # of residuals


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    body: Markup  # as HTML
    caption: str  # below it


class Pictures:
    """Draws the pictures of one page, so that no two share an id."""

    def __init__(self, refused: tuple[type[Exception], ...] = ()) -> None:
        self.count, self.refused, self.failed = 0, (InputError, *refused), list[NotDrawn]()

    def draw(self, make: Callable[[], Figure], caption: str) -> Picture:
        self.count += 1
        try:
            with plots.own_style(**SVG):
                return Picture(
                    inline(as_svg(make()), f"f{self.count}-", caption + ELSEWHERE), caption
                )
        except self.refused:
            raise
        except Exception as error:  # whatever it is, all else of the page can be read
            self.failed.append(NotDrawn(f"A picture ({caption})", error))
            return Picture(Markup("<p>{}.</p>").format(self.failed[-1]), caption)

    def residuals(self, calibration: Calibration, found: Check) -> list[Picture]:
        """Residuals of the last model against the covariates, the worst first, a picture each."""

        def panel(against: str) -> Figure:
            figure = plots.residuals(calibration, found, against)
            figure.set_size_inches(4.6, 2.9)
            return figure

        names = [e.against for e in found.entries if not e.by_group][:RESIDUAL_PANELS]
        return [
            self.draw(partial(panel, n), f"Residuals of the last model against {n}") for n in names
        ]

    def error(self, steps: Sequence[dict[str, Any]]) -> Picture:
        """The errors of steps, as in result.json."""
        return self.draw(lambda: plots.trail({"steps": steps}), "The error, step by step")


ELSEWHERE = ". The tables of this report hold the same."


def as_svg(figure: Figure) -> str:
    """A figure as an SVG without a background."""
    for patch in (figure.patch, *(ax.patch for ax in figure.axes)):
        patch.set_visible(False)
    out = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    FigureCanvasSVG(figure).print_svg(out, metadata=nothing)  # `savefig` would draw it twice
    return out.getvalue()


def inline(svg: str, prefix: str, alt: str) -> Markup:
    """An SVG, as Matplotlib writes it with labels escaped, as part of a page.

    Black becomes the colour of the page's text, fonts the page's, ids are prefixed, and all that names another place
    (document type, metadata) goes, and the comments, which repeat the labels.
    """
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r"\bid=\"([^\"]+)\"", rf'id="{prefix}\1"', body)
    body = re.sub(r"(url\(|href=\")#", rf"\1#{prefix}", body)
    body = body.replace("#000000", "currentColor")
    body = re.sub(r"font: (\w+ )?([\d.]+)px [^;\"]+", r"font-size: \2px", body)
    size = re.search(r'viewBox="0 0 ([\d.]+)', body)
    width = float(size[1]) * 4 / 3 if size else 600.0  # points to CSS pixels
    opening, rest = body.split(">", 1)
    view = re.search(r'viewBox="[^"]*"', opening)
    head = f'<svg role="img" aria-label="{escape(alt)}" style="max-width:{width:.0f}px"'
    return Markup(f"{head} {view[0] if view else ''}>{rest}")


# What the layout meets where a result.json is not as it was written, beside errors of its template.
OF_DAMAGE = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
NO_STIMULUS = (
    "There is no budget: nothing is measured with this instrument in use, so that the uncertainties are those of its "
    "coefficients."
)
MOST_ROWS = 60  # rows of a table of candidates or coefficients that are shown


def report(
    given: Calibration | SearchPath | Chapter | list[Any],
    path: str | Path,
    *,
    title: str = "",
    effects: Iterable[Effect] = (),
    certificate: str | Path | Foreworded | None = None,
    decisions: Foreworded | None = None,
) -> Path:
    """Write the report for sign-off.

    Args:
        given: a calibration or a trail, or several, a chapter each. What a calibration lacks is looked for, which
            takes a few seconds; a trail brings all that with it.
        path: of the file, ending in .html.
        title: of the report.
        effects: of your own, candidates where what a calibration lacks is looked for; its own are so anyway.
        certificate: TOML file of what a certificate states beside the numbers: device, serial number, place,
            operator, ambient conditions, standards, dates.
        decisions: about limits, as `bc.decide` made them: they stand before everything else, with their rule.

    Returns:
        The path.

    Raises:
        InputError: nothing to report of, another suffix, a place that cannot be written to, or a certificate that
            states something unknown; a folder's result that is not as it was written.
        NotDrawn: a picture could not be drawn; the page is written, and says so in its place.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"a report is HTML: name the file …html, not {path.name!r}")
    if not path.parent.is_dir():
        raise InputError(
            f"{str(path)!r} cannot be written: there is no folder {str(path.parent)!r}"
        )
    from jinja2 import TemplateError  # only a report needs it

    if isinstance(certificate, str | Path):
        certificate = first_offered("certificate", "certificate=")(certificate)
    several = given if isinstance(given, list | tuple) else [given]
    found = chapters(several, effects)
    before = [one.foreword(found) for one in (certificate, decisions) if one is not None]
    folders = [str(c.folder) for c in found if c.folder is not None]
    pictures = Pictures(OF_DAMAGE if folders else ())
    try:
        text = page(found, pictures, title, before)
    except (TemplateError, *OF_DAMAGE) as e:
        if not folders:
            raise
        raise InputError(
            f"{RESULT} in {' or '.join(folders)} is not as it was written ({type(e).__name__}: {e}): calibrate again, "
            "or give the calibration alone"
        ) from None
    written = write_text(text, path)
    if pictures.failed:
        raise pictures.failed[0]
    return written


def page(
    found: list[Chapter],
    pictures: Pictures,
    title: str = "",
    before: Sequence[Foreword] = (),
) -> str:
    """The report as HTML."""
    filters = {
        "number": number,
        "unit_label": unit_label,
        "probability": probability,
        "minus": lambda text: text.replace("-", "−"),
        "lines": lambda text: Markup("<br>").join(text.split("\n")),
        "measured": report_text.measured,
    }
    return template("bayescal._report", "report.html.j2", filters, autoescape=True).render(
        title=title or "Calibration report",
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        chapters=[_chapter(c, pictures) for c in found],
        k=report_text.K,
        before=before,
    )


def _chapter(chapter: Chapter, pictures: Pictures) -> dict[str, Any]:
    """All that the template lays out for one set of readings."""
    c, data = chapter.calibration, chapter.data
    rows = report_text.coefficients(chapter)
    signed = report_text.signed(rows, c.model)
    found, no_budget = _budget(chapter)
    ends = sorted({0, len(data["steps"]) - 1})
    checks = [check_table([r for r in data["check"] if r["step"] == step]) for step in ends]
    own, readings = ("conclusion", "effects", "files", "steps", "convergence"), c.readings
    return {
        **{name: getattr(report_text, name)(chapter) for name in own},
        "instrument": c.model.instrument,
        "ok": data["verdict"]["ok"],
        "devices": readings.groups("device")[0] if readings.has("device") else (),
        "channels": [name for name in dict.fromkeys(s.output for s in readings.sources) if name],
        "data": data,
        "final": data["steps"][-1],
        "identity": identity(chapter.used),
        "of_the_model": None if chapter.average is None else identity(c),
        "averaged": averaged_over(chapter.used),
        "sources": sources_of(readings),
        "groups": _groups(data),
        "signed": signed,
        "further": len(rows.rows) - len(signed.rows) + len(c.model.fixed),
        "ranges": report_text.ranges_table(report_text.ranges(chapter.used)),
        "noise": c.model.noise.in_words,
        "reference": [(n, f"{v:g} {unit_label(u)}") for n, (v, u) in c.held_at.items()],
        "coefficients": replace(rows, rows=rows.rows[: 4 * MOST_ROWS]),
        "further_tables": [pair for make in offered("coefficient_tables") for pair in make(data)],
        "check": chapter.check,
        "checks": [*zip(ends, checks, strict=True)],
        "discoveries": [_discovery(m, data, pictures) for m in data["missing"]],
        "budget": found,
        "budget_tables": found and [replace(t, rows=t.rows[:MOST_ROWS]) for t in found.tables()],
        "no_budget": no_budget,
        "pictures": _pictures(chapter, pictures),
    }


def _groups(data: dict[str, Any]) -> str:
    """How many runs, cells, axes and devices, where there are several."""
    counted = [(k, data["readings"]["groups"].get(k, 0)) for k in GROUPS]
    plural = {"axis": "axes"}
    return ", ".join(f"{n} {plural.get(k, k + 's')}" for k, n in counted if n > 1)


def _discovery(found: dict[str, Any], data: dict[str, Any], pictures: Pictures) -> dict[str, Any]:
    """What was missing from one step."""
    title = data["steps"][found["step"]]["title"]
    tested = [c for c in found["candidates"] if c["kind"] != "not testable"]
    shown = candidates_table(found["candidates"])
    return {
        "step": found["step"],
        "title": title,
        "nothing": found["nothing_missing_probability"],
        "unstated": found.get("unstated", ""),
        "sets": found["sets"],
        "leads": [c["effect"] for c in tested if c["kind"] == "lead"],
        "table": replace(shown, rows=shown.rows[:MOST_ROWS]),
        "alike": [", ".join(group) for group in confounded(found["candidates"])],
        "not_testable": not_tested(found["candidates"]),
        "picture": pictures.draw(lambda: plots.missing(found), f"What is missing from {title}")
        if any(c["log_bayes_factor"] is not None for c in found["candidates"])
        else None,
    }


def _budget(chapter: Chapter) -> tuple[Budget | None, str]:
    """The budget at the middle of what was covered; or why there is none."""
    if not chapter.data["verdict"]["ok"]:
        return None, "There is no budget of a result that is not reliable."
    if chapter.used.model.instrument.use is None:
        return None, NO_STIMULUS
    try:
        return budget(chapter.used, k=report_text.K).shown(), ""
    except BayescalError as error:
        return None, f"There is no budget: {error}"


def _pictures(chapter: Chapter, pictures: Pictures) -> dict[str, Any]:
    c = chapter.calibration
    of_last = pictures.residuals(c, chapter.check)
    offers = ((caption, make) for offer in offered("pictures") for caption, make in offer(c))
    front = next((pictures.draw(make, caption) for caption, make in offers), None)
    return {
        "last": of_last if front else of_last[1:],
        "front": front or next(iter(of_last), None),  # on the page that is signed
        "error": pictures.error(chapter.data["steps"]),
    }
