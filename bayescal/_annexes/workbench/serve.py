"""Server of the workbench for a browser, on the loopback interface, under a secret path.

Every path, and the websocket, is below the secret (`prefix` of Bokeh's server), so that neither other users of this
computer nor pages of other sites can reach it. Websockets are accepted from this origin only, and requests with this
Host header only, which prevents DNS rebinding. Nothing is loaded from other sites: Panel serves its own scripts.
"""

from __future__ import annotations

import secrets
import socket
import tempfile
import webbrowser
from collections.abc import Collection, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import panel as pn
from jinja2 import Template
from tornado.web import ErrorHandler

from bayescal import workshop as ws
from bayescal._annexes.workbench.app import Workbench
from bayescal._annexes.workbench.session import Session

LOOPBACK = "127.0.0.1"
MAX_MESSAGE_BYTES = 64 * 2**20  # of a websocket message; a selection of all points is far smaller
MAX_REQUEST_BYTES = 2**16  # of a request's headers and body: requests of the page have no body

FOLDER = Path(__file__).parent
# Scripts come last, so that the page above them is visible while they load.
PAGE = Template(
    "{% from macros import embed %}"
    + (FOLDER / "parts" / "skeleton.html").read_text("utf-8")
    + "{{ bokeh_css }}{{ bokeh_js }}{% for root in docs[0].roots %}{{ embed(root) }}{% endfor %}"
    + "{{ plot_script }}</body></html>"
)


def build_page(session: Session) -> pn.viewable.Viewable:
    """Build the page of a browser tab for a session."""
    document = pn.state.curdoc
    assert document is not None
    document.title, document.template = "bayescal workbench", PAGE
    return Workbench(session).view


EMBEDDING_PATH = "/autoload.js"  # of Bokeh, with which any other site could embed the workbench


def restrict_requests(application: Any, hosts: Collection[str]) -> None:
    """Reject requests for the embedding script (status 404), or whose Host header is not among `hosts` (403)."""
    find_handler = application.find_handler

    def find_allowed(request: Any, **keywords: Any) -> Any:
        status = 404 if request.path.endswith(EMBEDDING_PATH) else 403
        if request.host.lower() in hosts and status != 404:
            return find_handler(request, **keywords)
        return application.get_handler_delegate(request, ErrorHandler, {"status_code": status})

    application.find_handler = find_allowed


FORWARDING_PAGE = '<!DOCTYPE html><meta http-equiv="refresh" content="0; url={0}"><a href="{0}">bayescal workbench</a>'


@contextmanager
def open_in_browser(url: str, folder: Path) -> Iterator[None]:
    """Open an address in the browser through a forwarding file that only this user can read.

    An address among the browser's arguments would be visible to all users of the computer. The file is in `folder`,
    since a sandboxed browser cannot read temporary files, and is removed on exit.
    """
    with tempfile.TemporaryDirectory(prefix="open_", dir=folder.resolve()) as private:  # mode 700
        file = Path(private) / "workbench.html"
        file.touch(0o600)
        file.write_text(FORWARDING_PAGE.format(ws.escape_html(url)), "utf-8")
        webbrowser.open(file.as_uri())
        yield


def serve(session: Session, files: str, folder: Path, *, open_browser: bool) -> None:
    """Serve the workbench until Ctrl-C, at a free port under a path of 256 random bits; print the address.

    Args:
        session: session to show.
        files: names of the session's files, which are printed.
        folder: folder of the session, in which the file that opens a browser is created.
        open_browser: whether to open a browser.
    """
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    path, hosts = f"/{secrets.token_urlsafe(32)}", [f"{n}:{port}" for n in (LOOPBACK, "localhost")]
    url = f"http://{LOOPBACK}:{port}{path}/"
    server = pn.io.server.get_server(
        {"/": lambda: build_page(session)},
        port=port,
        address=LOOPBACK,
        websocket_origin=hosts,
        prefix=path,
        ico_path="none",
        websocket_max_message_size=MAX_MESSAGE_BYTES,
        http_server_kwargs=dict.fromkeys(("max_body_size", "max_header_size"), MAX_REQUEST_BYTES),
        keep_alive_milliseconds=10_000,
        title="bayescal workbench",
    )
    restrict_requests(server._tornado, hosts)
    server.start()
    print(f"bayescal workbench of {files}: {url}")
    print(f"(press Ctrl-C to stop; the session is saved in {folder})", flush=True)
    try:
        with open_in_browser(url, folder) if open_browser else nullcontext():
            server.io_loop.start()
    finally:
        session.stop()
        server.stop()
