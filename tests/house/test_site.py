"""The site: its pages are all reachable, its links lead somewhere, its code and commands do what is shown.

How a page is run stands in `benchmarks/shown.py`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

import bayescal as bc
import bayescal.effects
from bayescal_models import mems_gyro
from benchmarks.shown import LAST_DIGITS, followed
from tests.support.command_line import needs_installation, run
from tests.support.shown_output import load_module

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = {str(p.relative_to(DOCS)): p.read_text("utf-8") for p in sorted(DOCS.rglob("*.md"))}
QUICK = ("how_to/readings.md",)  # the others fit and search: minutes
SAMPLED = ("instruments/differential_pair.md",)  # by chains, whose draws depend on the processor
RUN = [name for name, page in PAGES.items() if re.search("^```(python|sh)", page, re.MULTILINE)]


SITE = load_module(DOCS / "build_site.py")


# Pages and links.


def test_pages_are_reachable_and_links_lead_somewhere() -> None:
    assert [*SITE.broken(SITE.filled_in())] == []


# What the code writes.


def test_a_data_sheet_ends_with_the_effects_their_sizes_and_sources() -> None:
    page = SITE.data_sheet("mems_gyro")
    rows = [
        [c.strip() for c in re.split(r"(?<!\\)\|", line.strip("|"))] for line in page.splitlines()
    ]
    table = {row[0].strip("`"): row[1:] for row in rows if len(row) == 5}
    voltage = " | ".join(table["bias.reference_voltage"][:3])
    assert voltage == "candidate | c·(T_board − T_board,0) | 0.02 °/s/°C"
    assert "(../sources.md)" in table["bias.run"][3]
    own = (*mems_gyro.INSTRUMENT.effects, *mems_gyro.INSTRUMENT.candidates)
    assert {e.name for e in own} | {"bias.resonance"} <= {*table}


def test_every_command_and_option_is_listed() -> None:
    listed = " ".join(re.findall(r"<!-- commands: (.*?) -->", "".join(PAGES.values())))
    page, commands = SITE.commands(listed), re.findall(r"^  ([a-z]+)  ", run("--help").out, re.M)
    assert sorted(listed.split()) == sorted(commands)
    for command in commands:
        part = page.split(f"## {command}\n")[1].split("\n## ")[0]
        options = set(re.findall(r"(?<!\S)--[a-z][a-z-]+", run(command, "--help").out)) - {"--help"}
        assert options
        for option in options:
            assert f"`{option}`" in part, f"{command} {option}"


def test_every_public_name_is_documented_once() -> None:
    listed = re.findall(r"<!-- names: (.*?) -->", "".join(PAGES.values()))
    names = [n for part in listed for n in part.replace("|", "").split()]
    public = [n for n in names if not n.startswith(("effects.", "plot."))]
    assert sorted(public) == sorted(set(bc.__all__) - {"plot"})
    drawn = (ROOT / "bayescal" / "plot.pyi").read_text("utf-8")
    drawn = re.findall(r"^from .* as (\w+)$", drawn, re.MULTILINE)
    for module, offered in (("effects", bayescal.effects.__all__), ("plot", drawn)):
        assert sorted(n for n in names if n.startswith(f"{module}.")) == sorted(
            f"{module}.{name}" for name in offered
        )


# Code and commands.


def _follow(name: str, folder: Path) -> None:
    """Run a page from top to bottom in a folder, and compare what it prints with what it shows."""

    def in_this_process(arguments: Sequence[str]) -> tuple[int, str]:
        done = run(*arguments)
        return done.status, done.out + "".join(f"{said}\n" for said in done.said)

    with contextlib.chdir(folder):
        for shown in followed(PAGES[name], in_this_process):
            if said := shown.difference(10 if name in SAMPLED else LAST_DIGITS):
                pytest.fail(said)


@pytest.mark.nightly
@needs_installation
@pytest.mark.parametrize("name", QUICK)
def test_quick_pages_do_what_they_show(name: str, tmp_path: Path) -> None:
    _follow(name, tmp_path)


@pytest.mark.nightly
@needs_installation
@pytest.mark.parametrize("name", [n for n in RUN if n not in QUICK])
def test_pages_do_what_they_show(name: str, tmp_path: Path) -> None:
    _follow(name, tmp_path)


# The site as built.


@pytest.fixture(scope="module")
def site() -> Path:
    if importlib.util.find_spec("zensical") is None:
        pytest.skip("Zensical is not installed: make docs installs it")
    command = [sys.executable, "docs/build_site.py"]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stderr
    return ROOT / "site"


@pytest.mark.nightly
def test_the_site_asks_for_nothing_outside(site: Path) -> None:
    fetched = re.compile(
        r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?([^\"\s>]+)|<link\b[^>]*\bhref=\"?([^\"\s>]+)"
    )
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > len(PAGES)
    for page in pages:
        for src, href in fetched.findall(page.read_text("utf-8")):
            assert not (src or href).startswith(("http:", "https:", "//")), (
                f"{page.name}: {src or href}"
            )
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//|@import", style.read_text("utf-8")), (
            style.name
        )
