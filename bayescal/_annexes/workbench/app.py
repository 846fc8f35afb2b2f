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
from bayescal._annexes.workbench.parts.widgets import CSS, INSIDE, label, row

FOLDER = Path(__file__).parent


class Browser(JSComponent):
    """State of the page that its script in the browser uses.

    Attributes:
        stale: whether the page is dimmed because its model is being replaced.
        folder: folder of the session, named in the message that the connection to the server was lost.
    """

    stale = param.Boolean(default=False)
    folder = param.String(default="")

    _esm = FOLDER / "parts" / "browser.js"


class Workbench:
    """Page of a session for one user; its methods are the actions of its panes.

    Attributes:
        session: session that the page shows and changes.
        view: Panel view of the page, for a server or a notebook.
    """

    def __init__(self, session: Any, *, is_embedded: bool = False) -> None:
        """Build the page of a session; it fills the window, unless it is embedded in a notebook."""
        self.session = session
        self.worker = PageWorker(self._show_status, self._set_busy)
        self.compared_number: int | None = None  # of the step to compare with; None: the parent
        self._progress, self._stopping = "", False  # of the last search
        self.model, self.residuals = ModelPane(self), ResidualPane(self)
        self.candidates, self.errors = CandidatesPane(self), ErrorPane(self)
        self.tabs = Tabs(self)
        self.view = self._lay_out(is_embedded)
        session.on_change.append(self._follow_session)
        self.refresh()
        pn.state.onload(self.find_missing)  # updates before the browser has connected may be lost
        document = pn.state.curdoc
        if document is not None and document.session_context is not None:
            document.on_session_destroyed(lambda _: self._close())

    def _lay_out(self, is_embedded: bool) -> pn.Column:
        self.status = label("", "small", "status")
        self.browser = Browser(margin=0, width=0, height=0, folder=str(self.session.folder.parent))
        title = pn.pane.HTML("<h1>bayescal workbench</h1>", stylesheets=[INSIDE], margin=0)
        description = label(describe_readings(self.session), "small", "about")
        return pn.Column(
            row(title, description, self.status, self.browser, kinds=("top",)),
            *(self.model.view, self.residuals.view, self.candidates.view, self.tabs.view),
            css_classes=["framed"] * is_embedded,
            stylesheets=[CSS],
            sizing_mode="stretch_both",
            margin=0,
        )

    def _close(self) -> None:
        self.session.on_change.remove(self._follow_session)
        self.worker.close()

    def _follow_session(self) -> None:
        """Refresh the page if another page changed the session; this page's own actions refresh it when they end."""

        def show() -> None:
            state = self.session.current.number, len(self.session.states)
            if not self.worker.busy and state != self._shown_state:
                self.show_state()

        self.worker.call_on_page(show)

    def compare(self, number: int) -> None:
        """Compare the current step with another one, in the panels of residuals and in a table."""
        self.compared_number = number
        self.refresh()
        self.residuals.show_comparison()
        self.tabs.selection.value = "Side by side"

    def refresh(self) -> None:
        """Show the session's current state."""
        states, state = self.session.states, self.session.current
        self._shown_state = (state.number, len(states))
        if self.compared_number == state.number:
            self.compared_number = None
        other = states.get(state.parent if self.compared_number is None else self.compared_number)
        self.residuals.show(state, other)
        self.tabs.compare_pane.set_other(None if other is None else other.number)
        for pane in (self.model, self.candidates, self.errors, self.tabs):
            pane.show(state)

    def act(self, name: str, *arguments: Any) -> None:
        """Run an action of the session in a worker thread, then show the resulting state."""
        self.worker.forget_preview()
        self.errors.show_search_progress(False)  # clears the last search's progress
        status = f"{name.replace('_', ' ')} {' '.join(map(str, arguments))} …"
        self.browser.stale = True
        job = lambda: getattr(self.session, name)(*arguments)  # noqa: E731
        self.worker.run(job, self.show_state, status=status, is_change=True, on_error=self._undim)

    def _undim(self) -> None:
        self.browser.stale = False

    def run(self, job: Callable[[], Any], finish: Callable[[Any], None], status: str = "") -> None:
        """Run a job in a worker thread, then call `finish(result)` on the page if the current state is unchanged."""
        number = self.session.current.number

        def show(result: Any) -> None:
            if self.session.current.number == number:
                finish(result)

        self.worker.run(job, show, status=status)

    def preview(self, on_result: Callable[[Any], None], *action: Any) -> None:
        """Compute the preview of an action of the session, then call `on_result(preview)`."""
        self.worker.preview(lambda: self.session.preview(*action), on_result)

    def _show_missing(self, _: Any = None) -> None:
        """Show the candidates missing from the current state."""
        for pane in (self.candidates, self.model, self.errors):
            pane.show(self.session.current)

    def find_missing(self) -> None:
        """Show the effects missing from the current state, after a search for them if there was none."""
        state = self.session.current
        if state.discovery is not None:
            self._show_missing()
        elif not state.calibration.verdict.ok:
            reason = "The fit is not reliable: a search for effects requires a reliable fit."
            self.candidates.show(state, reason)
        else:
            self.run(self.session.find_missing, self._show_missing)

    def show_state(self, _: Any = None) -> None:
        """Show the state after an action, and search for effects missing from it."""
        self._undim()
        self.refresh()
        if self.session.current.discovery is None:
            self.find_missing()

    def draw_candidate(self, effect: str) -> None:
        """Draw a candidate's curve over the residuals; remove the curve if `effect` is not a current candidate."""
        if effect not in {row["id"] for row in self.candidates.rows.rows}:
            self.worker.forget_preview()
            self.residuals.preview(None)
            return
        number = self.session.current.number

        def draw(preview: Any) -> None:
            if self.candidates.rows.pointed == effect and self.session.current.number == number:
                self.residuals.preview(preview.curve)
                self.candidates.preview(preview.summary)

        self.preview(draw, "add", effect)

    def find_all(self) -> None:
        """Search from the current state to the end, or until `stop`; each step becomes a state."""
        self.compared_number, self._progress, self._stopping = None, "", False
        self.errors.show_search_progress(True, "searching …")

        def follow(path: Any) -> None:
            self.worker.call_on_page(lambda: self._show_path(path))

        def finish(_: Any) -> None:
            self.errors.show_search_progress(False, self._progress)
            self.show_state()

        def fail() -> None:
            self.errors.show_search_progress(False)

        search = lambda: self.session.find_all(follow)  # noqa: E731
        self.worker.run(search, finish, status="Finding all …", is_change=True, on_error=fail)

    def _show_path(self, path: Any) -> None:
        self._progress = path.progress
        if not self._stopping:
            self.errors.show_search_progress(True, self._progress)
        if len(self.session.states) > len(self.errors.rows.rows):
            self.errors.show(self.session.current)

    def stop(self) -> None:
        """Stop the search with the best model so far."""
        self.session.stop()
        self._stopping = True
        self.errors.show_search_progress(True, "stopping …")

    def _set_busy(self, is_busy: bool) -> None:
        for pane in (self.model, self.candidates, self.errors):
            pane.set_busy(is_busy)

    def _show_status(self, status_text: str, is_error: bool) -> None:
        self.status.object = status_text
        self.status.css_classes = ["small", "status", *(["refused"] if is_error else [])]


def describe_readings(session: Any) -> str:
    """Describe the readings of a session: number, file and hold-out data."""
    readings, held_out = session.readings, session.holdout
    text = f"{len(readings):,} readings of {readings.file}"
    text += f"; hold-out data: {len(held_out):,} of {held_out.file}" if held_out is not None else ""
    return text
