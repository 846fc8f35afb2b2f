"""Progress lines on stderr: name of an operation of over a second and its duration so far, every ten seconds."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from bayescal._core.quoting import html_text, one_line

FIRST_SECONDS, INTERVAL_SECONDS = 1.0, 9.0  # delay of the first line of a stage, and between lines

_open_stages: list[threading.Event] = []  # events that end the stages, the innermost last
_last_line = 0.0  # time of the last line, s
_bar: Any = None  # shown in a notebook


def tell(operation: str, share: float | None = None) -> None:
    """Print a progress line on stderr, or show a bar in a notebook; `share` is the completed fraction."""
    global _last_line
    _last_line = time.monotonic()
    if "ipykernel" in sys.modules:
        show_bar(f"{operation} …", share)
    else:
        print(f"bayescal: {operation} …", file=sys.stderr, flush=True)


def show_bar(text: str, share: float | None = None) -> None:
    """Show a progress bar in a notebook cell, indeterminate without a `share`; an empty text removes it."""
    from IPython.display import HTML, display

    global _bar
    value = "" if share is None else f' value="{share:.3f}"'
    page = HTML(f"<progress{value}></progress> {html_text(text)}" if text else "")
    if _bar is None:
        _bar = display(page, display_id=True)
    else:
        _bar.update(page)
    _bar = _bar if text else None


def silence() -> float:
    """Return the time since the last progress line, s."""
    return time.monotonic() - _last_line


def print_notes(notes: Iterable[str]) -> None:
    """Print warnings on stderr."""
    for note in notes:
        print(f"bayescal: note: {one_line(note)}", file=sys.stderr, flush=True)


def counted(items: Sequence[Any], noun: str) -> Iterator[Any]:
    """Yield the items, and print a progress line every ten seconds: items processed, estimated remaining time."""
    start = time.monotonic()
    for i, item in enumerate(items):
        elapsed = time.monotonic() - start
        if min(silence(), elapsed) >= INTERVAL_SECONDS:
            remaining = elapsed * (len(items) / i - 1)
            tell(f"{i} of {len(items)} {noun}, about {remaining:,.0f} s left", i / len(items))
        yield item


@contextmanager
def stage(operation: str, delay: float = FIRST_SECONDS) -> Iterator[None]:
    """Print a progress line after `delay` seconds, then after each `INTERVAL_SECONDS` without one."""
    start, end_event = time.monotonic(), threading.Event()

    def watch() -> None:
        pause, has_printed = delay, delay >= INTERVAL_SECONDS
        while not end_event.wait(pause):
            now = time.monotonic()
            idle_seconds = now - max(_last_line, start)
            is_due = not has_printed or idle_seconds >= INTERVAL_SECONDS
            if is_due and _open_stages[-1:] == [end_event]:
                tell(operation + f", {now - start:.0f} s so far" * has_printed)
                idle_seconds, has_printed = 0.0, True
            pause = max(INTERVAL_SECONDS - idle_seconds, 0.5)

    _open_stages.append(end_event)
    threading.Thread(target=watch, daemon=True, name="bayescal progress").start()
    try:
        yield
    finally:
        end_event.set()
        _open_stages.remove(end_event)
        if _bar is not None and not _open_stages:
            show_bar("")
