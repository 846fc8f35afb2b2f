"""Rows that the pointer and the keyboard reach alike: effects, candidates, steps.

Panel's tables tell neither where the pointer rests nor hold buttons that the keyboard reaches, hence this one component
of our own. Every text is data: the browser gets it as text, never as HTML.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import param
from panel.custom import JSComponent

HERE = Path(__file__).parent


class Rows(JSComponent):
    """A list of rows, or a table with a head.

    Attributes:
        rows: each {"id", "cells": [{"text", "bar", "kind", "title"}], "actions": [{"id", "label", "title",
            "off"}], "group", "kind", "current", "note"}; `bar` from 0 to 1.
        head: titles of a table's columns.
        table: whether it is one.
        pointing: whether pointing at a row, with the pointer or the keyboard, counts.
        pointed: the row pointed at last; empty for none.
        busy: whether its buttons are shut for now.
        label: its name for those who hear the page.
        kind: class of its style.
    """

    rows = param.List(default=[], item_type=dict)
    head = param.List(default=[], item_type=str)
    table = param.Boolean(default=False)
    pointing = param.Boolean(default=False)
    pointed = param.String(default="")
    busy = param.Boolean(default=False)
    label = param.String(default="")
    kind = param.String(default="")

    _esm = HERE / "rows.js"
    _stylesheets = [(HERE / "rows.css").read_text("utf-8")]  # noqa: RUF012

    def __init__(self, on_press: Callable[[str, str], None] | None = None, **settings: Any) -> None:
        """As `JSComponent`; `on_press(row, action)` is called when a row's button is pressed."""
        room = {"margin": 0, "sizing_mode": "stretch_both", "styles": {"min-height": "0"}}
        super().__init__(**{**room, **settings})
        self._on_press = on_press

    def _handle_msg(self, data: Any) -> None:
        """A press in the browser: taken only where the row and its action are there and open."""
        if self.busy or self._on_press is None or not isinstance(data, dict):
            return
        for row in self.rows:
            if row["id"] == data.get("row"):
                open_now = {a["id"] for a in row.get("actions", ()) if not a.get("off")}
                if (action := str(data.get("action"))) in open_now:
                    self._on_press(row["id"], action)  # pyright: ignore[reportArgumentType]
                return
