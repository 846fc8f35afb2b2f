"""Description of a task for readers: its terms in words, and plots of its output and of the base model's residuals."""

from __future__ import annotations

from html import escape

import numpy as np

from missing_effect.regression import Regression
from missing_effect.task import Task

WIDTH, HEIGHT = 900, 220  # of a panel, pixels
MOST = 1500  # points drawn; of more, every so many


def in_words(task: Task) -> str:
    """Return the description of a task as text."""
    lines = [
        f"{task.name}: {len(task.train)} training and {len(task.holdout)} hold-out readings, in {task.unit}"
    ]
    for head, terms in (("known", task.base), ("may be missing", task.candidates)):
        lines.append(f"{head}:")
        for t in terms:
            shapes = "".join(f", {n} {low:g} to {high:g}" for n, (low, high) in t.shapes.items())
            nuisance = ", a nuisance" if t.nuisance else ""
            lines.append(f"  {t.name:24} {t.words}; size {t.size:.3g} {t.unit}{shapes}{nuisance}")
    return "\n".join(lines)


def picture(task: Task) -> str:
    """Render an HTML page with two panels: the output, and its residuals, in the order of the readings."""
    problem = Regression(task)
    panels = [
        _panel(f"output, {task.unit}", problem.y),
        _panel(f"residuals of the known terms, {task.unit}", problem.left),
    ]
    words = escape(in_words(task))
    body = f"<h1>{escape(task.name)}</h1>{''.join(panels)}<pre>{words}</pre>"
    return f'<!doctype html><html lang=en><meta charset="utf-8"><title>{escape(task.name)}</title>{body}</html>\n'


def _panel(head: str, values: np.ndarray) -> str:
    thinned = values[:: max(1, len(values) // MOST)]
    low, high = float(thinned.min()), float(thinned.max())
    x = np.linspace(5, WIDTH - 5, thinned.size)
    y = HEIGHT - 10 - (thinned - low) / max(high - low, 1e-300) * (HEIGHT - 20)
    dots = "".join(
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.8"/>' for a, b in zip(x, y, strict=True)
    )
    text = f"<p>{escape(head)}: {low:.6g} to {high:.6g}</p>"
    return f'{text}<svg width="{WIDTH}" height="{HEIGHT}" fill="#3a5f9e" style="border:1px solid #ccc">{dots}</svg>'
