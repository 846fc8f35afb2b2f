"""Names say what they hold, and docstrings of functions begin with a verb."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from tests.house.test_architecture import ROOT, parsed

VAGUE = re.compile(
    "_*(found|made|there|said|own|told|one|beside|kept|rest|wide|still|nothing|everything|each|every|more|left|taken|"
    "given|asked|looked|here|begun|held|worth|apart|alike|shown|led|known|seen|wanted)_*"
)
NO_VERB = re.compile(r"(Of|The same|What|Whether|That|Which|Where|How|As|In|By|Those|Nothing)\b")
FILES = [*(ROOT / "bayescal").rglob("*.py"), *(ROOT / "models").rglob("*.py")]
VAGUE_NAMES = 47  # public ones, and fields of saved files: none may be added


def names_in(tree: ast.Module) -> Iterator[tuple[str, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node.lineno


def test_no_vague_name_is_added() -> None:
    each = ((file, *name) for file in FILES for name in names_in(parsed(file)))
    vague = [f"{file}:{line} {n}" for file, n, line in each if VAGUE.fullmatch(n.lower())]
    assert len(vague) <= VAGUE_NAMES, "\n".join(vague)


def test_docstrings_of_functions_begin_with_a_verb() -> None:
    nodes = ((file, node) for file in FILES for node in ast.walk(parsed(file)))
    defs = ((file, node) for file, node in nodes if isinstance(node, ast.FunctionDef))
    wrong = [f"{f}:{n.lineno}" for f, n in defs if NO_VERB.match(ast.get_docstring(n) or "")]
    assert not wrong, wrong
