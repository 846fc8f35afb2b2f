"""A workbench as a user has it: a server in a process of its own, and its page in a real Chromium without a network."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.browser import chromium

ROOT = Path(__file__).resolve().parents[2]
# The page that stands while the workbench loads asks again and again, also while the port changes hands.
HANDED_OVER = re.compile(
    "ERR_(CONNECTION_REFUSED|CONNECTION_RESET|SOCKET_NOT_CONNECTED|EMPTY_RESPONSE)"
)
LONG = 120_000  # ms
ARGUMENTS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run")
QUIET = ("--disable-background-networking", "--disable-component-update", "--disable-sync")


class Bench:
    """`bayescal workbench` with these arguments, until `close`; it opens `BROWSER`, where one is given."""

    def __init__(self, *arguments: str | Path, **environment: str) -> None:
        command = [sys.executable, "-m", "bayescal", "workbench", *map(str, arguments)]
        command += [] if environment else ["--no-open"]
        path = f"{ROOT}{os.pathsep}{ROOT / 'models'}"
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT,
            env={**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1", **environment},
        )  # fmt: skip
        self.said: list[str] = []
        self.url = self._address()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _address(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(line)
            if found := re.search(r"http://127\.0\.0\.1:\S+", line):
                return found[0]
        self.process.wait(30)
        self.process.stdout.close()
        raise AssertionError(f"the workbench did not begin: {''.join(self.said)}")

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.said.extend(self.process.stdout)

    def end(self, how: signal.Signals) -> int:
        """End it by a signal; its exit status."""
        self.process.send_signal(how)
        status = self.process.wait(60)
        self._reader.join(30)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return status

    def close(self) -> None:
        self.end(signal.SIGTERM)


class Seen:
    """A page of the workbench: what is on it, what may be done to it, and what it must not do.

    Attributes:
        page: Playwright's.
        outside: addresses off this machine that it asked for.
        wrong: errors on its console, and dialogs.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.outside: list[str] = []
        self.wrong: list[str] = []
        page.set_default_timeout(LONG)
        page.route("**/*", self._only_here)
        page.on("console", lambda m: self._said(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: self.wrong.append(str(e)))
        page.on("dialog", lambda d: (self.wrong.append(f"dialog: {d.message}"), d.dismiss()))

    def _said(self, text: str) -> None:
        if HANDED_OVER.search(text) is None:
            self.wrong.append(text)

    def _only_here(self, route: Any) -> None:
        here = re.match(r"(https?://127\.0\.0\.1[:/]|data:|blob:)", route.request.url)
        if here:
            route.continue_()
        else:
            self.outside.append(route.request.url)
            route.abort()

    def open(self, url: str) -> Seen:
        self.page.goto(url)
        self.page.get_by_text("Where it fails").wait_for()
        return self

    def looked(self) -> Seen:
        """Wait until it is known what is missing."""
        self.page.get_by_text("no testable candidate is missing").wait_for()
        return self

    def add(self, effect: str) -> Seen:
        """Add a candidate, and wait for the state with it."""
        before = len(self.steps())
        self.page.get_by_role("button", name=f"Add {effect}", exact=True).click()
        # the page is not frozen
        self.page.wait_for_function("n => window.document && n >= 0", arg=before)
        self.page.locator(f'tr[data-row="{before}"]').wait_for()
        return self

    def steps(self) -> list[list[str]]:
        """The table of steps, by their numbers: a row's cells as text."""
        self.page.locator('tr[data-row="0"]').wait_for()
        rows = [self.page.locator(f'tr[data-row="{n}"]') for n in range(self.count())]
        return [row.locator("td").all_inner_texts() for row in rows]

    def count(self) -> int:
        """How many steps there are."""
        return self.page.locator("table[aria-label=Steps] tr[data-row]").count()

    def tab(self, name: str) -> Seen:
        self.page.get_by_text(name, exact=True).click()
        return self

    def press(self, name: str) -> Seen:
        self.page.get_by_role("button", name=name, exact=True).click()
        return self

    def download(self, name: str) -> Path:
        """Press a link, and what came of it."""
        with self.page.expect_download(timeout=LONG) as waiting:
            self.page.get_by_role("button", name=name).click()
        return Path(waiting.value.path())

    def clean(self) -> None:
        """Nothing was asked for elsewhere, and nothing went wrong."""
        assert not self.outside, self.outside
        assert not self.wrong, self.wrong


@contextmanager
def opened(url: str) -> Iterator[Seen]:
    """A page of the workbench in a headless Chromium that reaches this machine alone."""
    path = chromium()
    api = pytest.importorskip("playwright.sync_api", reason="Playwright for Python is not here")
    with api.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=path, args=[*ARGUMENTS, *QUIET])
        context = running.new_context(
            viewport={"width": 1280, "height": 800}, accept_downloads=True
        )
        try:
            yield Seen(context.new_page()).open(url)
        finally:
            running.close()
