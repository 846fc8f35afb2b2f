"""`python -m benchmarks NAME …` measures the missing campaigns of a benchmark and writes its page; without names, all.

python -m benchmarks render              write all pages from the stored results
python -m benchmarks stated              list pages that differ from the results, or from present output
python -m benchmarks release             measure a sample of every bank again: see `release.py`
python -m benchmarks shown PAGE …        print pages of docs/ again: see `shown.py`
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

from benchmarks.pages import Texts

MODULES = {  # each name's module, with `BANKS` or `main()`, and perhaps `render()`, in the order in which all are run
    "certified": "accuracy.certified",
    "coverage": "accuracy.coverage",
    "hidden_effects": "hidden_effects.measurement",
    "false_discoveries": "hidden_effects.false_discoveries",
    "triads": "hidden_effects.triads",
    "evidence_greedy": "evidence_greedy",
    "equivalent": "hidden_effects.equivalent",
    "ordinary_test": "ordinary_test.measurement",
    "no_family": "ordinary_test.no_family",
    "good_records": "ordinary_test.good_records",
    "wrong_model": "wrong_model.coverage",
    "gauntlet": "spoilt_records.measurement",
    "real_records": "real_records",
    "speed": "speed",
    "open_benchmark": "open_benchmark",
    "how_we_know": "how_we_know",
}
COMMANDS = ("release", "shown", "stated")  # take arguments, or measure what those above do


def module_of(name: str) -> Any:
    return import_module(f"benchmarks.{MODULES[name]}")


def rendered() -> Texts:
    """Return all pages, rendered from the stored results, by path."""
    modules = (module_of(name) for name in MODULES)
    pages = (module.render() for module in modules if hasattr(module, "render"))
    return {path: text for page in pages for path, text in page.items()}


def render() -> None:
    """Write all pages from the stored results."""
    for path, text in rendered().items():
        path.write_text(text, "utf-8")


def main(names: list[str]) -> int:
    """Run benchmarks in order.

    Returns:
        The exit status: 2 for an unknown name, otherwise 0.
    """
    if names == ["render"]:
        render()
        return 0
    if names and names[0] in COMMANDS:
        import_module(f"benchmarks.{names[0]}").main(names[1:])
        return 0
    if unknown := [name for name in names if name not in MODULES]:
        benchmark_names = ", ".join((*MODULES, "render", *COMMANDS))
        text = f"unknown benchmark: {', '.join(unknown)}; the benchmarks are: {benchmark_names}"
        print(text, file=sys.stderr)
        return 2
    for name in names or MODULES:
        module = module_of(name)
        for bank in getattr(module, "BANKS", ()):
            bank.run()
        if hasattr(module, "main"):
            module.main()
    render()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
