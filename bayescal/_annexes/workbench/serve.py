"""The workbench in a browser: on the loopback interface unless told otherwise, under an address that holds a secret.

Every path that is served, and the websocket, stands under that secret (`prefix` of Bokeh's server), so that neither
another user of this computer nor a page from elsewhere can reach it; a websocket is taken from this address alone, and
a request only under its name, so that no other name that is made to lead here (DNS rebinding) is answered.
Nothing is fetched from anywhere else: Panel serves its own scripts.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import panel as pn
from jinja2 import Template
from panel.io.state import set_curdoc
from tornado.web import ErrorHandler

from bayescal import workshop as ws
from bayescal._annexes.workbench.app import Workbench
from bayescal._annexes.workbench.parts.page_worker import in_words
from bayescal._annexes.workbench.parts.widgets import INSIDE, words
from bayescal._annexes.workbench.session import Session
from bayescal._annexes.workbench.start import Address, opened_in_browser

# Bytes of one message of a browser's; files come in pieces that are far smaller.
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


class Opened:
    """A session that is opened lazily, at the first request of its page.

    Attributes:
        session: None until then.
    """

    def __init__(self, make: Callable[[], Session]) -> None:
        """Store `make`, which begins or resumes a session."""
        self._make, self._lock = make, threading.Lock()
        self.session: Session | None = None

    def open(self) -> Session:
        """Open the session at the first call; return it.

        Raises:
            InputError: it can be neither begun nor resumed.
        """
        with self._lock:
            self.session = self.session or self._make()
            return self.session


def application(channels: Mapping[str, Opened]) -> Callable[[], Any]:
    """Return the factory of a tab's content: the page of a session, or a message until it is ready.

    Args:
        channels: the session of each channel of a unit, by its name; of a single one, by "".
    """

    def tab() -> Any:
        document = pn.state.curdoc
        assert document is not None
        name = pn.state.session_args.get("channel", [b""])[0].decode("utf-8", "replace")
        channel = name if name in channels else next(iter(channels))
        opened = channels[channel]
        place = pn.Column(sizing_mode="stretch_both", margin=0)
        document.title, document.template = "bayescal workbench", PAGE

        def show(session: Session) -> None:
            tags = (_link(n, n == channel) for n in channels if n)
            html = " ".join(tags)
            links = pn.pane.HTML(html, css_classes=["links"], stylesheets=[INSIDE], margin=0)
            with set_curdoc(document):
                place[:] = [Workbench(session, others=links).view]

        def refuse(text: str) -> None:
            with set_curdoc(document):
                place[:] = [words(text, margin=20)]

        def open_beside() -> None:
            try:
                session = opened.open()
            except Exception as error:
                document.add_next_tick_callback(partial(refuse, in_words(error)))
            else:
                document.add_next_tick_callback(partial(show, session))

        if opened.session is not None:
            show(opened.session)
            return place
        place[:] = [words("Fitting the first model …", margin=20)]
        work = threading.Thread(target=open_beside, daemon=True)
        pn.state.onload(work.start)  # a page that nobody looks at begins no session
        return place

    return tab


def _link(channel: str, active: bool) -> str:
    """Return the link to a channel's page; bold text for the active one."""
    name, query = ws.html_text(channel), urlencode({"channel": channel})
    return f"<b>{name}</b>" if active else f'<a href="?{query}">{name}</a>'


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


def serve(channels: Mapping[str, Opened], address: Address, text: str, folder: Path | None) -> None:
    """Serve the workbench until Ctrl-C.

    Args:
        channels: as of `application`.
        address: where.
        text: printed once it can be reached.
        folder: of the file that opens it in a browser; None opens none.
    """
    server = pn.io.server.get_server(
        {"/": application(channels)},
        port=address.port,
        address=address.host,
        websocket_origin=list(address.names),
        prefix=address.path,
        ico_path="none",
        websocket_max_message_size=LARGEST_MESSAGE,
        http_server_kwargs={"max_body_size": MOST_ASKED, "max_header_size": MOST_ASKED},
        keep_alive_milliseconds=10_000,
        title="bayescal workbench",
    )
    answer_only(server._tornado, address.names)
    server.start()
    print(text, flush=True)
    try:
        with nullcontext() if folder is None else opened_in_browser(address.url, folder):
            server.io_loop.start()
    finally:
        for opened in channels.values():
            if opened.session is not None:
                opened.session.stop()
        server.stop()
