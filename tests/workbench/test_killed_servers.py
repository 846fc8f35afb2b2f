"""A workbench that is killed at any moment while somebody works with its page goes on with the same numbers.

`BAYESCAL_KILLS=50 python -m pytest -m nightly tests/workbench/test_killed_servers.py` kills so many; usually few.
"""

from __future__ import annotations

import itertools
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path

import numpy as np
import pytest

from bayescal._workbench.kept import SESSION, State
from bayescal._workbench.session import Session
from tests.support.command_line import needs_installation
from tests.workbench.real_page import write_campaign
from tests.workbench.test_serve import Server
from tests.workbench.visitor import Gone, Visitor

pytest.importorskip("panel", reason="bayescal[workbench] is not installed")
pytestmark = [
    pytest.mark.nightly,
    needs_installation,
    pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX"),
    # Tornado leaves sockets to the garbage collector where the other end was killed.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
KILLS = int(os.environ.get("BAYESCAL_KILLS", "4"))
ADDED = ("bias.drift", "bias.thermal_lag", "bias.temperature_quadratic")
Numbers = tuple[dict[str, float | None], np.ndarray]


def numbers(state: State) -> Numbers:
    return dict(state.step.errors()), state.calibration.joint.x


def work(server: Server, todo: Sequence[str]) -> None:
    """Add effects one after another, until all are there or the server is gone."""
    server.ready()
    visitor = Visitor(server.url)
    try:
        visitor.wait_for_step(0)
        for name in todo:
            before = len(visitor.steps())
            visitor.press("Candidates", name, "add")
            visitor.wait_for_step(before)
    finally:
        visitor.close()


def life(
    file: Path, folder: Path, todo: Sequence[str], seconds: float
) -> tuple[Session | None, bool]:
    """Work with a server that is killed after so many seconds: the session that it leaves; whether it was killed."""
    server = Server(file, folder)
    killer = threading.Timer(seconds, server.process.kill)
    killer.start()
    try:
        work(server, todo)
        killed = False
    except (Gone, OSError, HTTPException):
        if not killer.finished.is_set():  # it is none of our doing
            raise AssertionError(
                f"ended with {server.process.poll()}: {''.join(server.said)}"
            ) from None
        killed = True
    finally:
        killer.cancel()
        server.end(signal.SIGKILL)
    kept = folder / server.session
    assert not folder.exists() or [p.name for p in folder.iterdir()] in ([], [server.session])
    return Session.resume(kept) if (kept / SESSION).exists() else None, killed


def test_a_server_killed_at_random_moments_goes_on_with_the_same_numbers(tmp_path: Path) -> None:
    file, _ = write_campaign(tmp_path)
    begun = time.monotonic()
    whole, _ = life(file, tmp_path / "whole", ADDED, 1e6)
    long = time.monotonic() - begun
    assert whole is not None
    right = {state.model.names: numbers(state) for state in whole.states.values()}
    assert len(right) == 1 + len(ADDED)

    rng, met, seen = np.random.default_rng(1), 0, Counter[int]()
    for path in itertools.count():
        todo = [*ADDED]
        while todo:
            last = met >= KILLS
            seconds = 1e6 if last else rng.uniform(0.0, long)
            session, killed = life(file, tmp_path / f"path_{path}", todo, seconds)
            met += killed
            kept = 0 if session is None else len(session.states)
            print(
                f"path {path}: {'killed' if killed else 'ended'} with {kept} steps kept", flush=True
            )
            seen[kept] += killed
            if session is None:
                continue
            for state in session.states.values():
                errors, draws = right[state.model.names]
                assert dict(state.step.errors()) == errors
                assert np.array_equal(state.calibration.joint.x, draws)
            todo = [name for name in ADDED if name not in session.current.model.names]
        if met >= KILLS:
            break
    print(f"{met} kills, by the steps that they left: {dict(seen)}")
    assert len(seen) > 1
