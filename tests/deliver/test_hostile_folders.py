"""A folder of results that somebody else left: its report holds no markup of theirs, or is refused in words."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.command_line import needs_installation, run
from tests.support.inside import whole_folder
from tests.support.reported import trail

pytestmark = needs_installation
NASTY = "</script><script>alert(1)</script><img src=x onerror=alert(2)> $\\frac{$ \"'"
KEPT = ("schema", "instrument", "effects", "calibration", "sha256")  # by which the folder is known
UNITS = ("unit", "covariate_unit")  # of which no text but a unit is let through


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("result")
    trail().save(made)
    return made


def leaves(data: Any, place: tuple = ()) -> Iterator[tuple]:
    """Places of all plain values."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in inner:
        if isinstance(value, dict | list) and value:
            yield from leaves(value, (*place, key))
        else:
            yield (*place, key)


def put(data: Any, place: tuple, change: Callable[[Any], Any]) -> None:
    for key in place[:-1]:
        data = data[key]
    data[place[-1]] = change(data[place[-1]])


def changed(saved: Path, folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """The folder with another result.json, and a manifest that is right."""
    folder.mkdir()
    data = json.loads((saved / "result.json").read_text("utf-8"))
    change(data)
    with whole_folder(folder, data.get("calibration")) as hidden:
        for path in saved.iterdir():
            if path.name not in ("manifest.json", "result.json"):
                (hidden / path.name).write_bytes(path.read_bytes())
        (hidden / "result.json").write_text(json.dumps(data), "utf-8")
    return folder


def reported(folder: Path) -> str:
    """The page, or the refusal."""
    done, page = run("report", folder, "--out", folder / "report.html"), folder / "report.html"
    return page.read_text("utf-8") if done.status < 2 else f"refused: {done.err}"


@pytest.mark.slow
def test_every_text_of_a_result_is_text_in_its_report(saved, tmp_path) -> None:
    def nasty(data: dict[str, Any]) -> None:
        for place in list(leaves(data)):
            known = {str(part) for part in place} & {*KEPT, *UNITS}
            if not known:
                put(data, place, lambda old: NASTY if isinstance(old, str) and old else old)

    text = reported(changed(saved, tmp_path / "nasty", nasty))
    assert not text.startswith("refused"), text
    assert "<script" not in text and "<img src=x" not in text
    assert "&lt;script&gt;" in text
