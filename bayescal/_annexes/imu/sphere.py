"""A picture of the poses of three axes: residuals of their magnitudes, where on the sphere each pose is.

Poses stand on two hemispheres, z up and z down, as seen from outside, each an equal-area map (Lambert's azimuthal), so
that poses that are spread evenly look so.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

import bayescal as bc
from bayescal import workshop as ws

CAPTION = "Residuals of the magnitude along the sphere of poses, in standard deviations"
COLOUR_END_SD = 3.0  # standard deviations, at which the colour ends


def sphere(calibration: bc.Calibration) -> Figure:
    """Plot the residuals of the magnitudes of poses on the sphere, in standard deviations.

    Raises:
        ModelError: an instrument of one output, or one of which the magnitude is not what is read.
    """
    direction, residual = residuals_on_sphere(calibration)
    figure = ws.new_figure(8.4, 4.2)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    points: Any = None
    for ax, up in zip(panels, (1, -1), strict=True):
        on_hemisphere = direction[:, 2] * up >= 0
        x, y, z = direction[on_hemisphere].T
        away = np.sqrt(1 / (1 + np.abs(z)))  # √(2(1 − |z|)) / √(2(1 − z²)), with 1 at the rim
        points = ax.scatter(
            *(np.stack([x, y]) * away),
            c=residual[on_hemisphere],
            cmap="RdBu_r",
            vmin=-COLOUR_END_SD,
            vmax=COLOUR_END_SD,
            edgecolors=ws.plot_colours.GREY,
            linewidths=0.5,
            s=36,
        )
        turn = np.linspace(0, 2 * np.pi, 200)
        ax.plot(np.cos(turn), np.sin(turn), color=ws.plot_colours.GREY, lw=0.8)
        ax.set_title(f"z {'up' if up > 0 else 'down'}: {int(on_hemisphere.sum())} poses")
        ax.set_xlabel("x")
        ax.set_aspect("equal")
        ax.set_xticks([])
        ax.set_yticks([])
    panels[0].set_ylabel("y")
    figure.colorbar(points, ax=panels, label="residual [standard deviations]", shrink=0.8)
    return figure


def pictures(calibration: bc.Calibration) -> list[tuple[str, Callable[[], Figure]]]:
    """Return the sphere of poses of three axes with its caption; nothing of other instruments."""
    vector = calibration.model.instrument.vector
    of_poses = vector is not None and vector.acting is None
    return [(CAPTION, partial(sphere, calibration))] if of_poses else []


def residuals_on_sphere(
    calibration: bc.Calibration,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return directions of poses, by their outputs, and residuals of their magnitudes in standard deviations."""
    vector, readings = calibration.model.instrument.vector, calibration.readings
    if vector is None or vector.acting is not None:
        raise bc.ModelError(
            f"instrument {calibration.model.instrument.name!r} reads no magnitudes of poses: "
            "bayescal.plot.residuals draws its residuals"
        )
    outputs = np.stack([readings[name] for name in vector.outputs], axis=1)
    mask = np.ones(len(readings), dtype=bool)
    if readings.has(ws.ACROSS[0]):
        mask = ~np.any([readings[name] != 0 for name in ws.ACROSS], axis=0)
    linear = calibration.linear
    residual = linear.conditional_residuals / np.sqrt(linear.variance)
    return outputs[mask] / np.linalg.norm(outputs[mask], axis=1)[:, None], residual[mask]
