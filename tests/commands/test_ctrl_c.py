"""Ctrl-C ends a command with what there is: wherever the signal comes, and once only."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

import bayescal as bc
from bayescal._core import deadline


@pytest.fixture(autouse=True)
def _as_at_a_terminal() -> Iterator[None]:
    """Ctrl-C as at a terminal: a shell starts its background commands with it ignored, and these tests with them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
    # Work that was left behind goes with the process of a command; these tests wait for it.
    while any(thread.name == "bayescal" for thread in threading.enumerate()):
        time.sleep(0.05)


class Raising:
    """An object whose end presses Ctrl-C: what is raised in `__del__` is printed and lost, as in callbacks of JAX."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)


def asked_until_over() -> str:
    deadline.offer(lambda why: f"what there is ({why})")
    while True:
        deadline.current().ask()
        time.sleep(0.001)


def press(after: float) -> None:
    threading.Timer(after, os.kill, (os.getpid(), signal.SIGINT)).start()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ctrl_c_that_python_cannot_raise_is_not_lost() -> None:
    with deadline.until(apart=True) as end:
        Raising()
        assert end.interrupted
        assert deadline.within(asked_until_over) == "what there is (interrupted)"


@pytest.mark.slow
def test_ctrl_c_waits_until_jax_is_loaded(tmp_path, monkeypatch) -> None:
    code = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(0.2)\nWHOLE = True\n"
    (tmp_path / "jax_slowly.py").write_text(code, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with deadline.until(apart=True):
        with pytest.raises(KeyboardInterrupt):
            _loaded_and_worked()
        import jax_slowly  # pyright: ignore[reportMissingImports]

        assert jax_slowly.WHOLE


def _loaded_and_worked() -> None:
    import jax_slowly  # pyright: ignore[reportMissingImports]  # noqa: F401

    time.sleep(5.0)


@pytest.mark.slow
def test_ctrl_c_while_a_call_that_cannot_be_asked_is_waited_for() -> None:
    def deaf() -> str:
        deadline.offer(lambda why: f"what there is ({why})")
        time.sleep(3.0)
        return "all"

    with deadline.until(apart=True):
        press(0.2)
        assert deadline.within(deaf) == "what there is (interrupted)"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_ends_at_once_even_while_a_result_is_written() -> None:
    with deadline.until(apart=True):
        press(0.2)
        press(0.5)
        with pytest.raises(KeyboardInterrupt):
            deadline.finish(lambda: time.sleep(1.5))


def test_ctrl_c_before_there_is_anything_is_an_interrupt() -> None:
    def nothing() -> None:
        while True:
            deadline.current().ask()
            time.sleep(0.001)

    press(0.5)
    with deadline.until(apart=True), pytest.raises(KeyboardInterrupt):
        deadline.within(nothing)
    with pytest.raises(bc.TimeIsUp), deadline.until(0.05):
        deadline.within(nothing)
