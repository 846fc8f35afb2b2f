"""Products of unknowns: which coefficients to sample with φ.

Where the product of two unknowns matters against the noise, the expected output is not linear in both, but it is
linear in either one given the other. One of them then belongs to φ. It is chosen by the size of the
second-order term: the change of the Jacobian over one posterior standard deviation of a coefficient, carried by
the posterior of the others, in units of the noise.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.errors import ModelError
from bayescal._core.jit import compiled
from bayescal._inference import laplace
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import CoefficientBlock, Layout

THRESHOLD = 0.3  # root-sum-square over the readings, noise standard deviations
MOST = 6  # entries of φ that promotion may add
MEMBERS = 12  # a group coefficient with more members than this is not promoted


def choose(
    layout: Layout, frame: Frame, y: Float[Array, "n"], asked: tuple[str, ...] | None
) -> tuple[Layout, tuple[str, ...]]:
    """The layout with what must be promoted, and what to say about it.

    Raises:
        ModelError: a name that was asked for is no coefficient of the model.
    """
    if asked is not None:
        known = [b.name for b in layout.x_blocks]
        for name in asked:
            if name not in known:
                raise ModelError(
                    f"promote: nothing that could be promoted is called {name!r}; there is: {', '.join(known)}"
                )
        return layout.promote(*asked), ()
    if not is_nonlinear(layout, frame):
        return layout, ()
    notes: tuple[str, ...] = ()
    while True:
        candidates = [b for b in layout.x_blocks if b.coefficient.per is None or b.size <= MEMBERS]
        free = MOST - sum(h.kind == "promoted" for h in layout.hypers)
        candidates = [b for b in candidates if b.size <= free]
        if not candidates:
            return layout, notes
        mode = laplace.compiled_mode(layout, frame, y)
        sizes = np.asarray(_second_order(layout, frame, y, mode))
        strength = [
            float(np.sqrt(np.sum(sizes[b.start : b.start + b.size] ** 2))) for b in candidates
        ]
        # Either factor of a product will do. In units of a spread that is learned itself, a coefficient would make a
        # funnel with it, so such a one is only taken where no other matters.
        free_of_spread = [
            s * (b.coefficient.spread is None) for s, b in zip(strength, candidates, strict=True)
        ]
        best = int(np.argmax(free_of_spread))
        if free_of_spread[best] < THRESHOLD:
            best = int(np.argmax(strength))
        if strength[best] < THRESHOLD:
            return layout, notes
        chosen = _with_its_parts(candidates, strength, best, free)
        layout = layout.promote(*(b.name for b in chosen))
        several = len(chosen) > 1
        notes = (
            *notes,
            f"{', '.join(b.name for b in chosen)} {'are' if several else 'is'} sampled with the hyper-parameters: "
            f"{'the' if several else 'its'} product with other unknowns amounts to {strength[best]:.2g} noise "
            "standard deviations.",
        )
        if not is_nonlinear(layout, frame):
            return layout, notes


def _with_its_parts(
    candidates: list[CoefficientBlock], strength: list[float], best: int, free: int
) -> list[CoefficientBlock]:
    """A coefficient with the other parts of its effect in the same slot, nonlinear with it, where all fit in φ."""
    one = candidates[best]
    parts = [
        b
        for b, s in zip(candidates, strength, strict=True)
        if (b.effect is one.effect and b.slot == one.slot and s >= 0.1 * THRESHOLD) or b is one
    ]
    return parts if sum(b.size for b in parts) <= free else [one]


def is_nonlinear(layout: Layout, frame: Frame) -> bool:
    """Whether the expected output is anything but affine in the coefficients, tried at random points."""
    if not layout.size:
        return False
    return bool(_nonlinearity(layout, frame) > 1e-9)


@compiled
def _nonlinearity(layout: Layout, frame: Frame) -> Float[Array, ""]:
    keys = jax.random.split(jax.random.key(1), 3)
    hyper = forward.hyper_values(layout, jnp.zeros(len(layout.hypers)))
    sd = forward.prior_sd(layout, hyper)
    middle = forward.prior_mean(layout)
    rows = forward.row_sd(layout) * jax.random.normal(keys[0], (frame.size, len(layout.row_blocks)))

    def output(z, share):
        return forward.mean(layout, frame, middle + sd * z, share * rows, hyper)

    one, two = jax.random.normal(keys[1], sd.shape), jax.random.normal(keys[2], sd.shape)
    base, a, b = output(0 * one, 0.0), output(one, 1.0), output(two, 0.0)
    both = output(one + two, 1.0)
    scale = jnp.max(jnp.abs(a - base)) + jnp.max(jnp.abs(b - base)) + 1e-300
    return jnp.max(jnp.abs((both - base) - (a - base) - (b - base))) / scale


@compiled
def _second_order(layout: Layout, frame: Frame, y: Array, mode: laplace.Mode) -> Float[Array, "p"]:
    """For each entry of x the size of its products with the others, in noise standard deviations."""
    hyper = forward.hyper_values(layout, mode.v)
    found = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)(mode.v)[1]
    covariance = found.covariance
    root = jnp.linalg.cholesky(covariance + 1e-12 * jnp.diag(jnp.diag(covariance)))
    noise = jnp.sqrt(layout.model.noise.variance(hyper, frame))
    sd = jnp.sqrt(jnp.diag(covariance))

    def jacobians(x):
        line = forward.linearise(layout, frame, x, mode.point.rows, hyper)
        return line.jacobian, line.rows

    def size(direction):
        (d_x, d_rows) = jax.jvp(jacobians, (mode.point.x,), (direction,))[1]
        in_x = (d_x @ root) / noise[:, None]
        in_rows = d_rows * forward.row_sd(layout) / noise[:, None]
        return jnp.sqrt(jnp.sum(in_x**2) + jnp.sum(in_rows**2))

    return jax.lax.map(size, jnp.diag(sd))
