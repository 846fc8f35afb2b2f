"""How a command leaves: its result on standard output, notes on standard error, an exit status, a folder.

Light: every command loads it before it starts.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bayescal._core.as_json import as_json, json_text
from bayescal._core.errors import NotDrawn
from bayescal._core.progress import print_notes


@dataclass(frozen=True)
class Answer:
    """What a command found: it is printed, in words or as data, and settles the exit status."""

    shown: Any  # prints itself; plain data is printed as JSON; None where all is said
    data: Any = None  # for --json; what `shown.data()` gives if not given
    ok: bool = True  # whether the result may be used; where not, the status is 1
    why: str = ""  # what stands against it
    doubt: str = ""  # what is noted beside a result that may be used, and makes the status 1 too
    made: bool = True  # whether all that is drawn of it could be: where not, the status is 1
    written: str = ""  # which files there are

    def tell(self, json_: bool) -> bool:
        """Print it; whether it may be used and all was drawn: if not, the status is 1."""
        shown = self.shown
        if json_:
            own = shown.data() if self.data is None and hasattr(shown, "data") else self.data
            shown = shown if own is None else own
        if isinstance(shown, dict | list):
            shown = json_text(as_json(shown)).rstrip("\n")
        if shown is not None:
            print(shown)
        if self.written and not json_:
            print(f"\nwritten: {self.written}")
        if not self.ok:
            print(f"bayescal: result not reliable: {self.why}", file=sys.stderr)
        elif self.doubt:
            print_notes([self.doubt])
        return self.ok and self.made and not self.doubt


def drawn(make: Callable[..., Any], *given: Any) -> bool:
    """Make pictures or a page of a result that is written; whether they could be made: where not, that is said."""
    try:
        make(*given)
    except NotDrawn as error:
        print_notes([str(error)])
        return False
    return True
