"""Pages that differ from the committed results: `python -m benchmarks stated`; `make docs` then builds no site.

Rendered pages are rendered again and compared; the page that shows output is run.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

from benchmarks import shown
from benchmarks.__main__ import rendered

PRINTED = "start.md"  # the tests run every page that shows what is printed


def differing() -> Iterator[str]:
    """Yield the differences of pages from their rendering, one sentence each."""
    for path, text in rendered().items():
        before = path.read_text("utf-8")
        lines = zip(before.splitlines(), text.splitlines(), strict=False)
        if before != text:
            first = next(((b, a) for b, a in lines if b != a), ("its end", "more or fewer lines"))
            yield f"{path.name}: the page has {first[0][:200]!r}, its results {first[1][:200]!r}"


def main(_: Sequence[str] = ()) -> None:
    """Print the differences.

    Raises:
        SystemExit: there are differences.
    """
    if differences := [*differing(), *shown.differing(PRINTED)]:
        sys.exit("\n".join(differences))
    print(f"all pages agree with the results, and {PRINTED} with present output")
