"""Code asks claims and results for codes and numbers: nothing in bayescal looks for English in what it said itself."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2] / "bayescal"
SENTENCE = re.compile(r"[A-Za-z]{2,} [A-Za-z]{2,}")  # two words of English
READS = ("startswith", "endswith", "removeprefix", "removesuffix", "partition", "rpartition")
READS = (*READS, "index", "find", "search", "match", "fullmatch", "findall", "compile", "split")


def constants(tree: ast.Module) -> dict[str, str]:
    """Texts that stand under a name of a module."""
    return {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name) and isinstance(node.value.value, str)
    }


TREES = {
    f"{file.relative_to(ROOT)}": ast.parse(file.read_text("utf-8"))
    for file in sorted(ROOT.rglob("*.py"))
}
EVERY = {name: text for tree in TREES.values() for name, text in constants(tree).items()}


def words_in(node: ast.expr, named: Mapping[str, str]) -> str:
    """Text that stands in an expression, or under the names in it."""
    texts = (
        named.get(n.id, "") if isinstance(n, ast.Name) else n.value
        for n in ast.walk(node)
        if isinstance(n, ast.Name | ast.Constant)
    )
    return " ".join(t for t in texts if isinstance(t, str))


def reads(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines that look for two words of English, or more, in a text."""
    named = EVERY | constants(tree)
    for node in ast.walk(tree):
        looked: list[ast.expr] = []
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
            looked = [node.left] if isinstance(node.left, ast.Constant | ast.Name) else []
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            looked = node.args[:1] if node.func.attr in READS else []
        for one in looked:
            if SENTENCE.search(words := words_in(one, named)):
                yield node.lineno, words


def test_nothing_reads_its_own_english() -> None:
    found = {name: lines for name, tree in TREES.items() if (lines := [*reads(tree)])}
    assert not found, f"ask the code of the claim, not its words: {found}"
