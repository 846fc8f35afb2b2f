"""The validation record as a document: PDF by Matplotlib, HTML by a template."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

from matplotlib import style
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from bayescal import workshop as ws
from bayescal._annexes.validation.validation_record import ValidationRecord

PAGE_WIDTH_INCHES, PAGE_HEIGHT_INCHES, MARGIN_INCHES = 11.69, 8.27, 0.6  # A4, landscape
FONT_POINTS = 7.0  # font size
LINE_INCHES, LETTER_INCHES = 1.35 * FONT_POINTS / 72, 0.602 * FONT_POINTS / 72  # line pitch; width
LETTERS_PER_LINE = int((PAGE_WIDTH_INCHES - 2 * MARGIN_INCHES) / LETTER_INCHES)
PAGE_LINES = int((PAGE_HEIGHT_INCHES - 2 * MARGIN_INCHES) / LINE_INCHES)
MIN_SECTION_LINES = 12  # lines left on a page, below which a section begins on a new one
SETTINGS = {"pdf.fonttype": 42, "font.family": "DejaVu Sans Mono", "text.parse_math": False}
PACKAGE, TITLE = "bayescal._annexes.validation", "Validation of bayescal on this installation"


def wrap_row(cells: Sequence[str], widths: Sequence[float]) -> list[str]:
    """Wrap cells to the widths of their columns, shares of the page; return the row's lines."""
    sizes = [int(width * LETTERS_PER_LINE) for width in widths]
    columns = [textwrap.wrap(c, n - 1) or [""] for c, n in zip(cells, sizes, strict=True)]
    rows = zip_longest(*columns, fillvalue="")
    return ["".join(map(str.ljust, texts, sizes)).rstrip() for texts in rows]


def write_pdf(record: ValidationRecord, path: Path) -> None:
    """Write the record as PDF; a table's header row is repeated on each page that it continues on."""
    pages, bold_lines = [[TITLE]], {TITLE}
    for section in record.sections():
        header_lines = wrap_row(section.head, section.widths)
        notes = (line for note in section.notes for line in textwrap.wrap(note, LETTERS_PER_LINE))
        if len(pages[-1]) > PAGE_LINES - MIN_SECTION_LINES:
            pages.append([])
        pages[-1] += ["", section.title, *notes, *header_lines]
        bold_lines |= {section.title, *header_lines}
        for row in section.rows:
            lines = wrap_row(row, section.widths)
            if len(pages[-1]) + len(lines) > PAGE_LINES:
                pages.append([*header_lines])
            pages[-1] += lines
    settings = style.context(["default", SETTINGS])
    with settings, ws.replace_user_file(path) as temporary_path, PdfPages(temporary_path) as pdf:
        for i, lines in enumerate(pages, 1):
            figure = Figure(figsize=(PAGE_WIDTH_INCHES, PAGE_HEIGHT_INCHES))
            footer = [""] * (PAGE_LINES + 1 - len(lines)) + [f"{TITLE}, page {i} of {len(pages)}"]
            for k, line in enumerate([*lines, *footer], 1):
                y = 1 - (MARGIN_INCHES + k * LINE_INCHES) / PAGE_HEIGHT_INCHES
                colour = "#a33c00" if "FAILED" in line else "black"
                weight = "bold" if line in bold_lines or "FAILED" in line else "normal"
                text_style = {"fontsize": FONT_POINTS, "weight": weight, "color": colour}
                figure.text(MARGIN_INCHES / PAGE_WIDTH_INCHES, y, line, **text_style)
            pdf.savefig(figure)


def write_html(record: ValidationRecord, path: Path) -> None:
    """Write the record as one self-contained HTML file."""
    page = ws.load_template(PACKAGE, "validation.html.j2", {}, autoescape=True)
    ws.write_text(page.render(title=TITLE, sections=record.sections()), path)


WRITERS = {".pdf": write_pdf, ".html": write_html}
