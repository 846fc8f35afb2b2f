"""A user's NumPyro program at a point: its sites' values and densities as functions of two flat vectors.

x holds the Gaussian sites that are integrated out, v the coordinates of all others, unconstrained as NumPyro's own
samplers see them (`biject_to` of each site's support). Nothing here decides which is which: see `gaussian_sites`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer import init_to_uniform

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
class TracedProgram:
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


class GaussianFactor(NamedTuple):
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

    gaussian: dict[str, GaussianFactor]
    other: dict[str, Array]


def base_law(law: Any) -> Any:
    """A distribution without what only gives it more entries."""
    while isinstance(law, (dist.Independent, dist.ExpandedDistribution)):
        law = law.base_dist
    return law


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


def trace_at(
    program: TracedProgram, values: Mapping[str, Array], free: Mapping[str, Array]
) -> Trace:
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


def factor_of(site: Any) -> GaussianFactor | None:
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
        return GaussianFactor(rest, jnp.broadcast_to(jnp.asarray(law.scale), shape))
    root = law.scale_tril
    return GaussianFactor(rest, jnp.broadcast_to(root, (*shape[:-1], *root.shape[-2:])))


def densities(program: TracedProgram, made: Trace) -> Densities:
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


def free_of(program: TracedProgram, made: Trace) -> dict[str, Array]:
    """Unconstrained coordinates of the unknowns of a trace."""
    return {
        site.name: biject_to(made[site.name]["fn"].support).inv(made[site.name]["value"])
        for site in program.latent
    }
