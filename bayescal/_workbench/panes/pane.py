"""What every part of the page is: over one bench, which has the session, the work beside the page and its colours."""

from __future__ import annotations

from typing import Any

from bayescal._workbench.parts.style import Palette, dress


class Pane:
    """A part of the page; what of this it has no use for, it leaves as it is here.

    Attributes:
        bench: the whole page (`app.Workbench`), through which a pane acts.
        figures: Bokeh's, which take the colours of the ground.
        view: what Panel shows.
    """

    view: Any

    def __init__(self, bench: Any) -> None:
        self.bench = bench
        self.figures: list[Any] = []

    @property
    def session(self) -> Any:
        """The bench's session, which another file may have replaced."""
        return self.bench.session

    def show(self, state: Any) -> None:
        """Show another state, or forget what was of the one before."""

    def wear(self, palette: Palette) -> None:
        """Take the colours of a ground."""
        for made in self.figures:
            dress(made, palette)

    def busy(self, busy: bool) -> None:
        """Shut or open what changes the model."""
