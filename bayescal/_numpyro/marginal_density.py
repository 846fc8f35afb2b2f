"""The density of a program's sampled sites with its Gaussian ones integrated out, its mode, and weighted draws.

Given v, every Gaussian site and reading leaves a residual e(x) = e₀ + A·(x − c) in standard deviations, prior and
likelihood alike, hierarchies included. So ∫ exp(−½|e|²) dx follows from the QR factors of [A e₀], and x is drawn
back exactly. v is sampled in coordinates u, moved and scaled by draws from its prior.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from bayescal._core.gaussian_algebra import triangle
from bayescal._core.jit import compiled
from bayescal._core.parallel import over
from bayescal._inference import gaussian, importance_sampling, laplace
from bayescal._numpyro.gaussian_sites import Split

STARTS = 64  # prior draws, among which the start of the search for the mode is chosen
SCALES = 256  # prior draws that the coordinates are scaled by
LOG_2PI = 1.8378770664093453


class ProgramMode(NamedTuple):
    """Mode of u with x integrated out, x there, and the Gaussian fit.

    Attributes:
        v: û, in the scaled coordinates. (Named as in `laplace.Mode`, of which importance sampling asks the same.)
        covariance: of u.
        log_density: log p(y, û).
        log_evidence: Laplace.
        x: mean of x given û.
        centre, width: v = centre + width·u.
    """

    v: Float[Array, "d"]
    covariance: Float[Array, "d d"]
    log_density: Float[Array, ""]
    log_evidence: Float[Array, ""]
    x: Float[Array, "p"]
    centre: Float[Array, "d"]
    width: Float[Array, "d"]


class ProgramDraws(NamedTuple):
    """Joint draws with their log weights, neither normalised nor smoothed.

    Attributes:
        x, v: of each draw, v in the program's own unconstrained coordinates.
        log_weight: true joint density over that which the draw came from.
        left_out: what the Gaussian form leaves out of the log joint density: rounding, if the split is right.
    """

    x: Float[Array, "s p"]
    v: Float[Array, "s d"]
    log_weight: Float[Array, "s"]
    left_out: Float[Array, "s"]


def log_joint(split: Split, x: Array, v: Array) -> Float[Array, ""]:
    """log p(y, x, v), from the program as it is."""
    found = split.densities(x, v)
    total = sum(found.other.values(), start=jnp.zeros(()))
    for factor in found.gaussian.values():
        white, logdet = factor.white()
        total = total - 0.5 * (white @ white + logdet + white.size * LOG_2PI)
    return total


def conditional_function(split: Split, centre: Float[Array, "p"]):
    """A function of v that gives log p(y, v) and x given v.

    Readings that share one scale and whose location does not move with v are summed up once, by the triangle of
    their QR factors: what follows does not grow with their number.

    Args:
        split: of the program.
        centre: c, where residuals are taken.
    """
    size = split.size
    zero = jnp.zeros(split.dim)

    def rests(x):
        found = split.densities(x, zero).gaussian
        return {name: jnp.ravel(found[name].rest) for name in split.fixed}

    def reduced(rest, slope):
        table = jnp.column_stack([slope, rest])
        return triangle(table) if len(table) > size + 1 else table

    tables, entries = {}, {}
    if split.fixed:
        here = rests(centre)
        entries = {name: rest.size for name, rest in here.items()}
        tables = jax.tree.map(reduced, here, jax.jacfwd(rests)(centre))

    def parts(x, v):
        found = split.densities(x, v)
        logdet = jnp.zeros(())
        white, scales = [], {}
        for name, factor in found.gaussian.items():
            if name in split.fixed:
                scales[name] = jnp.ravel(factor.root)[0]
                continue
            own, volume = factor.white()
            white.append(own)
            logdet = logdet + volume
        white = jnp.concatenate(white)
        other = sum(found.other.values(), start=jnp.zeros(()))
        return white, (white, logdet, scales, other)

    flat = gaussian.Prior(jnp.zeros(size), jnp.ones(size), jnp.zeros(size))

    def conditional(v: Float[Array, "d"]) -> tuple[Float[Array, ""], gaussian.Conditional]:
        slope, (white, logdet, scales, other) = jax.jacfwd(parts, has_aux=True)(centre, v)
        slopes, residuals = [slope], [white]
        for name, table in tables.items():
            slopes.append(table[:, :size] / scales[name])
            residuals.append(table[:, size] / scales[name])
            logdet = logdet + 2 * entries[name] * jnp.log(scales[name])
            logdet = logdet + (entries[name] - len(table)) * LOG_2PI
        found = gaussian.condition_white(
            -jnp.concatenate(slopes), jnp.concatenate(residuals), logdet, flat, centre
        )
        total = found.log_marginal + other
        return jnp.where(jnp.isfinite(total), total, -1e300), found

    return conditional


def density_of_u(split: Split, mode: ProgramMode):
    """log p(y, u) as a function of the scaled coordinates, with x given u."""
    conditional = conditional_function(split, mode.x)
    volume = jnp.sum(jnp.log(mode.width))

    def density(u):
        value, found = conditional(mode.centre + mode.width * u)
        return value + volume, found

    return density


def find_mode(split: Split, key: Array) -> ProgramMode:
    """The mode of u, by BFGS from the best of some prior draws; the fit there. Traceable."""
    draws = over(split.draw_v, jax.random.split(key, SCALES), SCALES)
    low, centre, high = jnp.quantile(draws, jnp.asarray([0.16, 0.5, 0.84]), axis=0)
    width = jnp.where(high > low, 0.5 * (high - low), 1.0)
    first = ProgramMode(
        v=jnp.zeros(split.dim),
        covariance=jnp.zeros((split.dim, split.dim)),
        log_density=jnp.asarray(jnp.nan),
        log_evidence=jnp.asarray(jnp.nan),
        x=jnp.zeros(split.size),
        centre=centre,
        width=width,
    )
    density = density_of_u(split, first)
    u = first.v
    if split.dim:
        starts = jnp.concatenate([u[None], ((draws - centre) / width)[:STARTS]])
        u = starts[jnp.argmax(over(lambda u: density(u)[0], starts, 16))]
        solver = optx.BFGS(rtol=1e-8, atol=1e-8)
        found = optx.minimise(lambda u, _: -density(u)[0], solver, u, max_steps=256, throw=False)
        u = jnp.where(jnp.all(jnp.isfinite(found.value)), found.value, u)
    value, given = density(u)
    if not split.dim:
        return first._replace(log_density=value, log_evidence=value, x=given.mean)
    covariance, volume, _ = laplace.gaussian_fit(lambda u: density(u)[0], u)
    return first._replace(
        v=u,
        covariance=covariance,
        log_density=value,
        log_evidence=value + volume,
        x=given.mean,
    )


compiled_mode = compiled(find_mode)


def draw_back(split: Split, mode: ProgramMode, density, u: Array, key: Array):
    """x given u, log p(y, u), and by how much the true joint density differs from the Gaussian form."""
    value, found = density(u)
    normal = jax.random.normal(key, (split.size,))
    x = found.place(normal)
    of_x = -found.log_jacobian - 0.5 * (normal @ normal + split.size * LOG_2PI)
    v = mode.centre + mode.width * u
    true = log_joint(split, x, v) + jnp.sum(jnp.log(mode.width))
    return x, v, value, true - (value + of_x)


@compiled
def sample(
    split: Split, mode: ProgramMode, key: Array, proposals: int, rounds: int
) -> ProgramDraws:
    """Adaptive importance sampling of u, with x drawn back; weights are those of the true joint density."""
    density = density_of_u(split, mode)
    adapt_key, draw_key, place_key = jax.random.split(key, 3)
    u, log_proposal = importance_sampling.explore(
        mode,
        lambda u: density(u)[0],
        _prior_share(split, mode),
        (adapt_key, draw_key),
        proposals,
        rounds,
    )
    keys = jax.random.split(place_key, proposals)
    x, v, value, left_out = over(
        lambda a: draw_back(split, mode, density, *a), (u, keys), importance_sampling.BATCH
    )
    some = jnp.isfinite(left_out)
    x, left_out = jnp.where(some[:, None], x, mode.x), jnp.where(some, left_out, -1e300)
    return ProgramDraws(x, v, value - log_proposal + left_out, left_out)


@compiled
def draws_back(split: Split, mode: ProgramMode, u: Float[Array, "s d"], key: Array):
    """x and v of draws of u, log p(y, u), and what was left out."""
    density = density_of_u(split, mode)
    keys = jax.random.split(key, len(u))
    return over(lambda a: draw_back(split, mode, density, *a), (u, keys), importance_sampling.BATCH)


def _prior_share(split: Split, mode: ProgramMode) -> importance_sampling.PriorShare | None:
    """The prior of u, where it can be drawn from without x."""
    if not split.dim or not split.separate or any(s.improper for s in split.outside):
        return None
    names = {site.name for site in split.outside}
    volume = jnp.sum(jnp.log(mode.width))

    def draw(key, count):
        v = jax.vmap(split.draw_v)(jax.random.split(key, count))
        return (v - mode.centre) / mode.width

    def log_density(u):
        found = split.densities(mode.x, mode.centre + mode.width * u)
        total = volume
        for name in names & set(found.other):
            total = total + found.other[name]
        for name in names & set(found.gaussian):
            white, logdet = found.gaussian[name].white()
            total = total - 0.5 * (white @ white + logdet + white.size * LOG_2PI)
        return total

    return importance_sampling.PriorShare(
        draw, lambda u: over(log_density, u, importance_sampling.BATCH)
    )


@compiled
def values_of(split: Split, x: Float[Array, "s p"], v: Float[Array, "s d"]) -> dict[str, Array]:
    """Every unknown and every `numpyro.deterministic`, in the program's own units and shapes."""
    names = {site.name for site in split.program.latent}

    def one(draw):
        made = split.trace(*draw)
        return {
            name: jnp.asarray(site["value"])
            for name, site in made.items()
            if name in names or site["type"] == "deterministic"
        }

    return over(one, (x, v), 64)
