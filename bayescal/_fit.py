"""One verb: fit a model to readings by a method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bayescal import _importance as importance
from bayescal import _promotion as promotion
from bayescal._calibration import Calibration
from bayescal._effect import Effect
from bayescal._errors import InputError, ModelError, NotConverged
from bayescal._frame import Frame, Reference, build_frame, reference_of
from bayescal._laplace import Mode
from bayescal._layout import Layout
from bayescal._marginal import Marginal, smoothed
from bayescal._measurements import Measurements
from bayescal._method import Method
from bayescal._model import Model
from bayescal._startup import spare_memory_maps
from bayescal._tree import build_tree, named

GROUPS = ("run", "cell", "axis", "device")


def fit(
    model: Model,
    readings: Measurements,
    method: Method | None = None,
    *,
    seed: int = 0,
    strict: bool = True,
    reference: Reference | None = None,
) -> Calibration:
    """Fit a model to readings.

    Args:
        model: an instrument, effects, a noise law.
        readings: measurements of that instrument.
        method: `Marginal()` if not given; or `LeastSquares()`, `NUTS()`.
        seed: of every random number; the same seed gives the same draws on the same machine.
        strict: raise if the fit did not converge; False returns it with its verdict.
        reference: constants of the bases, such as {"T0": 0.0}, to use in place of the data's own.

    Raises:
        ModelError: readings lack a column or have too few rows for the flat coefficients.
        NotConverged: the verdict is not good; carries the calibration.
    """
    spare_memory_maps()
    method = Marginal() if method is None else method
    model.require(readings)
    reference = {**reference_of(readings), **(reference or {})}
    layout, levels = bind(model, readings)
    frame = build_frame(readings, reference)
    outcome = method.run(layout, frame, jnp.asarray(readings["output"]), seed)
    tree = build_tree(outcome.layout, frame, readings, levels, outcome.draws, seed)
    calibration = Calibration(
        model,
        readings,
        tree,
        outcome.verdict,
        method.name,
        seed,
        reference,
        levels,
        outcome.layout,
        jax.tree.map(jnp.asarray, outcome.mode),
        outcome.log_evidence,
    )
    if strict and not outcome.verdict.ok:
        raise NotConverged(
            f"The fit of {', '.join(model.names)} to {readings.file} did not converge: "
            f"{' '.join(outcome.verdict.reasons)} (strict=False returns it all the same.)",
            calibration,
        )
    return calibration


def bind(model: Model, readings: Measurements) -> tuple[Layout, dict[str, tuple[str, ...]]]:
    """The model's layout for these readings, and the members of each group.

    Raises:
        ModelError: fewer readings than flat coefficients, or a group effect without its group.
    """
    levels = {group: readings.groups(group)[0] for group in GROUPS}
    counts = {**{g: len(names) for g, names in levels.items()}, "reading": len(readings)}
    layout = Layout(model, tuple(counts.items()))
    flat = sum(b.size for b in layout.x_blocks if b.coefficient.flat)
    if len(readings) <= flat:
        raise ModelError(
            f"{readings.file} has {len(readings)} readings for {flat} coefficients with a flat prior: "
            "measure more, take effects out, or give them a Normal prior"
        )
    if not model.noise.independent and layout.row_blocks:
        raise ModelError(
            f"Effect {layout.row_blocks[0].effect.name!r} has one coefficient for each reading, which is not "
            f"combined with {model.noise.law} noise: take the effect out, or use White() noise"
        )
    if not model.noise.independent and not readings.has("time"):
        raise ModelError(
            f"{model.noise.law} noise needs the column 'time', which {readings.file} lacks: record it, or use "
            "White() noise"
        )
    for b in layout.blocks:
        if b.size == 0:
            raise ModelError(
                f"Effect {b.effect.name!r} has one coefficient for each {b.coefficient.per}, and "
                f"{readings.file} has none: name them in a column, or take the effect out"
            )
    return layout, levels


@dataclass(frozen=True)
class Batch:
    """Weighted joint draws of many data sets, fitted in one compiled program.

    Attributes:
        layout: of the model, common to all.
        log_weight: (b, s), not normalised.
        x, v: (b, s, p) and (b, s, d).
        mode: φ̂ and x̂ of each.
        log_evidence: (b,).
        pareto_k: (b,).
    """

    layout: Layout
    levels: dict[str, tuple[str, ...]]
    log_weight: np.ndarray
    x: np.ndarray
    rows: np.ndarray
    v: np.ndarray
    mode: Mode
    log_evidence: np.ndarray
    pareto_k: np.ndarray

    def weights(self) -> np.ndarray:
        """Pareto-smoothed weights, summing to one for each data set, (b, s)."""
        return np.stack([smoothed(w)[0] for w in self.log_weight])

    def samples(self, index: int) -> dict[str, np.ndarray]:
        """Draws of every unknown of one data set, (s,) or (s, members), to be weighted."""
        made = named(
            self.layout, self.levels, *(a[index][None] for a in (self.x, self.rows, self.v))
        )
        return {str(name): made[name].values[0] for name in made}


def fit_batch(
    model: Model, readings: Sequence[Measurements], method: Marginal | None = None, *, seed: int = 0
) -> Batch:
    """Fit one model to many data sets of one shape, each on its own, without compiling anew.

    Args:
        model: must have Gaussian noise.
        readings: data sets with equal columns, numbers of rows and group sizes.
        method: `Marginal`, whose `proposals`, `rounds` and `promote` count.
        seed: of every random number.

    Raises:
        InputError: the data sets differ in shape.
        ModelError: the noise law is not Gaussian, or a name to promote is no coefficient of the model.
    """
    method = Marginal() if method is None else method
    if not model.noise.gaussian:
        raise ModelError(f"fit_batch needs Gaussian noise, not {model.noise.law}: fit one by one")
    bound = [bind(model, one) for one in readings]
    for one in readings:
        model.require(one)
    frames = [build_frame(one, reference_of(one)) for one in readings]
    shapes = {
        (str(jax.tree.map(jnp.shape, f)), b[0].counts) for f, b in zip(frames, bound, strict=True)
    }
    if len(shapes) != 1:
        raise InputError(
            f"fit_batch needs data sets of one shape; these {len(readings)} have {len(shapes)} different "
            "ones (rows, columns or group sizes differ)"
        )
    stacked: Frame = jax.tree.map(lambda *a: jnp.stack(a), *frames)
    ys = jnp.stack([jnp.asarray(one["output"]) for one in readings])
    layout, _ = promotion.choose(bound[0][0], frames[0], ys[0], method.promote or ())
    keys = jax.random.split(jax.random.key(seed), len(readings))
    found = importance.sample_batch(
        layout, stacked, ys, keys, method.proposals or 8192, method.rounds
    )
    k_hat = np.array([smoothed(np.asarray(w))[1] for w in found.log_weight])
    return Batch(
        layout,
        bound[0][1],
        np.asarray(found.log_weight),
        np.asarray(found.x),
        np.asarray(found.rows),
        np.asarray(found.v),
        jax.tree.map(np.asarray, found.mode),
        np.asarray(found.log_evidence),
        k_hat,
    )


def load(path: str | Path, *, effects: Sequence[Effect] = ()) -> Calibration:
    """Read a saved calibration.

    Its effects are resolved by name against the installed instruments and `effects`; nothing in the file is
    evaluated.

    Raises:
        InputError: not a calibration, another version, or an effect that is not installed.
    """
    from bayescal._store import load_calibration

    return load_calibration(Path(path), effects)
