"""The model: its equation in words, its effects with their coefficients, what may be changed, with what follows."""

from __future__ import annotations

from typing import Any

import panel as pn

from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.pieces import Pane, Rows, button, column, field, row, words

COEFFICIENTS_IN_A_ROW = 6  # coefficients of one effect that stand in its row
LEAST_PROBABILITY = 0.005  # probability of a noise law that is shown
NUMBER = {"kind": "value number"}


class ModelPane(Pane):
    """The left of the page: what is believed, and what may be done to it."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._calibration: Any = None
        self._chosen, self._shut = "", False
        wide: dict[str, Any] = {"sizing_mode": "stretch_width", "min_width": 90}
        high: dict[str, Any] = {"sizing_mode": "stretch_width", "styles": {}}  # as all their rows
        choose = lambda effect, _: self._open(effect)  # noqa: E731
        take = lambda law, _: bench.act("noise", law)  # noqa: E731
        self.effects = Rows(choose, kind="pair", label="Effects of the model", **high)
        self.noise = Rows(take, kind="pair", label="Noise law", **high)
        self.equation, self.verdict = words("", "small"), words("", "small")
        self.title, self.consequences = words("", "title"), words("", "small")
        self.coefficient = field(pn.widgets.Select, "unknown", **wide)
        self.value = field(pn.widgets.FloatInput, "held at", **wide)
        self.size = field(pn.widgets.FloatInput, "plausible size", start=0.0, **wide)
        self.buttons = out, fix, free, resize = (
            button("Take out", lambda _: self._do("take_out", self._chosen)),
            button("Fix", lambda _: self._do("fix", self.coefficient.value, self.value.value)),
            button("Free", lambda _: self._do("free", self.coefficient.value)),
            button("Resize", lambda _: self._do("resize", self._chosen, self.size.value)),
        )
        self.form = column(
            self.title,
            self.consequences,
            row(out, button("Close", lambda _: self._open(""))),
            row(self.coefficient),
            row(self.value, fix, free),
            row(self.size, resize),
            kinds=("form",),
            visible=False,
            sizing_mode="stretch_width",
        )
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
        self.coefficient.param.watch(lambda _: self._other_coefficient(), "value")

    def show(self, state: Any) -> None:
        self._calibration = calibration = state.calibration
        self.equation.object = equation_in_words(calibration.model)
        self.effects.rows = effect_rows(calibration)
        self.noise.rows = noise_rows(state)
        said = [f"not measured: {w}" for w in ws.null_directions(calibration)]
        said += [f"conflict: {w}" for w in calibration.conflicts]
        self.verdict.object = "\n".join([*said, str(calibration.verdict)])
        if self._chosen not in calibration.model.names:
            self._open("")
        self._open_buttons()

    def busy(self, busy: bool) -> None:
        self.effects.busy = self.noise.busy = self._shut = busy
        self._open_buttons()

    def _open_buttons(self) -> None:
        """*Free* is open where the chosen unknown is held."""
        model = self._calibration and self._calibration.model
        held = model is not None and self.coefficient.value in dict(model.fixed)
        for one in self.buttons:
            one.disabled = self._shut or (one.label == "Free" and not held)

    def _open(self, effect: str) -> None:
        self._chosen, self.form.visible = effect, bool(effect)
        if not effect:
            return
        own = self._calibration.model.effect(effect)
        self.title.object = effect
        self.consequences.object = "What taking it out would do is being computed …"
        names = [own.coefficient_name(i) for i in range(len(own.coefficients))]
        names += [own.shape_name(s) for s in own.shapes]
        self.coefficient.options, self.coefficient.value = names, names[0]
        first = own.coefficients[0]
        self.size.label = f"plausible size [{ws.unit_label(first.unit) or '1'}]"
        self.size.value = None if first.flat else float(first.size)
        self._other_coefficient()
        self.bench.ask(self._say_consequences, "take_out", effect)

    def _say_consequences(self, said: Any) -> None:
        self.consequences.object = f"Without it: {said.in_words}"

    def _other_coefficient(self) -> None:
        coefficients, others = ws.summary(self._calibration)
        means = {r["name"]: (r["mean"], r["unit"]) for r in (*coefficients, *others)}
        mean, unit = means.get(self.coefficient.value, (None, ""))
        mean = dict(self._calibration.model.fixed).get(self.coefficient.value, mean)
        self._open_buttons()
        self.value.value = None if mean is None else float(f"{mean:.6g}")
        self.value.label = f"held at [{ws.unit_label(unit) or '1'}]"

    def _do(self, action: str, *arguments: Any) -> None:
        if None not in arguments:
            self.bench.act(action, *arguments)


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


def effect_rows(calibration: Any) -> list[dict[str, Any]]:
    """A row an effect: each coefficient ± standard uncertainty, its contraction as a bar; a curve by its size."""
    model, rows = calibration.model, []
    told, curves = [t for own in ws.summary(calibration) for t in own], ws.unknown_rows(calibration)
    for effect in model.effects:
        own = [t for t in told if t["effect"] == effect.name]
        cells: list[dict[str, Any]] = [
            {"text": effect.name, "kind": "name", "title": effect.equation}
        ]
        if effect.is_placeholder:
            _, value, unit, *_ = curves[effect.name]
            own = []
            cells.append({"text": f"{value} [{unit}]", **NUMBER})
        for t in own[:COEFFICIENTS_IN_A_ROW]:
            short = t["name"].removeprefix(effect.name).lstrip(".:[").replace("]", "")
            value = f"{short if len(own) > 1 else ''} {_value(t)}".strip()
            cells.append({"text": value, **NUMBER, **_contraction(t["contraction"])})
        if len(own) > COEFFICIENTS_IN_A_ROW:
            cells.append(
                {"text": f"… and {len(own) - COEFFICIENTS_IN_A_ROW} more", "kind": "value"}
            )
        held = [f"{n} = {v:g}" for n, v in model.fixed if n in effect.unknown_names]
        cells += [{"text": f"held: {', '.join(held)}", **NUMBER}] if held else []
        change = {"id": "change", "label": "Change …", "title": "take out, fix or resize"}
        rows.append({"id": effect.name, "cells": cells, "actions": [change]})
    return rows


def _value(told: dict[str, Any]) -> str:
    return f"{ws.with_error(told['mean'], told['sd'])} {ws.unit_label(told['unit'])}".rstrip()


def _contraction(share: float | None) -> dict[str, Any]:
    """By how much the posterior is narrower than the prior, as a bar."""
    if share is None:
        return {"bar": None, "title": "no contraction: flat or learned prior"}
    title = f"contraction {share:.3f}: how much narrower than the prior"
    return {"bar": max(0.0, share), "title": title}


def noise_rows(state: Any) -> list[dict[str, Any]]:
    """The noise law in use with its parameters, and the probability of each law, where it was looked for."""
    calibration, found = state.calibration, state.discovery
    used, (_, others) = calibration.model.noise, ws.summary(calibration)
    own = [t for t in others if t["effect"] == "noise"]
    values = [f"{t['name'].removeprefix('noise.')} {_value(t)}" for t in own]
    told = {} if found is None else {law.law: law for law in found.noise}
    rows = []
    for name in dict.fromkeys((used.law, *told)):
        law, here = told.get(name), name == used.law
        if law is not None and not here and law.probability < LEAST_PROBABILITY:
            continue
        cells: list[dict[str, Any]] = [
            {"text": used.in_words if law is None else law.in_words, "kind": "name"}
        ]
        if law is not None:
            said = f"probability {ws.probability(law.probability)}"
            cells.append({"text": said, "bar": law.probability, **NUMBER})
        cells += [{"text": value, **NUMBER} for value in values if here]
        use = {"id": "use", "label": "Use", "title": "fit with this noise law"}
        actions = [] if here else [use]
        rows.append({"id": name, "cells": cells, "actions": actions, "current": here})
    return rows
