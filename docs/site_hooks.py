"""Pages of the site that the code writes: data sheets, commands, public names. Used by MkDocs (`hooks:`).

A page holds a comment where such a part belongs, so that nothing is written twice:

    <!-- data sheet: mems_gyro -->      the docstring of that instrument's model.py, and the table of its effects
    <!-- in NumPyro: mems_gyro -->      that instrument's as_numpyro.py
    <!-- tour: 3 -->                the third step of tour.py: its comments as prose, its code as code
    <!-- commands -->                   every command and option, from the command line itself
    <!-- names: fit fit_batch load -->  public names, for mkdocstrings to document

Docstrings are read from the source, and `bayescal --help` is light; of the instruments the effects alone are loaded.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
MODELS = HERE.parent / "models" / "bayescal_models"
PART = re.compile(
    r"^<!-- (data sheet|in NumPyro|tour|commands|names)(?:: (.*?))? -->$", re.MULTILINE
)


def on_startup(command: str, **_: Any) -> None:
    """Build no site while a page says another figure than the rows that it comes from."""
    if command != "build":
        return
    sys.path.insert(0, str(HERE.parent))
    from benchmarks.stated import main  # starts JAX

    main()


def on_page_markdown(markdown: str, **_: Any) -> str:
    return PART.sub(lambda found: PARTS[found[1]](found[2] or ""), markdown)


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


def commands(_: str = "") -> str:
    """Every command with its arguments and options, as its own `--help` has them."""
    import typer

    from bayescal._cli.main import app

    group: Any = typer.main.get_command(app)
    return "\n\n".join(_command(name, command) for name, command in group.commands.items())


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
    """Names of bayescal, each documented from its docstring by mkdocstrings."""
    return "\n\n".join(f"::: bayescal.{name}" for name in listed.split())


PARTS: dict[str, Callable[[str], str]] = {
    "data sheet": data_sheet,
    "in NumPyro": in_numpyro,
    "tour": step,
    "commands": commands,
    "names": names,
}
