"""A user's NumPyro program, traced: its sites, and their densities as functions of two flat vectors.

x holds the Gaussian sites that are integrated out, v the coordinates of all others, unconstrained as NumPyro's own
samplers see them (`biject_to` of each site's support). Nothing here decides which is which: see `_program_affine`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import numpyro.primitives
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer import init_to_uniform

from bayescal._core.errors import ModelError
from bayescal._core.jax_setup import configure_jax

configure_jax()

VOLUME = "_{}_log_volume"  # site that carries the Jacobian of a coordinate
Trace = Mapping[str, Any]


class Site(NamedTuple):
    """What is known of a site without its numbers.

    Attributes:
        name: the user's.
        shape: of its value.
        free: shape of its unconstrained coordinates; None for an observed one.
        law: name of its distribution, Normal for `Normal(…).expand(…).to_event(…)`.
        gaussian: whether its density is that of a Gaussian.
        improper: whether its density has no integral.
        dims: a name for each axis of `shape` that a plate names, else None.
    """

    name: str
    shape: tuple[int, ...]
    free: tuple[int, ...] | None
    law: str
    gaussian: bool
    improper: bool
    dims: tuple[str | None, ...]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return int(np.prod(self.free)) if self.free is not None else 0


@dataclass(frozen=True, eq=False)
class Program:
    """A model with its arguments, and what it samples.

    Attributes:
        run: the user's model, its arguments bound.
        name: of the user's function.
        latent, observed: sites in the order of the program; `numpyro.factor` counts as observed.
        loops: it holds a `scan` or another primitive of control flow.
    """

    run: Callable[[], Any]
    name: str
    latent: tuple[Site, ...]
    observed: tuple[Site, ...]
    loops: bool

    @property
    def improper(self) -> bool:
        return any(site.improper for site in self.latent)


class Factor(NamedTuple):
    """A Gaussian site: what is left of its value after its location, and its scale (a root, if it has a covariance)."""

    rest: Array  # value − location, (…,) or (…, d)
    root: Array  # standard deviation, shape of rest; or lower triangular, (…, d, d)

    def white(self) -> tuple[Float[Array, "n"], Float[Array, ""]]:
        """Residuals in standard deviations, and log |covariance|."""
        if self.root.ndim == self.rest.ndim:
            return jnp.ravel(self.rest / self.root), 2 * jnp.sum(jnp.log(self.root))
        white = solve_triangular(self.root, self.rest[..., None], lower=True)
        return jnp.ravel(white), 2 * jnp.sum(jnp.log(jnp.diagonal(self.root, axis1=-2, axis2=-1)))


class Densities(NamedTuple):
    """The joint density at a point, site by site: Gaussian factors, and the log densities of all else."""

    gaussian: dict[str, Factor]
    other: dict[str, Array]


# Finding the sites.


def survey(model: Callable, readings: Any) -> Program:
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
    return Program(run, name, tuple(latent), tuple(observed), loops)


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
    return Site(name, shape, free, _law(law), factor_of(site) is not None, improper, tuple(dims))


def base_law(law: Any) -> Any:
    """A distribution without what only gives it more entries."""
    while isinstance(law, (dist.Independent, dist.ExpandedDistribution)):
        law = law.base_dist
    return law


def _law(law: Any) -> str:
    base = base_law(law)
    return "masked" if isinstance(base, dist.MaskedDistribution) else type(base).__name__


def _listed(sites: list[Site]) -> str:
    return ", ".join(repr(site.name) for site in sites)


# Evaluating them.


def draw_trace(run: Callable, key: Array, tame: bool = False) -> Trace:
    """The program with its unknowns drawn from their prior, or near the origin of their coordinates.

    Args:
        run: model without arguments.
        key: of the draws.
        tame: coordinates uniform within ±2; so are, in any case, those of improper sites.
    """

    def place(site):
        if site["type"] != "sample" or site["is_observed"]:
            return None
        if tame or isinstance(base_law(site["fn"]), dist.ImproperUniform):
            return init_to_uniform(site)
        return None

    seeded = handlers.seed(run, key)
    return handlers.trace(handlers.substitute(seeded, substitute_fn=place)).get_trace()


def trace_at(program: Program, values: Mapping[str, Array], free: Mapping[str, Array]) -> Trace:
    """The program with all unknowns given: some by value, some by their unconstrained coordinates."""

    def place(site):
        name = site["name"]
        if site["type"] != "sample" or name in values:
            return values.get(name)
        if name not in free:
            return None
        to = biject_to(site["fn"].support)
        value = to(free[name])
        volume = jnp.sum(to.log_abs_det_jacobian(free[name], value))
        numpyro.factor(VOLUME.format(name), volume)
        return value

    seeded = handlers.seed(program.run, jax.random.key(0))
    return handlers.trace(handlers.substitute(seeded, substitute_fn=place)).get_trace()


def factor_of(site: Any) -> Factor | None:
    """The Gaussian factor of a traced site; None where it is none, or is scaled or masked."""
    scale = site["scale"]
    law = base_law(site["fn"])
    if not (scale is None or (isinstance(scale, (int, float)) and scale == 1)):
        return None
    if type(law) not in (dist.Normal, dist.MultivariateNormal):
        return None
    shape = jnp.broadcast_shapes(site["fn"].shape(), jnp.shape(site["value"]))
    rest = jnp.broadcast_to(site["value"] - law.loc, shape)
    if type(law) is dist.Normal:
        return Factor(rest, jnp.broadcast_to(jnp.asarray(law.scale), shape))
    root = law.scale_tril
    return Factor(rest, jnp.broadcast_to(root, (*shape[:-1], *root.shape[-2:])))


def densities(program: Program, made: Trace) -> Densities:
    """The joint density of a trace, site by site; a coordinate's Jacobian belongs to its site."""
    owner = {VOLUME.format(site.name): site.name for site in program.latent}
    gaussian, other = {}, {}
    for name, site in made.items():
        if site["type"] != "sample":
            continue
        factor = factor_of(site)
        if factor is not None:
            gaussian[name] = factor
            continue
        terms = site["fn"].log_prob(site["value"])
        if site["scale"] is not None:
            terms = site["scale"] * terms
        home = owner.get(name, name)
        other[home] = other.get(home, 0.0) + jnp.sum(terms)
    return Densities(gaussian, other)


def free_of(program: Program, made: Trace) -> dict[str, Array]:
    """Unconstrained coordinates of the unknowns of a trace."""
    return {
        site.name: biject_to(made[site.name]["fn"].support).inv(made[site.name]["value"])
        for site in program.latent
    }
