"""The page: its panes, laid out on one screen, and what happens when something on it is pressed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel as pn
import param
from panel.custom import JSComponent

from bayescal._annexes.workbench.panes.fails import Fails
from bayescal._annexes.workbench.panes.missing import Missing
from bayescal._annexes.workbench.panes.model_pane import ModelPane
from bayescal._annexes.workbench.panes.tabs import ErrorPane, Tabs
from bayescal._annexes.workbench.parts.pieces import CSS, DARK, INSIDE, LIGHT, choice, row, words
from bayescal._annexes.workbench.parts.work import Work

HERE = Path(__file__).parent


class Browser(JSComponent):
    """What the browser prefers, sees and is given: its ground, its room, a server that is gone.

    Attributes:
        stale: whether what is shown is of a model that is being left; it is dimmed until the next one stands there.
        dark, wide, seen: whether it prefers a dark ground, has room for a further panel, and has said so.
        kept: folder in which everything is, for the words when the server is gone.
        undone: how often Ctrl-Z was pressed outside a field.
    """

    stale = param.Boolean(default=False)
    dark = param.Boolean(default=False)
    wide = param.Boolean(default=False)
    seen = param.Boolean(default=False)
    kept = param.String(default="")
    undone = param.Integer(default=0)

    _esm = HERE / "parts" / "browser.js"


class Workbench:
    """One person's page over one session; its panes act through it.

    Attributes:
        session: what it shows and acts on.
        palette: colours of its ground.
        view: what Panel serves, or shows in a notebook.
    """

    def __init__(self, session: Any, *, framed: bool = False, others: Any = None) -> None:
        """Args:
        session: what it is over.
        framed: part of another page, such as a notebook; else it takes the whole screen.
        others: what else stands at the top, such as the way to other sessions.
        """
        self.session, self.palette = session, LIGHT
        self.work = Work(self._tell, self._set_busy)
        self.beside: int | None = None  # the step that is compared with; None: the one before
        self._found, self._ending = "", False  # of the last search; whether it was stopped
        self.model, self.fails = ModelPane(self), Fails(self)
        self.missing, self.error = Missing(self), ErrorPane(self)
        self.tabs = Tabs(self)
        self._panes = (self.model, self.fails, self.missing, self.error, self.tabs)
        self.view = self._page(framed, others)
        session.on_change.append(self._changed)
        self.refresh()
        self._wear(False)
        pn.state.onload(self._opened)
        document = pn.state.curdoc
        if document is not None and document.session_context is not None:
            document.on_session_destroyed(lambda _: self._close())

    def _page(self, framed: bool, others: Any) -> pn.Column:
        self.told = words(readings_in_words(self.session), "small", "about")
        self.status = words("", "small", "status")
        kept = str(self.session.folder.parent)
        self.browser = Browser(margin=0, width=0, height=0, kept=kept)
        self.light = choice(["light", "dark"], "light", "Ground")
        self.light.param.watch(lambda event: self._wear(event.new == "dark"), "value")
        self.browser.param.watch(lambda _: self._prefer(), "seen")
        self.browser.param.watch(lambda _: self.undo(), "undone")
        title = pn.pane.HTML("<h1>bayescal workbench</h1>", stylesheets=[INSIDE], margin=0)
        beside = [self.status, *([] if others is None else [others]), self.light, self.browser]
        return pn.Column(
            row(title, self.told, *beside, kinds=("top",)),
            *(self.model.view, self.fails.view, self.missing.view, self.tabs.view),
            css_classes=["unsaid", *(["framed"] if framed else [])],
            stylesheets=[CSS],
            sizing_mode="stretch_both",
            margin=0,
        )

    def _close(self) -> None:
        self.session.on_change.remove(self._changed)
        self.work.close()

    def _changed(self) -> None:
        """A state was made or gone to, here or by another page: what is done here is shown when it is done."""

        def show() -> None:
            shown = self.session.current.number, len(self.session.states)
            if not self.work.busy and shown != self._shown:
                self.done()

        self.work.on_page(show)

    def compare(self, number: int) -> None:
        """Compare another step with this one: in the panels, and in numbers."""
        self.beside = number
        self.refresh()
        self.fails.when.value = "both"
        self.tabs.open("Side by side")

    def undo(self) -> None:
        """Go back to the state before, if there is one and nothing is under way."""
        if self.session.before is not None and not self.work.busy:
            self.act("undo")

    def refresh(self) -> None:
        """Show the session's current state."""
        states, state = self.session.states, self.session.current
        self._shown = (state.number, len(states))
        if self.beside == state.number:
            self.beside = None
        other = states.get(state.parent if self.beside is None else self.beside)
        self.fails.show(state, other)
        self.tabs.compare.beside(None if other is None else other.number)
        for pane in (self.model, self.missing, self.error, self.tabs):
            pane.show(state)

    def act(self, name: str, *arguments: Any) -> None:
        """Do something to the session beside the page, then show the state that it led to."""
        self.work.forget_preview()
        self.error.searching(False)  # what the last search found is of another path
        told = f"{name.replace('_', ' ')} {' '.join(map(str, arguments))} …"
        self.browser.stale = True
        job = lambda: getattr(self.session, name)(*arguments)  # noqa: E731
        self.work.begin(told, job, self.done, failed=self._fresh)

    def _fresh(self) -> None:
        self.browser.stale = False

    def run(
        self, told: str, job: Callable[[], Any], then: Callable[[Any], None], reads: bool = False
    ) -> None:
        """Other work beside the page; `then(result)` follows on it. What only `reads` waits for no search."""
        self.work.begin(told, job, then, reads=reads)

    def ask(self, done: Callable[[Any], None], *action: Any) -> None:
        """What an action would do."""
        self.work.preview(lambda: self.session.consequences(*action), done)

    def _opened(self) -> None:
        """The browser has answered: what it is told before may be lost, and another page may have looked meanwhile."""
        if self.session.current.discovery is not None:
            self._looked()
        self.look()

    def _looked(self) -> None:
        """Show what is missing from the current state."""
        now = self.session.current
        for pane in (self.missing, self.model, self.error):
            pane.show(now)
        self.tabs.looked(now)

    def look(self) -> None:
        """Look for what is missing from the current state, unless that is known."""
        state = self.session.current
        if state.discovery is not None:
            return
        if not state.calibration.verdict.ok:
            reason = "Result not reliable: nothing is looked for until the fit has converged."
            self.missing.show(state, reason)
            return

        def found(_: Any) -> None:
            if self.session.current.number == state.number:
                self._looked()

        self.work.look(self.session.look, found)

    def done(self, _: Any = None) -> None:
        """Something was done: show the state that it led to, and look for what is missing from it."""
        self._fresh()
        self.refresh()
        self.look()

    def point(self, effect: str) -> None:
        """Lay a candidate's curve over the residuals; none if it is no candidate."""
        if effect not in {
            row["id"] for row in self.missing.rows.rows
        }:  # none, or of a state before
            self.work.forget_preview()
            self.fails.preview(None)
            return
        shown = self.session.current.number

        def drawn(found: Any) -> None:
            if self.missing.rows.pointed == effect and self.session.current.number == shown:
                self.fails.preview(found.curve)
                self.missing.preview(found.in_words)

        self.work.preview(lambda: self.session.preview(effect), drawn)

    def find_all(self) -> None:
        """Search from the current state on, each step on the way a state."""
        self.beside, self._found, self._ending = None, "", False
        self.error.searching(True, "searching …")

        def follow(trail: Any) -> None:
            self.work.on_page(lambda: self._searched(trail))

        def ended(_: Any) -> None:
            self.error.searching(False, self._found)
            self.done()

        search, failed = lambda: self.session.find_all(follow), lambda: self.error.searching(False)
        self.work.begin("Finding all …", search, ended, failed=failed)

    def _searched(self, trail: Any) -> None:
        self._found = trail.progress
        if not self._ending:
            self.error.searching(True, self._found)
        if len(self.session.states) > len(self.error.rows.rows):
            self.error.show(self.session.current)

    def stop(self) -> None:
        """End the search with the best so far."""
        self.session.stop()
        self._ending = True
        self.error.searching(True, "stopping …")

    def _set_busy(self, busy: bool) -> None:
        for pane in self._panes:
            pane.busy(busy)

    def _tell(self, told: str, refused: bool) -> None:
        self.status.object = told
        self.status.css_classes = ["small", "status", *(["refused"] if refused else [])]

    def _prefer(self) -> None:
        if self.browser.seen and self.browser.dark:
            self.light.value = "dark"
        elif self.browser.seen:
            self._wear(False)
        self.fails.widen(self.browser.wide)  # the further panel is made in the page's colours

    def _wear(self, dark: bool) -> None:
        """Take a light or a dark ground."""
        seen = self.browser.seen or dark
        kept = [c for c in self.view.css_classes if c not in ("dark", "light", "unsaid")]
        self.view.css_classes = [*kept, ("dark" if dark else "light") if seen else "unsaid"]
        self.palette = DARK if dark else LIGHT
        for pane in self._panes:
            pane.wear(self.palette)


def readings_in_words(session: Any) -> str:
    """What a session is about."""
    readings, kept = session.readings, session.holdout
    told = f"{len(readings):,} readings of {readings.file}"
    told += f"; hold-out data: {len(kept):,} of {kept.file}" if kept is not None else ""
    return told
