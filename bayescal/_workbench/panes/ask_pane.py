"""Questions to the current step, answered in text: verdict, comparison, budget, decisions, what to measure next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import panel as pn

from bayescal._data.unit_conversion import unit_label
from bayescal._search.next_experiment import next_experiment
from bayescal._search.plan_readings import ReadingPlan
from bayescal._use.budget import Budget
from bayescal._use.decide import CONFORMITY, FALSE_ACCEPT, Rule
from bayescal._workbench.panes.fails_panel import NOISE
from bayescal._workbench.panes.pane import Pane
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
from bayescal._workbench.parts.style import dress, new_figure


class AskPane(Pane):
    """A question with its fields, and the answer, which is marked when the model is no longer the one it is of.

    A question has its words, the rows of its fields, and `question`, which reads them on the page and returns the job.
    """

    LABEL = ""  # of the button
    TOLD = ""  # what is asked, in words
    BY_ITSELF = False  # whether it is asked when it is looked at
    KINDS: tuple[str, ...] = ("bare",)  # classes of the style of the answer's room

    def __init__(self, bench: Any, *fields: Any) -> None:
        super().__init__(bench)
        self._now, self._of = -1, -1
        self.begin = button(self.LABEL, lambda _: self.put(), color="primary")
        self.age = words("", "small")
        above = column(*fields, sizing_mode="stretch_width", styles={"flex": "0 0 auto"})
        self.answer = words("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")
        self.right = column(self.answer, kinds=self.KINDS)
        buttons = row(self.begin, self.age)
        left = column(words(self.TOLD, "small"), above, buttons, kinds=("bare", "scrolls"))
        self.view = halves(left, self.right)

    def question(self) -> Callable[[], Any]:
        raise NotImplementedError

    def answered(self, found: Any) -> None:
        """Show more of an answer than its text."""

    def show(self, state: Any) -> None:
        """Another state: an answer that is of the one before stays, and says so."""
        self._now = state.number
        self._say_age()
        if self.BY_ITSELF and self._of != self._now:
            self.put()

    def put(self) -> None:
        """Ask."""
        of = self._now

        def came(found: Any) -> None:
            self._of, self.answer.object = of, str(found)
            self.answered(found)
            self._say_age()

        self.bench.run("Computing …", self.question(), came)

    def _say_age(self) -> None:
        stale = self._of not in (-1, self._now)
        told = f"This answer is of step {self._of}; step {self._now} is shown." if stale else ""
        self.age.object = told or (f"Of step {self._of}." if self._of >= 0 else "")
        self.right.css_classes = [*self.KINDS, *["stale"] * stale]


class VerdictPane(AskPane):
    """Whether the result may be used, and why not."""

    LABEL, BY_ITSELF = "Judge it", True
    TOLD = "Whether this model may be used as it is, fitted as bayescal calibrate fits it."

    def question(self) -> Callable[[], Any]:
        return self.session.verdict


class ComparePane(AskPane):
    """Two steps side by side."""

    LABEL, BY_ITSELF = "Compare", True
    TOLD = "The step that is shown beside another one; its residuals stand in the panels, hollow."

    def __init__(self, bench: Any) -> None:
        self._showing = False
        self.which = field(pn.widgets.Select, "with step", options={}, width=200)
        self.which.param.watch(lambda _: self._chosen(), "value")
        super().__init__(bench, row(self.which))

    def question(self) -> Callable[[], Any]:
        other = self.which.value
        return lambda: "" if other is None else self.session.compare(other)

    def beside(self, number: int | None) -> None:
        """Which step is the other."""
        states, now = self.session.states, self.session.current.number
        options = {f"{n} {s.title}": n for n, s in states.items() if n != now}
        value = number if number in options.values() else None
        self._showing = True
        self.which.param.update(options=options, value=value)
        self._showing = False

    def show(self, state: Any) -> None:
        self.begin.disabled = self.which.value is None
        self._of = -1  # the other step may be another one
        super().show(state)

    def _chosen(self) -> None:
        if not self._showing and self.which.value is not None:
            self.bench.compare(self.which.value)


class BudgetPane(AskPane):
    """The uncertainty budget at an operating point."""

    LABEL, BY_ITSELF = "Make the budget", True
    TOLD = "Uncertainty of a corrected reading by its sources, at an operating point."

    def __init__(self, bench: Any) -> None:
        self._at: dict[str, Any] = {}
        self.room = row()
        super().__init__(bench, self.room)

    def question(self) -> Callable[[], Any]:
        at = {n: f.value for n, f in self._at.items() if f.value is not None}
        return lambda: self.session.budget(at)

    def answered(self, found: Budget) -> None:
        """A field a quantity of the operating point."""
        if list(self._at) == list(found.at):
            return
        self._at = {}
        for name, value in found.at.items():
            label, shown = f"{name} [{found.at_units[name] or '1'}]", float(f"{value:.6g}")
            self._at[name] = field(pn.widgets.FloatInput, label, value=shown, width=120)
        self.room[:] = list(self._at.values())


class DecisionPane(AskPane):
    """Whether it conforms to limits."""

    LABEL = "Decide"
    TOLD = (
        "Does it meet its specification, and until when? Limits such as “bias: ±0.5 °/s”, “corrected reading: "
        "±0.1 °/s over -20..60 °C”. What is decided stands first in the report."
    )

    def __init__(self, bench: Any) -> None:
        w, room = pn.widgets, {"height": 74, "sizing_mode": "stretch_width"}
        self.limits = code_field("Limits, one a line", max_length=10_000, **room)
        self.rule = field(
            w.Select, "rule", options=list(get_args(Rule)), value="guarded", width=110
        )
        self.risk = field(w.FloatInput, "false acceptance", value=FALSE_ACCEPT, width=100)
        self.until = field(w.FloatInput, "conformity until", value=CONFORMITY, width=100)
        how: dict[str, Any] = {"placeholder": "sd 0.2 °/s", "width": 150}
        self.devices = field(w.TextInput, "devices, for global risks", **how)
        super().__init__(bench, self.limits, row(self.rule, self.risk, self.until, self.devices))

    def question(self) -> Callable[[], Any]:
        limits = [line.strip() for line in self.limits.value.splitlines() if line.strip()]
        asked = {
            "rule": self.rule.value,
            "false_accept": self.risk.value or 0.0,
            "conformity": self.until.value or 0.0,
            "population": self.devices.value.strip() or None,
        }
        return lambda: self.session.decide(limits, **asked)


class ExperimentPane(AskPane):
    """Next experiment: which test would tell apart what these readings cannot."""

    LABEL = "Rank the experiments"
    TOLD = "Feasible experiments, the most telling first: what each could say of effects that are confounded here."

    def __init__(self, bench: Any) -> None:
        self.rivals = words("", "small")
        super().__init__(bench, self.rivals)

    def show(self, state: Any) -> None:
        self._calibration, found = state.calibration, state.discovery
        self._rivals = () if found is None else found.rivals
        self.begin.disabled = len(self._rivals) < 2
        if found is None:
            self.rivals.object = "What is missing has not been looked for yet."
        elif self.begin.disabled:
            self.rivals.object = (
                "Nothing is confounded here: there are no two effects to tell apart."
            )
        else:
            self.rivals.object = f"To tell apart: {', '.join(e.name for e in self._rivals)}"
        super().show(state)

    def question(self) -> Callable[[], Any]:
        calibration, rivals = self._calibration, self._rivals
        return lambda: next_experiment(calibration, rivals)


class PlanPane(AskPane):
    """Where to measure next: the readings that make a stated uncertainty small."""

    LABEL, KINDS = "Plan", ("bare", "drawn")
    TOLD = "Campaigns by the uncertainty that they would leave, and the readings of the best that matter most."

    def __init__(self, bench: Any) -> None:
        how: dict[str, Any] = {
            "placeholder": "corrected reading: ±0.1 °/s over -20..60 °C",
            "width": 320,
        }
        self.limit = field(pn.widgets.TextInput, "what is to be known better", **how)
        self.count = field(pn.widgets.IntInput, "readings to pick", value=12, start=0, width=100)
        super().__init__(bench, row(self.limit, self.count))

    def question(self) -> Callable[[], Any]:
        limit, count = self.limit.value.strip(), self.count.value or 0
        return lambda: self.session.plan(limit, count)

    def answered(self, found: ReadingPlan) -> None:
        """What is left of the uncertainty with each reading of the best campaign."""
        palette, left = self.bench.palette, [found.u, *(p.u for p in found.picked)]
        made = new_figure("readings picked", f"u [{unit_label(found.unit) or '1'}]", tools="")
        count = list(range(len(left)))
        made.line(count, left, color=palette.blue, line_width=2)
        made.scatter(count, left, color=palette.blue, size=6)
        made.line([0, len(left) - 1], [found.campaigns[0].u] * 2, color=NOISE, line_dash="dashed")
        made.y_range.start, made.y_range.end = 0.0, 1.05 * found.u
        dress(made, palette)
        self.figures = [made]
        self.right[:] = [plot(made), self.answer]
