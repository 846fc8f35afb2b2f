"""Who is served, and who is not; what the command refuses."""

from __future__ import annotations

import asyncio
import contextlib
import html
import http.client
import os
import re
import signal
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.command_line import GYRO, needs_installation
from tests.support.open_ports import listening, needs_proc
from tests.workbench.conftest import Campaign
from tests.workbench.real_page import Bench

pytest.importorskip("panel", reason="bayescal[workbench] is not installed")
LATE = 300.0  # seconds after which a server is given up


def get(url: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url, timeout=30) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode("utf-8", "replace")


class Server(Bench):
    """`bayescal workbench` of a file, in a process of its own."""

    def __init__(self, file: Path, folder: Path) -> None:
        super().__init__(file, *GYRO, "--out", folder)
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)(/\S+)/", self.url)
        assert found is not None, self.said
        self.port, self.path = int(found[1]), found[2]

    def ready(self) -> str:
        """The page, once it is the workbench's own."""
        ends = time.monotonic() + LATE
        while time.monotonic() < ends:
            try:
                status, page = get(self.url)
            except (urllib.error.URLError, ConnectionError):  # while one server follows the other
                if self.process.poll() is not None:
                    raise
                continue
            if status == 200 and "bokeh" in page:
                return page
            time.sleep(0.1)
        raise AssertionError("the workbench did not come up")


@pytest.fixture(scope="module")
def server(campaign: Campaign, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    one = Server(campaign.file, tmp_path_factory.mktemp("served") / "out")
    yield one
    one.end(signal.SIGKILL)


@pytest.mark.nightly
@needs_installation
@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as POSIX does")
def test_only_the_whole_address_is_served(server: Server) -> None:
    page = server.ready()
    assert "https://" not in re.sub(
        r"<!--.*?-->", "", "".join(re.findall(r'(?:src|href)="[^"]*"', page))
    )
    base = f"http://127.0.0.1:{server.port}"
    for path in ("", "/", "/favicon.ico", "/static/js/bokeh.min.js", "/ws", server.path[:-1], "/x"):
        assert get(base + path)[0] == 404, path
    assert get(f"{base}{server.path}/static/js/bokeh.min.js")[0] == 200


def asked_as(server: Server, host: str, path: str = "", body: bytes = b"", **headers: str) -> int:
    """Status of a request under a Host, which a name that is made to lead here would send."""
    method = "POST" if body else "GET"
    asked = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    with contextlib.closing(asked) as connection:  # also where it is cut off
        connection.request(method, server.path + path, body or None, {"Host": host, **headers})
        with connection.getresponse() as answer:
            text = answer.read().decode("utf-8", "replace")
    assert server.path not in text or answer.status == 200
    return answer.status


@pytest.mark.nightly
@needs_installation
def test_another_host_is_refused(server: Server) -> None:
    """DNS rebinding: a page of another name that is made to lead to 127.0.0.1."""
    server.ready()
    for host in (
        f"evil.example:{server.port}",
        "evil.example",
        "127.0.0.1",
        f"127.0.0.1.evil:{server.port}",
    ):
        for path in ("/", "/static/js/bokeh.min.js", "/ws"):
            assert asked_as(server, host, path) == 403, (host, path)
    for host in (
        f"127.0.0.1:{server.port}",
        f"localhost:{server.port}",
        f"LOCALHOST:{server.port}",
    ):
        assert asked_as(server, host, "/static/js/bokeh.min.js") == 200, host


@pytest.mark.nightly
@needs_installation
def test_pages_of_other_origins_cannot_read_the_served_page(server: Server) -> None:
    server.ready()
    asked = "autoload.js?bokeh-autoload-element=x&bokeh-app-path=/&bokeh-absolute-url=/"
    for method in ("GET", "OPTIONS"):
        for path in ("", "metadata", "static/js/bokeh.min.js", asked):
            url = f"http://127.0.0.1:{server.port}{server.path}/{path}"
            request = urllib.request.Request(
                url, method=method, headers={"Origin": "http://evil.example"}
            )
            try:
                with urllib.request.urlopen(request, timeout=30) as answer:
                    status, headers = answer.status, answer.headers
            except urllib.error.HTTPError as error:
                status, headers = error.code, error.headers
            assert headers.get("Access-Control-Allow-Origin") is None, (method, path)
            assert path != asked or status == 404


BROWSER = """#!/bin/sh
printf '%s\\n' "$@" > {0}.part && mv {0}.part {0}
"""


@pytest.mark.slow
@needs_installation
@pytest.mark.skipif(os.name != "posix", reason="a browser that is a script")
def test_browser_arguments_hold_no_secret(campaign: Campaign, tmp_path: Path) -> None:
    """The arguments of a process are read by every user: the browser gets a file that only this one can read."""
    browser, asked = tmp_path / "browser", tmp_path / "asked"
    browser.write_text(BROWSER.format(asked))
    browser.chmod(0o700)
    running = Bench(campaign.file, *GYRO, "--out", tmp_path / "out", BROWSER=f"{browser} %s")
    try:
        ends = time.monotonic() + LATE
        while not asked.exists():
            assert time.monotonic() < ends and running.process.poll() is None, running.said
            time.sleep(0.05)
        argument = asked.read_text().strip()
        secret = running.url.split("/")[3]
        assert secret not in argument
        page = Path(urllib.request.url2pathname(urllib.parse.urlparse(argument).path))
        assert page.stat().st_mode & 0o777 == 0o600
        assert page.parent.stat().st_mode & 0o777 == 0o700
        forwarded = html.unescape(page.read_text("utf-8"))
        assert running.url in forwarded and get(running.url)[0] == 200
    finally:
        assert running.end(signal.SIGINT) in (0, 130)  # while it still loads
    assert not page.parent.exists()


@pytest.mark.nightly
@needs_installation
@needs_proc
def test_server_listens_on_localhost_only(server: Server) -> None:
    server.ready()
    assert listening(server.process.pid) == {("127.0.0.1", server.port)}


@pytest.mark.nightly
@needs_installation
@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as POSIX does")
def test_a_websocket_needs_the_address_and_comes_from_it(server: Server) -> None:
    from tornado.httpclient import HTTPClientError, HTTPRequest
    from tornado.websocket import websocket_connect

    page = server.ready()
    token = re.search(r'"token":"([^"]+)"', page)
    assert token is not None

    async def opened(path: str, origin: str, **headers: str) -> int:
        url = f"ws://127.0.0.1:{server.port}{path}"
        request = HTTPRequest(url, headers={"Origin": origin, **headers})
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
    evil = f"evil.example:{server.port}"
    assert asyncio.run(opened(f"{server.path}/ws", f"http://{evil}", Host=evil)) == 403
    assert asyncio.run(opened(f"{server.path}/ws", own, Host=evil)) == 403
    assert asyncio.run(opened(f"{server.path}/ws", "null")) == 403
