"""A headless Chromium, where the machine has one: what the tests of the report share."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PLAYWRIGHT = Path.home() / ".cache" / "ms-playwright"


def found() -> str | None:
    """Path of a Chromium: on PATH, or where Playwright puts its own."""
    named = next((p for n in NAMES if (p := shutil.which(n))), None)
    if named or not PLAYWRIGHT.is_dir():
        return named
    kept = [
        p for n in ("chrome", "headless_shell") for p in sorted(PLAYWRIGHT.glob(f"chromium*/*/{n}"))
    ]
    return next((str(p) for p in kept if os.access(p, os.X_OK)), None)


def chromium() -> str:
    path = found()
    if path is None:
        pytest.skip(
            f"no Chromium on PATH ({', '.join(NAMES)}) nor of Playwright: the page was not opened"
        )
    return path


class Opened:
    """A page opened in Chromium: what it logged, and pictures of it."""

    def __init__(self, page: Path, folder: Path) -> None:
        self.page, self.folder, self.path = page.resolve(), folder, chromium()

    def _run(self, *options: str) -> subprocess.CompletedProcess[str]:
        command = [
            *(self.path, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *("--disable-background-networking", "--no-first-run", "--enable-logging=stderr"),
            *(f"--user-data-dir={self.folder / 'profile'}", *options, self.page.as_uri()),
        ]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)

    def screenshot(self, width: int, height: int, *options: str) -> tuple[Path, list[str]]:
        """A picture of the page at a width in CSS pixels, and what the page's console said."""
        name = self.folder / f"{self.page.stem}_{width}{''.join(options).replace('=', '_')}.png"
        ran = self._run(f"--screenshot={name}", f"--window-size={width},{height}", *options)
        return name, re.findall(r".*CONSOLE.*", ran.stderr)

    def dom(self, width: int) -> str:
        """The page as Chromium understood it."""
        return self._run("--dump-dom", f"--window-size={width},900").stdout
