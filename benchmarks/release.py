"""Check of a release's stated results by its code: `python -m benchmarks release`.

A random sample of each bank's campaigns, a different one for each version, is measured again and compared with the
stored rows: the same final model, status or verdict. Banks that results/release.json has for this version are not
measured again; the page *How we know* has the counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from benchmarks.__main__ import MODULES, module_of, render
from benchmarks.bank import same_outcome
from benchmarks.record import read, today, write


def main(_: Sequence[str] = ()) -> None:
    """Measure a sample of each bank, and write all pages."""
    installed = version("bayescal")
    release = read("release")
    banks: dict[str, Any] = release["banks"] if release.get("version") == installed else {}
    for name in MODULES:
        module = module_of(name)
        if name in banks or not hasattr(module, "SAMPLE"):
            continue
        pairs = [pair for bank in module.BANKS for pair in bank.again(module.SAMPLE, installed)]
        same = sum(same_outcome(*pair) for pair in pairs)
        rows = sum(len(bank.rows) for bank in module.BANKS)
        banks[name] = {"rows": rows, "anew": len(pairs), "same": same, "day": today()}
        write("release", {"version": installed, "banks": banks})
    render()
