"""Figures as SVG within a page: one colour with its text, names of their own, nothing from elsewhere."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from markupsafe import Markup, escape
from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check_result import Check
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._data.unit_conversion import unit_label
from bayescal._report import plot_allan, plot_posterior, plot_residuals, plot_search, plot_sphere
from bayescal._report.section import Chapter

SVG = {"svg.fonttype": "none", "svg.hashsalt": "bayescal", "font.size": 9.0}
PANELS = 4  # of residuals


@dataclass(frozen=True)
class Picture:
    """A figure of the page.

    Attributes:
        body: the figure as HTML.
        caption: below it.
    """

    body: Markup
    caption: str


class Pictures:
    """Draws the pictures of one page, so that no two share an id."""

    def __init__(self) -> None:
        self.count = 0

    def draw(self, make: Callable[[], Figure], caption: str, alt: str) -> Picture:
        with rc_context(SVG):
            text = as_svg(make())
        self.count += 1
        return Picture(inline(text, f"f{self.count}-", alt), caption)

    def residuals(self, calibration: Calibration, found: Check, which: str) -> list[Picture]:
        """Residuals against the covariates, the worst first, a picture each."""
        entries = [e for e in found.entries if not e.by_group][:PANELS]
        unit = unit_label(found.unit)
        pictures = []
        for e in entries:
            size = f"{e.worst.size:+.2g} {unit}".replace("-", "−")
            where = f"{number(e.worst.low, 4)} to {number(e.worst.high, 4)} {unit_label(e.worst.covariate_unit)}"
            structure = (
                f"the worst region, {where.strip()}, has a mean of {size}"
                if e.log_bayes_factor > 0
                else "no structure"
            )
            pictures.append(
                self.draw(
                    lambda e=e: _panel(calibration, found, e.against),
                    f"Residuals of {which} against {e.against}",
                    f"Residuals of {which} in {unit} against {e.against}: {structure}; log Bayes factor "
                    f"{e.log_bayes_factor:.1f}; noise {number(found.noise)} {unit}.",
                )
            )
        return pictures

    def allan(self, found: Check, which: str) -> Picture | None:
        """The Allan deviation of the residuals, where there is one."""
        if found.allan is None:
            return None
        return self.draw(
            lambda: plot_allan.allan(found),
            f"Allan deviation of the residuals of {which}, and what its noise law lets one expect (grey, 95 %)",
            f"Allan deviation over averaging time: {found.allan.sentence()}.",
        )

    def sphere(self, calibration: Calibration) -> Picture | None:
        """Residuals along the sphere of poses, of three axes that are read so."""
        vector = calibration.model.instrument.vector
        if vector is None or vector.acting is not None:
            return None
        residual = np.abs(plot_sphere.residuals_on_sphere(calibration)[1])
        return self.draw(
            lambda: plot_sphere.sphere(calibration),
            "Residuals of the magnitude along the sphere of poses, in standard deviations",
            f"Two hemispheres with {len(residual)} poses; the largest residual is {number(residual.max())} standard "
            f"deviations, {int(np.sum(residual > 2))} are beyond 2.",
        )

    def error(self, chapter: Chapter) -> Picture:
        steps = chapter.data["steps"]
        unit = unit_label(steps[-1]["unit"])
        told = "; ".join(f"{s['title']} {number(s['rmse_fitted'])} {unit}" for s in steps)
        floor = number(steps[-1]["noise_floor"])
        return self.draw(
            lambda: plot_search.trail(chapter.data),
            "The error, step by step",
            f"Bars of the rms error of each step, as fitted: {told}; noise floor {floor} {unit}.",
        )

    def missing(self, found: dict, title: str) -> Picture | None:
        tested = [c for c in found["candidates"] if c["log_bayes_factor"] is not None]
        if not tested:
            return None
        told = "; ".join(f"{c['effect']} {c['log_bayes_factor']:.1f}" for c in tested[:5])
        return self.draw(
            lambda: plot_search.missing(found),
            f"What is missing from {title}",
            f"Bars of the log Bayes factor of each candidate; the first of them: {told}.",
        )

    def of_fit(self, name: str, calibration: Calibration) -> Picture | None:
        """One of `OF_FIT`; None where there is nothing to draw."""
        make, caption, alt = OF_FIT[name]
        try:
            return self.draw(lambda: make(calibration), caption, alt)
        except InputError:
            return None


# What is drawn of a fit: by what, its caption, what it shows in words.
OF_FIT: dict[str, tuple[Callable[[Calibration], Figure], str, str]] = {
    "coefficients": (
        partial(plot_posterior.coefficients, columns=2),
        "Posterior of each unknown, its mean and its 95 % credible interval",
        "Posterior densities; the numbers are in the table of coefficients.",
    ),
    "identifiability": (
        plot_posterior.identifiability,
        "Posterior over prior standard deviation: 1 where the readings said nothing",
        "Bars of posterior over prior standard deviation; the table of coefficients has the same as contraction.",
    ),
    "pairs": (
        plot_posterior.pairs,
        "The most correlated unknowns, two by two",
        "Joint posterior draws of pairs of unknowns.",
    ),
    "predictive": (
        plot_posterior.predictive,
        "Readings against their predictive probabilities: within the band if the model is right",
        "Share of readings below each predictive probability minus that probability, with its 99 % band.",
    ),
}


def _panel(calibration: Calibration, found: Check, against: str) -> Figure:
    figure = plot_residuals.residuals(calibration, found, against)
    figure.set_size_inches(4.6, 2.9)
    return figure


def as_svg(figure: Figure) -> str:
    """A figure as an SVG without a background."""
    figure.patch.set_visible(False)
    for ax in figure.axes:
        ax.patch.set_visible(False)
    out = io.StringIO()
    nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
    FigureCanvasSVG(figure).print_svg(out, metadata=nothing)  # `savefig` would draw it twice
    return out.getvalue()


def inline(svg: str, prefix: str, alt: str) -> Markup:
    """An SVG as part of a page.

    Black becomes the colour of the page's text, fonts the page's, ids are prefixed, and all that names another place
    (document type, metadata) goes, and the comments, which repeat the labels.

    Args:
        svg: as Matplotlib writes it: labels are escaped.
        prefix: of every id.
        alt: what it shows, in words.
    """
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r"\bid=\"([^\"]+)\"", rf'id="{prefix}\1"', body)
    body = re.sub(r"url\(#", f"url(#{prefix}", body)
    body = re.sub(r"href=\"#", f'href="#{prefix}', body)
    body = body.replace("#000000", "currentColor")
    body = re.sub(r"font: ([\d.]+)px [^;\"]+", r"font-size: \1px", body)
    body = re.sub(r"font: (\w+ )?([\d.]+)px [^;\"]+", r"font-size: \2px", body)
    size = re.search(r'viewBox="0 0 ([\d.]+)', body)
    width = float(size[1]) * 4 / 3 if size else 600.0  # points to CSS pixels
    opening, rest = body.split(">", 1)
    view = re.search(r'viewBox="[^"]*"', opening)
    head = f'<svg role="img" aria-label="{escape(alt)}" style="max-width:{width:.0f}px"'
    return Markup(f"{head} {view[0] if view else ''}>{rest}")


def embedded(png: bytes, caption: str, alt: str) -> Picture:
    """A PNG as data within the page."""
    data = base64.b64encode(png).decode("ascii")
    return Picture(
        Markup('<img alt="{}" src="data:image/png;base64,{}">').format(alt, data), caption
    )
