"""The sites of a user's NumPyro program, found by tracing it once without numbers."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
import numpyro.primitives
from numpyro.distributions.transforms import biject_to

from bayescal._core.errors import ModelError
from bayescal._numpyro.trace import Site, Trace, TracedProgram, base_law, draw_trace, factor_of


def survey(model: Callable, readings: Any) -> TracedProgram:
    """Trace a program once, without numbers, and name what it samples.

    Args:
        model: NumPyro program.
        readings: its arguments: a dict by name, a tuple or list in order, anything else as the only one.

    Raises:
        ModelError: the program does not take these readings, branches on an unknown, observes nothing, or has a
            site that no method here can sample.
    """
    name = getattr(model, "__name__", type(model).__name__)
    run = _bound(model, name, readings)
    found: list[tuple[list[Site], list[Site], bool]] = []

    def once(key):
        watch = _Watch(run)
        made = draw_trace(watch, key)
        found.append((*_sites(name, made), watch.loops))

    try:
        jax.eval_shape(once, jax.random.key(0))
    except jax.errors.ConcretizationTypeError as error:
        raise ModelError(
            f"The program {name!r} branches in Python on a value that is not known before sampling, or makes one "
            f"concrete: use jnp.where in place of `if`, and numpy on the data ({str(error).splitlines()[0]})"
        ) from error
    latent, observed, loops = found[0]
    if not observed:
        raise ModelError(
            f"The program {name!r} observes nothing: every one of its sites ({_listed(latent)}) is unknown. Give "
            "one of them obs=…, and the readings under the argument that it takes"
        )
    if not latent:
        raise ModelError(f"The program {name!r} has no unknown: each of its sites is observed")
    return TracedProgram(
        run=run, name=name, latent=tuple(latent), observed=tuple(observed), loops=loops
    )


def _bound(model: Callable, name: str, readings: Any) -> Callable[[], Any]:
    args, kwargs = (readings,), {}
    if isinstance(readings, dict):
        args, kwargs = (), readings
    elif isinstance(readings, (tuple, list)):
        args = tuple(readings)
    try:
        inspect.signature(model).bind(*args, **kwargs)
    except TypeError as error:
        came = ", ".join(map(str, kwargs)) if kwargs else f"{len(args)} in order"
        raise ModelError(
            f"The program {name}{inspect.signature(model)} does not take these readings ({came}): {error}. Give a "
            "dict by the names of its arguments, or a tuple in their order"
        ) from error
    return lambda: model(*args, **kwargs)


class _Watch(numpyro.primitives.Messenger):
    """Notes whether a program uses control flow, which a trace does not record."""

    def __init__(self, fn: Callable) -> None:
        super().__init__(fn)
        self.loops = False

    def process_message(self, msg) -> None:
        self.loops = self.loops or msg["type"] == "control_flow"


def _sites(program: str, made: Trace) -> tuple[list[Site], list[Site]]:
    latent, observed = [], []
    for name, site in made.items():
        if site["type"] == "param":
            raise ModelError(
                f"Site {name!r} of {program!r} is a numpyro.param, which has no prior: use numpyro.sample"
            )
        if site["type"] == "plate" and len(site["value"]) < site["args"][0]:
            raise ModelError(
                f"Plate {name!r} of {program!r} takes {len(site['value'])} of {site['args'][0]} at random: hand "
                "in all readings, without subsample_size"
            )
        if site["type"] != "sample":
            continue
        if site["is_observed"]:
            observed.append(_site(name, site))
        elif site["fn"].support.is_discrete:
            raise ModelError(
                f"Site {name!r} of {program!r} is discrete ({_law(site['fn'])}): sum over its values in the "
                "program, for instance by numpyro.distributions.MixtureSameFamily"
            )
        else:
            latent.append(_site(name, site))
    return latent, observed


def _site(name: str, site: Any) -> Site:
    shape = tuple(jnp.shape(site["value"]))
    law = site["fn"]
    free = None
    if not site["is_observed"]:
        free = tuple(biject_to(law.support).inverse_shape(shape))
    dims: list[str | None] = [None] * len(shape)
    for plate in site["cond_indep_stack"]:
        axis = len(shape) - len(law.event_shape) + plate.dim
        if 0 <= axis < len(shape) and shape[axis] == plate.size:
            dims[axis] = plate.name
    base = base_law(law)
    improper = isinstance(base, dist.ImproperUniform)
    return Site(
        name=name,
        shape=shape,
        free=free,
        law=_law(law),
        gaussian=factor_of(site) is not None,
        improper=improper,
        dims=tuple(dims),
    )


def _law(law: Any) -> str:
    base = base_law(law)
    return "masked" if isinstance(base, dist.MaskedDistribution) else type(base).__name__


def _listed(sites: list[Site]) -> str:
    return ", ".join(repr(site.name) for site in sites)
