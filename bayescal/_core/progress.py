"""Progress lines on stderr: names of operations that take over a second, with their durations, every ten seconds."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from bayescal._core.quoting import escape_html, to_printable

FIRST_LINE_SECONDS, INTERVAL_SECONDS = 1.0, 9.0  # delays of a stage's first and further lines

_open_stages: list[threading.Event] = []  # the event that ends each stage, the innermost last
_last_line_time = 0.0  # time of the last line, s, of `time.monotonic`
_progress_bar: Any = None  # display handle of the progress bar in a notebook


def notify(operation: str, fraction: float | None = None) -> None:
    """Print a progress line on stderr, or show a progress bar in a notebook; `fraction`: the completed fraction."""
    global _last_line_time
    _last_line_time = time.monotonic()
    if "ipykernel" in sys.modules:
        show_bar(f"{operation} …", fraction)
    else:
        print(f"bayescal: {operation} …", file=sys.stderr, flush=True)


def show_bar(text: str, fraction: float | None = None) -> None:
    """Show a progress bar in a notebook cell, indeterminate without a `fraction`; an empty text removes it."""
    from IPython.display import HTML, display

    global _progress_bar
    value_attribute = "" if fraction is None else f' value="{fraction:.3f}"'
    bar = HTML(f"<progress{value_attribute}></progress> {escape_html(text)}" if text else "")
    if _progress_bar is None:
        _progress_bar = display(bar, display_id=True)
    else:
        _progress_bar.update(bar)
    _progress_bar = _progress_bar if text else None


def silence() -> float:
    """Return the time since the last progress line, s."""
    return time.monotonic() - _last_line_time


def print_notes(notes: Iterable[str]) -> None:
    """Print notes on stderr, one line each."""
    for note in notes:
        print(f"bayescal: note: {to_printable(note)}", file=sys.stderr, flush=True)


def iterate_with_progress(items: Sequence[Any], noun: str) -> Iterator[Any]:
    """Yield the items; every ten seconds, print the number processed (with `noun`) and the estimated remaining time."""
    start = time.monotonic()
    for i, item in enumerate(items):
        elapsed = time.monotonic() - start
        if min(silence(), elapsed) >= INTERVAL_SECONDS:
            remaining = elapsed * (len(items) / i - 1)
            notify(f"{i} of {len(items)} {noun}, about {remaining:,.0f} s left", i / len(items))
        yield item


@contextmanager
def track(operation: str, delay: float = FIRST_LINE_SECONDS) -> Iterator[None]:
    """Print progress lines during the `with` block, the first after `delay` s, then every `INTERVAL_SECONDS`."""
    start, end_event = time.monotonic(), threading.Event()

    def print_lines() -> None:
        pause_seconds, has_printed = delay, delay >= INTERVAL_SECONDS
        while not end_event.wait(pause_seconds):
            now = time.monotonic()
            idle_seconds = now - max(_last_line_time, start)
            is_due = not has_printed or idle_seconds >= INTERVAL_SECONDS
            if is_due and _open_stages[-1:] == [end_event]:
                notify(operation + f", {now - start:.0f} s so far" * has_printed)
                idle_seconds, has_printed = 0.0, True
            pause_seconds = max(INTERVAL_SECONDS - idle_seconds, 0.5)

    _open_stages.append(end_event)
    threading.Thread(target=print_lines, daemon=True, name="bayescal progress").start()
    try:
        yield
    finally:
        end_event.set()
        _open_stages.remove(end_event)
        if _progress_bar is not None and not _open_stages:
            show_bar("")
