"""Server of the workbench for a browser, on the loopback interface, under a secret path.

Every path, and the websocket, is below the secret (`prefix` of Bokeh's server), so that neither other users of this
computer nor pages of other sites can reach it. Websockets are accepted from this origin only, and requests with this
Host header only, which prevents DNS rebinding. Nothing is loaded from other sites: Panel serves its own scripts.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import panel as pn
from jinja2 import Template
from tornado.web import ErrorHandler

from bayescal._annexes.workbench.app import Workbench
from bayescal._annexes.workbench.session import Session
from bayescal._annexes.workbench.start import LOOPBACK, Address, opened_in_browser

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


def page(session: Session) -> pn.viewable.Viewable:
    """Build the page of a browser tab for a session."""
    document = pn.state.curdoc
    assert document is not None
    document.title, document.template = "bayescal workbench", PAGE
    return Workbench(session).view


EMBEDDING_PATH = "/autoload.js"  # of Bokeh, with which any other site could embed the workbench


def answer_only(application: Any, names: Collection[str]) -> None:
    """Restrict a Tornado application to requests whose Host header is among `names`; others get status 403."""
    find_handler = application.find_handler

    def find(request: Any, **keywords: Any) -> Any:
        status = 404 if request.path.endswith(EMBEDDING_PATH) else 403
        if request.host.lower() in names and status != 404:
            return find_handler(request, **keywords)
        return application.get_handler_delegate(request, ErrorHandler, {"status_code": status})

    application.find_handler = find


def serve(session: Session, address: Address, text: str, folder: Path | None) -> None:
    """Serve the workbench until Ctrl-C.

    Args:
        session: session to show.
        address: address of the server.
        text: text to print when the server is ready.
        folder: folder for the file that opens a browser; None to open none.
    """
    server = pn.io.server.get_server(
        {"/": lambda: page(session)},
        port=address.port,
        address=LOOPBACK,
        websocket_origin=address.hosts,
        prefix=address.path,
        ico_path="none",
        websocket_max_message_size=MAX_MESSAGE_BYTES,
        http_server_kwargs=dict.fromkeys(("max_body_size", "max_header_size"), MAX_REQUEST_BYTES),
        keep_alive_milliseconds=10_000,
        title="bayescal workbench",
    )
    answer_only(server._tornado, address.hosts)
    server.start()
    print(text, flush=True)
    try:
        with nullcontext() if folder is None else opened_in_browser(address.url, folder):
            server.io_loop.start()
    finally:
        session.stop()
        server.stop()
