"""Where the refit of a structure begins: at what another one, which was fitted before, has found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from bayescal._inference.assembly import Assembly
from bayescal._inference.mode import Mode

UNKNOWN = 0.1  # variance of a coordinate of which nothing is known


def carried(
    assembly: Assembly, near: Assembly, mode: Mode
) -> tuple[dict[str, float], Float[np.ndarray, "d d"]]:
    """Another structure's φ̂ by name, in these priors' coordinates, and a first guess of φ's covariance.

    Where the prior of a shape is another, both are moved: what the readings say, which is the other's Gaussian fit
    without its prior, counts under this one's.

    Args:
        assembly: the structure to fit.
        near: the other one.
        mode: where that one has its mode.
    """
    places = {h.name: i for i, h in enumerate(near.hypers)}
    at = [i for i, h in enumerate(assembly.hypers) if h.name in places]
    there = [places[assembly.hypers[i].name] for i in at]
    scale, middle = np.ones(len(at)), np.zeros(len(at))  # of these coordinates in the other's
    for k, (i, j) in enumerate(zip(at, there, strict=True)):
        own, other = assembly.hypers[i].prior, near.hypers[j].prior
        if own != other:
            # Both coordinates are linear in one another where both priors are of one family (log-normal, say): two
            # points tell scale and middle.
            ends = [own.coordinate(float(other.value(np.float64(v)))) for v in (0.0, 1.0)]
            scale[k], middle[k] = ends[1] - ends[0], ends[0]
    values = middle + scale * mode.v[there]
    width = scale[:, None] * mode.covariance[np.ix_(there, there)] * scale
    moved = np.array([(*pair,) != (1.0, 0.0) for pair in zip(scale, middle, strict=True)])
    if moved.any() and np.all(np.isfinite(width)):
        # In this structure's coordinate the other's prior is N(middle, scale²) and its own N(0, 1): one is taken out
        # of the Gaussian fit and the other put in. Where that leaves no positive precision the fit is carried over as
        # it is.
        precision = np.linalg.inv(width) + np.diag(moved * (1 - scale**-2))
        if np.all(np.linalg.eigvalsh(precision) > 0):
            pull = np.linalg.solve(width, values) - moved * middle / scale**2
            values, width = np.linalg.solve(precision, pull), np.linalg.inv(precision)
    wide = UNKNOWN * np.eye(len(assembly.hypers))
    wide[np.ix_(at, at)] = width
    names = [assembly.hypers[i].name for i in at]
    return dict(zip(names, values.tolist(), strict=True)), wide


def starts(
    assembly: Assembly,
    near: Assembly,
    known: Mapping[str, float],
    hints: Sequence[Mapping[str, float]],
) -> list[Float[np.ndarray, "d"]]:
    """Coordinates to begin at: the other structure's, the hints, and others along each shape.

    Args:
        assembly: the structure to fit.
        near: the other one.
        known: its φ̂ by name, as `carried`.
        hints: coordinates by name.
    """
    names, priors = [h.name for h in assembly.hypers], {h.name: h.prior for h in near.hypers}
    here = {n: known.get(n, 0.0) for n in names}
    found = [here, *({**here, **{n: v for n, v in hint.items() if n in names}} for hint in hints)]
    for h in assembly.hypers:
        # Shapes are tried to either side, as a neighbour's effects may have shifted them; a spread or a parameter of
        # the noise that is new, below and above its scale.
        further: tuple[float, ...] = ()
        if h.kind == "shape" and h.name in known:
            same = h.prior == priors[h.name]
            further = (here[h.name] - 1.0, here[h.name] + 1.0) if same else (0.0,)
        elif h.kind in ("group_sd", "noise") and h.name not in known:
            further = (-1.5, 1.0)
        found += [{**here, h.name: v} for v in further]
    return [np.array([start[n] for n in names]) for start in found]
