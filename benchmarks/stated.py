"""Pages that say otherwise than the committed results: `python -m benchmarks stated`; `make docs` builds no site then.

Pages that are rendered are rendered anew and compared; the page that shows what is printed is run.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

from benchmarks import shown
from benchmarks.__main__ import rendered

PRINTED = "start.md"  # the tests run every page that shows what is printed


def differing() -> Iterator[str]:
    """Give what a page says otherwise than it is rendered, a sentence each."""
    for path, text in rendered().items():
        before = path.read_text("utf-8")
        lines = zip(before.splitlines(), text.splitlines(), strict=False)
        if before != text:
            first = next(((b, a) for b, a in lines if b != a), ("its end", "more or fewer lines"))
            yield f"{path.name}: it says {first[0][:200]!r}, rendered anew {first[1][:200]!r}"


def main(_: Sequence[str] = ()) -> None:
    """Name what differs.

    Raises:
        SystemExit: something does.
    """
    if differences := [*differing(), *shown.differing(PRINTED)]:
        sys.exit("\n".join(differences))
    print(f"the pages are as the results have them, {PRINTED} as it is printed")
