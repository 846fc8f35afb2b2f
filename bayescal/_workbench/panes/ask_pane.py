"""Questions to the current step, answered in text: verdict, comparison, budget, decisions, where to measure next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, get_args

import panel as pn

from bayescal._data.unit_conversion import unit_label
from bayescal._search.plan_readings import ReadingPlan
from bayescal._use.budget import Budget
from bayescal._use.decide import CONFORMITY, FALSE_ACCEPT, Rule
from bayescal._workbench.panes.fails_panel import NOISE
from bayescal._workbench.parts.pieces import (
    button,
    code_field,
    column,
    field,
    halves,
    plot,
    row,
    words,
)
from bayescal._workbench.parts.style import LIGHT, Palette, dress, new_figure


class AskPane:
    """A question with its fields, and the answer, which is marked when the model is no longer the one it is of.

    Attributes:
        fields: what Panel shows above the button.
        answered: called on the page with what came.
        view: what Panel shows.
    """

    KINDS: ClassVar[tuple[str, ...]] = ("bare",)  # classes of the style of the answer's room

    def __init__(
        self,
        run: Callable[..., None],
        label: str,
        ask: Callable[[], Callable[[], Any]],
        told: str,
        *fields: Any,
        by_itself: bool = False,
    ) -> None:
        """Args:
        run: `run(words, job, then)` works beside the page.
        label: of the button.
        ask: reads the fields, on the page, and returns the job.
        told: what is asked, in words.
        fields: rows of widgets.
        by_itself: whether it is asked when it is looked at.
        """
        self._run, self._ask, self._by_itself = run, ask, by_itself
        self._now, self._of = -1, -1
        self.answered: Callable[[Any], None] = lambda _: None
        self.begin = button(label, lambda _: self.put(), color="primary")
        self.age = words("", "small")
        self.fields = column(*fields, sizing_mode="stretch_width", styles={"flex": "0 0 auto"})
        self.answer = words("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")
        self.right = column(self.answer, kinds=self.KINDS)
        buttons = row(self.begin, self.age)
        left = column(words(told, "small"), self.fields, buttons, kinds=("bare", "scrolls"))
        self.view = halves(left, self.right)

    def show(self, state: Any) -> None:
        """Another state: an answer that is of the one before stays, and says so."""
        self._now = state.number
        self._say_age()
        if self._by_itself and self._of != self._now:
            self.put()

    def put(self) -> None:
        """Ask."""
        of = self._now
        self._run("Computing …", self._ask(), lambda found: self._came(of, found))

    def _came(self, of: int, found: Any) -> None:
        self._of = of
        self.answer.object = str(found)
        self.answered(found)
        self._say_age()

    def _say_age(self) -> None:
        stale = self._of not in (-1, self._now)
        told = f"This answer is of step {self._of}; step {self._now} is shown." if stale else ""
        self.age.object = told or (f"Of step {self._of}." if self._of >= 0 else "")
        self.right.css_classes = [*self.KINDS, *["stale"] * stale]


class VerdictPane(AskPane):
    """Whether the result may be used, and why not."""

    def __init__(self, run: Callable[..., None], session: Callable[[], Any]) -> None:
        told = "Whether this model may be used as it is, fitted as bayescal calibrate fits it."
        super().__init__(run, "Judge it", lambda: session().verdict, told, by_itself=True)


class ComparePane(AskPane):
    """Two steps side by side."""

    def __init__(
        self, run: Callable[..., None], session: Callable[[], Any], beside: Callable[[int], None]
    ) -> None:
        self._session, self._other, self._showing = session, beside, False
        self.which = field(pn.widgets.Select, "with step", options={}, width=200)
        self.which.param.watch(lambda _: self._chosen(), "value")

        def ask() -> Callable[[], Any]:
            other = self.which.value
            return lambda: "" if other is None else session().compare(other)

        told = (
            "The step that is shown beside another one; its residuals stand in the panels, hollow."
        )
        super().__init__(run, "Compare", ask, told, row(self.which), by_itself=True)

    def beside(self, number: int | None) -> None:
        """Which step is the other."""
        states, now = self._session().states, self._session().current.number
        options = {f"{n} {s.title}": n for n, s in states.items() if n != now}
        self._showing = True
        self.which.param.update(
            options=options, value=number if number in options.values() else None
        )
        self._showing = False

    def show(self, state: Any) -> None:
        self.begin.disabled = self.which.value is None
        self._of = -1  # the other step may be another one
        super().show(state)

    def _chosen(self) -> None:
        if not self._showing and self.which.value is not None:
            self._other(self.which.value)


class BudgetPane(AskPane):
    """The uncertainty budget at an operating point."""

    def __init__(self, run: Callable[..., None], session: Callable[[], Any]) -> None:
        self._at: dict[str, Any] = {}
        self.room = row()

        def ask() -> Callable[[], Any]:
            at = {n: f.value for n, f in self._at.items() if f.value is not None}
            return lambda: session().budget(at)

        told = "Uncertainty of a corrected reading by its sources, at an operating point."
        super().__init__(run, "Make the budget", ask, told, self.room, by_itself=True)
        self.answered = self._fill

    def _fill(self, found: Budget) -> None:
        """A field a quantity of the operating point."""
        if list(self._at) == list(found.at):
            return
        self._at = {
            n: field(
                pn.widgets.FloatInput,
                f"{n} [{found.at_units[n] or '1'}]",
                value=float(f"{v:.6g}"),
                width=120,
            )
            for n, v in found.at.items()
        }
        self.room[:] = list(self._at.values())


class DecisionPane(AskPane):
    """Whether it conforms to limits."""

    def __init__(self, run: Callable[..., None], session: Callable[[], Any]) -> None:
        self.limits = code_field(
            "Limits, one a line", max_length=10_000, height=74, sizing_mode="stretch_width"
        )
        self.rule = field(
            pn.widgets.Select, "rule", options=list(get_args(Rule)), value="guarded", width=110
        )
        self.risk = field(pn.widgets.FloatInput, "false acceptance", value=FALSE_ACCEPT, width=100)
        self.until = field(pn.widgets.FloatInput, "conformity until", value=CONFORMITY, width=100)
        self.devices = field(
            pn.widgets.TextInput, "devices, for global risks", placeholder="sd 0.2 °/s", width=150
        )

        def ask() -> Callable[[], Any]:
            limits = [line.strip() for line in self.limits.value.splitlines() if line.strip()]
            asked = {
                "rule": self.rule.value,
                "false_accept": self.risk.value or 0.0,
                "conformity": self.until.value or 0.0,
                "population": self.devices.value.strip() or None,
            }
            return lambda: session().decide(limits, **asked)

        told = (
            "Does it meet its specification, and until when? Limits such as “bias: ±0.5 °/s”, “corrected reading: "
            "±0.1 °/s over -20..60 °C”. What is decided stands first in the report."
        )
        how = row(self.rule, self.risk, self.until, self.devices)
        super().__init__(run, "Decide", ask, told, self.limits, how)


class PlanPane(AskPane):
    """Where to measure next: the readings that make a stated uncertainty small."""

    KINDS = ("bare", "drawn")

    def __init__(self, run: Callable[..., None], session: Callable[[], Any]) -> None:
        self.limit = field(
            pn.widgets.TextInput,
            "what is to be known better",
            placeholder="corrected reading: ±0.1 °/s over -20..60 °C",
            width=320,
        )
        self.count = field(pn.widgets.IntInput, "readings to pick", value=12, start=0, width=100)

        def ask() -> Callable[[], Any]:
            limit, count = self.limit.value.strip(), self.count.value or 0
            return lambda: session().plan(limit, count)

        told = "Campaigns by the uncertainty that they would leave, and the readings of the best that matter most."
        super().__init__(run, "Plan", ask, told, row(self.limit, self.count))
        self.palette, self._drawn = LIGHT, None
        self.answered = self._draw

    def wear(self, palette: Palette) -> None:
        """Take the colours of a ground."""
        self.palette = palette
        if self._drawn is not None:
            dress(self._drawn, palette)

    def _draw(self, found: ReadingPlan) -> None:
        """What is left of the uncertainty with each reading of the best campaign."""
        left = [found.u, *(p.u for p in found.picked)]
        unit = unit_label(found.unit) or "1"
        made = new_figure("readings picked", f"u [{unit}]", tools="")
        count = list(range(len(left)))
        made.line(count, left, color=self.palette.blue, line_width=2)
        made.scatter(count, left, color=self.palette.blue, size=6)
        made.line([0, len(left) - 1], [found.campaigns[0].u] * 2, color=NOISE, line_dash="dashed")
        made.y_range.start, made.y_range.end = 0.0, 1.05 * found.u
        dress(made, self.palette)
        self._drawn = made
        self.right[:] = [plot(made), self.answer]
