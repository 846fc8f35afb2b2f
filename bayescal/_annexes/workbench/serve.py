"""The workbench in a browser: on the loopback interface, under an address that holds a secret.

Every path that is served, and the websocket, stands under that secret (`prefix` of Bokeh's server), so that neither
another user of this computer nor a page from elsewhere can reach it; a websocket is taken from this address alone, and
a request only under its name, so that no other name that is made to lead here (DNS rebinding) is answered.
Nothing is fetched from anywhere else: Panel serves its own scripts.
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

# Bytes of one message of a browser's; a selection of all drawn readings is far smaller.
LARGEST_MESSAGE = 64 * 2**20
MOST_ASKED = 2**16  # bytes of a request beside its messages: the page asks without a body

FOLDER = Path(__file__).parent
# Scripts come last: what stands before them is seen while they load.
PAGE = Template(
    "{% from macros import embed %}"
    + (FOLDER / "parts" / "skeleton.html").read_text("utf-8")
    + "{{ bokeh_css }}{{ bokeh_js }}{% for root in docs[0].roots %}{{ embed(root) }}{% endfor %}"
    + "{{ plot_script }}</body></html>"
)


def page(session: Session) -> pn.viewable.Viewable:
    """Return the content of a browser's tab over a session."""
    document = pn.state.curdoc
    assert document is not None
    document.title, document.template = "bayescal workbench", PAGE
    return Workbench(session).view


UNUSED = "/autoload.js"  # of Bokeh, by which pages from elsewhere would show the workbench: it answers any of them


def answer_only(application: Any, names: Collection[str]) -> None:
    """Have an application of Tornado answer requests whose Host is one of these, and refuse others (403)."""
    find_handler = application.find_handler

    def find(request: Any, **keywords: Any) -> Any:
        status = 404 if request.path.endswith(UNUSED) else 403
        if request.host.lower() in names and status != 404:
            return find_handler(request, **keywords)
        return application.get_handler_delegate(request, ErrorHandler, {"status_code": status})

    application.find_handler = find


def serve(session: Session, address: Address, text: str, folder: Path | None) -> None:
    """Serve the workbench until Ctrl-C.

    Args:
        session: that its pages show.
        address: where.
        text: printed once it can be reached.
        folder: of the file that opens it in a browser; None opens none.
    """
    server = pn.io.server.get_server(
        {"/": lambda: page(session)},
        port=address.port,
        address=LOOPBACK,
        websocket_origin=address.hosts,
        prefix=address.path,
        ico_path="none",
        websocket_max_message_size=LARGEST_MESSAGE,
        http_server_kwargs={"max_body_size": MOST_ASKED, "max_header_size": MOST_ASKED},
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
