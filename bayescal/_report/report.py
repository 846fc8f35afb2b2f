"""The report for sign-off: one HTML file that needs nothing else.

Everything that comes from files (names of files, devices, effects) is escaped; nothing in the page is run.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.description import identity, sources_of
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import BayescalError, InputError
from bayescal._core.formatting import number, probability, with_error
from bayescal._core.templates import template
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS
from bayescal._report import figures, sentences, tables
from bayescal._report.certificate import Certificate, read_certificate
from bayescal._report.result_json import is_quiet
from bayescal._report.section import Chapter, chapters
from bayescal._report.under_way import RESULT
from bayescal._search.search_path import SearchPath
from bayescal._use.budget import Budget, budget
from bayescal._use.decide import Decisions, decision_cells

# What the layout meets where a result.json is not as it was written, beside errors of its template.
OF_DAMAGE = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
MANY = 60  # rows of a table of candidates or coefficients that are shown


def report(
    given: Calibration | SearchPath | Chapter | list[Any],
    path: str | Path,
    *,
    title: str = "",
    effects: Iterable[Effect] = (),
    certificate: str | Path | Certificate | None = None,
    decisions: Decisions | None = None,
    output_unit: str | None = None,
) -> Path:
    """Write the report for sign-off.

    Args:
        given: a calibration or a trail, or several. Calibrations of the same readings become one chapter, in which the
            error falls from the first to the last, and the last is what is signed for; what each of them lacks is
            looked for, which takes a few seconds each. A trail brings all that with it.
        path: of the file, ending in .html.
        title: of the report.
        effects: of your own, candidates where what a calibration lacks is looked for; those that one of the
            calibrations has are so anyway.
        certificate: TOML file of what a certificate states beside the numbers: device, serial number, place,
            operator, ambient conditions, standards, dates.
        decisions: about limits, as `bc.decide` made them: they stand before everything else, with their rule.
        output_unit: in which errors and coefficients are said once more, such as the file's mV; of the raw output by
            the nominal scale.

    Returns:
        The path.

    Raises:
        InputError: nothing to report of, another suffix, a place that cannot be written to, or a certificate that
            states something unknown; a folder's result that is not as it was written; an output in no such unit.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"a report is HTML: name the file …html, not {path.name!r}")
    if not path.parent.is_dir():
        raise InputError(
            f"{str(path)!r} cannot be written: there is no folder {str(path.parent)!r}"
        )
    from jinja2 import TemplateError  # only a report needs it

    stated = certificate
    if stated is not None and not isinstance(stated, Certificate):
        stated = read_certificate(stated)
    several = given if isinstance(given, list | tuple) else [given]
    found = chapters(several, effects)
    try:
        text = page(found, title, stated, decisions, output_unit)
    except (TemplateError, *OF_DAMAGE) as e:
        folders = [str(c.folder) for c in found if c.folder is not None]
        if not folders:
            raise
        raise InputError(
            f"{RESULT} in {' or '.join(folders)} is not as it was written ({type(e).__name__}: {e}): calibrate again, "
            "or give the calibration alone"
        ) from None
    return write_text(text, path)


def page(
    found: list[Chapter],
    title: str = "",
    certificate: Certificate | None = None,
    decisions: Decisions | None = None,
    output_unit: str | None = None,
) -> str:
    """The report as HTML."""
    filters = {
        "number": number,
        "unit_label": unit_label,
        "probability": probability,
        "minus": lambda text: text.replace("-", "−"),
        "measured": tables.measured,
        "with_error": with_error,
        "zip": zip,
    }
    pictures = figures.Pictures()
    return template("bayescal._report", "report.html.j2", filters, autoescape=True).render(
        title=title or "Calibration report",
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        chapters=[_chapter(c, pictures) for c in found],
        k=tables.K,
        many=MANY,
        certificate=certificate.rows() if certificate else [],
        decisions=decisions,
        output_unit=output_unit,
        in_output_unit=[
            tables.rows_in_output_unit(c, output_unit) if output_unit else [] for c in found
        ],
        decided=[] if decisions is None else [decision_cells(d) for d in decisions.decisions],
    )


def _chapter(chapter: Chapter, pictures: figures.Pictures) -> dict[str, Any]:
    """All that the template lays out for one set of readings."""
    c, data = chapter.calibration, chapter.data
    may, not_for = sentences.use_and_limits(chapter)
    rows = tables.coefficients(chapter)
    signed = [r for r in rows if not r["member"]]
    last = len(data["steps"]) - 1
    found, no_budget = _budget(chapter)
    return {
        "instrument": c.model.instrument,
        "devices": tables.devices(c.readings),
        "channels": tables.channels(c.readings),
        "ok": sentences.ok(chapter),
        "data": data,
        "final": data["steps"][-1],
        "identity": identity(c),
        "files": sources_of(c.readings),
        "groups": _groups(data),
        "signed": signed[: tables.SUMMARY],
        "further": len(rows) - len(signed[: tables.SUMMARY]),
        "may": may,
        "not_for": not_for,
        "unexplained": sentences.unexplained(chapter),
        "story": sentences.story(chapter),
        "ranges": tables.ranges(c),
        "effects": tables.effects(chapter),
        "noise": c.model.noise.in_words,
        "fixed": [(n, number(v, 6)) for n, v in c.model.fixed],
        "reference": [(n, tables.measured(v, "degC")) for n, v in c.hold_at.items()],
        "coefficients": rows[: 4 * MANY],
        "matrix": tables.matrix(chapter),
        "skewed": tables.skewed(chapter),
        "check": chapter.check,
        "checks": [0, last] if last else [0],
        "allan": tables.allan(chapter.check),
        "discoveries": [_discovery(m, data, pictures) for m in data["missing"]],
        "budget": found,
        "no_budget": no_budget,
        "pictures": _pictures(chapter, pictures),
    }


def _groups(data: dict[str, Any]) -> str:
    """How many runs, cells, axes and devices, where there are several."""
    counted = [(k, data["readings"]["groups"].get(k, 0)) for k in GROUPS]
    plural = {"axis": "axes"}
    return ", ".join(f"{n} {plural.get(k, k + 's')}" for k, n in counted if n > 1)


def _discovery(
    found: dict[str, Any], data: dict[str, Any], pictures: figures.Pictures
) -> dict[str, Any]:
    """What was missing from one step."""
    title = data["steps"][found["step"]]["title"]
    tested = [c for c in found["candidates"] if c["kind"] != "not testable"]
    alike = {
        frozenset((c["effect"], *c["indistinguishable_from"]))
        for c in tested
        if c["indistinguishable_from"]
    }
    groups = [g for g in alike if not any(g < other for other in alike)]
    return {
        "step": found["step"],
        "title": title,
        "nothing": found["nothing_missing_probability"],
        "unstated": found.get("unstated", ""),
        "sets": found["sets"],
        "leads": [c["effect"] for c in tested if c["kind"] == "lead"],
        "rows": [c for c in tested if not is_quiet(c)][:MANY],
        "alike": sorted(", ".join(sorted(g)) for g in groups),
        "not_testable": sentences.not_tested(found["candidates"]),
        "picture": pictures.missing(found, title),
    }


def _budget(chapter: Chapter) -> tuple[Budget | None, str]:
    """The budget at the middle of what was covered; or why there is none."""
    if not sentences.ok(chapter):
        return None, "There is no budget of a result that is not reliable."
    try:
        return budget(chapter.calibration, k=tables.K).shown(), ""
    except BayescalError as error:
        return None, f"There is no budget: {error}"


def _pictures(chapter: Chapter, pictures: figures.Pictures) -> dict[str, Any]:
    c, last = chapter.calibration, len(chapter.data["steps"]) - 1
    first: list[figures.Picture] = []
    if last and chapter.first is not None and chapter.first_check is not None:
        first = pictures.residuals(chapter.first, chapter.first_check, "the first model")
    elif last and chapter.picture is not None:
        first = [
            figures.embedded(
                chapter.picture,
                "The loop as it was drawn when the calibration was made",
                "Four panels: residuals of the first model, candidates for what is missing, residuals of the last "
                "model, and the error of each step. The tables of this report hold the same.",
            )
        ]
    return {
        "first": first,
        "last": pictures.residuals(c, chapter.check, "the last model"),
        "sphere": pictures.sphere(c),
        "error": pictures.error(chapter),
        **{name: pictures.of_fit(name, c) for name in figures.OF_FIT},
        "allan": pictures.allan(chapter.check, "the last model"),
    }
