"""The model pane: equation, effects with coefficients, noise law, and actions with previews of their results."""

from __future__ import annotations

from typing import Any

import panel as pn

from bayescal import workshop as ws
from bayescal._annexes.workbench.parts.widgets import Pane, Rows, button, column, label, row, widget

NUMBER = {"kind": "value number"}


class ModelPane(Pane):
    """Pane of the model and the actions that change it, on the left of the page."""

    def __init__(self, page: Any) -> None:
        super().__init__(page)
        self._calibration: Any = None
        self._effect, self._is_busy = "", False
        sizing: dict[str, Any] = {"sizing_mode": "stretch_width", "min_width": 90}
        layout: dict[str, Any] = {"sizing_mode": "stretch_width", "styles": {}}  # as all their rows
        open_effect = lambda effect, _: self._open_form(effect)  # noqa: E731
        set_law = lambda law, _: page.act("noise", law)  # noqa: E731
        self.effects = Rows(open_effect, kind="pair", label="Effects of the model", **layout)
        self.noise = Rows(set_law, kind="pair", label="Noise law", **layout)
        self.equation, self.verdict = label("", "small"), label("", "small")
        self.title, self.consequences = label("", "title"), label("", "small")
        self.coefficient = widget(pn.widgets.Select, "unknown", **sizing)
        self.value = widget(pn.widgets.FloatInput, "fixed at", **sizing)
        self.size = widget(pn.widgets.FloatInput, "plausible size", start=0.0, **sizing)
        self.buttons = remove_button, fix_button, free_button, resize_button = (
            button("Take out", lambda _: self._act("take_out", self._effect)),
            button("Fix", lambda _: self._act("fix", self.coefficient.value, self.value.value)),
            button("Free", lambda _: self._act("free", self.coefficient.value)),
            button("Resize", lambda _: self._act("resize", self._effect, self.size.value)),
        )
        self.form = column(
            self.title,
            self.consequences,
            row(remove_button, button("Close", lambda _: self._open_form(""))),
            row(self.coefficient),
            row(self.value, fix_button, free_button),
            row(self.size, resize_button),
            kinds=("form",),
            visible=False,
            sizing_mode="stretch_width",
        )
        self.view = column(
            label("The model", "title"),
            self.equation,
            self.form,
            self.effects,
            label("Noise law", "title"),
            self.noise,
            self.verdict,
            kinds=("pane", "model", "scrolls"),
        )
        self.coefficient.param.watch(lambda _: self._show_coefficient(), "value")

    def show(self, state: Any) -> None:
        self._calibration = calibration = state.calibration
        self.equation.object = format_equation(calibration.model)
        self.effects.rows = build_effect_rows(calibration)
        self.noise.rows = build_noise_rows(state)
        notes = [f"not measured: {w}" for w in ws.null_directions(calibration)]
        notes += [f"conflict: {w}" for w in calibration.conflicts]
        self.verdict.object = "\n".join([*notes, str(calibration.verdict)])
        if self._effect not in calibration.model.names:
            self._open_form("")
        self._enable_buttons()

    def set_busy(self, is_busy: bool) -> None:
        self.effects.busy = self.noise.busy = self._is_busy = is_busy
        self._enable_buttons()

    def _enable_buttons(self) -> None:
        """Enable the buttons unless the page is busy; *Free* only if the selected unknown is fixed."""
        model = self._calibration and self._calibration.model
        is_fixed = model is not None and self.coefficient.value in dict(model.fixed)
        for control in self.buttons:
            control.disabled = self._is_busy or (control.label == "Free" and not is_fixed)

    def _open_form(self, effect: str) -> None:
        self._effect, self.form.visible = effect, bool(effect)
        if not effect:
            return
        opened_effect = self._calibration.model.effect(effect)
        self.title.object = effect
        self.consequences.object = "Computing the model without this effect …"
        names = [opened_effect.coefficient_name(i) for i in range(len(opened_effect.coefficients))]
        names += [opened_effect.shape_name(s) for s in opened_effect.shapes]
        self.coefficient.options, self.coefficient.value = names, names[0]
        first_coefficient = opened_effect.coefficients[0]
        self.size.label = f"plausible size [{ws.unit_label(first_coefficient.unit) or '1'}]"
        self.size.value = None if first_coefficient.flat else float(first_coefficient.size)
        self._show_coefficient()
        show = lambda p: self.consequences.param.update(object=f"Without it: {p.summary}")  # noqa: E731
        self.page.preview(show, "take_out", effect)

    def _show_coefficient(self) -> None:
        coefficients, other_unknowns = ws.summary(self._calibration)
        means = {r["name"]: (r["mean"], r["unit"]) for r in (*coefficients, *other_unknowns)}
        mean, unit = means.get(self.coefficient.value, (None, ""))
        mean = dict(self._calibration.model.fixed).get(self.coefficient.value, mean)
        self._enable_buttons()
        self.value.value = None if mean is None else float(f"{mean:.6g}")
        self.value.label = f"fixed at [{ws.unit_label(unit) or '1'}]"

    def _act(self, action: str, *arguments: Any) -> None:
        if None not in arguments:
            self.page.act(action, *arguments)


def format_equation(model: Any) -> str:
    """Format a model's equations, one line for each slot as a sum of terms."""
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
    fixed_text = ", ".join(f"{name} = {value:g}" for name, value in model.fixed)
    return "\n".join([*lines, *([f"fixed: {fixed_text}"] if fixed_text else [])])


def build_effect_rows(calibration: Any) -> list[dict[str, Any]]:
    """Return a row per effect: coefficients ± standard uncertainty with bars of contraction, or a curve's size."""
    model, rows = calibration.model, []
    unknowns, curves = [t for r in ws.summary(calibration) for t in r], ws.format_rows(calibration)
    for effect in model.effects:
        terms = [t for t in unknowns if t["effect"] == effect.name]
        cells: list[dict[str, Any]] = [
            {"text": effect.name, "kind": "name", "title": effect.equation}
        ]
        if effect.is_placeholder:
            _, value, unit, *_ = curves[effect.name]
            terms = []
            cells.append({"text": f"{value} [{unit}]", **NUMBER})
        for t in terms:
            suffix = t["name"].removeprefix(effect.name).lstrip(".:[").replace("]", "")
            value = f"{suffix if len(terms) > 1 else ''} {_format_value(t)}".strip()
            cells.append({"text": value, **NUMBER, **_build_bar(t["contraction"])})
        fixed_values = [f"{n} = {v:g}" for n, v in model.fixed if n in effect.unknown_names]
        cells += [{"text": f"fixed: {', '.join(fixed_values)}", **NUMBER}] if fixed_values else []
        change_action = {"id": "change", "label": "Change …", "title": "take out, fix or resize"}
        rows.append({"id": effect.name, "cells": cells, "actions": [change_action]})
    return rows


def _format_value(row: dict[str, Any]) -> str:
    return f"{ws.format_value(row['mean'], row['sd'])} {ws.unit_label(row['unit'])}".rstrip()


def _build_bar(contraction: float | None) -> dict[str, Any]:
    """Return the length and the title of a bar for a posterior contraction."""
    if contraction is None:
        return {"bar": None, "title": "no contraction: flat or hierarchical prior"}
    title = f"contraction {contraction:.3f}: 1 − posterior variance / prior variance"
    return {"bar": max(0.0, contraction), "title": title}


def build_noise_rows(state: Any) -> list[dict[str, Any]]:
    """Return a row per noise law: the model's law with its parameters; after a search, the probability of each."""
    calibration, discovery = state.calibration, state.discovery
    model_law, (_, hyperparameters) = calibration.model.noise, ws.summary(calibration)
    noise_unknowns = [t for t in hyperparameters if t["effect"] == "noise"]
    values = [f"{t['name'].removeprefix('noise.')} {_format_value(t)}" for t in noise_unknowns]
    laws = {} if discovery is None else {law.law: law for law in discovery.noise}
    rows = []
    for name in dict.fromkeys((model_law.law, *laws)):
        law, is_used = laws.get(name), name == model_law.law
        cells: list[dict[str, Any]] = [
            {"text": model_law.in_words if law is None else law.in_words, "kind": "name"}
        ]
        if law is not None:
            text = f"probability {ws.probability(law.probability)}"
            cells.append({"text": text, "bar": law.probability, **NUMBER})
        cells += [{"text": value, **NUMBER} for value in values if is_used]
        use_action = {"id": "use", "label": "Use", "title": "fit with this noise law"}
        actions = [] if is_used else [use_action]
        rows.append({"id": name, "cells": cells, "actions": actions, "current": is_used})
    return rows
