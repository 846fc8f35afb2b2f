"""Page of the workbench: layout of its panes, and actions of its buttons."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel as pn
import param
from panel.custom import JSComponent

from bayescal._annexes.workbench.panes.candidates_pane import CandidatesPane
from bayescal._annexes.workbench.panes.model_pane import ModelPane
from bayescal._annexes.workbench.panes.residual_pane import ResidualPane
from bayescal._annexes.workbench.panes.tabs import ErrorPane, Tabs
from bayescal._annexes.workbench.parts.page_worker import PageWorker
from bayescal._annexes.workbench.parts.widgets import CSS, INSIDE, row, words

FOLDER = Path(__file__).parent


class Browser(JSComponent):
    """State shared with the browser: whether the page is out of date, and the message for a lost server.

    Attributes:
        stale: whether the page is dimmed because its model is being replaced.
        folder: folder of the session, for the message of a lost server.
    """

    stale = param.Boolean(default=False)
    folder = param.String(default="")

    _esm = FOLDER / "parts" / "browser.js"


class Workbench:
    """One user's page for a session; its panes act through it.

    Attributes:
        session: session that the page shows and changes.
        view: Panel view of the page, for a server or a notebook.
    """

    def __init__(self, session: Any, *, framed: bool = False) -> None:
        """Args:
        session: session to show.
        framed: whether the page is part of another one, such as a notebook; otherwise it fills the window.
        """
        self.session = session
        self.work = PageWorker(self._report, self._set_busy)
        self.other: int | None = None  # number of the step to compare with; None: the parent
        self._progress, self._stopping = "", False  # of the last search
        self.model, self.residuals = ModelPane(self), ResidualPane(self)
        self.missing, self.error = CandidatesPane(self), ErrorPane(self)
        self.tabs = Tabs(self)
        self.view = self._page(framed)
        session.on_change.append(self._changed)
        self.refresh()
        pn.state.onload(self.look)  # since updates before the browser has connected may be lost
        document = pn.state.curdoc
        if document is not None and document.session_context is not None:
            document.on_session_destroyed(lambda _: self._close())

    def _page(self, framed: bool) -> pn.Column:
        self.status = words("", "small", "status")
        self.browser = Browser(margin=0, width=0, height=0, folder=str(self.session.folder.parent))
        title = pn.pane.HTML("<h1>bayescal workbench</h1>", stylesheets=[INSIDE], margin=0)
        about = words(readings_in_words(self.session), "small", "about")
        return pn.Column(
            row(title, about, self.status, self.browser, kinds=("top",)),
            *(self.model.view, self.residuals.view, self.missing.view, self.tabs.view),
            css_classes=["framed"] * framed,
            stylesheets=[CSS],
            sizing_mode="stretch_both",
            margin=0,
        )

    def _close(self) -> None:
        self.session.on_change.remove(self._changed)
        self.work.close()

    def _changed(self) -> None:
        """Refresh after another page changed the state; actions of this page refresh when they end."""

        def show() -> None:
            state = self.session.current.number, len(self.session.states)
            if not self.work.busy and state != self._shown:
                self.done()

        self.work.on_page(show)

    def compare(self, number: int) -> None:
        """Compare the current step with another one, in the panels and in numbers."""
        self.other = number
        self.refresh()
        self.residuals.show_other()
        self.tabs.which.value = "Side by side"

    def refresh(self) -> None:
        """Show the session's current state."""
        states, state = self.session.states, self.session.current
        self._shown = (state.number, len(states))
        if self.other == state.number:
            self.other = None
        other = states.get(state.parent if self.other is None else self.other)
        self.residuals.show(state, other)
        self.tabs.compare.set_other(None if other is None else other.number)
        for pane in (self.model, self.missing, self.error, self.tabs):
            pane.show(state)

    def act(self, name: str, *arguments: Any) -> None:
        """Run an action of the session in a worker thread, then show the resulting state."""
        self.work.forget_preview()
        self.error.show_search_progress(False)  # clears the last search's progress
        status = f"{name.replace('_', ' ')} {' '.join(map(str, arguments))} …"
        self.browser.stale = True
        job = lambda: getattr(self.session, name)(*arguments)  # noqa: E731
        self.work.run(job, self.done, status=status, changes=True, failed=self._fresh)

    def _fresh(self) -> None:
        self.browser.stale = False

    def run(self, job: Callable[[], Any], then: Callable[[Any], None], status: str = "") -> None:
        """Run a job in a worker thread, then call `then(result)` on the page if the current state is unchanged."""
        number = self.session.current.number

        def show(result: Any) -> None:
            if self.session.current.number == number:
                then(result)

        self.work.run(job, show, status=status)

    def ask(self, done: Callable[[Any], None], *action: Any) -> None:
        """Compute the preview of an action, then call `done` with it."""
        self.work.preview(lambda: self.session.preview(*action), done)

    def _show_missing(self, _: Any = None) -> None:
        """Show the candidates missing from the current state."""
        for pane in (self.missing, self.model, self.error):
            pane.show(self.session.current)

    def look(self) -> None:
        """Show the effects missing from the current state; search for them unless that is done."""
        state = self.session.current
        if state.discovery is not None:
            self._show_missing()
        elif not state.calibration.verdict.ok:
            reason = "The result is not reliable: a search requires a reliable fit."
            self.missing.show(state, reason)
        else:
            self.run(self.session.look, self._show_missing)

    def done(self, _: Any = None) -> None:
        """Show the state after an action, and search for effects missing from it."""
        self._fresh()
        self.refresh()
        if self.session.current.discovery is None:
            self.look()

    def point(self, effect: str) -> None:
        """Draw a candidate's curve over the residuals; remove it if the effect is not a candidate of this state."""
        if effect not in {row["id"] for row in self.missing.rows.rows}:
            self.work.forget_preview()
            self.residuals.preview(None)
            return
        number = self.session.current.number

        def draw(preview: Any) -> None:
            if self.missing.rows.pointed == effect and self.session.current.number == number:
                self.residuals.preview(preview.curve)
                self.missing.preview(preview.in_words)

        self.ask(draw, "add", effect)

    def find_all(self) -> None:
        """Run the search from the current state; add a state for each step."""
        self.other, self._progress, self._stopping = None, "", False
        self.error.show_search_progress(True, "searching …")

        def follow(path: Any) -> None:
            self.work.on_page(lambda: self._searched(path))

        def ended(_: Any) -> None:
            self.error.show_search_progress(False, self._progress)
            self.done()

        def failed() -> None:
            self.error.show_search_progress(False)

        search = lambda: self.session.find_all(follow)  # noqa: E731
        self.work.run(search, ended, status="Finding all …", changes=True, failed=failed)

    def _searched(self, path: Any) -> None:
        self._progress = path.progress
        if not self._stopping:
            self.error.show_search_progress(True, self._progress)
        if len(self.session.states) > len(self.error.rows.rows):
            self.error.show(self.session.current)

    def stop(self) -> None:
        """Stop the search with the best model so far."""
        self.session.stop()
        self._stopping = True
        self.error.show_search_progress(True, "stopping …")

    def _set_busy(self, busy: bool) -> None:
        for pane in (self.model, self.missing, self.error):
            pane.busy(busy)

    def _report(self, text: str, refused: bool) -> None:
        self.status.object = text
        self.status.css_classes = ["small", "status", *(["refused"] if refused else [])]


def readings_in_words(session: Any) -> str:
    """Describe the readings of a session in words."""
    readings, held_out = session.readings, session.holdout
    text = f"{len(readings):,} readings of {readings.file}"
    text += f"; hold-out data: {len(held_out):,} of {held_out.file}" if held_out is not None else ""
    return text
