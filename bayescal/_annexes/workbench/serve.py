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
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import panel as pn
from bokeh.document import Document
from jinja2 import Template
from panel.io.state import set_curdoc
from tornado.web import ErrorHandler

from bayescal import InputError
from bayescal._annexes.workbench import kept
from bayescal._annexes.workbench.app import Workbench
from bayescal._annexes.workbench.parts.pieces import INSIDE, words
from bayescal._annexes.workbench.parts.work import in_words
from bayescal._annexes.workbench.session import Session
from bayescal._annexes.workbench.start import FIRST, Address, kept_sessions, opened_in_browser
from bayescal.workshop import html_text

# Bytes of one message of a browser's; files come in pieces that are far smaller.
LARGEST_MESSAGE = 64 * 2**20
MOST_LINKS = 4  # other sessions that are named; the others are in the folder
MOST_ASKED = 2**16  # bytes of a request beside its messages: the page asks without a body

HERE = Path(__file__).parent
# Scripts come last: what stands before them is seen while they load.
PAGE = Template(
    "{% from macros import embed %}"
    + (HERE / "parts" / "skeleton.html").read_text("utf-8")
    + "{{ bokeh_css }}{{ bokeh_js }}{% for root in docs[0].roots %}{{ embed(root) }}{% endfor %}"
    + "{{ plot_script }}</body></html>"
)


class Sessions:
    """The sessions of one server, each in a folder of its own; a tab is a session, a tab that is loaded again the same.

    Attributes:
        folder: that holds theirs.
    """

    def __init__(
        self,
        folder: Path,
        begin: Callable[[Path], Session],
        resume: Callable[[Path], Session] = Session.resume,
    ) -> None:
        """`begin(folder)` makes a new session, `resume(folder)` goes on with one."""
        self.folder, self._begin, self._resume = folder, begin, resume
        self._open: dict[str, Session] = {}
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()

    def open(self, name: str = "") -> Session:
        """The session of a name, resumed if need be; the first is begun where there is none. Without a name a new one.

        Raises:
            InputError: there is none of that name, or it cannot be resumed.
        """
        if not name:
            session = self._begin(kept.fresh_folder(self.folder))
            self._open[session.folder.name] = session
            return session
        with self._lock:
            lock = self._locks.setdefault(name, threading.Lock())
        with lock:
            if name not in self._open:
                there = name in kept_sessions(self.folder)
                if not there and name != FIRST:
                    raise InputError(
                        f"there is no session {name!r} here: open the address without it"
                    )
                make = self._resume if there else self._begin
                self._open[name] = make(self.folder / name)
            return self._open[name]

    @property
    def last(self) -> str:
        """Name of the session that was worked with last; of the first where there is none."""
        return [FIRST, *kept_sessions(self.folder)][-1]

    def there(self, name: str) -> Session | None:
        """The session of a name, if it is open."""
        return self._open.get(name)

    def links(self, shown: str, channel: str) -> str:
        """HTML of the way to the other sessions of the folder, the last first, and to a new one."""
        names = [n for n in reversed(kept_sessions(self.folder)) if n != shown][:MOST_LINKS]
        told = [(n, {"session": n}) for n in names]
        return "".join(_link(*one, channel) for one in [*told, ("new session", {})])

    def stop(self) -> None:
        """End the searches that are under way."""
        for session in self._open.values():
            session.stop()


def _link(text: str, query: Mapping[str, str], channel: str) -> str:
    """A link within the address."""
    address = urlencode({**query, **({"channel": channel} if channel else {})})
    return f'<a href="?{html_text(address)}">{html_text(text)}</a> '


def application(channels: Mapping[str, Sessions]) -> Callable[[], Any]:
    """What a tab is given: the page of its session, or a word until that is ready.

    Args:
        channels: the sessions of each channel of a unit, by its name; of a single one, by "".
    """

    def tab() -> Any:
        document, location = pn.state.curdoc, pn.state.location
        assert document is not None
        asked, channel = (
            pn.state.session_args.get(name, [b""])[0].decode("utf-8", "replace")
            for name in ("session", "channel")
        )
        channel = channel if channel in channels else next(iter(channels))
        sessions = channels[channel]
        place = pn.Column(sizing_mode="stretch_both", margin=0)
        document.title, document.template = "bayescal workbench", PAGE

        def show(session: Session) -> None:
            name = session.folder.name
            told = "".join(
                f"<b>{html_text(n)}</b> " if n == channel else _link(n, {"session": s.last}, n)
                for n, s in channels.items()
                if n
            )
            links = pn.pane.HTML(
                told + sessions.links(name, channel),
                css_classes=["links"],
                stylesheets=[INSIDE],
                margin=0,
            )
            with set_curdoc(document):
                if location is not None:
                    query = {"session": name, **({"channel": channel} if channel else {})}
                    location.update_query(**query)  # pyright: ignore[reportArgumentType]
                place[:] = [Workbench(session, others=links).view]

        if (session := sessions.there(asked)) is not None:
            show(session)
            return place
        place[:] = [words("Fitting the first model …", margin=20)]
        work = threading.Thread(
            target=_open, args=(sessions, asked, document, place, show), daemon=True
        )
        pn.state.onload(work.start)  # a page that nobody looks at begins no session
        return place

    return tab


def _open(
    sessions: Sessions,
    asked: str,
    document: Document,
    place: pn.Column,
    show: Callable[[Session], None],
) -> None:
    """Open a session beside the page, then show it there; or say why not."""

    try:
        session = sessions.open(asked)
    except Exception as error:
        told = in_words(error)

        def refused() -> None:
            with set_curdoc(document):
                place[:] = [words(told, margin=20)]

        document.add_next_tick_callback(refused)
    else:
        document.add_next_tick_callback(lambda: show(session))


UNUSED = "/autoload.js"  # of Bokeh, by which pages from elsewhere would show the workbench: it answers any of them


def answer_only(application: Any, names: Collection[str]) -> None:
    """Have an application of Tornado answer requests whose Host is one of these, and refuse others (403)."""
    known = application.find_handler

    def find(request: Any, **more: Any) -> Any:
        status = 404 if request.path.endswith(UNUSED) else 403
        if request.host.lower() in names and status != 404:
            return known(request, **more)
        return application.get_handler_delegate(request, ErrorHandler, {"status_code": status})

    application.find_handler = find


def serve(
    channels: Mapping[str, Sessions], address: Address, told: str, folder: Path | None
) -> None:
    """Serve the workbench until Ctrl-C.

    Args:
        channels: as of `application`.
        address: where.
        told: that is printed once it can be reached.
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
    print(told, flush=True)
    url = address.of(next(iter(channels.values())).last)
    try:
        with nullcontext() if folder is None else opened_in_browser(url, folder):
            server.io_loop.start()
    finally:
        for sessions in channels.values():
            sessions.stop()
        server.stop()
