"""A visitor of the workbench without a browser: the page over HTTP, its websocket, presses of the buttons of its rows.

It speaks what Bokeh's own script does (docs.bokeh.org, "Server protocol"): three parts of JSON a message, then buffers.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

from tornado.httpclient import HTTPRequest
from tornado.websocket import (
    WebSocketClientConnection,
    WebSocketClosedError,
    websocket_connect,
)

LATE = 300.0  # s, after which nothing more is expected


class Gone(Exception):
    """The server is no longer there."""


class Visitor:
    """A tab with the page of a session."""

    def __init__(self, url: str) -> None:
        """`url`: the whole address, as the command prints it, once its page stands there."""
        with urlopen(url, timeout=LATE) as answer:
            token = re.search(r'"token":"([^"]+)"', answer.read().decode())
        assert token is not None
        self._runner, self._sent, self._parts = asyncio.Runner(), 0, urlsplit(url)
        self._socket = self._run(self._opened(token[1]))
        while self._received()[0]["msgtype"] != "ACK":  # what comes before it is not understood
            pass
        self._event("document_ready")

    async def _opened(self, token: str) -> WebSocketClientConnection:
        at = f"{self._parts.netloc}{self._parts.path.rstrip('/')}"
        headers = {"Origin": f"{self._parts.scheme}://{self._parts.netloc}"}
        request = HTTPRequest(f"ws://{at}/ws", headers=headers)
        return await websocket_connect(request, subprotocols=["bokeh", token])

    def close(self) -> None:
        async def end() -> None:
            self._socket.close()
            await asyncio.sleep(0.1)  # in which it says so to the server

        self._runner.run(end())
        self._runner.close()

    def _send(self, kind: str, content: Mapping[str, Any]) -> str:
        self._sent += 1
        header = {"msgid": str(self._sent), "msgtype": kind}

        async def send() -> None:
            for part in (header, {}, content):
                await self._socket.write_message(json.dumps(part))

        self._run(send())
        return header["msgid"]

    def _run(self, work: Any) -> Any:
        try:
            return self._runner.run(asyncio.wait_for(work, LATE))
        except TimeoutError:  # it is there, and does not answer
            raise
        except (WebSocketClosedError, OSError) as error:
            raise Gone from error

    def _event(self, name: str, **values: Any) -> None:
        entries = [list(item) for item in values.items()]
        event = {"type": "event", "name": name, "values": {"type": "map", "entries": entries}}
        sent = {"kind": "MessageSent", "msg_type": "bokeh_event", "msg_data": event}
        self._send("PATCH-DOC", {"events": [sent]})

    def _received(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The next message: its header and its content."""

        async def part() -> Any:
            if (found := await self._socket.read_message()) is None:  # once; then it waits for ever
                raise Gone(self._socket.close_code, self._socket.close_reason)
            return found

        async def receive() -> list[dict[str, Any]]:
            header, _, content = [json.loads(await part()) for _ in range(3)]
            for _ in range(2 * header.get("num_buffers", 0)):
                await part()
            return [header, content]

        header, content = self._run(receive())
        return header, content

    def _page(self) -> dict[str, Any]:
        """All that is on the page now."""
        asked = self._send("PULL-DOC-REQ", {})
        while True:
            header, content = self._received()
            if header.get("reqid") == asked:
                return content["doc"]

    def rows(self, label: str) -> tuple[str, dict[str, Any]] | None:
        """The component of rows of a name, and what it shows; None while it is not there."""
        for model in _models(self._page()):
            data = model.get("attributes", {}).get("data")
            shown = data.get("attributes", {}) if isinstance(data, dict) else {}
            if shown.get("label") == label:
                return model["id"], shown
        return None

    def steps(self) -> list[str]:
        """Numbers of the steps that the page shows."""
        found = self.rows("Steps")
        return [_plain(row)["id"] for row in found[1].get("rows", [])] if found else []

    def press(self, label: str, row: str, action: str) -> None:
        """Press a button of a row, once it is there and open."""
        ends = time.monotonic() + LATE
        while time.monotonic() < ends:
            model, shown = self.rows(label) or ("", {})
            rows = [one for one in map(_plain, shown.get("rows", ())) if one["id"] == row]
            actions = [a for one in rows for a in map(_plain, one.get("actions", ()))]
            if not shown.get("busy") and any(
                a["id"] == action and not a.get("off") for a in actions
            ):
                data = {"type": "map", "entries": [["row", row], ["action", action]]}
                self._event("data_event", model={"id": model}, data=data)
                return
            time.sleep(0.1)
        raise AssertionError(f"{label}: no row {row!r} to {action}")

    def wait_for_step(self, number: int) -> None:
        """Until the page shows a step of this number."""
        ends = time.monotonic() + LATE
        while str(number) not in self.steps():
            assert time.monotonic() < ends, f"step {number} did not come"
            time.sleep(0.1)


def _plain(value: dict[str, Any]) -> dict[str, Any]:
    """A table as Bokeh writes it, as one."""
    return dict(value["entries"]) if value.get("type") == "map" else value


def _models(value: Any) -> Iterator[dict[str, Any]]:
    """Every model in a document."""
    if isinstance(value, dict):
        if value.get("type") == "object" and "id" in value:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            yield from _models(inner)
