"""Build the documentation site: `python docs/build_site.py` writes build/docs and site/.

No site is built while a stated figure differs from its rows, a page is missing or a link leads nowhere; Zensical builds
it. A page holds a comment where the code writes a part, so that nothing is written twice:

    <!-- data sheet: mems_gyro -->      the docstring of that instrument's model.py, and the table of its effects
    <!-- in NumPyro: mems_gyro -->      that instrument's as_numpyro.py
    <!-- tour: 3 -->                the third step of tour.py: its comments as prose, its code as code
    <!-- commands: fit check -->        commands with their options, from the command line itself
    <!-- names: fit load | White -->   public names, for mkdocstrings to document

Docstrings are read from the source, and `bayescal --help` is light; of the instruments the effects alone are loaded.
"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
FILLED_IN = ROOT / "build" / "docs"
MODELS = ROOT / "models" / "bayescal_models"
PART = re.compile(
    r"^<!-- (data sheet|in NumPyro|tour|commands|names)(?:: (.*?))? -->$", re.MULTILINE
)


def main() -> None:
    """Write the pages to build/docs and build them to site/.

    Raises:
        SystemExit: a page is missing, a link broken, a stated figure wrong, or a docstring cannot be read.
    """
    pages = filled_in()
    if problems := [*broken(pages)]:
        sys.exit("\n".join(problems))
    shutil.rmtree(FILLED_IN, ignore_errors=True)
    shutil.copytree(HERE, FILLED_IN, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for name, text in pages.items():
        (FILLED_IN / name).write_text(text, "utf-8")
    build = "zensical build --strict --clean"  # its cache does not follow docstrings
    for command in ("benchmarks stated", build):
        if status := subprocess.run([sys.executable, "-m", *command.split()], cwd=ROOT).returncode:
            sys.exit(status)


def filled_in() -> dict[str, str]:
    """Return the Markdown of every page by its path in docs/, with the parts that the code writes."""
    pages = sorted(HERE.rglob("*.md"))
    return {p.relative_to(HERE).as_posix(): fill_in(p.read_text("utf-8")) for p in pages}


def fill_in(markdown: str) -> str:
    return PART.sub(lambda part: PARTS[part[1]](part[2] or ""), markdown)


def broken(pages: dict[str, str]) -> Iterator[str]:
    """Describe each page that is not in the navigation once, and each link to no file or heading of docs/."""
    listed = re.findall(r'"([\w/]+\.md)"', (ROOT / "zensical.toml").read_text("utf-8"))
    for name in sorted({*listed, *pages}):
        if listed.count(name) != 1 or name not in pages:
            yield f"{name}: expected once in docs/ and once in the navigation of zensical.toml"
    for name, text in pages.items():
        prose = re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
        for link in re.findall(r"\]\(([^)\s]+)\)", prose):
            path, _, anchor = link.partition("#")
            target = ((HERE / name).parent / path).resolve() if path else HERE / name
            if link.startswith("https://"):
                continue
            if not target.is_file() or HERE not in target.parents:
                yield f"{name}: {link} leads to no file of docs/"
            elif anchor and anchor not in anchors(pages[target.relative_to(HERE).as_posix()]):
                yield f"{name}: {link} leads to no heading of its page"


def anchors(markdown: str) -> set[str]:
    """Return the anchors of a page's headings, as Python-Markdown names them."""
    heads = re.findall(r"^#+ (.+)$", markdown, re.MULTILINE)
    plain = (re.sub(r"[^\w\s-]", "", h.encode("ascii", "ignore").decode()) for h in heads)
    return {re.sub(r"[-\s]+", "-", p.strip().lower()) for p in plain}


# Data sheets.


def docstring(instrument: str) -> str:
    source = (MODELS / instrument / "model.py").read_text("utf-8")
    return ast.get_docstring(ast.parse(source)) or ""


def in_numpyro(instrument: str) -> str:
    """The model that is written out whole, as a listing."""
    path = MODELS / instrument / "as_numpyro.py"
    return _code(path.read_text("utf-8").strip())


def data_sheet(instrument: str) -> str:
    """An instrument's docstring as Markdown, and the table of its effects; a source's name leads to its title."""
    title, _, body = docstring(instrument).partition("\n")
    text = "\n\n".join([f"**{title}**", body.strip("\n"), table_of_effects(instrument)])
    return re.sub(r"\bsource [0-4]\b", r"[\g<0>](../sources.md)", text)


def table_of_effects(instrument: str) -> str:
    """The table that the instrument's code is made of: a row for each effect, with its size and source."""
    from bayescal._data.unit_conversion import unit_label

    made = import_module(f"bayescal_models.{instrument}.model").INSTRUMENT
    in_models = {e.name: e for _, model in made.structures for e in model().effects}
    rows, seen = ["| effect | | form | plausible size | source |", "|---|---|---|---|---|"], set()
    for kind, effects in (
        ("baseline", made.effects),
        ("candidate", made.candidates),
        ("named models", in_models.values()),
    ):
        for e in (e for e in effects if e.name not in seen):
            seen.add(e.name)
            sizes = dict.fromkeys(
                f"{c.size:g} {unit_label(c.unit)}".strip() for c in e.coefficients
            )
            equation = e.equation.replace("](", r"]\(")  # v[device](t) is no link
            cells = (f"`{e.name}`", kind, equation, ", ".join(sizes), e.source)
            rows.append(f"| {' | '.join(_cell(cell) for cell in cells)} |")
    return "\n".join(rows)


# The tour.


def steps() -> list[str]:
    """The sources of the steps of tour.py, each with its title in the first line."""
    return re.split(r"^# %% ", (HERE / "tour.py").read_text("utf-8"), flags=re.MULTILINE)[1:]


def step(number: str) -> str:
    """A step as Markdown: paragraphs of comments are prose, all else is code."""
    title, _, body = steps()[int(number) - 1].partition("\n")
    parts = [f"## {title}"]
    for prose, lines in groupby(re.split("\n{2,}", body.strip()), lambda p: p.startswith("# ")):
        text = "\n\n".join(lines).strip("\n")
        parts.append(re.sub("^# ?", "", text, flags=re.MULTILINE) if prose else _code(text))
    return "\n\n".join(parts)


def _code(text: str) -> str:
    return f"```python\n{text}\n```"


# Commands.


def commands(listed: str) -> str:
    """Return commands with their arguments and options, as their own `--help` has them."""
    import typer

    from bayescal._cli.main import build_application

    group: Any = typer.main.get_command(build_application())
    return "\n\n".join(_command(name, group.commands[name]) for name in listed.split())


def _command(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option"]
    usage = " ".join(
        [
            f"bayescal {name}",
            *(f"{_shown(a)}{'…' if a.nargs == -1 else ''}" for a in arguments),
            *(f"{max(o.opts, key=len)} …" for o in options if o.required),
        ]
    )
    rows = [f"| `{_shown(a)}` | {_cell(a.help)} | required |" for a in arguments]
    rows += [
        f"| {', '.join(f'`{opt}`' for opt in o.opts)} | {_cell(o.help)} | {_default(o)} |"
        for o in options
    ]
    example = (command.epilog or "").removeprefix("Example: ")
    return "\n\n".join(
        [
            f"## {name}",
            _cell(command.help),
            f"```console\n{usage}\n```",
            "\n".join(["| | | default |", "|---|---|---|", *rows]),
            f"Example: `{example}`",
        ]
    )


def _shown(argument: Any) -> str:
    return argument.name.rstrip("_").upper()


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


def _default(option: Any) -> str:
    if option.required:
        return "required"
    return "" if option.default in (None, False, ()) else f"`{option.default}`"


# Public names.


def names(listed: str) -> str:
    """Return what mkdocstrings replaces by the documentation of each name; of those behind "|" without what they
    inherit from one that stands before."""
    whole, _, own = listed.partition("|")
    alone = "\n    options:\n      inherited_members: false"
    parts = [f"::: bayescal.{name}" for name in whole.split()]
    return "\n\n".join([*parts, *(f"::: bayescal.{name}{alone}" for name in own.split())])


PARTS: dict[str, Callable[[str], str]] = {
    "data sheet": data_sheet,
    "in NumPyro": in_numpyro,
    "tour": step,
    "commands": commands,
    "names": names,
}

if __name__ == "__main__":
    main()
