"""The report for sign-off: one self-contained HTML file.

All text from files (names of files, devices, effects) is escaped; the page has no script. Figures are inline SVG in
the text's colour, with unique ids and without external references.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import Check, tabulate_check
from bayescal._calibration.storage import identity, list_sources
from bayescal._core.annex import load_entries, load_entry
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import BayescalError, InputError, NotDrawn
from bayescal._core.formatting import number, probability
from bayescal._core.quoting import load_template
from bayescal._core.settings import Settings
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Effect
from bayescal._report import plots, report_text
from bayescal._report.result_json import Chapter, Foreword, ForewordSource, chapters
from bayescal._search.discover import candidates_table, group_confounded, group_untested
from bayescal._search.search_path import SearchPath
from bayescal._use.budget import Budget, budget
from bayescal._use.compensation_program import list_average_claims

SVG = {"svg.fonttype": "none", "svg.hashsalt": "bayescal", "font.size": 9.0}
MAX_RESIDUAL_PANELS = 4  # pictures of residuals in a chapter


@dataclass(frozen=True)
class Picture:
    """A figure of the page, as HTML, with its caption."""

    html: Markup
    caption: str  # text below the figure


class Pictures:
    """Figures of one page, drawn with unique ids; `failed`: errors of the figures that could not be drawn."""

    def __init__(self) -> None:
        self.count, self.failed = 0, list[NotDrawn]()

    def draw(self, plot: Callable[[], Figure], caption: str) -> Picture:
        self.count += 1
        try:
            with plots.use_own_style(**SVG):
                return Picture(
                    embed_svg(render_svg(plot()), f"f{self.count}-", caption + ALT_SUFFIX), caption
                )
        except InputError:
            raise
        except Exception as error:  # the page is written without the figure
            self.failed.append(NotDrawn(f"A picture ({caption})", error))
            return Picture(Markup("<p>{}.</p>").format(self.failed[-1]), caption)

    def draw_residuals(self, calibration: Calibration, checks: Check) -> list[Picture]:
        """Draw the residuals of the last model against each covariate, at most `MAX_RESIDUAL_PANELS`, worst first."""

        def panel(against: str) -> Figure:
            figure = plots.residuals(calibration, checks, against)
            figure.set_size_inches(4.6, 2.9)
            return figure

        names = [e.covariate for e in checks.entries if not e.by_group][:MAX_RESIDUAL_PANELS]
        body, text = plots.compute_body_temperature, "Residuals of the last model against "
        lags = {n: "lagged " * (body(calibration, n) is not None) for n in names}
        return [self.draw(partial(panel, n), f"{text}{lag}{n}") for n, lag in lags.items()]

    def draw_missing(self, found: dict[str, Any], title: str) -> Picture | None:
        """Draw the log Bayes factors of `found`, an entry of `missing` in result.json; None if it has no factor."""
        if all(c["log_bayes_factor"] is None for c in found["candidates"]):
            return None
        return self.draw(lambda: plots.missing(found), f"Effects missing from {title}")

    def draw_errors(self, steps: Sequence[dict[str, Any]]) -> Picture:
        """Draw the rms errors of the steps of a search, given as `steps` in result.json."""
        return self.draw(lambda: plots.trail({"steps": steps}), "The error, step by step")


ALT_SUFFIX = ". The tables of this report contain the same data."


def render_svg(figure: Figure) -> str:
    """Return a figure as the text of an SVG file without a background."""
    for patch in (figure.patch, *(ax.patch for ax in figure.axes)):
        patch.set_visible(False)
    out = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    FigureCanvasSVG(figure).print_svg(out, metadata=metadata)  # `savefig` would draw it twice
    return out.getvalue()


def embed_svg(svg: str, prefix: str, alt: str) -> Markup:
    """Convert Matplotlib's SVG, whose labels are already escaped, to inline SVG for the page.

    Black becomes the page's text colour, fonts become the page's, ids are prefixed by `prefix`, and `alt` becomes the
    ARIA label. External references (document type, metadata) and comments, which repeat the labels, are removed.
    """
    markup = svg[svg.index("<svg") :]
    markup = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", markup, flags=re.DOTALL)
    markup = re.sub(r"\bid=\"([^\"]+)\"", rf'id="{prefix}\1"', markup)
    markup = re.sub(r"(url\(|href=\")#", rf"\1#{prefix}", markup)
    markup = markup.replace("#000000", "currentColor")
    markup = re.sub(r"font: (\w+ )?([\d.]+)px [^;\"]+", r"font-size: \2px", markup)
    size = re.search(r'viewBox="0 0 ([\d.]+)', markup)
    width = float(size[1]) * 4 / 3 if size else 600.0  # points to CSS pixels
    opening, content = markup.split(">", 1)
    view = re.search(r'viewBox="[^"]*"', opening)
    svg_tag = f'<svg role="img" aria-label="{escape(alt)}" style="max-width:{width:.0f}px"'
    return Markup(f"{svg_tag} {view[0] if view else ''}>{content}")


NO_STIMULUS = (
    "No budget by source: the instrument has no single stimulus to compensate for. Uncertainties are under "
    "Coefficients, for three axes also that of a compensated vector, whose covariance correction.h and .py return."
)
MAX_ROWS = 60  # rows of a table of candidates; a table of coefficients has up to four times as many


def report(
    given: Calibration | SearchPath | Chapter | list[Any],
    path: str | Path,
    *,
    title: str = "",
    effects: Iterable[Effect] = (),
    certificate: str | Path | ForewordSource | None = None,
    decisions: ForewordSource | None = None,
) -> Path:
    """Write the report for sign-off.

    Args:
        given: a calibration or a search path, or a list of them: each has a chapter. The missing effects of a
            calibration are searched for, which takes a few seconds; a search path includes them.
        path: file to write, ending in .html.
        title: title of the report.
        effects: user-defined effects, further candidates of the search for missing effects.
        certificate: TOML file of a certificate's statements: device, serial number, place, operator, ambient
            conditions, standards, dates.
        decisions: conformity decisions and their rule, from `bc.decide`, for the first section.

    Returns:
        The path.

    Raises:
        InputError: `given` has no calibration, `path` has another suffix or cannot be written, or `certificate` has an
            unknown entry.
        NotDrawn: a figure could not be drawn; the page is written with a note instead.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"a report is an HTML file: its name must end in .html, not {path.name!r}")
    if isinstance(certificate, str | Path):
        certificate = load_entry("certificate", "certificate=")(certificate)
    parts = chapters(given if isinstance(given, list | tuple) else [given], effects)
    forewords = [part.foreword(parts) for part in (certificate, decisions) if part is not None]
    pictures = Pictures()
    output_path = write_text(render_page(parts, pictures, title, forewords), path)
    if pictures.failed:
        raise pictures.failed[0]
    return output_path


def render_page(
    parts: list[Chapter], pictures: Pictures, title: str = "", forewords: Sequence[Foreword] = ()
) -> str:
    """Return the report as HTML, with `forewords` as sections before the first chapter."""
    filters = {
        "number": number,
        "unit_label": unit_label,
        "probability": probability,
        "minus": lambda text: re.sub(r"(?<![\w-])-(?=\d)|(?<=[\d)]e)-", "−", text),
        "lines": lambda text: Markup("<br>").join(text.split("\n")),
        "measured": report_text.format_with_unit,
    }
    functions = (
        *(list_average_claims, candidates_table, tabulate_check, compute_budget, group_confounded),
        *(group_untested, identity, list_sources),
    )
    return load_template("bayescal._report", "report.html.j2", filters, autoescape=True).render(
        title=title or "Calibration report",
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        chapters=parts,
        pictures=pictures,
        text=report_text,
        coefficient_tables=load_entries("coefficient_tables"),
        k=report_text.K,
        max_rows=MAX_ROWS,
        default_settings=asdict(Settings()),
        before=forewords,
        **{function.__name__: function for function in functions},
    )


def compute_budget(chapter: Chapter) -> tuple[Budget | None, str]:
    """Return a chapter's uncertainty budget at the default point and an empty text; if there is none, None and why."""
    if not chapter.data["verdict"]["ok"]:
        return None, "There is no uncertainty budget, since the result is not reliable."
    if chapter.used.model.instrument.use is None:
        return None, NO_STIMULUS
    try:
        return budget(chapter.used, k=report_text.K).in_output_unit(), ""
    except BayescalError as error:
        return None, f"There is no budget: {error}"
