"""The model: its equation in words, its effects with their coefficients, what may be changed, with what follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn

from bayescal._calibration.summary import null_directions, summary
from bayescal._core.formatting import probability, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._workbench.parts.pieces import button, column, field, row, words
from bayescal._workbench.parts.rows import Rows

MOST = 6  # coefficients of one effect that stand in its row


class ModelPane:
    """The left of the page: what is believed, and what may be done to it."""

    def __init__(self, act: Callable[..., None], ask: Callable[..., None]) -> None:
        """`act(name, *arguments)` does something; `ask(done, name, *arguments)` asks what it would do."""
        self._act, self._ask = act, ask
        self._calibration: Any = None
        self._chosen, self._shut = "", False
        self.equation = words("", "small")
        high: dict[str, Any] = {"sizing_mode": "stretch_width", "styles": {}}  # as all their rows
        self.effects = Rows(self._choose, kind="pair", label="Effects of the model", **high)
        self.noise = Rows(self._take_law, kind="pair", label="Noise law", **high)
        self.verdict = words("", "small")
        self.title = words("", "title")
        self.consequences = words("", "small")
        wide: dict[str, Any] = {"sizing_mode": "stretch_width", "min_width": 90}
        self.coefficient = field(pn.widgets.Select, "unknown", **wide)
        self.value = field(pn.widgets.FloatInput, "held at", **wide)
        self.size = field(pn.widgets.FloatInput, "plausible size", start=0.0, **wide)
        self.form = self._form()
        self.view = column(
            words("The model", "title"),
            self.equation,
            self.form,
            self.effects,
            words("Noise law", "title"),
            self.noise,
            self.verdict,
            kinds=("pane", "model", "scrolls"),
        )
        self.coefficient.param.watch(self._other_coefficient, "value")

    def _form(self) -> pn.Column:
        self.buttons = [
            button("Take out", lambda _: self._do("take_out", self._chosen)),
            button("Fix", lambda _: self._do("fix", self.coefficient.value, self.value.value)),
            button("Free", lambda _: self._do("free", self.coefficient.value)),
            button("Resize", lambda _: self._do("resize", self._chosen, self.size.value)),
            button("Close", lambda _: self._open("")),
        ]
        out, fix, free, resize, close = self.buttons
        return column(
            self.title,
            self.consequences,
            row(out, close),
            row(self.coefficient),
            row(self.value, fix, free),
            row(self.size, resize),
            kinds=("form",),
            visible=False,
            sizing_mode="stretch_width",
        )

    def show(self, state: Any) -> None:
        """Show a state's model."""
        self._calibration = calibration = state.step.calibration
        self.equation.object = equation_in_words(calibration.model)
        coefficients, others = summary(calibration)
        self.effects.rows = effect_rows(calibration.model, [*coefficients, *others])
        self.noise.rows = noise_rows(state)
        lines = [d["in_words"] for d in null_directions(calibration)]
        lines += [f"conflict: {w}" for w in calibration.conflicts]
        self.verdict.object = "\n".join(
            [*(f"not measured: {w}" for w in lines[:3]), str(calibration.verdict)]
        )
        if self._chosen not in calibration.model.names:
            self._open("")
        self._open_buttons()

    def busy(self, busy: bool) -> None:
        """Shut or open what changes the model."""
        self.effects.busy = self.noise.busy = busy
        self._shut = busy
        self._open_buttons()

    def _open_buttons(self) -> None:
        """*Free* is open where the chosen unknown is held."""
        held = self._calibration is not None and self.coefficient.value in dict(
            self._calibration.model.fixed
        )
        for one in self.buttons[:-1]:
            one.disabled = self._shut or (one.label == "Free" and not held)

    def _choose(self, effect: str, _: str) -> None:
        self._open(effect)

    def _open(self, effect: str) -> None:
        self._chosen, self.form.visible = effect, bool(effect)
        if not effect:
            return
        model = self._calibration.model
        own = model.effect(effect)
        self.title.object = effect
        self.consequences.object = "What taking it out would do is being computed …"
        names = [own.coefficient_name(i) for i in range(len(own.coefficients))]
        names += [own.shape_name(s) for s in own.shapes]
        self.coefficient.options = names
        self.coefficient.value = names[0]
        first = own.coefficients[0]
        self.size.label = f"plausible size [{unit_label(first.unit) or '1'}]"
        self.size.value = None if first.flat else float(first.size)
        self._other_coefficient()
        self._ask(self._say_consequences, "take_out", effect)

    def _say_consequences(self, said: Any) -> None:
        self.consequences.object = f"Without it: {said}"

    def _other_coefficient(self, *_: Any) -> None:
        coefficients, others = summary(self._calibration)
        means = {r["name"]: (r["mean"], r["unit"]) for r in (*coefficients, *others)}
        mean, unit = means.get(self.coefficient.value, (None, ""))
        mean = dict(self._calibration.model.fixed).get(self.coefficient.value, mean)
        self._open_buttons()
        self.value.value = None if mean is None else float(f"{mean:.6g}")
        self.value.label = f"held at [{unit_label(unit) or '1'}]"

    def _do(self, action: str, *arguments: Any) -> None:
        if None not in arguments:
            self._act(action, *arguments)

    def _take_law(self, law: str, _: str) -> None:
        self._act("noise", law)


def equation_in_words(model: Any) -> str:
    """A model as a sum: what the output is made of, slot by slot."""
    lines = [model.instrument.title]
    for slot in model.instrument.slots:
        terms = [
            e.equation
            for e in model.effects
            if slot.name in {c.slot or e.slot for c in e.coefficients}
        ]
        if terms:
            meaning = f" ({slot.meaning})" if slot.meaning else ""
            lines.append(f"{slot.name}{meaning} = {' + '.join(terms)}")
    fixed = ", ".join(f"{name} = {value:g}" for name, value in model.fixed)
    return "\n".join([*lines, *([f"held: {fixed}"] if fixed else [])])


def effect_rows(model: Any, told: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row an effect: each coefficient ± standard uncertainty, its contraction as a bar."""
    rows = []
    for effect in model.effects:
        own = [t for t in told if t["effect"] == effect.name]
        cells: list[dict[str, Any]] = [
            {"text": effect.name, "kind": "name", "title": effect.equation}
        ]
        for t in own[:MOST]:
            short = (
                t["name"].removeprefix(effect.name).lstrip(".:[").replace("]", "")
                if len(own) > 1
                else ""
            )
            value = f"{with_error(t['mean'], t['sd'])} {unit_label(t['unit'])}".rstrip()
            cells.append(
                {
                    "text": f"{short} {value}".strip(),
                    "kind": "value number",
                    **_contraction(t["contraction"]),
                }
            )
        if len(own) > MOST:
            cells.append({"text": f"… and {len(own) - MOST} more", "kind": "value"})
        held = [f"{n} = {v:g}" for n, v in model.fixed if n.startswith(effect.name)]
        if held:
            cells.append({"text": f"held: {', '.join(held)}", "kind": "value number"})
        change = {"id": "change", "label": "Change …", "title": "take out, fix or resize"}
        rows.append({"id": effect.name, "cells": cells, "actions": [change]})
    return rows


def _contraction(share: float | None) -> dict[str, Any]:
    """By how much the posterior is narrower than the prior, as a bar."""
    if share is None:
        return {"bar": None, "title": "no contraction: flat or learned prior"}
    title = f"contraction {share:.3f}: how much narrower than the prior"
    return {"bar": max(0.0, share), "title": title}


def noise_rows(state: Any) -> list[dict[str, Any]]:
    """The noise law in use with its parameters, and the probability of each law, where it was looked for."""
    calibration, found = state.step.calibration, state.discovery
    _, others = summary(calibration)
    used = calibration.model.noise
    values = [
        f"{t['name'].removeprefix('noise.')} {with_error(t['mean'], t['sd'])} {unit_label(t['unit'])}".rstrip()
        for t in others
        if t["effect"] == "noise"
    ]
    laws = [] if found is None else list(found.noise)
    known = {law.law: law for law in laws}
    words = known[used.law].in_words if used.law in known else used.in_words
    rows = [_law_row(used.law, words, known.get(used.law), values, True)]
    rows += [
        _law_row(w.law, w.in_words, w, [], False)
        for w in laws
        if w.law != used.law and w.probability >= 0.005
    ]
    return rows


def _law_row(law: str, text: str, told: Any, values: list[str], used: bool) -> dict[str, Any]:
    cells: list[dict[str, Any]] = [{"text": text, "kind": "name"}]
    if told is not None:
        said = f"probability {probability(told.probability)}"
        cells.append({"text": said, "bar": told.probability, "kind": "value number"})
    cells += [{"text": value, "kind": "value number"} for value in values]
    actions = [] if used else [{"id": "use", "label": "Use", "title": "fit with this noise law"}]
    return {"id": law, "cells": cells, "actions": actions, "current": used}
