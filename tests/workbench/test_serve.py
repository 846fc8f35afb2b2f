"""Who is served, and who is not; what stands before the page does; what the command refuses."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

import bayescal as bc
from bayescal._workbench import start
from bayescal._workbench.session import Session
from tests.support.command_line import GYRO, needs_installation, run
from tests.workbench.conftest import Campaign

pytest.importorskip("panel", reason="bayescal[workbench] is not installed")
ROOT = Path(__file__).resolve().parents[2]
COMMAND = "from bayescal._cli.main import main; main()"
LATE = 300.0  # seconds after which a server is given up


def get(url: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url, timeout=30) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode("utf-8", "replace")


class Server:
    """`bayescal workbench` in a process of its own."""

    def __init__(self, file: Path, folder: Path) -> None:
        command = ["workbench", str(file), *GYRO, "--no-open", "--out", str(folder)]
        self.process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, *command],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        told = self.process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:(\d+)(/\S+)/\?session=(\w+)", told)
        assert found is not None, told + (self.process.stderr.read() if self.process.stderr else "")
        self.url, self.port, self.path, self.session = found[0], int(found[1]), found[2], found[3]
        self.waited = False

    def ready(self) -> str:
        """The page, once it is the workbench's own."""
        ends = time.monotonic() + LATE
        while time.monotonic() < ends:
            try:
                status, page = get(self.url)
            except (urllib.error.URLError, ConnectionError):  # while one server follows the other
                continue
            if status == 200 and "bokeh" in page:
                return page
            self.waited = self.waited or (status == 200 and "readings.csv" in page)
            time.sleep(0.1)
        raise AssertionError("the workbench did not come up")

    def end(self, how: signal.Signals = signal.SIGINT) -> tuple[int, str, str]:
        if self.process.poll() is None:
            self.process.send_signal(how)
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


@pytest.fixture(scope="module")
def server(campaign: Campaign, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    one = Server(campaign.file, tmp_path_factory.mktemp("served") / "out")
    yield one
    one.end(signal.SIGKILL)


@needs_installation
@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as POSIX does")
def test_only_the_whole_address_is_served(server: Server) -> None:
    page = server.ready()
    assert server.waited, "nothing was shown before the workbench"
    assert "https://" not in re.sub(
        r"<!--.*?-->", "", "".join(re.findall(r'(?:src|href)="[^"]*"', page))
    )
    base = f"http://127.0.0.1:{server.port}"
    for path in ("", "/", "/favicon.ico", "/static/js/bokeh.min.js", "/ws", server.path[:-1], "/x"):
        assert get(base + path)[0] == 404, path
    assert get(f"{base}{server.path}/static/js/bokeh.min.js")[0] == 200


@needs_installation
@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as POSIX does")
def test_a_websocket_needs_the_address_and_comes_from_it(server: Server) -> None:
    from tornado.httpclient import HTTPClientError, HTTPRequest
    from tornado.websocket import websocket_connect

    page = server.ready()
    token = re.search(r'"token":"([^"]+)"', page)
    assert token is not None

    async def opened(path: str, origin: str) -> int:
        request = HTTPRequest(f"ws://127.0.0.1:{server.port}{path}", headers={"Origin": origin})
        try:
            connection = await websocket_connect(request, subprotocols=["bokeh", token[1]])
        except HTTPClientError as error:
            return error.code
        connection.close()
        while await connection.read_message() is not None:
            pass
        return 101

    own = f"http://127.0.0.1:{server.port}"
    assert asyncio.run(opened(f"{server.path}/ws", own)) == 101
    assert asyncio.run(opened(f"{server.path}/ws", "http://evil.example")) == 403
    assert asyncio.run(opened("/ws", own)) == 404


@pytest.mark.slow
@needs_installation
@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as POSIX does")
def test_ended_and_gone_on_with(campaign: Campaign, tmp_path: Path) -> None:
    """Killed, then resumed by the same command, then ended by Ctrl-C."""
    folder = tmp_path / "out"
    first = Server(campaign.file, folder)
    first.ready()
    assert first.end(signal.SIGKILL)[0] == -signal.SIGKILL
    session = Session.resume(folder / first.session)
    session.add("bias.drift")
    again = Server(campaign.file, folder)
    assert again.session == first.session and again.path != first.path
    again.ready()
    status, out, err = again.end()
    assert (status, "Traceback" in err) == (0, False), err
    assert out.endswith("bayescal workbench: ended\n")
    assert sorted(p.name for p in folder.iterdir()) == ["session_1"]


@needs_installation
def test_a_bad_file_is_refused_before_anything_opens(tmp_path: Path) -> None:
    file = tmp_path / "bad.csv"
    file.write_text("temperature [furlong],output [deg/s]\n20,1\n21,2\n")
    done = run("workbench", file, *GYRO, "--no-open", "--out", tmp_path / "out")
    assert done.status == 2 and "furlong" in done.err
    assert not (tmp_path / "out").exists()


def test_without_panel_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(bc.InputError, match=r"pip install 'bayescal\[workbench\]'"):
        start.refuse_without_panel()


def test_the_waiting_page_is_of_one_address_and_escapes(tmp_path: Path) -> None:
    address = start.Address.new()
    with start.Waiting(address, "<script>alert(1)</script>.csv", "Reading …"):
        status, page = get(address.of("session_1"))
        assert status == 200 and "&lt;script&gt;alert(1)&lt;/script&gt;.csv" in page
        assert "<script>alert" not in page and "Reading …" in page
        assert get(f"http://127.0.0.1:{address.port}/")[0] == 404
        assert get(f"http://127.0.0.1:{address.port}{address.path[:-1]}")[0] == 404
    with pytest.raises(urllib.error.URLError):
        get(address.of("session_1"))


def test_sessions_of_a_server(session: Session, tmp_path: Path) -> None:
    """A tab without a name begins one; a name gives the same again; two at once begin two."""
    from bayescal._workbench.serve import Sessions

    def begin(folder: Path) -> Session:
        return Session.begin(session.current.model, session.readings, folder=folder)

    sessions = Sessions(tmp_path / "served", begin)
    made: list[Session] = []
    tabs = [threading.Thread(target=lambda: made.append(sessions.open())) for _ in range(2)]
    for tab in tabs:
        tab.start()
    for tab in tabs:
        tab.join()
    names = {one.folder.name for one in made}
    assert names == {"session_1", "session_2"}
    assert sessions.open("session_1") is sessions.open("session_1")
    assert sessions.there("session_3") is None
    with pytest.raises(bc.InputError, match=r"there is no session '\.\./\.\./x' here"):
        sessions.open("../../x")
    again = Sessions(tmp_path / "served", begin)
    assert again.open("session_2").states[0].title == "baseline"
    assert start.kept_sessions(tmp_path / "served") == ["session_1", "session_2"]
