"""A search to report of and to draw, and a page taken apart."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.support import references

HIDDEN = "bias.thermal_lag"
trail = references.gyro_search
VOID = {"meta", "link", "img", "br", "input", "hr"}


def unpaint(patch: pytest.MonkeyPatch) -> None:
    """Leave a report's pictures white, as long as the patch holds."""
    patch.setattr("bayescal._report.report.render_svg", lambda _: '<svg viewBox="0 0 1 1"></svg>')


class Page(HTMLParser):
    """A page taken apart: its elements, its headings, its text, what it names elsewhere.

    Attributes:
        elements: (tag, attributes), in order.
        headings: levels, in order.
        text: all of it.
        elsewhere: whatever an attribute or a style would fetch.
        unclosed: tags that were left open or closed out of turn.
    """

    def __init__(self, source: str | Path) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.headings: list[int] = []
        self.text, self.elsewhere, self.unclosed = "", [], []
        self._open: list[str] = []
        self.source = source.read_text("utf-8") if isinstance(source, Path) else source
        self.feed(self.source)
        self.close()
        self.unclosed += self._open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
        if len(tag) == 2 and tag[0] == "h" and tag[1].isdigit():
            self.headings.append(int(tag[1]))
        for name, value in attrs:
            fetches = name in ("src", "href", "xlink:href", "srcset", "action", "data", "poster")
            if fetches and not (value or "").startswith(("#", "data:image/png;base64,")):
                self.elsewhere.append((tag, name, value))
            if name == "style" and "url(" in (value or "").replace("url(#", ""):
                self.elsewhere.append((tag, name, value))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self._open.pop()

    def handle_endtag(self, tag):
        if not self._open or self._open.pop() != tag:
            self.unclosed.append(tag)

    def handle_data(self, data):
        if self._open and self._open[-1] == "style":
            if "url(" in data.replace("url(#", "") or "@import" in data:
                self.elsewhere.append(("style", "", data))
        else:
            self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]
