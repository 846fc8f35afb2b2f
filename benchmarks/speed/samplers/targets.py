"""The log densities that samplers are given, of one model bound to its readings.

- *plain*: the NumPyro program, non-centred, as anyone would write it;
- *whitened*: exact, in coordinates whitened by the linearised model's posterior.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import bayescal as bc
from bayescal._inference import nuts_chains, sampled_products
from bayescal._inference.laplace import find_mode
from bayescal._inference.nuts import program
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from benchmarks.speed.samplers.peers import CHAINS, Target

SEED = 20261121


class BoundProblem(NamedTuple):
    """The model bound to its readings, as given and with what is promoted."""

    plain: Any
    layout: Any
    frame: Any
    y: jax.Array


def bound(model: bc.Model, readings: bc.Measurements) -> BoundProblem:
    plain, _ = bind(model, readings)
    frame = build_frame(readings, reference_of(readings))
    y = jnp.asarray(readings["output"])
    problem = Problem(plain, Record(plain.model.instrument, frame, y))
    return BoundProblem(plain, sampled_products.choose(problem, None)[0].layout, frame, y)


def _on_record(p: BoundProblem) -> Problem:
    return Problem(p.layout, Record(p.layout.model.instrument, p.frame, np.asarray(p.y)))


def plain_target(p: BoundProblem) -> Target:
    """The NumPyro program in its own unconstrained coordinates."""
    from numpyro.infer.util import initialize_model

    made = initialize_model(
        jax.random.split(jax.random.key(SEED), CHAINS), program(p.plain, p.frame), model_args=(p.y,)
    )
    first = jax.tree.map(lambda a: a[0], made.param_info.z)
    unravel = ravel_pytree(first)[1]
    start = jax.vmap(lambda z: ravel_pytree(z)[0])(made.param_info.z)

    def unknowns(q: jax.Array) -> jax.Array:
        sites = made.postprocess_fn(unravel(q))
        return jnp.concatenate([sites["x"], sites["v"]])

    inner = {
        n: np.full(np.size(a), n not in {h.name for h in p.plain.hypers}) for n, a in first.items()
    }
    latent = np.concatenate(
        [inner[name] for name in sorted(inner)]
    )  # the order in which they are ravelled
    return Target(lambda q: -made.potential_fn(unravel(q)), start, unknowns, latent)


def whitened_target(p: BoundProblem) -> Target:
    """The exact log density in our whitened coordinates."""
    problem = _on_record(p)
    density, unpack, centre, covariance = nuts_chains.whitened(problem, find_mode(problem))
    root = jnp.linalg.cholesky(covariance)
    noise = jax.random.normal(jax.random.key(SEED), (CHAINS, centre.size))

    def unknowns(q: jax.Array) -> jax.Array:
        x, v, _ = unpack(centre + root @ q)
        return jnp.concatenate([x, v])

    none = np.zeros(centre.size, bool)
    return Target(lambda q: density(centre + root @ q), 0.5 * noise, unknowns, none)


TARGETS = {"plain": plain_target, "whitened": whitened_target}


def in_plain_order(plain: Any, layout: Any, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Draws of all unknowns in the order of the plain layout's (x, v)."""
    at = {h.name: i for i, h in enumerate(layout.hypers)}
    own = {b.name: b for b in layout.x_blocks}
    columns = []
    for b in plain.x_blocks:
        if b.name in own:
            columns.append(x[:, own[b.name].start : own[b.name].start + b.size])
        else:
            for name in b.member_names():
                h = layout.hypers[at[name]]
                columns.append(np.asarray(h.prior.value(jnp.asarray(v[:, at[name]])))[:, None])
    columns += [v[:, [at[h.name]]] for h in plain.hypers]
    return np.concatenate(columns, axis=1)
