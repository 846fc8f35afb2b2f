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

WIDTH, HEIGHT, MARGIN = 11.69, 8.27, 0.6  # inches, A4 across
POINTS = 7.5  # font size
LINE_INCHES, LETTER_INCHES = 1.35 * POINTS / 72, 0.56 * POINTS / 72  # line spacing; letter width
SECTION_LINES = 12  # lines left on a page, below which a section begins on a new one
SETTINGS = {"pdf.fonttype": 42, "font.family": "DejaVu Sans", "text.parse_math": False}
TITLE = "Validation of bayescal on this installation"


class Pages:
    """Pages filled from the top; a table's header row is repeated on each page that it continues on."""

    def __init__(self) -> None:
        self.figures, self.y = list[Figure](), 0.0
        self.head: Sequence[str] = ()
        self.widths: Sequence[float] = (1.0,)

    def add(self, cells: Sequence[str], size: float = 1.0, weight: str = "normal") -> None:
        """Add a row of cells, each wrapped to the width of its column."""
        width, letter = WIDTH - 2 * MARGIN, size * LETTER_INCHES
        columns = [*zip(cells, self.widths if len(cells) > 1 else (1.0,), strict=True)]
        wrapped = [textwrap.wrap(cell, int(w * width / letter) - 1) or [""] for cell, w in columns]
        if self.y < MARGIN + size * LINE_INCHES * max(map(len, wrapped)):
            self.figures.append(Figure(figsize=(WIDTH, HEIGHT)))
            self.y = HEIGHT - MARGIN
            if self.head:
                self.add(self.head, weight="bold")
        for lines in zip_longest(*wrapped, fillvalue=""):
            x = MARGIN
            self.y -= size * LINE_INCHES
            for text, (_, w) in zip(lines, columns, strict=True):
                text_style = {"fontsize": size * POINTS, "weight": weight}
                text_style |= {"color": "#a33c00", "weight": "bold"} if text == "FAILED" else {}
                self.figures[-1].text(x / WIDTH, self.y / HEIGHT, text, **text_style)
                x += w * width

    def write(self, path: Path) -> None:
        """Write the numbered pages as a PDF file."""
        with ws.replacing_for_user(path) as partial, PdfPages(partial) as pdf:
            for i, figure in enumerate(self.figures, 1):
                text = f"{TITLE}, page {i} of {len(self.figures)}"
                figure.text(MARGIN / WIDTH, 0.5 * MARGIN / HEIGHT, text, fontsize=POINTS)
                pdf.savefig(figure)


def write_pdf(record: ValidationRecord, path: Path) -> None:
    """Write the record as PDF."""
    with style.context(["default", SETTINGS]):
        pages = Pages()
        pages.add([TITLE], size=2.0)
        for section in record.sections():
            pages.head, pages.widths = (), section.widths
            if pages.y < MARGIN + SECTION_LINES * LINE_INCHES:
                pages.y = 0.0
            pages.add([""])
            pages.add([section.title], size=1.3, weight="bold")
            for note in section.notes:
                pages.add([note])
            pages.add(section.head, weight="bold")
            pages.head = section.head
            for row in section.rows:
                pages.add(row)
        pages.write(path)


def write_html(record: ValidationRecord, path: Path) -> None:
    """Write the record as one self-contained HTML file."""
    page = ws.template("bayescal._annexes.validation", "validation.html.j2", {}, autoescape=True)
    ws.write_text(page.render(title=TITLE, sections=record.sections()), path)


WRITERS = {".pdf": write_pdf, ".html": write_html}
